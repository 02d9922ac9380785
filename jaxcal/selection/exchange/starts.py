"""Compiled random starts of the exchange, rarely singular."""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import INNER, draw

__all__ = ["RIDGE", "random_start", "random_starts", "seeded"]

RIDGE = 1e-6  # of the information of all candidates, to climb from a singular start


@njit(inline="always")
def seeded(seed):
    """(1,) uint64 state of the generator :func:`draw` for a seed."""
    state = np.empty(1, dtype=np.uint64)
    state[0] = np.uint64(seed) * np.uint64(2685821657736338717) + np.uint64(
        88172645463325252
    )
    if state[0] == np.uint64(0):
        state[0] = np.uint64(1)
    for _ in range(8):
        draw(state, 2)
    return state


@njit(inline="always")
def random_start(
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
    for a in range(num_blocks):
        counts[a] = 0
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
    for r in range(rank):
        for a in range(p):
            basis[r, a] = span[r, a]
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


@njit(**INNER)
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
def random_starts(blocks, upper, required, span, full, k, count, seed):
    """(count, k) random starts; see :func:`random_start` for the arguments."""
    num_blocks, _, p = blocks.shape
    state, order = seeded(seed), np.arange(num_blocks)
    basis = np.empty((p, p))
    counts = np.zeros(num_blocks, dtype=np.int64)
    starts = np.empty((count, k), dtype=np.int64)
    for turn in range(count):
        random_start(
            blocks, upper, required, span, full, k, state, order, basis, starts[turn],
            counts,
        )  # fmt: skip
    return starts
