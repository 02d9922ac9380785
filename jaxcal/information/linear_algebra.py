"""Small linear algebra and random numbers for compiled solvers.

Imported only by the compiled kernels, because numba takes a second to load.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["add_outer", "draw", "factor", "gram_of"]


@njit(cache=True, nogil=True)
def gram_of(rows, counts, gram):
    """``gram = sum of counts_i x_i x_i.T`` of rows (M, p)."""
    num_rows, p = rows.shape
    gram[:] = 0.0
    for i in range(num_rows):
        if counts[i] != 0:
            for a in range(p):
                scaled = counts[i] * rows[i, a]
                for b in range(a + 1):
                    gram[a, b] += scaled * rows[i, b]
    for a in range(p):
        for b in range(a):
            gram[b, a] = gram[a, b]


@njit(cache=True, nogil=True)
def add_outer(gram, x, weight):
    """``gram += weight x x.T``."""
    p = len(x)
    for a in range(p):
        for b in range(p):
            gram[a, b] += weight * x[a] * x[b]


@njit(cache=True, nogil=True)
def factor(gram, inverse):
    """Log det of a positive definite matrix, and its inverse; -inf where singular."""
    p = gram.shape[0]
    lower = np.empty((p, p))
    log_det = 0.0
    for a in range(p):
        for b in range(a + 1):
            total = gram[a, b]
            for c in range(b):
                total -= lower[a, c] * lower[b, c]
            if a == b:
                if not total > 1e-14 * gram[a, a]:
                    return -np.inf
                lower[a, a] = np.sqrt(total)
                log_det += np.log(total)
            else:
                lower[a, b] = total / lower[b, b]
    for a in range(p):  # lower becomes its own inverse, row by row
        for b in range(a):
            total = 0.0
            for c in range(b, a):
                total -= lower[a, c] * lower[c, b]
            lower[a, b] = total / lower[a, a]
        lower[a, a] = 1.0 / lower[a, a]
    for a in range(p):
        for b in range(a + 1):
            total = 0.0
            for c in range(a, p):
                total += lower[c, a] * lower[c, b]
            inverse[a, b] = total
            inverse[b, a] = total
    return log_det


@njit(cache=True, nogil=True)
def draw(state, below):
    """A whole number in [0, below) from a xorshift generator; state is (1,) uint64."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return np.int64((x >> np.uint64(11)) % np.uint64(below))
