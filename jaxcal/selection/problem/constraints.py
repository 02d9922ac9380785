"""Linear constraints on how often candidates are chosen: ``A w <= b``."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, Indices, array_of

_SLACK = 1e-9  # of the largest sum: rounding breaks no constraint


@dataclasses.dataclass(frozen=True, eq=False)
class Constraints:
    """``costs @ counts <= most``: r rules for M candidates."""

    costs: Array  # (r, M)
    most: Array  # (r,) with what rounding may add

    def broken(self, counts: Indices) -> str:
        """The first rule that counts (M,) break, in words; "" where none is."""
        total = self.costs @ counts
        for r in np.flatnonzero(total > self.most):
            return f"row {r} of A w is {total[r]:.6g}, more than {self.most[r]:.6g}"
        return ""

    def of(self, rows: Indices) -> Constraints:
        """Constraints on the candidates ``rows`` alone."""
        return Constraints(np.ascontiguousarray(self.costs[:, rows]), self.most)

    @functools.cached_property
    def order(self) -> NDArray[np.intp]:
        """(r, M) candidates, the cheapest first."""
        return np.argsort(self.costs, axis=1, kind="stable").astype(np.intp)

    def selection(self, k: int, lower: Indices, upper: Indices) -> Indices | None:
        """Counts (M,) of sum k within bounds that keep all rules; None: there are none.

        Raises:
            ValueError: the search for them did not end.
        """
        from scipy import optimize

        within = optimize.LinearConstraint(
            np.vstack([self.costs, np.ones(len(lower))]),
            np.append(np.full(len(self.most), -np.inf), k),
            np.append(self.most, k),
        )
        counts = optimize.milp(
            np.zeros(len(lower)),
            integrality=np.ones(len(lower)),
            bounds=optimize.Bounds(lower, upper),
            constraints=within,
            options={"time_limit": 60.0},
        )
        if counts.status not in (0, 2):
            raise ValueError(
                f"constraints could not be checked for a selection: {counts.message}"
            )
        return None if counts.x is None else np.rint(counts.x).astype(np.int64)


def checked_constraints(given: Any, count: int) -> Constraints | None:
    """``(A, b)`` as given, A (r, M) or (M,) and b (r,) or a number."""
    if given is None:
        return None
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise ValueError("constraints must be a pair (A, b) with A w <= b")
    rule = ", a column for each candidate"
    costs = array_of("A of constraints", np.atleast_2d(given[0]), "r", count, rule=rule)
    most = array_of("b of constraints", np.atleast_1d(given[1]), len(costs))
    size = np.abs(most) + np.abs(costs).max(axis=1, initial=0.0)
    return Constraints(costs, most + _SLACK * size)
