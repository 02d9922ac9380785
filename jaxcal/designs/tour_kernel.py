"""The order of least time, compiled: optimal for few postures, else improved."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY

MOST_EXACT = 12  # postures up to which the order is optimal (Held and Karp 1962)

_IMPROVED = 20  # shortest nearest-neighbour tours that are improved beyond that
_SHORTER = cython.declare(cython.double, 1e-10)  # seconds that a change must save


def best_order(times, start):
    """(K,) order of least time, ending anywhere, and its seconds."""
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
    tours = np.full((1 << k, k), np.inf)
    _fill(tours, times, start)
    order = np.empty(k, np.int64)
    mask = (1 << k) - 1
    last, least = int(tours[mask].argmin()), tours[mask].min()
    for place in range(k - 1, -1, -1):
        order[place] = last
        mask &= ~(1 << last)
        last = int((tours[mask] + times[:, last]).argmin())
    return order, least


def _fill(tours, times, start):
    """Fill the table of best open tours (2^K, K), infinite before (Held and Karp):
    ``tours[mask, last]`` is the least time over the postures in ``mask`` that ends in
    ``last``."""
    one: cython.Py_ssize_t = 1
    mask: cython.Py_ssize_t
    for mask in range(1, one << tours.shape[1]):
        for last in range(tours.shape[1]):
            rest = mask & ~(one << last)
            if rest == mask:
                continue
            best: cython.double = INFINITY if rest else start[last]
            for before in range(tours.shape[1]):
                if rest >> before & 1:
                    best = min(best, tours[rest, before] + times[before, last])
            tours[mask, last] = best


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
