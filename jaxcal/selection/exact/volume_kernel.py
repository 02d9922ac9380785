"""Compiled depth-first search for the largest volume; see ``volume.py``.

A node has chosen s of the q vectors. What the others still add is their part outside
the span of the chosen, held as coordinates in the q - s dimensions left over (one
Householder reflection per choice). The volume of any completion is at most the volume
chosen times the q - s largest lengths that are left (Hadamard). With two choices left
the problem is planar: the largest cross product of two points, which is at most that of
two corners of the polygon around the points and their negatives.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["descend"]

_TOLERANCE = 5e-11  # relative; a node must be able to improve the volume by more
_SIDES = 16  # half the sides of the polygon, which is at most 1 % too large
_FEW = 12  # points up to which all pairs are tried without the polygon


@njit(cache=True, nogil=True)
def descend(points, index, size, place, volume, depth, chosen, subset, largest, budget):
    """Search until nothing is open or ``budget`` nodes are done; resumes where it was.

    Args:
        points: (q - 1, h, q) coordinates of the vectors left at each depth, longest
            first; only the first q - depth of them count.
        index: (q - 1, h) which vectors these are.
        size: (q - 1,) how many.
        place: (q - 1,) the next to choose at each depth.
        volume: (q - 1,) of the chosen.
        depth: where to go on; 0 at first.
        chosen: (q,) vectors chosen on the way to ``depth``.
        subset, largest: (q,) vectors and (1,) volume of the incumbent; updated.
        budget: nodes.

    Returns:
        The depth to resume at, -1 where the search is complete, and the nodes done.
    """
    q = len(chosen)
    nodes = 0
    while depth >= 0 and nodes < budget:
        if depth == q - 2:
            _best_pair(points[depth], index, size, volume, chosen, subset, largest)
            nodes += 1
            depth -= 1
            continue
        c = place[depth]
        needed = (1.0 + _TOLERANCE) * largest[0] / volume[depth]
        if _too_short(points[depth], c, size[depth], q - depth, needed):
            depth -= 1
            continue
        place[depth] = c + 1
        chosen[depth] = index[depth, c]
        _open(points, index, size, volume, depth, c, largest[0])
        depth += 1
        place[depth] = 0
        nodes += 1
    return depth, nodes


@njit(cache=True, nogil=True)
def _length(point, dimension):
    total = 0.0
    for a in range(dimension):
        total += point[a] * point[a]
    return math.sqrt(total)


@njit(cache=True, nogil=True)
def _too_short(points, first, size, dimension, needed):
    """Do all subsets of the points from ``first`` on stay below the volume needed?"""
    if first + dimension > size:
        return True
    bound = 1.0
    for c in range(first, first + dimension):  # the longest of them
        bound *= _length(points[c], dimension)
    return bound < needed


@njit(cache=True, nogil=True)
def _open(points, index, size, volume, depth, c, reached):
    """Fill depth + 1 with what comes after c, without what is too short to matter."""
    q = points.shape[2]
    left = q - depth - 1  # dimensions after the choice
    chosen, below, names = points[depth, c], points[depth + 1], index[depth + 1]
    length = _length(chosen, left + 1)
    volume[depth + 1] = volume[depth] * length
    # The reflection that takes the chosen onto the first axis, which is then dropped.
    mirror = chosen[: left + 1].copy()
    mirror[0] += math.copysign(length, mirror[0])
    factor = 1.0 / (length * (length + abs(chosen[0])))
    count = size[depth] - c - 1
    lengths = np.empty(count)
    longest = 0.0
    for k in range(count):
        point = points[depth, c + 1 + k]
        along = 0.0
        for a in range(left + 1):
            along += mirror[a] * point[a]
        along *= factor
        square = 0.0
        for a in range(left):
            value = point[a + 1] - along * mirror[a + 1]
            below[k, a] = value
            square += value * value
        lengths[k] = math.sqrt(square)
        longest = max(longest, lengths[k])
    needed = (1.0 + _TOLERANCE) * reached / volume[depth + 1]
    least = needed / longest ** (left - 1) if longest > 0.0 else np.inf
    kept = 0
    for k in range(count):
        if lengths[k] >= least:
            for a in range(left):
                below[kept, a] = below[k, a]
            names[kept] = index[depth, c + 1 + k]
            lengths[kept] = -lengths[k]
            kept += 1
    size[depth + 1] = kept
    if left > 2:  # longest first; loops, since slices take seconds to compile
        order = np.argsort(lengths[:kept])
        unsorted, unsorted_names = below[:kept].copy(), names[:kept].copy()
        for k in range(kept):
            names[k] = unsorted_names[order[k]]
            for a in range(left):
                below[k, a] = unsorted[order[k], a]


@njit(cache=True, nogil=True)
def _best_pair(plane, index, size, volume, chosen, subset, largest):
    """The two of the planar points with the largest cross product, if it is enough."""
    last = len(chosen) - 2
    count = size[last]
    needed = (1.0 + _TOLERANCE) * largest[0] / volume[last]
    if count > _FEW and _polygon_bound(plane, count) < needed:
        return
    for i in range(count - 1):
        x, y = plane[i, 0], plane[i, 1]
        for j in range(i + 1, count):
            found = volume[last] * abs(x * plane[j, 1] - y * plane[j, 0])
            if found > largest[0]:
                largest[0] = found
                for a in range(last):
                    subset[a] = chosen[a]
                subset[last], subset[last + 1] = index[last, i], index[last, j]


@njit(cache=True, nogil=True)
def _polygon_bound(plane, count):
    """Largest cross product of two points of the polygon that holds the points.

    Its sides are at equal angles and touch the points or their negatives.
    """
    step = math.pi / _SIDES
    reach = np.zeros(_SIDES + 1)
    for d in range(_SIDES):
        c, s = math.cos(d * step), math.sin(d * step)
        for k in range(count):
            reach[d] = max(reach[d], abs(c * plane[k, 0] + s * plane[k, 1]))
    reach[_SIDES] = reach[0]
    x, y = np.empty(_SIDES), np.empty(_SIDES)
    for d in range(_SIDES):  # the corner between sides d and d + 1
        c, s = math.cos(d * step), math.sin(d * step)
        along = (reach[d + 1] - reach[d] * math.cos(step)) / math.sin(step)
        x[d] = reach[d] * c - along * s
        y[d] = reach[d] * s + along * c
    bound = 0.0
    for d in range(_SIDES):
        for e in range(d):
            bound = max(bound, abs(x[d] * y[e] - y[d] * x[e]))
    return bound
