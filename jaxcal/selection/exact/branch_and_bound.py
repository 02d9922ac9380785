"""Exact selection for any k by branch and bound on the concave relaxation.

Source: Ponte, Fampa and Lee, Branch-and-bound for integer D-Optimality with fast local
search and variable-bound tightening, arXiv 2302.07386. A node is closed when its bound
is within ``TOLERANCE`` of the incumbent, far above the rounding of either (1e-13), so
"proven" means: no selection is better by more than that.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["TOLERANCE", "BranchResult", "branch_and_bound"]

TOLERANCE = 1e-10  # of log det(Z.T Z); times m in log det S
_CHUNK = 16  # nodes between looks at the clock, where there is a deadline
_ALL = 1 << 40
_MEMORY = 64 * 2**20  # bytes of open nodes up to which the best bound goes first

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class BranchResult:
    """The best selections within the counts, and how far they can be from optimal."""

    counts: Indices  # (found, M), best first
    values: Array  # (found,) log det(X_s.T X_s)
    bound: float  # of every selection that is not listed, or of the best
    nodes: int
    proven: bool


def branch_and_bound(
    rows: Array,
    lower: Indices,
    upper: Indices,
    start: Indices,
    best: int = 1,
    deadline: float | None = None,
) -> BranchResult:
    """The ``best`` selections by log det, with proof.

    Args:
        rows: (M, p) whitened regressors.
        lower: (M,) least counts.
        upper: (M,) largest counts.
        start: (M,) counts of a good selection, sum k.
        best: how many selections.
        deadline: ``time.perf_counter()`` at which to stop with what there is.
    """
    from jaxcal.information.linear_algebra import factor, gram_of
    from jaxcal.selection.exact import branch_kernel as kernel

    num_rows, p = rows.shape
    k = int(start.sum())
    rows = np.ascontiguousarray(rows)
    gram, inverse = np.empty((p, p)), np.empty((p, p))
    best_counts = np.zeros((best, num_rows), dtype=np.int64)
    best_values = np.full(best, -np.inf)
    gram_of(rows, start, gram)
    kernel.offer(start, factor(gram, inverse), best_counts, best_values)
    if best > 1:
        kernel.offer_swaps(rows, lower, upper, start.copy(), best_counts, best_values)
    low, high, weights = lower.copy(), upper.copy(), start.astype(np.float64)
    root, branch = kernel.process(
        rows, np.ascontiguousarray(rows.T), low, high, weights, k, TOLERANCE,
        best_counts, best_values, gram, inverse, np.empty((2, num_rows)),
    )  # fmt: skip
    nodes, proven, bound = 1, True, float(best_values[0])
    if branch >= 0:
        # Incumbents may use what the root rules out as no better than they are.
        alive = np.flatnonzero((high > 0) | best_counts.any(axis=0))
        few = np.ascontiguousarray(best_counts[:, alive])
        few_nodes, proven, bound = _search(
            rows[alive], low[alive], high[alive], weights[alive], k, root,
            few, best_values, deadline,
        )  # fmt: skip
        nodes += few_nodes
        best_counts[:, alive] = few
    found = np.isfinite(best_values)
    return BranchResult(best_counts[found], best_values[found], bound, nodes, proven)


def _search(
    rows: Array,
    low: Indices,
    high: Indices,
    weights: Array,
    k: int,
    root: float,
    best_counts: Indices,
    best_values: Array,
    deadline: float | None,
) -> tuple[int, bool, float]:
    """Drive the compiled search, growing its room and watching the clock."""
    from jaxcal.selection.exact.branch_kernel import search

    num_rows = len(rows)
    columns = np.ascontiguousarray(rows.T)
    widest = max(256, _MEMORY // (24 * num_rows))
    room = 64
    lows = np.empty((room, num_rows), dtype=np.int64)
    highs = np.empty((room, num_rows), dtype=np.int64)
    points = np.empty((room, num_rows))
    bounds = np.empty(room)
    lows[0], highs[0], points[0], bounds[0] = low, high, weights, root
    size, nodes = 1, 0
    while size:
        if deadline is not None and time.perf_counter() > deadline:
            return nodes, False, float(max(bounds[:size].max(), best_values[0]))
        if size + 2 > room:
            room *= 2
            lows, highs, points = (_grown(a, room) for a in (lows, highs, points))
            bounds = _grown(bounds, room)
        size, done = search(
            rows, columns, k, TOLERANCE, lows, highs, points, bounds, size,
            best_counts, best_values, widest, _ALL if deadline is None else _CHUNK,
        )  # fmt: skip
        nodes += done
    return nodes, True, float(best_values[0])


def _grown(array: NDArray[Any], room: int) -> NDArray[Any]:
    grown = np.empty((room, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown
