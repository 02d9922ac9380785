"""Compiled search for the order of least time through some postures."""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["MOST_EXACT", "best_order", "extend"]

MOST_EXACT = 12  # postures up to which the order is optimal (Held and Karp 1962)

_IMPROVED = 20  # shortest nearest-neighbour tours that are improved beyond that
_SHORTER = 1e-10  # seconds that a change must save


@njit(cache=True, nogil=True)
def extend(tours, times, start, chosen, depth):
    """Add a posture to the table of best open tours (Held and Karp).

    Args:
        tours: (2^K, K) float64; ``tours[mask, last]`` is the least time over the
            postures in ``mask`` that ends in ``last``, known below ``2^depth``.
        times: (M, M) float64 seconds from each posture to each, symmetric.
        start: (M,) float64 seconds to each from the start.
        chosen: (K,) int64 into ``times``; bit c of a mask stands for ``chosen[c]``.
        depth: the posture to add is ``chosen[depth]``.

    Returns:
        Seconds of the best tour through the first ``depth + 1`` chosen.
    """
    bit = 1 << depth
    new = chosen[depth]
    for last in range(depth + 1):
        tours[bit, last] = np.inf
    tours[bit, depth] = start[new]
    for rest in range(1, bit):
        mask = rest | bit
        reached = np.inf
        for before in range(depth):
            if rest >> before & 1:
                t = tours[rest, before] + times[chosen[before], new]
                if t < reached:
                    reached = t
        tours[mask, depth] = reached
        for last in range(depth):
            best = np.inf
            if rest >> last & 1:
                without = mask & ~(1 << last)
                for before in range(depth + 1):
                    if without >> before & 1:
                        t = tours[without, before] + times[chosen[before], chosen[last]]
                        if t < best:
                            best = t
            tours[mask, last] = best
    return tours[2 * bit - 1, : depth + 1].min()


@njit(cache=True, nogil=True)
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
    tours = np.empty((k, k), np.int64)
    seconds = np.empty(k)
    for first in range(k):
        seconds[first] = _nearest_neighbours(times, start, first, tours[first])
    best, least = tours[0], np.inf
    for first in np.argsort(seconds)[:_IMPROVED]:
        reached = _improve(times, start, tours[first], seconds[first])
        if reached < least:
            best, least = tours[first], reached
    return best, least


@njit(cache=True, nogil=True)
def _exact_order(times, start):
    k = len(start)
    every = np.arange(k)
    tours = np.full((1 << k, k), np.inf)
    least = 0.0
    for depth in range(k):
        least = extend(tours, times, start, every, depth)
    order = np.empty(k, np.int64)
    mask = (1 << k) - 1
    last = tours[mask].argmin()
    for place in range(k - 1, -1, -1):
        order[place] = last
        mask &= ~(1 << last)
        last = (tours[mask] + times[:, last]).argmin()
    return order, least


@njit(cache=True, nogil=True)
def _nearest_neighbours(times, start, first, order):
    """Fill ``order`` (K,) from posture ``first`` on; returns its seconds."""
    k = len(start)
    free = np.ones(k, np.bool_)
    here, seconds = first, start[first]
    for place in range(k):
        if place:
            nearest = -1
            for j in range(k):
                if free[j] and (nearest < 0 or times[here, j] < times[here, nearest]):
                    nearest = j
            seconds += times[here, nearest]
            here = nearest
        order[place] = here
        free[here] = False
    return seconds


@njit(cache=True, nogil=True)
def _improve(times, start, order, seconds):
    """Reverse pieces and move single postures until neither shortens ``order`` (K,)."""
    k = len(order)
    again = True
    while again:
        again = False
        for i in range(k - 1):
            for j in range(i + 1, k):
                a, b = order[i], order[j]
                into_a = times[order[i - 1], a] if i else start[a]
                into_b = times[order[i - 1], b] if i else start[b]
                after = order[i + 1]
                into_after = times[order[i - 1], after] if i else start[after]
                a_out = times[a, order[j + 1]] if j + 1 < k else 0.0
                b_out = times[b, order[j + 1]] if j + 1 < k else 0.0
                reverse = into_b - into_a + a_out - b_out
                later = into_after - into_a - times[a, after] + times[b, a]
                later += a_out - b_out
                if reverse < -_SHORTER and reverse <= later:
                    order[i : j + 1] = order[i : j + 1][::-1].copy()
                    seconds += reverse
                    again = True
                elif later < -_SHORTER:
                    order[i:j] = order[i + 1 : j + 1].copy()
                    order[j] = a
                    seconds += later
                    again = True
    return seconds
