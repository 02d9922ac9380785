"""What every solver returns."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Indices, aligned, axis_names, lasted
from jaxcal.information.blocks import rank_of_blocks
from jaxcal.late import late
from jaxcal.selection.problem import Problem

if TYPE_CHECKING:
    from jaxcal.information.criteria import Criteria
    from jaxcal.selection.in_scenarios import ScenarioTable


class Subset(NamedTuple):
    """One subset and its worth."""

    indices: Indices  # (k,)
    value: float  # of the criterion
    log_det: float  # natural log det S, whatever the criterion


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Selection:
    """The chosen candidates, the method and their quality; ``print`` shows a table.

    ``bound``, ``gap``, ``efficiency`` and ``criteria`` are computed when first read.
    """

    indices: Indices  # (k,) into the candidates, in the order picked
    value: float  # of the criterion, in the caller's units
    log_det: float  # natural log det S, the value of D, whatever the criterion
    method: str  # the solver that answered, or "score" for a subset made elsewhere
    proven: bool  # True: no selection is better by more than 1e-9
    seconds: float  # wall time of the solver
    problem: Problem
    reason: str = ""  # of auto, one sentence: why this answer is good enough
    seed: int | None = None  # where the solver draws at random
    restarts: int | None = None  # random starts of the exchange
    nodes: int | None = None  # nodes of branch and bound or of the search
    alternatives: tuple[Subset, ...] = ()  # the best subsets, best first
    known_bound: float | None = None  # bound, where the solver gave one
    names: tuple[str, ...] | None = None  # (M,) of the candidates, the caller's own
    axes: tuple[str, ...] | None = None  # (n,) of the inputs, the caller's own

    def __post_init__(self) -> None:
        for indices in (self.indices, *(each.indices for each in self.alternatives)):
            indices.flags.writeable = False

    @property
    def criterion(self) -> str:
        """Name in ``CRITERIA``, as D or I; of scenarios "Mean(D)"."""
        return self.problem.criterion.name

    @property
    def labels(self) -> tuple[str, ...]:
        """(k,) names of the chosen; their indices where the caller gave none."""
        chosen = self.indices.tolist()
        return tuple(str(i) if self.names is None else self.names[i] for i in chosen)

    @cached_property
    def bound(self) -> float:
        """Bound on the value of every allowed selection: upper, for A, As, I lower.

        The optimum where the solver proved it or ``score`` was asked to, or where
        k = n + 1 makes it cheap; otherwise the concave relaxation.
        """
        bound = self.known_bound
        if bound is None:
            from jaxcal.selection.exact.exact import upper_bound

            bound = upper_bound(self.problem)
        better = max if self.problem.criterion.larger_is_better else min
        return better(bound, self.value)

    @property
    def gap(self) -> float:
        """How far the value is from ``bound``, zero where optimality is proven."""
        return abs(self.bound - self.value)

    @property
    def efficiency(self) -> float:
        """Lower limit of the efficiency against the best selection, from ``bound``.

        ``exp((value - bound) / s)`` for s parameters of interest (D, Ds), else a ratio.
        """
        return self.problem.criterion.efficiency(self.value, self.bound)

    @cached_property
    def in_scenarios(self) -> ScenarioTable | None:
        """The efficiency in each scenario; None where there is one only."""
        joint = self.problem.joint
        if joint is None or self.criterion == "G":
            return None
        from jaxcal.selection.in_scenarios import in_scenarios

        return in_scenarios(joint, self.indices)

    @cached_property
    def criteria(self) -> Criteria:
        """D, A, I, E, G and O1 to O5; I and G over the available candidates."""
        from jaxcal.information.criteria import criteria

        problem = self.problem
        chosen, region = problem.raw[self.indices], problem.readings[problem.available]
        return criteria(chosen, problem.root, region, problem.multiplicity)

    @cached_property
    def left_without(self) -> NDArray[np.float64]:
        """(k,) det S without each of the chosen, as a share of det S; 0 is singular.

        Of scenarios the least over them.
        """
        members = self.problem.members
        shares = [_shares_without(member, self.indices) for member in members]
        return np.asarray(np.min(shares, axis=0))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, text and lists, as a JSON file takes them."""
        candidates = self.problem.candidates
        chosen = None if candidates is None else candidates[self.indices].tolist()
        content = {
            "indices": self.indices.tolist(),
            "labels": list(self.labels),
            "candidates": chosen,
            "criterion": self.criterion,
            "value": self.value,
            "log_det": self.log_det,
            "bound": self.bound,
            "efficiency": self.efficiency,
            "proven": self.proven,
            "left_without": self.left_without.tolist(),
            "method": self.method,
            "reason": self.reason,
            "seconds": self.seconds,
            "seed": self.seed,
        }
        if self.in_scenarios is not None:
            content["in_scenarios"] = {
                name: None if value is None else value.tolist()
                for name, value in vars(self.in_scenarios).items()
            }
        return content

    @property
    def _noun(self) -> str:
        """What a measurement is called in the table."""
        return "candidate"

    def _axes(self) -> tuple[str, ...]:
        assert self.problem.candidates is not None
        count = self.problem.candidates.shape[1]
        return self.axes or axis_names("names", None, "u", count)

    def _lost(self) -> str:
        """What is left of det S where one measurement fails, in words."""
        needed = np.flatnonzero(self.left_without == 0.0)
        if len(needed) == len(self.indices):
            return "singular, whichever measurement is lost"
        names = [self.labels[i] for i in needed]
        if len(names) > 1:
            return f"singular without any one of {self._noun}s {', '.join(names)}"
        if names:
            return f"singular without {self._noun} {names[0]}"
        worst = int(self.left_without.argmin())
        share, name = self.left_without[worst], f"{self._noun} {self.labels[worst]}"
        return f"losing {name} costs most: {100 * share:.3g} % of det S remains"

    def __str__(self) -> str:
        head = ["candidate"] + (["name"] if self.names is not None else [])
        cells = [[str(i)] for i in self.indices.tolist()]
        if self.names is not None:
            cells = [[*row, name] for row, name in zip(cells, self.labels, strict=True)]
        if self.problem.candidates is not None:
            head += self._axes()
            for row, i in zip(cells, self.indices, strict=True):
                row += [f"{x:.6g}" for x in self.problem.candidates[i]]
        count = int(self.problem.available.sum())
        side = "upper" if self.problem.criterion.larger_is_better else "lower"
        best = "proven optimal" if self.proven else f"{side} bound {self.bound:.6g}"
        share = self.problem.criterion.efficiency_name
        extra = "" if self.seed is None else f", seed {self.seed}"
        lines = [
            f"{len(self.indices)} of {count} candidates, method {self.method}",
            *aligned([head, *cells]),
            f"{self.problem.criterion.says:13} {self.value:.6g} ({best})",
            f"{share:13} {self.efficiency:.6f}" + ("" if self.proven else " or more"),
            *(() if self.in_scenarios is None else self.in_scenarios.summary()),
            f"{'without one':13} {self._lost()}",
            f"time          {lasted(self.seconds)}{extra}",
        ]
        return "\n".join(
            lines + ([f"reason        {self.reason}"] if self.reason else [])
        )

    __repr__ = __str__
    plot = late("jaxcal.reports.shown:plot_selection")
    _repr_html_ = late("jaxcal.reports.shown:as_html")


@dataclasses.dataclass(frozen=True, eq=False)
class BatchSelection:
    """One selection per candidate set."""

    indices: Indices  # (B, k)
    log_det: NDArray[np.float64]  # (B,) natural log det S
    proven: NDArray[np.bool_]  # (B,)
    bound: NDArray[np.float64]  # (B,) upper bound on log det S, inf where none is known
    nodes: Indices  # (B,) nodes examined, 0 where not counted
    method: str
    seconds: float  # wall time of the whole batch


def _shares_without(problem: Problem, indices: Indices) -> NDArray[np.float64]:
    """(k,) det S without each of the chosen (k,), as a share of det S."""
    k = len(indices)
    others = np.tile(indices, (k, 1))[~np.eye(k, dtype=np.bool_)].reshape(k, -1)
    if k == 1 and not len(problem.root):
        return np.zeros(1)
    log_det = rank_of_blocks(problem.raw[others], problem.root, problem.white.size)[1]
    return np.asarray(np.exp(problem.multiplicity * log_det - problem.log_det(indices)))
