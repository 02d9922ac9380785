"""Compiled searches: the order of least time, and the fastest subset with its proof."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import add, copy, dot, factor
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, log

__all__ = ["MOST_EXACT", "best_order", "fastest_subset"]

MOST_EXACT = 12  # postures up to which the order is optimal (Held and Karp 1962)

_IMPROVED = 20  # shortest nearest-neighbour tours that are improved beyond that
_SHORTER = cython.declare(cython.double, 1e-10)  # seconds that a change must save


def best_order(times, start):
    """Order of least time, ending anywhere: exact for few postures, else improved.

    Args:
        times: (K, K) float64 seconds, symmetric.
        start: (K,) float64 seconds from the start.

    Returns:
        (K,) int64 order, and its seconds.
    """
    k = len(start)
    if k <= MOST_EXACT:
        return _exact_order(times, start)
    # From every posture on to the nearest one left.
    every, free = np.arange(k), ~np.eye(k, dtype=bool)
    tours, seconds = np.repeat(every[:, None], k, axis=1), start.copy()
    for place in range(1, k):
        way = np.where(free, times[tours[:, place - 1]], np.inf)
        tours[:, place] = way.argmin(axis=1)
        seconds += way.min(axis=1)
        free[every, tours[:, place]] = False
    best, least = tours[0], np.inf
    for first in np.argsort(seconds)[:_IMPROVED]:
        reached = _improve(times, start, tours[first], seconds[first])
        if reached < least:
            best, least = tours[first], reached
    return best, least


def _exact_order(times, start):
    k = len(start)
    every = np.arange(k)
    tours = np.full((1 << k, k), np.inf)
    least = 0.0
    for depth in range(k):
        least = _extend(tours, times, start, every, depth)
    order = np.empty(k, np.int64)
    mask = (1 << k) - 1
    last = int(tours[mask].argmin())
    for place in range(k - 1, -1, -1):
        order[place] = last
        mask &= ~(1 << last)
        last = int((tours[mask] + times[:, last]).argmin())
    return order, least


def _extend(tours, times, start, chosen, depth):
    """Add a posture to the table of best open tours (Held and Karp).

    Args:
        tours: (2^K, K); ``tours[mask, last]`` is the least time over the postures in
            ``mask`` that ends in ``last``, known below ``2^depth``.
        times: (M, M) seconds from each posture to each, symmetric.
        start: (M,) seconds to each from the start.
        chosen: (K,) into ``times``; bit c of a mask stands for ``chosen[c]``.
        depth: the posture to add is ``chosen[depth]``.

    Returns:
        Seconds of the best tour through the first ``depth + 1`` chosen.
    """
    one: cython.Py_ssize_t = 1
    bit = one << depth
    new = chosen[depth]
    for last in range(depth + 1):
        tours[bit, last] = INFINITY
    tours[bit, depth] = start[new]
    rest: cython.Py_ssize_t
    for rest in range(1, bit):
        mask = rest | bit
        best: cython.double = INFINITY
        for before in range(depth):
            if rest >> before & 1:
                best = min(best, tours[rest, before] + times[chosen[before], new])
        tours[mask, depth] = best
        for last in range(depth):
            best = INFINITY
            if rest >> last & 1:
                end = chosen[last]
                without = mask & ~(one << last)
                for before in range(depth + 1):
                    if without >> before & 1:
                        best = min(
                            best, tours[without, before] + times[chosen[before], end]
                        )
            tours[mask, last] = best
    least: cython.double = INFINITY
    for last in range(depth + 1):
        least = min(least, tours[2 * bit - 1, last])
    return least


def _improve(times, start, order, seconds):
    """Reverse pieces and move single postures until neither shortens ``order`` (K,)."""
    k = order.shape[0]
    saved: cython.double = 1.0
    watch: Watch = begin(INFINITY)
    while saved:
        saved = 0.0
        for i in range(k - 1):
            late(cython.address(watch))
            for j in range(i + 1, k):
                a, b, after = order[i], order[j], order[i + 1]
                into_a = times[order[i - 1], a] if i else start[a]
                into_b = times[order[i - 1], b] if i else start[b]
                into_after = times[order[i - 1], after] if i else start[after]
                a_out = times[a, order[j + 1]] if j + 1 < k else 0.0
                b_out = times[b, order[j + 1]] if j + 1 < k else 0.0
                reverse = into_b - into_a + a_out - b_out
                later = into_after - into_a - times[a, after] + times[b, a]
                later += a_out - b_out
                if min(reverse, later) >= -_SHORTER:
                    continue
                saved -= min(reverse, later)
                if reverse <= later:
                    for step in range((j - i + 1) // 2):
                        one, other = i + step, j - step
                        order[one], order[other] = order[other], order[one]
                else:
                    for step in range(i, j):
                        order[step] = order[step + 1]
                    order[j] = a
        seconds -= saved
    return seconds


def fastest_subset(
    blocks: cython.const[cython.double][:, :, ::1],
    prior: cython.const[cython.double][:, ::1],
    times: cython.double[:, ::1],
    start: cython.double[::1],
    fixed: cython.Py_ssize_t,
    relaxed: cython.const[cython.double][:, ::1],
    wanted: cython.double,
    same: cython.double,
    chosen: cython.Py_ssize_t[::1],
    best: cython.double[::1],
    seconds: cython.double,
):
    """Depth-first search for the fastest subset with a determinant.

    Args:
        blocks: (M, q, p) float64 whitened.
        prior: (p, p) float64 information beforehand.
        times: (M, M) float64 seconds, a metric.
        start: (M,) float64 seconds to each from the start, zero where there is none.
        fixed: postures in every subset, the first of ``blocks``; fewer than k.
        relaxed: (p, p) information of a good selection of k, without the prior; any
            leaves the bound true.
        wanted: log det a subset must have.
        same: seconds within which two runs take as long; of these the one with the
            larger determinant wins.
        chosen: (k,) int64 the incumbent, written.
        best: (2,) float64 its seconds and log det, written.
        seconds: time limit.

    Returns:
        Whether the search is complete, and its nodes.
    """
    m, k, p = blocks.shape[0], chosen.shape[0], blocks.shape[2]
    tours: cython.double[:, ::1] = np.full((1 << k, k), np.inf)
    held: cython.Py_ssize_t[::1] = np.zeros(k + 1, np.int64)
    room: cython.double[:, ::1] = np.empty((4, p * p))
    gains: cython.double[::1] = np.empty(k)
    depth: cython.Py_ssize_t
    nodes: cython.Py_ssize_t = 0
    watch: Watch = begin(seconds)
    with cython.nogil:
        for depth in range(fixed):
            held[depth] = depth
            _extend(tours, times, start, held, depth)
        depth = fixed
        held[depth] = fixed - 1  # the next one tried is one further
        while depth >= fixed:
            held[depth] += 1
            if held[depth] + (k - depth) > m:
                depth -= 1
                continue
            if late(cython.address(watch)):
                break
            nodes += 1
            least = _extend(tours, times, start, held, depth)
            if least > best[0] + same:
                continue
            bound = _bound(blocks, prior, held, depth + 1, k, relaxed, room, gains)
            if depth == k - 1:
                if bound >= wanted and (
                    least < best[0] - same or bound > best[1] + 1e-12
                ):
                    best[0], best[1] = min(least, best[0]), bound
                    chosen[:] = held[:k]
                continue
            if bound < wanted or (least > best[0] - same and bound <= best[1]):
                continue
            depth += 1
            held[depth] = held[depth - 1]
    return depth < fixed, nodes


def _bound(blocks, prior, held, count, k, relaxed, room, gains):
    """Upper bound on log det of the first ``count`` held with k - count after them.

    It is log det where all k are held, and infinite where it cannot be computed.

    Args:
        blocks, prior, k, relaxed: see above.
        room: (4, p p) to work in: the information of the held, what stands in for all
            k of them, its inverse and its factor.
        gains: (k,) likewise.
    """
    m, q, p = blocks.shape[0], blocks.shape[1], cython.cast(cython.int, blocks.shape[2])
    more = k - count
    share = cython.cast(cython.double, more) / k
    gram = cython.address(room[0, 0])
    whole, inverse = gram + p * p, gram + 2 * p * p
    copy(gram, cython.address(prior[0, 0]), p * p)
    for c in range(count):
        add(gram, 1.0, cython.address(blocks[held[c], 0, 0]), q, p)
    for a in range(p):
        for b in range(p):
            gram[a * p + b] = gram[max(a, b) * p + min(a, b)]
            whole[a * p + b] = gram[a * p + b] + share * relaxed[a, b]
    log_det = factor(whole, inverse, gram + 3 * p * p, p)
    if not more:
        return log_det
    if log_det == -INFINITY:
        return INFINITY
    total: cython.double = dot(inverse, gram, p * p)
    gains[:more] = -1.0  # the largest so far, ascending
    for j in range(held[count - 1] + 1, m):
        gain: cython.double = 0.0
        for r in range(q):
            row = cython.address(blocks[j, r, 0])
            for a in range(p):
                gain += row[a] * dot(inverse + a * p, row, p)
        if gain <= gains[0]:
            continue
        place: cython.Py_ssize_t = 0
        while place + 1 < more and gains[place + 1] < gain:
            gains[place] = gains[place + 1]
            place += 1
        gains[place] = gain
    for place in range(more):
        total += gains[place]
    return log_det + p * log(total / p)
