"""Dynamic programming over the states of a small task, compiled."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, log

__all__ = ["backwards"]


def backwards(
    after: cython.Py_ssize_t[:, :, ::1],
    chance: cython.double[:, :, ::1],
    travel: cython.Py_ssize_t[:, ::1],
    extra: cython.Py_ssize_t[:, ::1],
    place_after: cython.Py_ssize_t[:, ::1],
    taken: cython.Py_ssize_t[:, ::1],
    ticks: cython.Py_ssize_t,
    uses: cython.Py_ssize_t,
):
    """Nats still to gain in every state, and the best measurement there.

    Args:
        after: (B, A, Y) int64 the belief after outcome y of measurement a.
        chance: (B, A, Y) float64 of that outcome.
        travel: (P, A) int64 ticks to a from each place, at least 1.
        extra: (A, Y) int64 ticks more.
        place_after: (A, Y) int64.
        taken: (A, Y) int64 uses.
        ticks: of the longest session.
        uses: of the largest budget.

    Returns:
        (ticks + 1, uses + 1, P, B) float32 and int16.
    """
    beliefs, designs, outcomes = after.shape[0], after.shape[1], after.shape[2]
    places = travel.shape[0]
    shape = (ticks + 1, uses + 1, places, beliefs)
    found = np.zeros(shape, np.float32)
    best_ones = np.zeros(shape, np.int16)
    values: cython.float[:, :, :, ::1] = found
    chosen: cython.short[:, :, :, ::1] = best_ones
    gains: cython.double[:, ::1] = np.zeros((beliefs, designs))
    watch: Watch = begin(INFINITY)
    b: cython.Py_ssize_t
    t: cython.Py_ssize_t
    with cython.nogil:
        for b in range(beliefs):
            for a in range(designs):
                for y in range(outcomes):
                    p = chance[b, a, y]
                    if p > 0.0:
                        gains[b, a] -= p * log(p)
        for t in range(1, ticks + 1):
            for e in range(1, uses + 1):
                for place in range(places):
                    late(cython.address(watch))
                    for b in range(beliefs):
                        best: cython.double = 0.0
                        for a in range(designs):
                            if gains[b, a] <= 0.0:
                                continue
                            total: cython.double = gains[b, a]
                            for y in range(outcomes):
                                p = chance[b, a, y]
                                left = t - travel[place, a] - extra[a, y]
                                more = e - taken[a, y]
                                if p > 0.0 and left > 0 and more > 0:
                                    total += (
                                        p
                                        * values[
                                            left,
                                            more,
                                            place_after[a, y],
                                            after[b, a, y],
                                        ]
                                    )
                            if total > best:
                                best = total
                                chosen[t, e, place, b] = a
                        values[t, e, place, b] = best
    return found, best_ones
