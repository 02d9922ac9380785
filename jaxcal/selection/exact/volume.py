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
class Volume:
    """The largest volume found."""

    subset: Indices  # (q,) sorted
    size: float  # |det|
    examined: int  # nodes of the search
    complete: bool  # False when the deadline passed first
    bound: float  # no subset has a larger |det|; ``size`` where complete


def largest_volume(vectors: Array, deadline: Deadline = NEVER) -> Volume:
    """The q of (h, q) vectors with the largest |det|.

    Complete: no other subset has one larger by more than a share of 1e-10.
    """
    h, q = vectors.shape
    unit = float(np.abs(vectors).max(initial=0.0)) ** q
    if q == 0 or unit == 0.0:
        return Volume(np.arange(q), unit, 1, True, unit)
    vectors = vectors / np.abs(vectors).max()
    if q == 1:
        longest = np.abs(vectors[:, 0]).argmax(axis=0, keepdims=True)
        return Volume(longest, unit, h, True, unit)
    vectors, triangle = np.linalg.qr(vectors)
    unit *= float(np.prod(np.abs(np.diag(triangle))))
    subset, largest, kept = np.arange(q), np.zeros(1), np.arange(h)
    if math.comb(h, q) > _PREPARED:
        subset = _climbed(vectors)
        # Of equal vectors one is enough: two of them span no volume.
        kept = np.unique(np.round(vectors, 13), axis=0, return_index=True)[1]
        vectors, shrink = _evened(vectors, kept)
        unit *= shrink
        largest[0] = abs(np.linalg.det(vectors[subset]))
    lengths = np.linalg.norm(vectors[kept], axis=1)
    order = np.argsort(-lengths, kind="stable")
    kept, lengths = kept[order], lengths[order]  # the longest first
    points = np.empty((q - 1, len(kept), q))
    index, place = np.empty(points.shape[:2], dtype=np.int64), np.zeros(q - 1, np.int64)
    points[0], index[0] = vectors[kept], kept
    complete, nodes = descend(
        points, index, place, subset, largest, deadline.remaining_s
    )
    size = bound = float(largest[0])
    if not complete:  # of the vectors that come first
        begun = max(0, int(place[0]) - 1)
        bound = max(bound, float(np.prod(lengths[begun : begun + q])))
    return Volume(np.sort(subset), unit * size, nodes, complete, unit * bound)


def _climbed(vectors: Array) -> Indices:
    """(q,) vectors of large volume by exchange: its square is det of their
    information."""
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

    Bounds are products of lengths, and sharpest in the metric of the D-optimal weights;
    a few of Titterington's steps come near it.
    """
    q = vectors.shape[1]
    weights = np.full(len(kept), 1.0 / len(kept))
    for _ in range(_STEPS):
        rows = np.sqrt(weights)[:, None] * vectors[kept]
        triangle = np.linalg.qr(rows)[1]
        even = np.linalg.solve(triangle.T, vectors.T).T
        weights *= (even[kept] ** 2).sum(axis=1) / q
    return even, float(np.prod(np.abs(np.diag(triangle))))
