"""Compiled Fedorov exchange; :mod:`jaxcal.selection.exchange.exchange` is its front."""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import add_outer, draw, factor

__all__ = ["exchange_starts"]

_IMPROVES = 1.0 + 1e-11  # a swap must raise det by more than rounding


@njit(cache=True, nogil=True)
def _random_start(rows, upper, required, k, state, order, residual, chosen, counts):
    """Fill ``chosen`` (k,) at random, never singular; ``order`` is any permutation."""
    num_rows, p = rows.shape
    counts[:] = 0
    size = len(required)
    for r in range(size):
        chosen[r] = required[r]
        counts[required[r]] += 1
    for a in range(num_rows - 1, 0, -1):
        b = draw(state, a + 1)
        order[a], order[b] = order[b], order[a]
    # An orthonormal basis grows with what is chosen: first the required ones, then
    # at random what leaves the span by enough, then the farthest where that fails.
    basis = residual
    rank = 0
    for r in range(size):
        rank = _extend(rows[chosen[r]], basis, rank, 1e-18)
    for position in range(num_rows):
        if rank == p or size == k:
            break
        i = order[position]
        if counts[i] < upper[i]:
            grown = _extend(rows[i], basis, rank, 1e-6 / num_rows)
            if grown > rank:
                rank = grown
                chosen[size] = i
                counts[i] += 1
                size += 1
    while rank < p and size < k:
        farthest, most = -1, 0.0
        for i in range(num_rows):
            if counts[i] < upper[i]:
                outside = _outside(rows[i], basis, rank)
                if outside > most:
                    most = outside
                    farthest = i
        if farthest < 0:
            break
        rank = _extend(rows[farthest], basis, rank, 0.0)
        chosen[size] = farthest
        counts[farthest] += 1
        size += 1
    while size < k:
        i = order[draw(state, num_rows)]
        if counts[i] < upper[i]:
            chosen[size] = i
            counts[i] += 1
            size += 1


@njit(cache=True, nogil=True)
def _outside(x, basis, rank):
    """Squared length of x outside the span of the first ``rank`` basis rows."""
    square = 0.0
    for a in range(len(x)):
        square += x[a] * x[a]
    for r in range(rank):
        dot = 0.0
        for a in range(len(x)):
            dot += basis[r, a] * x[a]
        square -= dot * dot
    return square


@njit(cache=True, nogil=True)
def _extend(x, basis, rank, least):
    """Add x to the basis where more than ``least`` of it is new; the new rank."""
    p = len(x)
    if rank == p:
        return rank
    for a in range(p):
        basis[rank, a] = x[a]
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
    if not square > least:
        return rank
    for a in range(p):
        basis[rank, a] /= np.sqrt(square)
    return rank + 1


@njit(cache=True, nogil=True)
def climb(rows, columns, upper, num_fixed, chosen, counts, gram, inverse):
    """Swap each chosen posture for its best replacement until none helps.

    Args:
        rows, columns: (M, p) and its transpose (p, M), contiguous.
        upper: (M,) how often each may be chosen.
        num_fixed: leading entries of ``chosen`` that stay.
        chosen, counts: (k,) and (M,), changed in place.
        gram, inverse: (p, p) work space.

    Returns:
        log det of the local optimum; -inf, and nothing changed, from a singular start.
    """
    num_rows, p = rows.shape
    k = len(chosen)
    gram[:] = 0.0
    for r in range(k):
        add_outer(gram, rows[chosen[r]], 1.0)
    log_det = factor(gram, inverse)
    if not log_det > -np.inf:
        return log_det
    leverage = np.empty(num_rows)
    cross = np.empty(num_rows)
    weight = np.empty(p)
    stale = True
    since = 0
    position = num_fixed
    while since < k - num_fixed:
        if stale:
            for j in range(num_rows):
                leverage[j] = 0.0
            for a in range(p):
                for b in range(a + 1):
                    w = inverse[a, b] if a == b else 2.0 * inverse[a, b]
                    for j in range(num_rows):
                        leverage[j] += w * columns[a, j] * columns[b, j]
            stale = False
        out = chosen[position]
        for a in range(p):
            total = 0.0
            for b in range(p):
                total += inverse[a, b] * rows[out, b]
            weight[a] = total
        for j in range(num_rows):
            cross[j] = 0.0
        for a in range(p):
            for j in range(num_rows):
                cross[j] += weight[a] * columns[a, j]
        keep = 1.0 - leverage[out]
        best_ratio = _IMPROVES
        best = -1
        for j in range(num_rows):
            ratio = (1.0 + leverage[j]) * keep + cross[j] * cross[j]
            if ratio > best_ratio and counts[j] < upper[j]:
                best_ratio = ratio
                best = j
        since += 1
        if best >= 0:
            add_outer(gram, rows[out], -1.0)
            add_outer(gram, rows[best], 1.0)
            after = factor(gram, inverse)
            if after > log_det:
                counts[out] -= 1
                counts[best] += 1
                chosen[position] = best
                log_det = after
                since = 0
            else:  # rounding promised more than there is
                add_outer(gram, rows[best], -1.0)
                add_outer(gram, rows[out], 1.0)
                factor(gram, inverse)
            stale = True
        position += 1
        if position == k:
            position = num_fixed
    return log_det


@njit(cache=True, nogil=True)
def exchange_starts(rows, columns, upper, required, k, restarts, seed):
    """Best local optimum over random starts.

    Returns:
        (k,) chosen, the required first; its log det; how many starts reached it.
    """
    num_rows, p = rows.shape
    state = np.empty(1, dtype=np.uint64)
    state[0] = np.uint64(seed) * np.uint64(2685821657736338717) + np.uint64(
        88172645463325252
    )
    if state[0] == np.uint64(0):
        state[0] = np.uint64(1)
    for _ in range(8):
        draw(state, 2)
    order = np.arange(num_rows)
    residual = np.empty((p, p))
    counts = np.zeros(num_rows, dtype=np.int64)
    chosen = np.empty(k, dtype=np.int64)
    best_chosen = np.empty(k, dtype=np.int64)
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    best = -np.inf
    hits = 0
    for _ in range(restarts):
        _random_start(rows, upper, required, k, state, order, residual, chosen, counts)
        log_det = climb(
            rows, columns, upper, len(required), chosen, counts, gram, inverse
        )
        if log_det > best + 1e-10:
            best = log_det
            best_chosen[:] = chosen
            hits = 1
        elif log_det > best - 1e-10:
            hits += 1
    return best_chosen, best, hits
