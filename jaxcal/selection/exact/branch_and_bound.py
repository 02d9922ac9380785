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

__all__ = ["TOLERANCE", "BranchResult", "branch_and_bound", "relaxed_bound"]

TOLERANCE = 1e-10  # of log det of the blocks; times their multiplicity in log det S
_CHUNK = 16  # nodes between looks at the clock, where there is a deadline
_ALL = 1 << 40
_MEMORY = 64 * 2**20  # bytes of open nodes up to which the best bound goes first
_FREE = 3e6  # node x M q p^2 spent on a proof although ``enough`` is reached: 10 ms
_BOUND_SHARE = 0.01  # of its distance to the start, how far a bound is left from solved

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class BranchResult:
    """The best selections within the counts, and how far they can be from optimal."""

    counts: Indices  # (found, M), best first
    values: Array  # (found,) log det of the whitened information
    bound: float  # of every selection that is not listed, or of the best
    nodes: int
    proven: bool


def relaxed_bound(
    blocks: Array, prior: Array, lower: Indices, upper: Indices, start: Indices
) -> float:
    """Upper bound on log det within the counts; arguments as below."""
    from jaxcal.information.linear_algebra import factor, gram_of
    from jaxcal.selection.exact.branch_kernel import relax

    p = blocks.shape[2]
    gram, inverse = np.empty((p, p)), np.empty((p, p))
    gram_of(blocks, start, prior, gram)
    value, most, _ = relax(
        blocks, _columns(blocks), prior, lower, upper, start.astype(np.float64),
        int(start.sum()), factor(gram, inverse), _BOUND_SHARE, gram, inverse,
        np.empty((3, len(blocks))),
    )  # fmt: skip
    return float(value + p * np.log(most / p))


def branch_and_bound(
    blocks: Array,
    prior: Array,
    lower: Indices,
    upper: Indices,
    start: Indices,
    best: int = 1,
    deadline: float | None = None,
    enough: float = 0.0,
) -> BranchResult:
    """The ``best`` selections by log det, with proof.

    Args:
        blocks: (M, q, p) whitened, contiguous and writable (one compiled signature).
        prior: (p, p) precision in the same coordinates.
        lower: (M,) least counts.
        upper: (M,) largest counts.
        start: (M,) counts of a good selection, sum k.
        best: how many selections.
        deadline: ``time.perf_counter()`` at which to stop with what there is.
        enough: gap in log det at which to stop, once the proof has had a fair try.
    """
    from jaxcal.information.linear_algebra import factor, gram_of
    from jaxcal.selection.exact import branch_kernel as kernel

    num_blocks, q, p = blocks.shape
    k = int(start.sum())
    gram, inverse = np.empty((p, p)), np.empty((p, p))
    best_counts = np.zeros((best, num_blocks), dtype=np.int64)
    best_values = np.full(best, -np.inf)
    gram_of(blocks, start, prior, gram)
    kernel.offer(start, factor(gram, inverse), best_counts, best_values)
    low, high, weights = lower.copy(), upper.copy(), start.astype(np.float64)
    if best > 1:
        kernel.offer_swaps(
            blocks, prior, low, high, start.copy(), best_counts, best_values
        )
    root, branch = kernel.process(
        blocks, _columns(blocks), prior, low, high, weights, k, TOLERANCE,
        best_counts, best_values, gram, inverse, np.empty((3, num_blocks)),
    )  # fmt: skip
    nodes, proven, bound = 1, True, float(best_values[0])
    if branch >= 0:
        # Incumbents may use what the root rules out as no better than they are.
        alive = np.flatnonzero((high > 0) | best_counts.any(axis=0))
        few = np.ascontiguousarray(best_counts[:, alive])
        free = int(_FREE / (len(alive) * q * p * p)) if enough else _ALL
        few_nodes, proven, bound = _search(
            blocks[alive], prior, low[alive], high[alive], weights[alive], k, root,
            few, best_values, deadline, enough, free,
        )  # fmt: skip
        nodes += few_nodes
        best_counts[:, alive] = few
    found = np.isfinite(best_values)
    return BranchResult(best_counts[found], best_values[found], bound, nodes, proven)


def _columns(blocks: Array) -> Array:
    """(q, p, M)."""
    return np.ascontiguousarray(blocks.transpose(1, 2, 0))


def _search(
    blocks: Array,
    prior: Array,
    low: Indices,
    high: Indices,
    weights: Array,
    k: int,
    root: float,
    best_counts: Indices,
    best_values: Array,
    deadline: float | None,
    enough: float,
    free: int,
) -> tuple[int, bool, float]:
    """Drive the compiled search, growing its room and watching the clock.

    ``free`` nodes are searched before a gap of ``enough`` ends it.
    """
    from jaxcal.selection.exact.branch_kernel import search

    num_blocks = len(blocks)
    columns = _columns(blocks)
    widest = max(256, _MEMORY // (24 * num_blocks))
    room = 64
    lows = np.empty((room, num_blocks), dtype=np.int64)
    highs = np.empty((room, num_blocks), dtype=np.int64)
    points = np.empty((room, num_blocks))
    bounds = np.empty(room)
    lows[0], highs[0], points[0], bounds[0] = low, high, weights, root
    size, nodes = 1, 0
    while size:
        bound = float(max(bounds[:size].max(), best_values[0]))
        late = deadline is not None and time.perf_counter() > deadline
        if late or (nodes >= free and bound - best_values[0] <= enough):
            return nodes, False, bound
        if size + 2 > room:
            room *= 2
            lows, highs, points = (_grown(a, room) for a in (lows, highs, points))
            bounds = _grown(bounds, room)
        chunk = _CHUNK if deadline is not None or nodes >= free else free - nodes
        size, done = search(
            blocks, columns, prior, k, TOLERANCE, lows, highs, points, bounds, size,
            best_counts, best_values, widest, chunk,
        )  # fmt: skip
        nodes += done
    return nodes, True, float(best_values[0])


def _grown(array: NDArray[Any], room: int) -> NDArray[Any]:
    grown = np.empty((room, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown
