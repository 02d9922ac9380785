"""What every solver returns, and what it is worth in each scenario, by the optimum of
that scenario alone, which is proven or bounded within a share of a time limit.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, Indices, aligned, axis_names, lasted
from jaxcal.deadline import Deadline
from jaxcal.information.blocks import rank_of_blocks
from jaxcal.late import late
from jaxcal.selection.exact.exact import solve_exact, upper_bound
from jaxcal.selection.problem import Problem, ScenarioProblem

if TYPE_CHECKING:
    from jaxcal.information.criteria import Criteria

_LIMIT = 2.0  # seconds for the optima of all scenarios together
_LEAST_LIMIT = 0.02  # and at least of each
_ENOUGH = 0.999  # an efficiency that ends the search for an optimum


class Subset(NamedTuple):
    """One subset and its worth."""

    indices: Indices  # (k,)
    value: float  # of the criterion
    log_det: float  # natural log det S, whatever the criterion


@dataclasses.dataclass(frozen=True, eq=False)
class ScenarioTable:
    """A selection in each of S scenarios; printing it shows a table."""

    weights: Array  # (S,) of sum 1
    values: Array  # (S,) of the criterion
    optima: Array  # (S,) no selection of the scenario alone has a better value
    proven: NDArray[np.bool_]  # (S,) whether that is within 0.1 % of its optimum
    efficiencies: Array  # (S,) against ``optima``
    nominal_indices: Indices | None  # (k,) the design made at the nominal alone
    nominal_efficiencies: Array | None  # (S,) what it would have had; 0 is singular

    @property
    def least(self) -> float:
        """The smallest efficiency."""
        return float(self.efficiencies.min())

    def __str__(self) -> str:
        """This design, and the nominal's own."""
        count = f"{len(self.weights)}, efficiency against the optimum of each"
        if not self.proven.all():
            count += f", {int(self.proven.sum())} of them proven"
        lines = [f"scenarios     {count}"]
        both = self.efficiencies, self.nominal_efficiencies
        for name, shares in zip(("this one", "nominal's"), both, strict=True):
            if shares is not None:
                least, mean = shares.min(), self.weights @ shares
                lines.append(f"  {name:9}   least {least:.4f}, mean {mean:.4f}")
        return "\n".join(lines)


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
        """Bound on the value of every allowed selection: upper, for A, As, I lower. The
        optimum where it was proven or is cheap; otherwise the concave relaxation."""
        bound = self.known_bound
        if bound is None:
            bound = upper_bound(self.problem)
        better = max if self.problem.criterion.larger_is_better else min
        return better(bound, self.value)

    @property
    def gap(self) -> float:
        """How far the value is from ``bound``, zero where optimality is proven."""
        return abs(self.bound - self.value)

    @property
    def efficiency(self) -> float:
        """At least this efficiency, from ``bound``: ``exp((value - bound) / s)`` for s
        parameters of interest (D, Ds), else a ratio."""
        return self.problem.criterion.efficiency(self.value, self.bound)

    @cached_property
    def in_scenarios(self) -> ScenarioTable | None:
        """The efficiency in each scenario; None where there is one only."""
        problem = self.problem.joint
        if problem is None or self.criterion == "G":
            return None
        optima, proven = optima_of(problem)
        values = problem.scenario_values(self.indices[None])[0]
        better = np.maximum if problem.criterion.each.larger_is_better else np.minimum
        optima = better(optima, values[:, 0])
        shares = problem.efficiencies(values, optima)[:, 0].clip(0.0, 1.0)
        nominal = of_nominal = None
        if problem.nominal is not None:
            nominal = _optimum(problem.nominal, _LIMIT / 4.0)[0]
            values_then = problem.scenario_values(nominal[None])[0]
            of_nominal = problem.efficiencies(values_then, optima)[:, 0].clip(0.0, 1.0)
        return ScenarioTable(
            problem.weights, values[:, 0], optima, proven, shares, nominal, of_nominal
        )

    @cached_property
    def criteria(self) -> Criteria:
        """D, A, I, E, G and O1 to O5; I and G over the available candidates."""
        from jaxcal.information.criteria import criteria

        problem = self.problem
        chosen, region = problem.raw[self.indices], problem.readings[problem.available]
        return criteria(chosen, problem.root, region, problem.multiplicity)

    @cached_property
    def left_without(self) -> Array:
        """(k,) det S without each of the chosen, as a share of det S; 0 is singular; of
        scenarios the least."""
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
        }
        for name in ("criterion", "value", "log_det", "bound", "efficiency", "proven"):
            content[name] = getattr(self, name)
        content["left_without"] = self.left_without.tolist()
        for name in ("method", "reason", "seconds", "seed"):
            content[name] = getattr(self, name)
        if self.in_scenarios is not None:
            content["in_scenarios"] = {
                name: None if value is None else value.tolist()
                for name, value in vars(self.in_scenarios).items()
            }
        return content

    _noun: ClassVar[str] = "candidate"  # what a measurement is called in the table

    def _axes(self) -> tuple[str, ...]:
        assert self.problem.candidates is not None
        count = self.problem.candidates.shape[1]
        return self.axes or axis_names("names", None, "u", count)

    def _lost(self) -> str:
        """What is left of det S where one measurement fails, in words."""
        needed = np.flatnonzero(self.left_without == 0.0)
        if len(needed) == len(self.indices):
            return "singular, whichever measurement is lost"
        if len(needed):
            names = " or ".join(self.labels[i] for i in needed)
            return f"singular without {self._noun} {names}"
        worst = int(self.left_without.argmin())
        share, name = self.left_without[worst], f"{self._noun} {self.labels[worst]}"
        return f"losing {name} costs most: {100 * share:.3g} % of det S remains"

    def _table(self) -> list[str]:
        """What was chosen, a line each, under a title."""
        head = ["candidate"] + (["name"] if self.names is not None else [])
        cells = [[str(i)] for i in self.indices.tolist()]
        if self.names is not None:
            cells = [[*row, name] for row, name in zip(cells, self.labels, strict=True)]
        if self.problem.candidates is not None:
            head += self._axes()
            for row, i in zip(cells, self.indices, strict=True):
                row += [f"{x:.6g}" for x in self.problem.candidates[i]]
        count = int(self.problem.available.sum())
        title = f"{len(self.indices)} of {count} candidates, method {self.method}"
        return [title, *aligned([head, *cells])]

    def _limit(self) -> str:
        """The bound of the value, in words."""
        side = "upper" if self.problem.criterion.larger_is_better else "lower"
        return "proven optimal" if self.proven else f"{side} bound {self.bound:.6g}"

    def __str__(self) -> str:
        share = self.problem.criterion.efficiency_name
        extra = "" if self.seed is None else f", seed {self.seed}"
        lines = [
            *self._table(),
            f"{self.problem.criterion.says:13} {self.value:.6g} ({self._limit()})",
            f"{share:13} {self.efficiency:.6f}" + ("" if self.proven else " or more"),
            *(() if self.in_scenarios is None else [str(self.in_scenarios)]),
            f"{'without one':13} {self._lost()}",
            f"time          {lasted(self.seconds)}{extra}",
        ]
        return "\n".join(lines + [f"reason        {self.reason}"] * bool(self.reason))

    __repr__ = __str__
    plot = late("jaxcal.reports.shown:plot_selection")
    _repr_html_ = late("jaxcal.reports.shown:as_html")


def _shares_without(problem: Problem, indices: Indices) -> Array:
    """(k,) det S without each of the chosen (k,), as a share of det S."""
    k = len(indices)
    others = np.tile(indices, (k, 1))[~np.eye(k, dtype=np.bool_)].reshape(k, -1)
    if k == 1 and not len(problem.root):
        return np.zeros(1)
    log_det = rank_of_blocks(problem.raw[others], problem.root, problem.white.size)[1]
    return np.asarray(np.exp(problem.multiplicity * log_det - problem.log_det(indices)))


def _optimum(problem: Problem, limit: float) -> tuple[Indices, float, bool]:
    """A good selection, the value that none betters, and whether that is proven."""
    deadline = Deadline(limit)
    solution = solve_exact(problem, deadline=deadline, restarts=8, enough=_ENOUGH)
    assert solution.value is not None and solution.bound is not None
    share = problem.criterion.efficiency(solution.value, solution.bound)
    return solution.indices, solution.bound, solution.proven or share >= _ENOUGH


def optima_of(problem: ScenarioProblem) -> tuple[Array, NDArray[np.bool_]]:
    """(S,) values that no selection of a scenario betters, and which are proven."""
    limit = max(_LIMIT / len(problem.members), _LEAST_LIMIT)
    each = [_optimum(member, limit)[1:] for member in problem.members]
    return np.array([x for x, _ in each]), np.array([proven for _, proven in each])
