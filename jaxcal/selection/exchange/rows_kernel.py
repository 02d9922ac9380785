"""Compiled Fedorov exchange for log det and one reading per candidate.

With d_ij = b_i V b_j.T, V the inverse information, swapping row i for row j multiplies
det by (1 + d_j)(1 - d_i) + d_ij^2. The general case is ``blocks_kernel``; this one is
several times as fast where there are few parameters.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import (
    add_block,
    factor,
    row_cross,
    row_products,
)
from jaxcal.selection.exchange.starts import random_start, seeded

__all__ = ["climb_rows", "exchange_rows"]

_IMPROVES = 1.0 + 1e-11  # a swap must raise det by more than rounding
_MOST_SWAPS = 100  # of each place, where a few are usual


@njit(inline="always")
def _log_det(blocks, chosen, prior, gram, inverse):
    """log det of the chosen from sums made anew; gram and inverse are filled."""
    for a in range(len(gram)):  # a slice assignment takes seconds to compile
        for b in range(len(gram)):
            gram[a, b] = prior[a, b]
    for i in chosen:
        add_block(gram, blocks, i, 1.0)
    return factor(gram, inverse)


@njit(inline="always")
def _best_row(leverage, inner, out, counts, upper):
    """The j, or -1, that raises det most when swapped for ``out``.

    Args:
        leverage, inner: (M,) d_j, and d_ij of i the row that goes out.
        out: i.
        counts, upper: (M,) how often each is and may be chosen.
    """
    best_ratio = _IMPROVES
    best = -1
    keep = 1.0 - leverage[out]
    for j in range(len(leverage)):
        ratio = (1.0 + leverage[j]) * keep + inner[j] * inner[j]
        if ratio > best_ratio and counts[j] < upper[j]:
            best_ratio = ratio
            best = j
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def climb_rows(blocks, columns, upper, num_fixed, chosen, counts, prior, gram, inverse):
    """Swap each chosen posture for its best replacement until none helps.

    Args:
        blocks, columns: (M, 1, p), and transposed (1, p, M), contiguous.
        upper: (M,) how often each may be chosen.
        num_fixed: leading entries of ``chosen`` that stay.
        chosen, counts: (k,) and (M,), changed in place.
        prior: (p, p) precision.
        gram, inverse: (p, p) work space.

    Returns:
        log det of the local optimum; -inf, and nothing changed, from a singular start.
    """
    k = len(chosen)
    log_det = _log_det(blocks, chosen, prior, gram, inverse)
    if not log_det > -np.inf:
        return log_det
    leverage, inner = np.empty(len(blocks)), np.empty(len(blocks))
    rows, first = blocks[:, 0], columns[0]
    stale = True
    since = swaps = 0
    position = num_fixed
    while since < k - num_fixed:
        if stale:
            row_products(first, first, inverse, True, leverage)
            stale = False
        out = chosen[position]
        row_cross(first, inverse, rows, out, inner)
        best = _best_row(leverage, inner, out, counts, upper)
        since += 1
        if best >= 0:
            chosen[position] = best
            after = _log_det(blocks, chosen, prior, gram, inverse)
            if after > log_det and swaps < _MOST_SWAPS * k:
                counts[out] -= 1
                counts[best] += 1
                log_det = after
                since = 0
                swaps += 1
            else:  # rounding promised more than there is
                chosen[position] = out
                _log_det(blocks, chosen, prior, gram, inverse)
            stale = True
        position += 1
        if position == k:
            position = num_fixed
    return log_det


@njit(cache=True, nogil=True, error_model="numpy")
def exchange_rows(
    blocks, columns, prior, ridged, span, full, upper, required, k, restarts, seed
):
    """Best local optimum over random starts; see ``random_start`` for the arguments.

    ``ridged`` (p, p) is the prior and a little more, to climb from a singular start.

    Returns:
        (k,) chosen, the required first, and its log det.
    """
    num_blocks, _, p = blocks.shape
    state = seeded(seed)
    order = np.arange(num_blocks)
    basis, gram, inverse = np.empty((p, p)), np.empty((p, p)), np.empty((p, p))
    counts = np.zeros(num_blocks, dtype=np.int64)
    chosen, best_chosen = np.empty(k, dtype=np.int64), np.empty(k, dtype=np.int64)
    fixed = len(required)
    best = -np.inf
    for _ in range(restarts):
        random_start(
            blocks, upper, required, span, full, k, state, order, basis, chosen, counts
        )
        log_det = -np.inf
        for attempt in range(3):  # the last two where swaps may mend a singular start
            known = ridged if attempt == 1 else prior
            log_det = climb_rows(
                blocks, columns, upper, fixed, chosen, counts, known, gram, inverse
            )
            if attempt == 0 and log_det > -np.inf:
                break
        if log_det > best + 1e-10:
            best = log_det
            for r in range(k):
                best_chosen[r] = chosen[r]
    return best_chosen, best
