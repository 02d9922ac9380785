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

import numpy as np
from numpy.typing import NDArray

__all__ = ["Volumes", "enumeration_cost", "largest_volumes"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ONE_PRODUCT = 150_000  # entries up to which a single product beats the grouped ones
_BLOCK = 1 << 18  # entries a block: a float32 block stays in the second-level cache


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
    if best == 1 and len(left) * len(right) <= _ONE_PRODUCT:
        found = _single_product(left_minors, right_minors)
        pair, examined, complete = [found], math.comb(h, q), True
    else:
        pair, examined, complete = _grouped(
            left, right, left_minors, right_minors, best, deadline
        )
    subsets = np.array([[*left[a], *right[b]] for a, b in pair], dtype=np.int64)
    return Volumes(
        np.sort(subsets.reshape(-1, q), axis=1),
        np.array([abs(left_minors[a] @ right_minors[b]) for a, b in pair]),
        examined,
        complete,
    )


def _single_product(left: Array, right: Array) -> tuple[int, int]:
    product = left @ right.T
    flat = np.abs(product, out=product).argmax()
    row, column = divmod(int(flat), product.shape[1])
    return row, column


def _grouped(
    left: Indices,
    right: Indices,
    left_minors: Array,
    right_minors: Array,
    best: int,
    deadline: float | None,
) -> tuple[list[tuple[int, int]], int, bool]:
    """Best (left, right) pairs; single precision screens, double precision decides."""
    h = int(left[-1, -1]) + 1
    left_small = left_minors.astype(np.float32)
    right_small = np.ascontiguousarray(right_minors.T.astype(np.float32))
    slack = 1e-5 * float(
        np.linalg.norm(left_minors, axis=1).max()
        * np.linalg.norm(right_minors, axis=1).max()
    )
    kept: list[tuple[float, int, int]] = []
    threshold = -np.inf
    examined = 0
    start_of = np.searchsorted(left[:, -1], np.arange(h + 1))
    first_right = np.searchsorted(right[:, 0], np.arange(h + 1), side="left")
    for b in range(left.shape[1] - 1, h - right.shape[1]):
        begin, end = int(start_of[b]), int(start_of[b + 1])
        column = int(first_right[b + 1])
        width = len(right) - column
        step = max(1, _BLOCK // width)
        for low in range(begin, end, step):
            if deadline is not None and time.perf_counter() > deadline:
                return [(i, j) for _, i, j in kept], examined, False
            high = min(low + step, end)
            block = left_small[low:high] @ right_small[:, column:]
            examined += block.size
            if max(block.max(), -block.min()) < threshold - slack:
                continue
            exact = np.abs(left_minors[low:high] @ right_minors[column:].T).ravel()
            cut = np.flatnonzero(exact > threshold)
            if len(cut) > best:
                cut = cut[np.argpartition(-exact[cut], best - 1)[:best]]
            kept.extend(
                (float(exact[f]), low + int(f) // width, column + int(f) % width)
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
    smaller = list(itertools.combinations(range(q), size - 1))
    if size == 2:
        inner = vectors[subsets[:, 0]]
    else:
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
