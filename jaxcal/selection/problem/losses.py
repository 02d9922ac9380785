"""Measurements that fail: the worst loss, and the mean over what arrives.

Where candidate i is lost its block is zero: one more scenario. The worst loss of a
selection is that of one of its own, and a loss of another leaves more, so the least
over some losses bounds the least over all from above, whatever they are.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of
from jaxcal.selection.criteria import LossCriterion, ScenarioCriterion
from jaxcal.selection.problem.problem import Problem
from jaxcal.selection.problem.scenario_problem import ScenarioProblem, fields_of

__all__ = ["Loss", "LossProblem", "checked_reliability", "with_arrivals", "with_losses"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Loss = tuple[int, ...]  # candidates that fail together

_MOST_FAILING = 6  # candidates that may fail of which every case counts
_DRAWS = 64  # of what arrives, where more may fail


@dataclasses.dataclass(frozen=True, eq=False)
class LossProblem(Problem):
    """Choose k candidates of which the worst few may fail.

    The attributes of a ``Problem`` are those of one where none is lost.
    """

    whole: Problem | None = None  # where none is lost; of several scenarios the worst
    lost: int = 1  # how many of the chosen fail

    @property
    def rank_one(self) -> bool:
        """False: the kernels of one reading per candidate count no losses."""
        return False

    @property
    def simplex(self) -> bool:
        """False: the search for the largest simplex counts no losses."""
        return False

    @property
    def unlost(self) -> Problem:
        """The problem where nothing is lost."""
        assert self.whole is not None
        return self.whole

    def of_size(self, k: int) -> Self:
        """This problem with k candidates to choose."""
        return dataclasses.replace(self, k=k, whole=self.unlost.of_size(k))

    def uncertainty(self, indices: Indices) -> float:
        """The largest with one loss, see ``Problem.uncertainty``."""
        return max(self.unlost.uncertainty(left) for left in self._left(indices))

    def log_det(self, indices: Indices) -> float:
        """log det S where none is lost; -inf if it is singular with a loss."""
        return float(self.values(np.asarray(indices)[None])[1][0])

    def _left(self, indices: Indices) -> Indices:
        """(L, k - lost) what each loss leaves of a selection (k,)."""
        kept = itertools.combinations(range(len(indices)), len(indices) - self.lost)
        return indices[np.array(list(kept), dtype=np.int64)]

    def values(self, indices: Indices) -> tuple[Array, Array]:
        """(R,) the value with the worst loss, and log det S with none lost."""
        values, log_dets = np.empty((2, len(indices)))
        worst = np.min if self.criterion.larger_is_better else np.max
        for r, chosen in enumerate(indices):
            value, log_det = self.unlost.values(self._left(chosen))
            values[r] = worst(value)
            whole = self.unlost.values(chosen[None])[1][0]
            log_dets[r] = whole if np.isfinite(log_det).all() else -np.inf
        return values, log_dets

    def losses_of(self, indices: Indices) -> set[Loss]:
        """Which may fail together, of a selection (k,)."""
        chosen = sorted(set(indices.tolist()))
        return set(itertools.combinations(chosen, self.lost))

    def among(self, losses: Collection[Loss]) -> Problem:
        """The problem where these losses are all there are: its optimum is a bound."""
        members, weights = [], []
        whole = getattr(self.unlost, "members", (self.unlost,))
        for member in whole:
            for loss in sorted(losses):
                members.append(_without(member, list(loss)))
                weights.append(1.0 / (len(losses) * len(whole)))
        fields = fields_of(members[0]) | {"criterion": self.criterion}
        return ScenarioProblem(
            **fields, members=tuple(members), weights=np.array(weights), told=False
        )


def _without(problem: Problem, missing: list[int]) -> Problem:
    """The problem where some candidates tell nothing."""
    blocks, raw = problem.white.blocks.copy(), problem.raw.copy()
    blocks[missing] = 0.0
    raw[missing] = 0.0
    white = problem.white._replace(blocks=blocks)
    return dataclasses.replace(problem, white=white, raw=raw)


def with_losses(problem: Problem, lost: int) -> Problem:
    """The problem where the worst ``lost`` of the chosen fail."""
    if problem.max_replicates > 1:
        raise ValueError(
            f"lost must come with max_replicates = 1, got {problem.max_replicates}"
        )
    criterion = problem.criterion
    if isinstance(problem, ScenarioProblem):
        if not problem.joined.least or problem.joined.of_efficiency:
            raise ValueError(
                "lost must come with jaxcal.Worst(...) over scenarios, got "
                f"{problem.joined.name}"
            )
        criterion = problem.joined.each
    fields = fields_of(problem) | {"criterion": LossCriterion(lost).within(criterion)}
    return LossProblem(**fields, whole=problem, lost=lost)


def checked_reliability(reliability: ArrayLike, count: int) -> Array:
    """(M,) probabilities that a candidate can be measured."""
    checked = array_of("reliability", reliability, count, rule=", one a candidate")
    wrong = (checked <= 0.0) | (checked > 1.0)
    if wrong.any():
        raise ValueError(
            f"reliability must be in (0, 1], got {checked[wrong][0]:g} for candidate "
            f"{np.flatnonzero(wrong)[0]}; leave out what cannot be measured with "
            "available"
        )
    return checked


def with_arrivals(
    problem: Problem, reliability: Array, criterion: ScenarioCriterion
) -> Problem:
    """The mean over what arrives: over draws of which candidates fail, by one seed."""
    if criterion.least:
        raise ValueError(
            "reliability must come with a mean over scenarios, got Worst; of the worst "
            "loss it is lost=1"
        )
    missing, chances = _arrivals(reliability)
    whole = getattr(problem, "members", (problem,))
    weights = getattr(problem, "weights", np.ones(1))
    members = [_without(one, lost) for one in whole for lost in missing]
    of_one = getattr(problem.criterion, "each", problem.criterion)
    fields = fields_of(problem) | {"criterion": criterion.within(of_one)}
    return ScenarioProblem(
        **fields,
        members=tuple(members),
        weights=np.outer(weights, chances).ravel(),
        told=False,
    )


def _arrivals(reliability: Array) -> tuple[list[list[int]], Array]:
    """Which candidates fail in each case, and the probabilities of the cases.

    Every case where at most six may fail; draws, equally likely, where more may.
    """
    failing = np.flatnonzero(reliability < 1.0)
    if len(failing) > _MOST_FAILING:
        arrives = np.random.default_rng(0).random((_DRAWS, len(reliability)))
        missing = [np.flatnonzero(row >= reliability).tolist() for row in arrives]
        return missing, np.full(_DRAWS, 1.0 / _DRAWS)
    cases = list(itertools.product([False, True], repeat=len(failing)))
    fails = np.array(cases, dtype=bool)
    chances = np.where(fails, 1.0 - reliability[failing], reliability[failing])
    return [failing[row].tolist() for row in fails], chances.prod(axis=1)
