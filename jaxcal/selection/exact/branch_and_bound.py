"""Exact selection for any k and criterion by branch and bound on the relaxation.

Source: Ponte, Fampa and Lee, Branch-and-bound for integer D-Optimality with fast local
search and variable-bound tightening, arXiv 2302.07386. A node is closed when its bound
is within ``TOLERANCE`` of the incumbent, far above the rounding of either (1e-13), so
"proven" means: no selection is better by more than that.
"""

from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.criterion import Criterion

if TYPE_CHECKING:
    from jaxcal.selection.exact.criterion_kernel import Relaxation

__all__ = ["TOLERANCE", "BranchResult", "branch_and_bound"]

TOLERANCE = 1e-10  # of phi of "det"; of the others a share of it
_CHUNK = 16  # nodes between looks at the clock, where ``enough`` may stop the search
_PACE = 0.01  # seconds between looks where not, at which an interrupt is seen too
_MEMORY = 64 * 2**20  # bytes of open nodes up to which the best bound goes first
_FREE = 3e6  # node x M q p^2 spent on a proof although ``enough`` is reached: 10 ms
_SHARE = 0.05  # of its distance to the incumbent, how far a node is left from solved;
# the root, whose bound may be all that is asked for, is solved

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class BranchResult:
    """The best selections within the counts, and how far they can be from optimal."""

    counts: Indices  # (found, M), best first
    values: Array  # (found,) phi
    bound: float  # on phi of every selection that is not listed, or of the best
    nodes: int
    proven: bool


def branch_and_bound(
    blocks: Array,
    prior: Array,
    criterion: Criterion,
    lower: Indices,
    upper: Indices,
    start: Indices,
    best: int = 1,
    deadline: float | None = None,
    enough: float | None = None,
    root_only: bool = False,
) -> BranchResult:
    """The ``best`` selections by phi of the criterion, with proof.

    Args:
        blocks: (M, q, p) whitened.
        prior: (p, p) precision in the same coordinates.
        criterion: in the same coordinates.
        lower: (M,) least counts.
        upper: (M,) largest counts.
        start: (M,) counts of a good selection, sum k.
        best: how many selections.
        deadline: ``time.perf_counter()`` at which to stop with what there is.
        enough: share of the best possible (its efficiency) at which to stop, once the
            proof has had a fair try.
        root_only: stop at the bound of the relaxation.
    """
    from jaxcal.selection.exact.branch_kernel import search

    problem, scale, shift = _relaxation(blocks, prior, criterion, start)
    num_blocks, q, p = blocks.shape
    best_counts = np.zeros((best, num_blocks))
    best_values = np.full(best, -np.inf)
    width = num_blocks
    alive = np.arange(num_blocks)
    nodes, bounds = np.empty((64, 3, num_blocks)), np.full(64, np.inf)
    nodes[0] = lower, upper, start
    counts = best_counts
    size, done, free, bound, chunk = 1, 0, 0, np.inf, 1
    while size:
        bound = max(bounds[:size].max(), best_values[0])
        late = deadline is not None and time.perf_counter() > deadline
        close = (
            enough is not None
            and done >= free
            and (
                scale * bound + shift
                <= criterion.enough(float(scale * best_values[0] + shift), enough)
            )
        )
        if done and (late or close or root_only):
            break
        if size + 2 > len(bounds):
            nodes, bounds = (
                np.concatenate([a, np.empty_like(a)]) for a in (nodes, bounds)
            )
        begun = time.perf_counter()
        size, more = search(
            problem, TOLERANCE, _SHARE if done else 0.0, nodes, bounds, size, counts,
            best_values, max(256, _MEMORY // (24 * width)), chunk,
        )  # fmt: skip
        if not done and size:
            # Incumbents may use what the root rules out as no better than they are.
            alive = np.flatnonzero(nodes[:size, 1].any(axis=0) | counts.any(axis=0))
            nodes = np.ascontiguousarray(nodes[:, :, alive])
            counts = np.ascontiguousarray(counts[:, alive])
            problem = problem._replace(blocks=problem.blocks[alive])
            width = len(alive)
            if enough is not None:
                free = int(_FREE / (width * q * p * p))
        done += more
        chunk = _CHUNK
        if enough is None:
            seconds = max(time.perf_counter() - begun, 1e-6)
            chunk = max(1, int(more * _PACE / seconds))
    proven = size == 0
    found = np.isfinite(best_values)
    best_counts[:, alive] = counts
    return BranchResult(
        best_counts[found].astype(np.int64),
        scale * best_values[found] + shift,
        float(scale * (best_values[0] if proven else bound) + shift),
        done,
        proven,
    )


def _relaxation(
    blocks: Array, prior: Array, criterion: Criterion, start: Indices
) -> tuple[Relaxation, float, float]:
    """The problem in numbers near 1, and the unit and the origin of its values."""
    from jaxcal.selection.exact.criterion_kernel import DS, TRACE, D, E, Relaxation

    k, root = int(start.sum()), criterion.root
    rank = 1 if blocks.shape[1] == 1 else int(np.linalg.matrix_rank(blocks).max())
    p = len(prior)
    scale, shift = 1.0, 0.0
    if criterion.kind == "det" and len(root) == p:
        kind, shift = D, -2.0 * float(np.linalg.slogdet(root)[1])
    elif criterion.kind == "det":
        kind = DS
    else:
        chosen = np.repeat(blocks, start, axis=0).reshape(-1, p)
        phi = abs(float(criterion.value(prior + chosen.T @ chosen)))
        scale = phi if 0.0 < phi < np.inf else 1.0
        if criterion.kind == "trace":
            kind, root = TRACE, root / np.sqrt(scale)
        else:
            kind, root = E, root * np.sqrt(scale)
    blocks, prior, root = (np.array(each, order="C") for each in (blocks, prior, root))
    # Affine postures are enough for D at nearly every node: half as much to compile.
    plain = kind == D and blocks.shape[1] == 1 and not prior.any()
    made = Relaxation(kind, blocks, prior, None if plain else root, k, rank)
    return made, scale, shift
