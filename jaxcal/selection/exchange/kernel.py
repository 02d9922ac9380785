"""Compiled Fedorov exchange; :mod:`jaxcal.selection.exchange.exchange` is its front.

Swapping block i for block j multiplies det by

    det(I + D_jj) det(I - D_ii + D_ij (I + D_jj)^-1 D_ji),   D_ij = B_i V B_j.T,

V the inverse information; for one reading (1 + d_j)(1 - d_i) + d_ij^2.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import (
    add_block,
    block_cross,
    block_products,
    draw,
    factor,
    row_cross,
    row_products,
)

__all__ = ["climb", "exchange_starts"]

_IMPROVES = 1.0 + 1e-11  # a swap must raise det by more than rounding
_RIDGE = 1e-6  # of the information of all candidates, to climb from a singular start


@njit(cache=True, nogil=True)
def _random_start(
    blocks, upper, required, span, full, k, state, order, basis, chosen, counts
):
    """Fill ``chosen`` (k,) at random, rarely singular.

    Args:
        blocks: (M, q, p).
        upper, required: (M,) and (r,).
        span: (s, p) orthonormal directions that the prior informs.
        full: rank that a block can have.
        k, state: size, and (1,) of the random generator.
        order: (M,) any permutation, changed.
        basis: (p, p) work space.
        chosen, counts: (k,) and (M,), filled.
    """
    num_blocks, p = len(blocks), blocks.shape[2]
    counts[:] = 0
    size = len(required)
    for r in range(size):
        chosen[r] = required[r]
        counts[required[r]] += 1
    for a in range(num_blocks - 1, 0, -1):
        b = draw(state, a + 1)
        order[a], order[b] = order[b], order[a]
    # An orthonormal basis grows with what is chosen: first the required ones, then
    # at random what leaves the span by enough.
    rank = len(span)
    basis[:rank] = span
    for r in range(size):
        rank = _extend(blocks, chosen[r], basis, rank, 1e-18)
    for position in range(num_blocks):
        if rank == p or size == k:
            break
        i = order[position]
        if counts[i] < upper[i]:
            grown = _extend(blocks, i, basis, rank, 1e-6 / num_blocks)
            if grown - rank >= min(full, p - rank):
                rank = grown
                chosen[size] = i
                counts[i] += 1
                size += 1
    while size < k:
        i = order[draw(state, num_blocks)]
        if counts[i] < upper[i]:
            chosen[size] = i
            counts[i] += 1
            size += 1


@njit(cache=True, nogil=True)
def _extend(blocks, i, basis, rank, least):
    """Add to the basis the rows of block i of which over ``least`` is new; the rank."""
    _, q, p = blocks.shape
    for s in range(q):
        if rank == p:
            break
        for a in range(p):
            basis[rank, a] = blocks[i, s, a]
        for _ in range(2):  # twice is enough for orthogonality to rounding
            for r in range(rank):
                dot = 0.0
                for a in range(p):
                    dot += basis[r, a] * basis[rank, a]
                for a in range(p):
                    basis[rank, a] -= dot * basis[r, a]
        square = 0.0
        for a in range(p):
            square += basis[rank, a] * basis[rank, a]
        if square > least:
            for a in range(p):
                basis[rank, a] /= np.sqrt(square)
            rank += 1
    return rank


@njit(cache=True, nogil=True)
def _best_row(leverage, inner, out, counts, upper):
    """The j, or -1, that raises det most when swapped for ``out``; see _best_block."""
    best_ratio = _IMPROVES
    best = -1
    keep = 1.0 - leverage[out]
    for j in range(len(leverage)):
        ratio = (1.0 + leverage[j]) * keep + inner[j] * inner[j]
        if ratio > best_ratio and counts[j] < upper[j]:
            best_ratio = ratio
            best = j
    return best


@njit(cache=True, nogil=True)
def _best_block(grown, cross, out, counts, upper, work):
    """The j, or -1, that raises det most when swapped for block ``out``.

    Args:
        grown: (q, q, M) lower triangles of D_jj.
        cross: (q, q, M) D_ij, i the block that goes out.
        out: i.
        counts, upper: (M,) how often each is and may be chosen.
        work: (3, q, q) work space.
    """
    q, _, num_blocks = grown.shape
    best_ratio = _IMPROVES
    best = -1
    lower, solved, left = work[0], work[1], work[2]
    for j in range(num_blocks):
        det = 1.0
        for a in range(q):  # lower = Cholesky factor of I + D_jj
            for b in range(a + 1):
                total = grown[a, b, j] + (1.0 if a == b else 0.0)
                for c in range(b):
                    total -= lower[a, c] * lower[b, c]
                if a == b:
                    det *= total
                    lower[a, a] = np.sqrt(total)
                else:
                    lower[a, b] = total / lower[b, b]
        for s in range(q):  # solved = lower^-1 D_ji
            for a in range(q):
                total = cross[s, a, j]
                for c in range(a):
                    total -= lower[a, c] * solved[c, s]
                solved[a, s] = total / lower[a, a]
        for a in range(q):  # left becomes the factor of what the swap leaves
            for b in range(a + 1):
                total = (1.0 if a == b else 0.0) - grown[a, b, out]
                for c in range(q):
                    total += solved[c, a] * solved[c, b]
                for c in range(b):
                    total -= left[a, c] * left[b, c]
                if a == b:
                    det *= max(total, 0.0)
                    left[a, a] = np.sqrt(max(total, 1e-300))
                else:
                    left[a, b] = total / left[b, b]
        if det > best_ratio and counts[j] < upper[j]:
            best_ratio = det
            best = j
    return best


@njit(cache=True, nogil=True)
def climb(blocks, columns, upper, num_fixed, chosen, counts, prior, gram, inverse):
    """Swap each chosen posture for its best replacement until none helps.

    Args:
        blocks, columns: (M, q, p), and transposed (q, p, M), contiguous.
        upper: (M,) how often each may be chosen.
        num_fixed: leading entries of ``chosen`` that stay.
        chosen, counts: (k,) and (M,), changed in place.
        prior: (p, p) precision.
        gram, inverse: (p, p) work space.

    Returns:
        log det of the local optimum; -inf, and nothing changed, from a singular start.
    """
    num_blocks, q, _ = blocks.shape
    k = len(chosen)
    gram[:] = prior
    for r in range(k):
        add_block(gram, blocks, chosen[r], 1.0)
    log_det = factor(gram, inverse)
    if not log_det > -np.inf:
        return log_det
    grown = np.empty((q, q, num_blocks))
    cross = np.empty((q, q, num_blocks))
    work = np.empty((3, q, q))
    # Views made once: one reading per candidate is the case that has to be fast.
    rows, first = blocks[:, 0], columns[0]
    leverage, inner = grown[0, 0], cross[0, 0]
    stale = True
    since = 0
    position = num_fixed
    while since < k - num_fixed:
        if stale:
            if q == 1:
                row_products(first, first, inverse, True, leverage)
            else:
                block_products(columns, inverse, grown)
            stale = False
        out = chosen[position]
        if q == 1:
            row_cross(first, inverse, rows, out, inner)
            best = _best_row(leverage, inner, out, counts, upper)
        else:
            block_cross(columns, inverse, blocks[out], cross)
            best = _best_block(grown, cross, out, counts, upper, work)
        since += 1
        if best >= 0:
            add_block(gram, blocks, out, -1.0)
            add_block(gram, blocks, best, 1.0)
            after = factor(gram, inverse)
            if after > log_det:
                counts[out] -= 1
                counts[best] += 1
                chosen[position] = best
                log_det = after
                since = 0
            else:  # rounding promised more than there is
                add_block(gram, blocks, best, -1.0)
                add_block(gram, blocks, out, 1.0)
                factor(gram, inverse)
            stale = True
        position += 1
        if position == k:
            position = num_fixed
    return log_det


@njit(cache=True, nogil=True)
def exchange_starts(
    blocks, columns, prior, span, full, upper, required, k, restarts, seed
):
    """Best local optimum over random starts.

    Returns:
        (k,) chosen, the required first; its log det; how many starts reached it.
    """
    num_blocks, _, p = blocks.shape
    state = np.empty(1, dtype=np.uint64)
    state[0] = np.uint64(seed) * np.uint64(2685821657736338717) + np.uint64(
        88172645463325252
    )
    if state[0] == np.uint64(0):
        state[0] = np.uint64(1)
    for _ in range(8):
        draw(state, 2)
    order = np.arange(num_blocks)
    basis = np.empty((p, p))
    counts = np.zeros(num_blocks, dtype=np.int64)
    chosen = np.empty(k, dtype=np.int64)
    best_chosen = np.empty(k, dtype=np.int64)
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    fixed = len(required)
    ridged = prior + _RIDGE * np.eye(p)
    best = -np.inf
    hits = 0
    for _ in range(restarts):
        _random_start(
            blocks, upper, required, span, full, k, state, order, basis, chosen, counts
        )
        log_det = -np.inf
        for attempt in range(3):  # the last two where swaps may mend a singular start
            known = ridged if attempt == 1 else prior
            log_det = climb(
                blocks, columns, upper, fixed, chosen, counts, known, gram, inverse
            )
            if attempt == 0 and log_det > -np.inf:
                break
        if log_det > best + 1e-10:
            best = log_det
            best_chosen[:] = chosen
            hits = 1
        elif log_det > best - 1e-10:
            hits += 1
    return best_chosen, best, hits
