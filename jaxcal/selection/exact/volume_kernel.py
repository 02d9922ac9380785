"""Compiled depth-first search for the largest volumes; see ``exact.py``.

A node has chosen s of the q vectors. What the others still add is their part outside
the span of the chosen, held as coordinates in the q - s dimensions left over (one
Householder reflection per choice). The volume of any completion is at most the volume
chosen times the q - s largest lengths that are left (Hadamard). With two choices left
the problem is planar: the largest cross product of two points, which is at most that of
two corners of the polygon around the points and their negatives.
"""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, M_PI, copysign, cos, fabs, sin, sqrt

# Relative; a node must be able to improve the volume by more.
_TOLERANCE = cython.declare(cython.double, 5e-11)
# Half the sides of the polygon, which is at most 1 % too large.
_SIDES = cython.declare(cython.int, 16)
# Points up to which all pairs are tried without the polygon.
_FEW = cython.declare(cython.int, 12)


def descend(
    points: cython.double[:, :, ::1],
    index: cython.Py_ssize_t[:, ::1],
    place: cython.Py_ssize_t[::1],
    subset: cython.Py_ssize_t[::1],
    largest: cython.double[::1],
    seconds: cython.double,
):
    """Search until nothing is open or the time is over: is it complete, and nodes done.

    Args:
        points: (q - 1, h, q) coordinates of the vectors left at each depth, longest
            first; only the first q - depth count. The first depth is given.
        index, place: (q - 1, h) which these are; (q - 1,) how many were chosen first.
        subset, largest: (q,) and (1,) the incumbent and its volume, 0 of none.
    """
    q, h = points.shape[2], points.shape[1]
    size: cython.Py_ssize_t[::1] = np.full(q - 1, h)
    volume: cython.double[::1] = np.ones(q - 1)
    chosen: cython.Py_ssize_t[::1] = np.zeros(q, np.int64)
    room: cython.double[:, ::1] = np.empty((h, q + 1))
    order: cython.Py_ssize_t[:, ::1] = np.empty((2, h), np.int64)
    depth: cython.Py_ssize_t = 0
    nodes: cython.Py_ssize_t = 0
    watch: Watch = begin(seconds)
    place[:] = 0
    with cython.nogil:
        while depth >= 0:
            if late(cython.address(watch)):
                break
            if depth == q - 2:
                nodes += 1
                if _best_pair(
                    points[depth], index, size, volume, chosen, subset, largest,
                    cython.address(watch),
                ):  # fmt: skip
                    break
                depth -= 1
                continue
            c = place[depth]
            needed = (1.0 + _TOLERANCE) * largest[0] / volume[depth]
            if _too_short(points[depth], c, size[depth], q - depth, needed):
                depth -= 1
                continue
            place[depth] = c + 1
            chosen[depth] = index[depth, c]
            _open(points, index, size, volume, depth, c, largest[0], room, order)
            depth += 1
            place[depth] = 0
            nodes += 1
    return depth < 0, nodes


def _length(points, c, dimension):
    total: cython.double = 0.0
    for a in range(dimension):
        total += points[c, a] * points[c, a]
    return sqrt(total)


def _too_short(points, first, size, dimension, needed):
    """Do all subsets of the points from ``first`` on stay below the volume needed?"""
    if first + dimension > size:
        return True
    bound: cython.double = 1.0
    for c in range(first, first + dimension):  # the longest of them
        bound *= _length(points, c, dimension)
    return bound == 0.0 or bound < needed


def _open(points, index, size, volume, depth, c, reached, room, order):
    """Fill depth + 1 with what comes after c, without what is too short to matter."""
    q = points.shape[2]
    dimensions = q - depth - 1  # after the choice
    below, names = points[depth + 1], index[depth + 1]
    length = _length(points[depth], c, dimensions + 1)
    volume[depth + 1] = volume[depth] * length
    # The reflection that takes the chosen onto the first axis, which is then dropped.
    first = points[depth, c, 0]
    factor = 1.0 / (length * (length + fabs(first)))
    count = size[depth] - c - 1
    longest: cython.double = 0.0
    for k in range(count):
        i = c + 1 + k
        along: cython.double = copysign(length, first) * points[depth, i, 0]
        for a in range(dimensions + 1):
            along += points[depth, c, a] * points[depth, i, a]
        along *= factor
        square: cython.double = 0.0
        for a in range(dimensions):
            value = points[depth, i, a + 1] - along * points[depth, c, a + 1]
            room[k, a] = value
            square += value * value
        room[k, q] = sqrt(square)
        longest = max(longest, room[k, q])
    least = INFINITY
    if longest > 0.0:
        least = (1.0 + _TOLERANCE) * reached / volume[depth + 1]
        for _ in range(dimensions - 1):
            least /= longest
    kept: cython.Py_ssize_t = 0
    for k in range(count):
        if room[k, q] >= least:
            order[0, kept] = k
            kept += 1
    size[depth + 1] = kept
    if dimensions > 2:
        _longest_first(room, order, kept)
    for k in range(kept):
        i = order[0, k]
        names[k] = index[depth, c + 1 + i]
        for a in range(dimensions):
            below[k, a] = room[i, a]


def _longest_first(room, order, count):
    """Sort the first ``count`` of ``order[0]`` by length, by merging runs."""
    key, width = room.shape[1] - 1, 1
    while width < count:
        begin_of: cython.Py_ssize_t = 0
        while begin_of < count:
            middle = min(begin_of + width, count)
            end = min(begin_of + 2 * width, count)
            i, j = begin_of, middle
            for k in range(begin_of, end):
                if j >= end or (
                    i < middle and room[order[0, i], key] >= room[order[0, j], key]
                ):
                    order[1, k] = order[0, i]
                    i += 1
                else:
                    order[1, k] = order[0, j]
                    j += 1
            begin_of = end
        order[0, :count] = order[1, :count]
        width *= 2


def _best_pair(plane, index, size, volume, chosen, subset, largest, watch):
    """Keep the largest pair of the planar points; 1 if time is over."""
    last = chosen.shape[0] - 2
    count = size[last]
    needed = (1.0 + _TOLERANCE) * largest[0] / volume[last]
    if count > _FEW and _polygon_bound(plane, count) < needed:
        return 0
    for i in range(count - 1):
        if i % 64 == 63 and late(watch):
            return 1
        x, y = plane[i, 0], plane[i, 1]
        for j in range(i + 1, count):
            area = volume[last] * fabs(x * plane[j, 1] - y * plane[j, 0])
            if area > largest[0]:
                chosen[last], chosen[last + 1] = index[last, i], index[last, j]
                largest[0] = area
                subset[:] = chosen
    return 0


def _polygon_bound(plane, count):
    """Largest cross product of two points of the polygon that holds the points.

    Its sides are at equal angles and touch the points or their negatives.
    """
    reach = cython.declare(cython.double[17])
    x = cython.declare(cython.double[16])
    y = cython.declare(cython.double[16])
    step = M_PI / _SIDES
    d: cython.Py_ssize_t
    for d in range(_SIDES):
        c, s = cos(d * step), sin(d * step)
        reach[d] = 0.0
        for k in range(count):
            reach[d] = max(reach[d], fabs(c * plane[k, 0] + s * plane[k, 1]))
    reach[_SIDES] = reach[0]
    for d in range(_SIDES):  # the corner between sides d and d + 1
        c, s = cos(d * step), sin(d * step)
        along = (reach[d + 1] - reach[d] * cos(step)) / sin(step)
        x[d] = reach[d] * c - along * s
        y[d] = reach[d] * s + along * c
    bound: cython.double = 0.0
    for d in range(_SIDES):
        for e in range(d):
            bound = max(bound, fabs(x[d] * y[e] - y[d] * x[e]))
    return bound
