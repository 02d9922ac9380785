"""The compiled search for the subset and order of least time at a wanted determinant.

Depth first over subsets in the order of ``rows``; a level keeps the best open tours
through its postures (Held and Karp), so going one deeper costs only the new ones.

Two things close a branch. Time: travel times are a metric, so a tour through more
postures takes no less than the best one through those already held. Determinant: for
any positive definite W, ``log det M <= -log det W + p log(trace(W M) / p)``; W is taken
as the inverse of what the held postures and the D-optimum's share of the rest give, and
the trace is completed by the largest gains that are left. Source of the bound: Ponte,
Fampa and Lee, arXiv 2302.07386.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import factor

__all__ = ["search"]


@njit(cache=True, nogil=True)
def _extend(tours, times, start, chosen, depth):
    """Best tours over the first depth + 1 chosen; those without the last are known.

    ``tours[mask, last]`` is the least time over the postures in mask that ends in last.
    Returns the least over all of them.
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
    least = np.inf
    full = 2 * bit - 1
    for last in range(depth + 1):
        if tours[full, last] < least:
            least = tours[full, last]
    return least


@njit(cache=True, nogil=True)
def _gram(rows, chosen, count, gram):
    p = rows.shape[1]
    gram[:] = 0.0
    for c in range(count):
        x = rows[chosen[c]]
        for a in range(p):
            for b in range(p):
                gram[a, b] += x[a] * x[b]


@njit(cache=True, nogil=True)
def _bound(rows, chosen, count, first, k, relaxed, gram, work, inverse, gains):
    """Upper bound on log det of the held with k - count more from ``first`` on."""
    num_rows, p = rows.shape
    _gram(rows, chosen, count, gram)
    share = (k - count) / k
    for a in range(p):
        for b in range(p):
            work[a, b] = gram[a, b] + share * relaxed[a, b]
    log_det = factor(work, inverse)
    if log_det == -np.inf:
        return np.inf
    trace = 0.0
    for a in range(p):
        for b in range(p):
            trace += inverse[a, b] * gram[a, b]
    more = k - count
    held = 0
    for j in range(first, num_rows):
        gain = 0.0
        for a in range(p):
            for b in range(p):
                gain += rows[j, a] * inverse[a, b] * rows[j, b]
        # insertion into the largest ``more`` gains, ascending
        if held < more:
            place = held
            held += 1
        elif gain <= gains[0]:
            continue
        else:
            place = 0
            while place + 1 < more and gains[place + 1] < gain:
                gains[place] = gains[place + 1]
                place += 1
            gains[place] = gain
            continue
        while place > 0 and gains[place - 1] > gain:
            gains[place] = gains[place - 1]
            place -= 1
        gains[place] = gain
    if held < more:
        return -np.inf
    for j in range(more):
        trace += gains[j]
    return log_det + p * np.log(trace / p)


@njit(cache=True, nogil=True)
def search(
    rows,
    times,
    start,
    fixed,
    k,
    relaxed,
    least_log_det,
    slack,
    tours,
    chosen,
    state,
    best,
    best_chosen,
    limit,
):
    """Go on with the search for at most ``limit`` nodes.

    Args:
        rows: (M, p) whitened regressors; the first ``fixed`` are in every subset.
        times: (M, M) travel times, a metric.
        start: (M,) time to each posture from the start, zero where there is none.
        fixed: postures that are in every subset.
        k: postures in all, at most as many as ``tours`` has columns.
        relaxed: (p, p) Gram matrix of a good selection of k; any leaves the bound true.
        least_log_det: log det(X_s.T X_s) a subset must have.
        slack: two times this close are equal; the larger determinant wins.
        tours: (2^k, k) room for the tours.
        chosen: (k + 1,) the subset on the stack, to be all zero at first.
        state: (3,) depth, whether begun, nodes so far; zero at first.
        best: (2,) time and log det of the incumbent.
        best_chosen: (k,) the incumbent.
        limit: nodes.

    Returns:
        Whether the search is complete.
    """
    num_rows, p = rows.shape
    gram = np.empty((p, p))
    work = np.empty((p, p))
    inverse = np.empty((p, p))
    gains = np.empty(k + 1)
    if state[1] == 0:
        state[1] = 1
        least = 0.0
        for depth in range(fixed):
            chosen[depth] = depth
            least = _extend(tours, times, start, chosen, depth)
        if least > best[0] + slack:
            return True
        if fixed == k:
            _gram(rows, chosen, k, gram)
            log_det = factor(gram, inverse)
            if log_det >= least_log_det and (
                least < best[0] - slack or log_det > best[1]
            ):
                best[0], best[1] = least, log_det
                best_chosen[:] = chosen[:k]
            return True
        state[0] = fixed
        chosen[fixed] = fixed - 1  # the next one tried is one further
    depth = state[0]
    done = 0
    while depth >= fixed:
        chosen[depth] += 1
        if chosen[depth] + (k - depth) > num_rows:
            depth -= 1
            continue
        if done >= limit:
            chosen[depth] -= 1
            state[0] = depth
            state[2] += done
            return False
        done += 1
        least = _extend(tours, times, start, chosen, depth)
        if least > best[0] + slack:
            continue
        if depth == k - 1:
            _gram(rows, chosen, k, gram)
            log_det = factor(gram, inverse)
            if log_det < least_log_det:
                continue
            if least < best[0] - slack or log_det > best[1] + 1e-12:
                best[0], best[1] = min(least, best[0]), log_det
                best_chosen[:] = chosen[:k]
            continue
        bound = _bound(
            rows, chosen, depth + 1, chosen[depth] + 1, k, relaxed,
            gram, work, inverse, gains,
        )  # fmt: skip
        if bound < least_log_det:
            continue
        if least > best[0] - slack and bound <= best[1]:
            continue
        depth += 1
        chosen[depth] = chosen[depth - 1]
    state[0] = depth
    state[2] += done
    return True
