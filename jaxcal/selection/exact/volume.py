"""Largest volume |det| of q vectors out of many.

The compiled search of ``jaxcal.selection.exact.volume_kernel`` visits only subsets
that may be among the largest. Where there are many, it starts from a large volume, and
in a metric in which its bounds are sharp.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from jaxcal import compiled
from jaxcal.checks import Array, Indices
from jaxcal.deadline import NEVER, Deadline
from jaxcal.selection.exact.volume_kernel import descend
from jaxcal.selection.exchange.exchange import rules_of

_PREPARED = 100_000_000  # subsets from which a known volume is worth its time
_STEPS = 5  # towards the D-optimal weights
_STARTS = 4  # random ones of climbs to a known volume, beside a greedy one, which
_SHARE = 0.2  # counts this share of mean vectors for those not chosen yet


@dataclasses.dataclass(frozen=True)
class Volumes:
    """The largest volumes found."""

    subsets: Indices  # (found, q), largest volume first
    volumes: Array  # (found,) |det|
    examined: int  # nodes of the search
    complete: bool  # False when the deadline passed first
    bound: float  # no subset has a larger |det|; volumes[0] where complete


def largest_volumes(
    vectors: Array, best: int = 1, deadline: Deadline = NEVER
) -> Volumes:
    """The ``best`` subsets of q vectors with the largest |det|.

    Complete means: no other subset has a volume larger by more than a share of 1e-10.
    Subsets without volume are left out, unless there is no other.

    Args:
        vectors: (h, q), h >= q.
        best: how many subsets.
        deadline: when the search stops.
    """
    h, q = vectors.shape
    unit = float(np.abs(vectors).max(initial=0.0)) ** q
    if q == 0 or unit == 0.0:
        return Volumes(np.arange(q)[None], np.full(1, unit), 1, True, unit)
    vectors = vectors / np.abs(vectors).max()
    if q == 1:
        order = np.argsort(-np.abs(vectors[:, 0]), kind="stable")[:best]
        volumes = unit * np.abs(vectors[order, 0])
        return Volumes(order[:, None], volumes, h, True, float(volumes[0]))
    vectors, triangle = np.linalg.qr(vectors)
    unit *= float(np.prod(np.abs(np.diag(triangle))))
    subsets, volumes = np.tile(np.arange(q), (best, 1)), np.zeros(best)
    kept = np.arange(h)
    if math.comb(h, q) > _PREPARED:
        if best == 1:
            subsets[0] = _climbed(vectors)
            # Of equal vectors one is enough: two of them span no volume.
            kept = np.unique(np.round(vectors, 13), axis=0, return_index=True)[1]
        vectors, shrink = _evened(vectors, kept)
        unit *= shrink
        if best == 1:
            volumes[0] = abs(np.linalg.det(vectors[subsets[0]]))
    lengths = np.linalg.norm(vectors[kept], axis=1)
    order = np.argsort(-lengths, kind="stable")
    kept, lengths = kept[order], lengths[order]
    nodes, begun = _search(vectors, kept, subsets, volumes, deadline)
    order = np.argsort(-volumes, kind="stable")
    order = order[: max(1, np.count_nonzero(volumes))]
    subsets, volumes = np.sort(subsets[order], axis=1), volumes[order]
    bound = float(volumes[0])
    if begun is not None:  # of the vectors that come first
        bound = max(bound, float(np.prod(lengths[begun : begun + q])))
    return Volumes(subsets, unit * volumes, nodes, begun is None, unit * bound)


def _search(
    vectors: Array, order: Indices, subsets: Indices, volumes: Array, deadline: Deadline
) -> tuple[int, int | None]:
    """Fill ``subsets`` and ``volumes`` with the largest of vectors, longest first.

    Returns:
        Nodes, and where the deadline passed first the vector that was begun with.
    """
    h, q = len(order), vectors.shape[1]
    points, index = np.empty((q - 1, h, q)), np.empty((q - 1, h), dtype=np.int64)
    points[0], index[0] = vectors[order], order
    place = np.zeros(q - 1, dtype=np.int64)
    complete, nodes = descend(
        points, index, place, subsets, volumes, deadline.remaining_s
    )
    return nodes, None if complete else max(0, int(place[0]) - 1)


def _climbed(vectors: Array) -> Indices:
    """(q,) vectors of large volume by exchange: its square is det of their information.

    Args:
        vectors: (h, q) of rank q, with orthonormal columns.
    """
    kernel = compiled.kernel("jaxcal.selection.exchange.exchange_kernel")
    q, none = vectors.shape[1], np.zeros(0, dtype=np.int64)
    blocks = np.ascontiguousarray(vectors[:, None])
    nothing, unit, once = np.zeros((q, q)), np.eye(q), np.ones(len(blocks), np.intp)
    climber = kernel.Climber(
        "det", blocks, nothing, unit, once, none, q, 0, *rules_of(None, len(blocks))
    )
    chosen, phi = climber.climb(none, _SHARE, 1, math.inf)
    return np.asarray(climber.random_climbs(_STARTS, chosen, phi, math.inf)[0])


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
