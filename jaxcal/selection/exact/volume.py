"""Largest volume |det| of q vectors out of many.

Few subsets are enumerated through matrix products: by Laplace's
expansion the determinant is a bilinear form of the minors of its first s rows and of
its last t = q - s; for q = 4 these are the Pluecker coordinates of two pairs, and one
(pairs, 6) x (6, pairs) product gives every tetrahedron. Subsets are split at their s-th
smallest index, so each is met once. Where there are many, the compiled search of
:mod:`jaxcal.selection.exact.volume_kernel` visits only those that may be the largest.
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

_PRUNE = 200_000  # products from which a known volume to prune by is worth its time
_SEARCH = 4_000_000  # products, 15 ms, from which the compiled search is used
_MINORS = 200_000  # entries of the minors from which making them takes as long
_STEPS = 5  # towards the D-optimal weights
_STARTS = 4  # climbs to a known volume
_UNTHREADED = 240_000  # multiplications up to which BLAS starts no threads, which stall


@dataclasses.dataclass(frozen=True)
class Volumes:
    """The largest volumes found."""

    subsets: Indices  # (found, q), largest volume first
    volumes: Array  # (found,) |det|
    examined: int  # subsets enumerated, or nodes of the search
    complete: bool  # False when the deadline passed first
    bound: float  # no subset has a larger |det|; volumes[0] where complete


def enumeration_cost(num_vectors: int, q: int) -> float:
    """Multiplications that enumerating all subsets takes, about."""
    return float(math.comb(num_vectors, q)) * math.comb(q, q // 2)


def largest_volumes(
    vectors: Array, best: int = 1, deadline: float | None = None
) -> Volumes:
    """The ``best`` subsets of q vectors with the largest |det|.

    Complete means: no other subset has a volume larger by more than a share of 1e-10.

    Args:
        vectors: (h, q), h >= q.
        best: how many subsets; more than one are always enumerated.
        deadline: ``time.perf_counter()`` at which the search stops.
    """
    h, q = vectors.shape
    unit = float(np.abs(vectors).max(initial=0.0)) ** q
    if q == 0 or unit == 0.0:
        return _complete(np.arange(q)[None], np.full(1, unit), 1)
    vectors = vectors / np.abs(vectors).max()
    if q == 1:
        order = np.argsort(-np.abs(vectors[:, 0]), kind="stable")[:best]
        return _complete(order[:, None], unit * np.abs(vectors[order, 0]), h)
    s = (q + 1) // 2
    known = None
    if best == 1 and math.comb(h, s) * math.comb(h, q - s) > _PRUNE:
        # Whitened, lengths (which bound a volume) are as equal as they can be.
        vectors, triangle = np.linalg.qr(vectors)
        unit *= float(np.prod(np.abs(np.diag(triangle))))
        known = _climbed(vectors)
        if math.comb(h, s) * math.comb(q, s) > _MINORS:
            return _search(vectors, known, unit, deadline)
    left, right = _last_ordered(h, s), _first_ordered(h, q - s)
    left_minors = _minors(vectors, left)
    right_minors = _minors(vectors, right) @ _pairing(q, s)
    if known is not None:
        # |det| <= |left minors| |right minors|: most halves are too short for any
        # subset as good as the one known.
        reached = (1.0 - 1e-9) * abs(np.linalg.det(vectors[known]))
        left_norm = np.linalg.norm(left_minors, axis=1)
        right_norm = np.linalg.norm(right_minors, axis=1)
        long_left = left_norm * right_norm.max() >= reached
        long_right = right_norm * left_norm.max() >= reached
        left, left_minors = left[long_left], left_minors[long_left]
        right, right_minors = right[long_right], right_minors[long_right]
        if len(left) * len(right) > _SEARCH:
            return _search(vectors, known, unit, deadline)
    pair, examined = _products(left, right, left_minors, right_minors, best)
    subsets = np.array([[*left[a], *right[b]] for a, b in pair]).reshape(-1, q)
    volumes = np.array([abs(left_minors[a] @ right_minors[b]) for a, b in pair])
    return _complete(subsets, unit * volumes, examined)


def _complete(subsets: Indices, volumes: Array, examined: int) -> Volumes:
    bound = float(volumes[0])
    return Volumes(np.sort(subsets, axis=1), volumes, examined, True, bound)


def _climbed(vectors: Array) -> Indices:
    """(q,) vectors of large volume, by swapping one at a time from a few starts.

    Row i of ``vectors @ inverse(chosen)`` holds the factors by which the volume grows
    when vector i replaces each of the chosen (Goreinov et al., How to find a good
    submatrix, 2010).

    Args:
        vectors: (h, q) of rank q, with orthonormal columns.
    """
    h, q = vectors.shape
    rng = np.random.default_rng(0)
    farthest, rest = [], vectors
    for _ in range(q):
        farthest.append(int((rest * rest).sum(axis=1).argmax()))
        axis = rest[farthest[-1]] / np.linalg.norm(rest[farthest[-1]])
        rest = rest - np.outer(rest @ axis, axis)
    found, largest = np.array(farthest), 0.0
    for start in range(_STARTS):
        chosen = rng.permutation(h)[:q] if start else found.copy()
        if start and abs(np.linalg.det(vectors[chosen])) < 1e-6 * largest:
            continue
        for _ in range(10 * q):
            factors = np.abs(np.linalg.solve(vectors[chosen].T, vectors.T))
            out, new = divmod(int(factors.argmax()), h)
            if factors[out, new] <= 1.0 + 1e-9:
                break
            chosen[out] = new
        volume = float(abs(np.linalg.det(vectors[chosen])))
        if volume > largest:
            found, largest = chosen, volume
    return found


def _search(
    vectors: Array, known: Indices, unit: float, deadline: float | None
) -> Volumes:
    """The largest volume by the compiled search, in multiples of ``unit``.

    Args:
        vectors: (h, q) with orthonormal columns.
        known: (q,) vectors of large volume.
        unit: by which the volumes are multiplied.
        deadline: ``time.perf_counter()`` at which to stop.
    """
    from jaxcal.selection.exact.volume_kernel import descend

    # Of equal vectors one is enough: two of them span no volume.
    kept = np.unique(np.round(vectors, 13), axis=0, return_index=True)[1]
    vectors, shrink = _evened(vectors, kept)
    unit *= shrink
    lengths = np.linalg.norm(vectors[kept], axis=1)
    order = np.argsort(-lengths, kind="stable")
    kept, lengths = kept[order], lengths[order]
    h, q = len(kept), vectors.shape[1]
    points, index = np.empty((q - 1, h, q)), np.empty((q - 1, h), dtype=np.int64)
    points[0], index[0] = vectors[kept], kept
    place, subset = np.zeros(q - 1, dtype=np.int64), known.copy()
    largest = np.array([abs(np.linalg.det(vectors[known]))])
    seconds = math.inf if deadline is None else deadline - time.perf_counter()
    complete, nodes = descend(points, index, place, subset, largest, seconds)
    if not complete:
        begun = max(0, int(place[0]) - 1)  # of the vectors that come first
        bound = max(float(largest[0]), float(np.prod(lengths[begun : begun + q])))
        found = np.sort(subset)[None]
        return Volumes(found, unit * largest, nodes, False, unit * bound)
    return _complete(subset[None], unit * largest, nodes)


def _evened(vectors: Array, kept: Indices) -> tuple[Array, float]:
    """The vectors in a metric where the longest are about equally long, and its unit.

    The bounds are products of lengths, and sharpest in the metric of the D-optimal
    weights; a few of Titterington's steps come near it.
    """
    q = vectors.shape[1]
    weights = np.full(len(kept), 1.0 / len(kept))
    for _ in range(_STEPS):
        rows = np.sqrt(weights)[:, None] * vectors[kept]
        triangle = np.linalg.qr(rows)[1]
        even = np.linalg.solve(triangle.T, vectors.T).T
        weights *= (even[kept] ** 2).sum(axis=1) / q
    return even, float(np.prod(np.abs(np.diag(triangle))))


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
    left: Indices, right: Indices, left_minors: Array, right_minors: Array, best: int
) -> tuple[list[tuple[int, int]], int]:
    """Best (left, right) pairs, and how many were examined."""
    right_columns = np.ascontiguousarray(right_minors.T)
    kept: list[tuple[float, int, int]] = []
    threshold = -np.inf
    examined = 0
    for low, high, column in _blocks(left, right, left_minors.shape[1], best > 1):
        width = len(right) - column
        examined += (high - low) * width
        block = left_minors[low:high] @ right_columns[:, column:]
        flat = np.abs(block, out=block).ravel()
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
    return [(i, j) for _, i, j in kept], examined


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
