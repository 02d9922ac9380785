"""Small linear algebra and random numbers for compiled solvers.

Imported only by the compiled kernels, because numba takes a second to load.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = [
    "INNER",
    "add_block",
    "draw",
    "factor",
    "gram_of",
    "row_cross",
    "row_products",
]

# Inner functions: a caller that is compiled includes them, so they need no entry from
# Python, which takes as long to compile as they do.
INNER = {
    "cache": True, "nogil": True, "error_model": "numpy", "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}  # fmt: skip


@njit(**INNER)
def gram_of(blocks, counts, prior, gram):
    """``gram = prior + sum of counts_i B_i.T B_i`` of blocks (M, q, p)."""
    num_blocks, q, p = blocks.shape
    gram[:] = 0.0
    for i in range(num_blocks):
        if counts[i] != 0:
            for r in range(q):
                for a in range(p):
                    scaled = counts[i] * blocks[i, r, a]
                    for b in range(a + 1):
                        gram[a, b] += scaled * blocks[i, r, b]
    for a in range(p):
        for b in range(a + 1):
            gram[a, b] += prior[a, b]
            gram[b, a] = gram[a, b]


@njit(**INNER)
def add_block(gram, blocks, i, weight):
    """``gram += weight B_i.T B_i`` of blocks (M, q, p)."""
    _, q, p = blocks.shape
    for r in range(q):
        for a in range(p):
            scaled = weight * blocks[i, r, a]
            for b in range(p):
                gram[a, b] += scaled * blocks[i, r, b]


@njit(**INNER)
def row_products(x, y, inverse, same, out):
    """``out_j = x[:, j] inverse y[:, j]``, (M,), x and y (p, M); ``same``: y is x."""
    p, num_blocks = x.shape
    for j in range(num_blocks):
        out[j] = 0.0
    for a in range(p):
        for b in range(a + 1 if same else p):
            w = inverse[a, b] if a == b or not same else 2.0 * inverse[a, b]
            for j in range(num_blocks):
                out[j] += w * x[a, j] * y[b, j]


@njit(**INNER)
def row_cross(x, inverse, y, i, out):
    """``out_j = x[:, j] inverse y[i]``, (M,), of x (p, M) and y (N, p)."""
    p, num_blocks = x.shape
    for j in range(num_blocks):
        out[j] = 0.0
    for a in range(p):
        total = 0.0
        for b in range(p):
            total += inverse[a, b] * y[i, b]
        for j in range(num_blocks):
            out[j] += total * x[a, j]


@njit(cache=True, nogil=True, error_model="numpy")
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
