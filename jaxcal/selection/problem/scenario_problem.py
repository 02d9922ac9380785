"""One choice for several scenarios of the parameters: their problems, joined.

Every scenario is a problem of its own, in its own coordinates; they share what may be
chosen. Sums and minima of concave functions are concave, so what proves a selection of
one problem proves that of several.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.criteria import ScenarioCriterion
from jaxcal.selection.problem.problem import Problem, values_of_one

__all__ = ["ScenarioProblem", "joined_problem"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class ScenarioProblem(Problem):
    """Choose k candidates so that a joined criterion is best.

    The attributes of a ``Problem`` are those of the first scenario.
    """

    members: tuple[Problem, ...] = ()  # (S,) the scenarios
    weights: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # (S,)
    optima: Array | None = None  # (S,) reported values, of a worst efficiency
    nominal: Problem | None = None  # at the model's nominal, where there is a model

    @property
    def joined(self) -> ScenarioCriterion:
        """The criterion."""
        assert isinstance(self.criterion, ScenarioCriterion)
        return self.criterion

    @property
    def rank_one(self) -> bool:
        """False: the kernels of one reading per candidate take one scenario."""
        return False

    @property
    def simplex(self) -> bool:
        """False: the search for the largest simplex takes one scenario."""
        return False

    def of_size(self, k: int) -> Self:
        """This problem with k candidates to choose."""
        members = tuple(member.of_size(k) for member in self.members)
        nominal = None if self.nominal is None else self.nominal.of_size(k)
        return dataclasses.replace(self, k=k, members=members, nominal=nominal)

    def uncertainty(self, indices: Indices) -> float:
        """The largest of the scenarios, see ``Problem.uncertainty``."""
        return max(member.uncertainty(indices) for member in self.members)

    def log_det(self, indices: Indices) -> float:
        """Weighted mean of log det S over the scenarios; -inf if one is singular."""
        return float(self.values(np.asarray(indices)[None])[1][0])

    def scenario_values(self, indices: Indices) -> tuple[Array, Array]:
        """(S, R) reported values and log det S of subsets (R, k) in each scenario."""
        both = np.array([values_of_one(member, indices) for member in self.members])
        return both[:, 0], both[:, 1]

    def values(self, indices: Indices) -> tuple[Array, Array]:
        """(R,) joined value, as reported, and mean log det S of subsets (R, k)."""
        of_members, log_dets = self.scenario_values(indices)
        regular = np.isfinite(log_dets).all(axis=0)
        joined = self.joined
        if joined.of_efficiency:
            assert self.optima is not None
            one, best = joined.each, self.optima
            of_members = np.array(
                [
                    [one.efficiency(x, best[s]) if np.isfinite(x) else 0.0 for x in row]
                    for s, row in enumerate(of_members)
                ]
            )
        if joined.least:
            value = of_members.min(0) if joined.larger_is_better else of_members.max(0)
        else:
            value = self.weights @ np.where(regular, of_members, 0.0)
        worst = -np.inf if joined.larger_is_better else np.inf
        log_det = self.weights @ np.where(regular, log_dets, 0.0)
        return np.where(regular, value, worst), np.where(regular, log_det, -np.inf)

    def terms(self) -> tuple[Array, Array]:
        """(S,) scale and shift of ``ScenarioCriterion.terms``."""
        criteria = [member.criterion for member in self.members]
        return self.joined.terms(criteria, self.optima)


def joined_problem(
    members: Sequence[Problem],
    weights: Array,
    criterion: ScenarioCriterion,
    nominal: Problem | None,
) -> Problem:
    """The problem of scenarios; where all are equal it is that of one, but
    for efficiencies.

    Args:
        members: (S,) problems that differ in blocks and prior only.
        weights: (S,) positive, of sum 1.
        criterion: as asked for.
        nominal: the problem at the model's nominal, where there is a model.
    """
    first, k = members[0], max(member.k for member in members)
    if not criterion.of_efficiency and all(
        (member.raw == first.raw).all() and np.array_equal(member.root, first.root)
        for member in members[1:]
    ):
        return first
    # The fewest that identify in every scenario, where k was not given.
    members = [one if one.k == k else one.of_size(k) for one in members]
    fields = {f.name: getattr(members[0], f.name) for f in dataclasses.fields(Problem)}
    fields["criterion"] = criterion.within(first.criterion)
    weights = np.array(weights)
    weights.flags.writeable = False
    if nominal is not None and nominal.k != k:
        nominal = nominal.of_size(k)
    return ScenarioProblem(
        **fields, members=tuple(members), weights=weights, nominal=nominal
    )
