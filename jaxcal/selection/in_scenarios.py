"""What a selection is worth in each scenario, and what the nominal's own would be.

An efficiency in a scenario is measured by the optimum of that scenario alone, which is
proven or bounded within a share of a time limit; where it is only bounded, the
efficiency is at least what is said.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, Indices
from jaxcal.deadline import Deadline
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.problem import Problem, ScenarioProblem

_LIMIT = 2.0  # seconds for the optima of all scenarios together
_LEAST_LIMIT = 0.02  # and at least of each
_ENOUGH = 0.999  # an efficiency that ends the search for an optimum


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

    @property
    def mean(self) -> float:
        """The weighted mean efficiency."""
        return float(self.weights @ self.efficiencies)

    def summary(self) -> list[str]:
        """Two lines: this design, and the nominal's own."""
        count = len(self.weights)
        bounded = (
            "" if self.proven.all() else f", {int(self.proven.sum())} of them proven"
        )
        lines = [
            f"scenarios     {count}, efficiency against the optimum of each{bounded}",
            f"  this one    least {self.least:.4f}, mean {self.mean:.4f}",
        ]
        if self.nominal_efficiencies is not None:
            other = self.nominal_efficiencies
            least, mean = other.min(), self.weights @ other
            lines.append(f"  nominal's   least {least:.4f}, mean {mean:.4f}")
        return lines

    def __str__(self) -> str:
        return "\n".join(self.summary())


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


def in_scenarios(problem: ScenarioProblem, indices: Indices) -> ScenarioTable:
    """A selection (k,) in each scenario."""
    optima, proven = optima_of(problem)
    values = problem.scenario_values(indices[None])[0][:, 0]
    better = np.maximum if problem.criterion.each.larger_is_better else np.minimum
    optima = better(optima, values)
    nominal = nominal_efficiencies = None
    if problem.nominal is not None:
        nominal = _optimum(problem.nominal, _LIMIT / 4.0)[0]
        nominal_efficiencies = _efficiencies(problem, nominal, optima)
    return ScenarioTable(
        weights=problem.weights,
        values=values,
        optima=optima,
        proven=proven,
        efficiencies=_efficiencies(problem, indices, optima),
        nominal_indices=nominal,
        nominal_efficiencies=nominal_efficiencies,
    )


def _efficiencies(problem: ScenarioProblem, indices: Indices, optima: Array) -> Array:
    """(S,) of a selection; 0 where it is singular."""
    values, log_dets = problem.scenario_values(indices[None])
    return np.array(
        [
            member.criterion.efficiency(value, best) if np.isfinite(log_det) else 0.0
            for member, value, log_det, best in zip(
                problem.members, values[:, 0], log_dets[:, 0], optima, strict=True
            )
        ]
    ).clip(0.0, 1.0)
