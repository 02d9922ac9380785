"""Largest volume of q vectors out of many, by enumeration through matrix products.

By Laplace's expansion the determinant of q vectors is a bilinear form of the minors of
its first s rows and of its last t = q - s rows; for q = 4 these are the Pluecker
coordinates of two pairs, and one (pairs, 6) x (6, pairs) product gives every
tetrahedron. Subsets are split at their s-th smallest index, so each is met once.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

__all__ = ["Volumes", "enumeration_cost", "largest_volumes"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PRUNE = 200_000  # entries from which a known volume to prune by is worth its time
_STARTS = 8  # climbs to such a volume
_SCREEN = 500_000  # entries from which single precision first is faster
_UNTHREADED = 240_000  # multiplications up to which BLAS starts no threads, which stall


@dataclasses.dataclass(frozen=True)
class Volumes:
    """The largest volumes found."""

    subsets: Indices  # (found, q), largest volume first
    volumes: Array  # (found,) |det|
    examined: int  # subsets enumerated
    complete: bool  # False when the deadline passed first


def enumeration_cost(num_vectors: int, q: int) -> float:
    """Multiplications that :func:`largest_volumes` needs, about."""
    return float(math.comb(num_vectors, q)) * math.comb(q, q // 2)


def largest_volumes(
    vectors: Array, best: int = 1, deadline: float | None = None
) -> Volumes:
    """The ``best`` subsets of q vectors with the largest \\|det\\|.

    Args:
        vectors: (h, q), h >= q.
        best: how many subsets.
        deadline: ``time.perf_counter()`` at which to stop.
    """
    h, q = vectors.shape
    if q <= 1:
        size = np.abs(vectors[:, 0]) if q else np.ones(1)
        order = np.argsort(-size, kind="stable")[:best]
        subsets = order[:, None] if q else np.zeros((1, 0), dtype=np.int64)
        return Volumes(subsets, size[order], len(size), True)
    vectors = vectors / np.abs(vectors).max()
    s = (q + 1) // 2
    left, right = _last_ordered(h, s), _first_ordered(h, q - s)
    left_minors = _minors(vectors, left)
    right_minors = _minors(vectors, right) @ _pairing(q, s)
    if best == 1 and len(left) * len(right) > _PRUNE:
        # |det| <= |left minors| |right minors|, which is nearly sharp in whitened
        # coordinates: most halves are too short for any subset as good as one known.
        reached = (1.0 - 1e-9) * _climbed_volume(vectors)
        left_norm = np.linalg.norm(left_minors, axis=1)
        right_norm = np.linalg.norm(right_minors, axis=1)
        long_left = left_norm * right_norm.max() >= reached
        long_right = right_norm * left_norm.max() >= reached
        left, left_minors = left[long_left], left_minors[long_left]
        right, right_minors = right[long_right], right_minors[long_right]
    pair, examined, complete = _products(
        left, right, left_minors, right_minors, best, deadline
    )
    subsets = np.array([[*left[a], *right[b]] for a, b in pair], dtype=np.int64)
    return Volumes(
        np.sort(subsets.reshape(-1, q), axis=1),
        np.array([abs(left_minors[a] @ right_minors[b]) for a, b in pair]),
        examined,
        complete,
    )


def _climbed_volume(vectors: Array) -> float:
    """A large volume, by swapping one vector at a time from a few starts.

    Row i of ``vectors @ inverse(chosen)`` holds the factors by which the volume grows
    when vector i replaces each of the chosen (Goreinov et al., How to find a good
    submatrix, 2010).
    """
    h, q = vectors.shape
    rng = np.random.default_rng(0)
    largest = 0.0
    for _ in range(_STARTS):
        chosen = rng.permutation(h)[:q]
        if abs(np.linalg.det(vectors[chosen])) < 1e-9:
            continue
        for _ in range(10 * q):
            factors = np.abs(np.linalg.solve(vectors[chosen].T, vectors.T))
            out, new = divmod(int(factors.argmax()), h)
            if factors[out, new] <= 1.0 + 1e-9:
                break
            chosen[out] = new
        largest = max(largest, float(abs(np.linalg.det(vectors[chosen]))))
    return largest


def _blocks(
    left: Indices, right: Indices, components: int, once: bool
) -> Iterator[tuple[int, int, int]]:
    """Blocks (first left, end of left, first right) that cover every subset.

    Lefts are sorted by their largest index and rights by their smallest, so the rights
    that lie beyond a left are a tail. A block takes the tail of its first left: the
    extra pairs are subsets met before or overlap, with volume zero. ``once`` ends each
    block where that index changes, so that no subset is met twice.
    """
    h = int(right[-1, -1]) + 1
    begin_of = np.searchsorted(left[:, -1], np.arange(h + 1)).tolist()
    tail_of = np.searchsorted(right[:, 0], np.arange(h + 1)).tolist()
    end = begin_of[int(right[-1, 0])]  # lefts from here on have no right beyond them
    limit = _UNTHREADED // components
    low = 0
    while low < end:
        b = int(left[low, -1])
        width = len(right) - tail_of[b + 1]
        high = min(low + max(1, limit // width), begin_of[b + 1] if once else end)
        yield low, high, tail_of[b + 1]
        low = high


def _products(
    left: Indices,
    right: Indices,
    left_minors: Array,
    right_minors: Array,
    best: int,
    deadline: float | None,
) -> tuple[list[tuple[int, int]], int, bool]:
    """Best (left, right) pairs; single precision screens, double precision decides."""
    right_columns = np.ascontiguousarray(right_minors.T)
    screen = len(left) * len(right) > _SCREEN
    if screen:
        left_small = left_minors.astype(np.float32)
        right_small = right_columns.astype(np.float32)
        slack = 1e-5 * float(
            np.linalg.norm(left_minors, axis=1).max()
            * np.linalg.norm(right_minors, axis=1).max()
        )
    kept: list[tuple[float, int, int]] = []
    threshold = -np.inf
    examined = 0
    for low, high, column in _blocks(left, right, left_minors.shape[1], best > 1):
        if deadline is not None and time.perf_counter() > deadline:
            return [(i, j) for _, i, j in kept], examined, False
        width = len(right) - column
        examined += (high - low) * width
        if screen and kept:
            block = left_small[low:high] @ right_small[:, column:]
            if max(block.max(), -block.min()) < threshold - slack:
                continue
        exact = left_minors[low:high] @ right_columns[:, column:]
        flat = np.abs(exact, out=exact).ravel()
        if best == 1:
            cut = np.array([flat.argmax()])
            cut = cut[flat[cut] > threshold]
        else:
            cut = np.flatnonzero(flat > threshold)
        if len(cut) > best:
            cut = cut[np.argpartition(-flat[cut], best - 1)[:best]]
        kept.extend(
            (float(flat[f]), low + int(f) // width, column + int(f) % width)
            for f in cut
        )
        kept = sorted(kept, key=lambda item: -item[0])[:best]
        if len(kept) == best:
            threshold = kept[-1][0]
    return [(i, j) for _, i, j in kept], examined, True


@functools.lru_cache(maxsize=16)
def _first_ordered(h: int, size: int) -> Indices:
    """(C(h, size), size) subsets of range(h), by smallest index."""
    if size == 2:
        return np.stack(np.triu_indices(h, 1), axis=1)
    count = math.comb(h, size)
    flat = itertools.chain.from_iterable(itertools.combinations(range(h), size))
    return np.fromiter(flat, dtype=np.int64, count=count * size).reshape(count, size)


@functools.lru_cache(maxsize=16)
def _last_ordered(h: int, size: int) -> Indices:
    """(C(h, size), size) subsets of range(h), by largest index."""
    return np.ascontiguousarray((h - 1 - _first_ordered(h, size))[::-1, ::-1])


def _minors(vectors: Array, subsets: Indices) -> Array:
    """(N, C(q, s)) minors of rows ``subsets`` (N, s), columns in lexical order."""
    size, q = subsets.shape[1], vectors.shape[1]
    if size == 1:
        return vectors[subsets[:, 0]]
    if size == 2:
        first, second = vectors[subsets[:, 0]], vectors[subsets[:, 1]]
        a, b = _first_ordered(q, 2).T
        return first[:, a] * second[:, b] - first[:, b] * second[:, a]
    smaller = list(itertools.combinations(range(q), size - 1))
    inner = _minors(vectors, subsets[:, :-1])
    last = vectors[subsets[:, -1]]
    columns = []
    for chosen in itertools.combinations(range(q), size):
        total = np.zeros(len(subsets))
        for j, c in enumerate(chosen):
            rest = smaller.index(chosen[:j] + chosen[j + 1 :])
            sign = 1.0 if (size - 1 - j) % 2 == 0 else -1.0
            total += sign * last[:, c] * inner[:, rest]
        columns.append(total)
    return np.stack(columns, axis=1)


@functools.lru_cache(maxsize=16)
def _pairing(q: int, s: int) -> Array:
    """(C(q, t), C(q, s)) signed permutation that pairs minors with complements."""
    right = list(itertools.combinations(range(q), q - s))
    matrix = np.zeros((len(right), len(right)))
    for a, chosen in enumerate(itertools.combinations(range(q), s)):
        rest = tuple(c for c in range(q) if c not in chosen)
        sign = -1.0 if (sum(chosen) - s * (s - 1) // 2) % 2 else 1.0
        matrix[right.index(rest), a] = sign
    return matrix
