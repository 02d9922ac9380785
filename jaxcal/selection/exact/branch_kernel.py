"""Compiled branch and bound; :mod:`jaxcal.selection.exact.branch_and_bound` is its front.

A node bounds the count of every candidate, ``low_i <= c_i <= high_i``, sum k. Its
relaxation is climbed by moving weight between two candidates at a time; any point on
the way gives a true bound (see :mod:`jaxcal.information.relaxation`), whose linear
maximum is taken through one multiplier ``cut``:

    a = k cut + sum of max(low_i (d_i - cut), high_i (d_i - cut)),  d_i leverage.

Forcing one count away from the side the multiplier puts it on costs |d_i - cut| a unit,
which tightens ``low`` and ``high`` wherever the bound then falls to the incumbent.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import add_outer, factor, gram_of

__all__ = ["offer", "offer_swaps", "process", "search"]

_WHOLE = 1e-9  # a count this near a whole number is that number
_SOLVED = 1e-11  # spread of leverages that may move at the relaxed optimum
_MAX_STEPS = 4000


@njit(cache=True, nogil=True)
def offer(counts, log_det, best_counts, best_values):
    """Insert a selection into the sorted list of the best, once; True if it entered."""
    size = len(best_values)
    if not log_det > best_values[size - 1]:
        return False
    for r in range(size):
        if abs(best_values[r] - log_det) < 1e-7:
            same = True
            for i in range(len(counts)):
                if best_counts[r, i] != counts[i]:
                    same = False
                    break
            if same:
                return False
    r = size - 1
    while r > 0 and best_values[r - 1] < log_det:
        best_values[r] = best_values[r - 1]
        best_counts[r] = best_counts[r - 1]
        r -= 1
    best_values[r] = log_det
    for i in range(len(counts)):
        best_counts[r, i] = counts[i]
    return True


@njit(cache=True, nogil=True)
def offer_swaps(rows, low, high, counts, best_counts, best_values):
    """Offer every selection one swap away from ``counts``."""
    num_rows, p = rows.shape
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    for i in range(num_rows):
        if counts[i] > low[i]:
            counts[i] -= 1
            for j in range(num_rows):
                if j != i and counts[j] < high[j]:
                    counts[j] += 1
                    gram_of(rows, counts, gram)
                    offer(counts, factor(gram, inverse), best_counts, best_values)
                    counts[j] -= 1
            counts[i] += 1


@njit(cache=True, nogil=True)
def _leverages(columns, inverse, leverage):
    p, num_rows = columns.shape
    for j in range(num_rows):
        leverage[j] = 0.0
    for a in range(p):
        for b in range(a + 1):
            w = inverse[a, b] if a == b else 2.0 * inverse[a, b]
            for j in range(num_rows):
                leverage[j] += w * columns[a, j] * columns[b, j]


@njit(cache=True, nogil=True)
def _apply(columns, inverse, x, out):
    """``out_j = x_j.T inverse x``."""
    p, num_rows = columns.shape
    for j in range(num_rows):
        out[j] = 0.0
    for a in range(p):
        total = 0.0
        for b in range(p):
            total += inverse[a, b] * x[b]
        for j in range(num_rows):
            out[j] += total * columns[a, j]


@njit(cache=True, nogil=True)
def _balance(rows, low, high, c, k, leverage):
    """Move c into its bounds and back to sum k, keeping it near where it was."""
    num_rows = len(c)
    total = 0.0
    for i in range(num_rows):
        c[i] = min(max(c[i], float(low[i])), float(high[i]))
        total += c[i]
    while abs(total - k) > 1e-12:
        best = -1
        for i in range(num_rows):
            if total < k:
                if c[i] < high[i] and (best < 0 or leverage[i] > leverage[best]):
                    best = i
            elif c[i] > low[i] and (best < 0 or leverage[i] < leverage[best]):
                best = i
        if best < 0:
            return False
        before = c[best]
        moved = before + (k - total)
        c[best] = min(max(moved, float(low[best])), float(high[best]))
        total += c[best] - before
    return True


@njit(cache=True, nogil=True)
def _spread(low, high, c, k):
    """Share what the lower bounds leave in proportion to the room of each count."""
    room = 0.0
    fixed = 0.0
    for i in range(len(c)):
        room += high[i] - low[i]
        fixed += low[i]
    for i in range(len(c)):
        c[i] = low[i] + (k - fixed) * (high[i] - low[i]) / max(room, 1.0)


@njit(cache=True, nogil=True)
def _linear_maximum(low, high, leverage, up, down, k):
    """Largest ``sum of c_i d_i`` within the bounds, and the multiplier it was had by.

    ``up`` is the largest leverage that can rise, ``down`` the smallest that can fall;
    halfway between them the multiplier is exact at the optimum and valid anywhere.
    """
    if up >= 0 and down >= 0:
        cut = 0.5 * (leverage[up] + leverage[down])
    elif up >= 0:
        cut = leverage[up]
    elif down >= 0:
        cut = leverage[down]
    else:
        cut = 0.0
    most = k * cut
    for i in range(len(leverage)):
        slope = leverage[i] - cut
        most += high[i] * slope if slope > 0.0 else low[i] * slope
    return most, cut


@njit(cache=True, nogil=True)
def _relax(rows, columns, low, high, c, k, goal, gram, inverse, leverage, cross):
    """Climb the relaxation of a node until it is pruned, or solved well enough.

    Returns:
        log det of the matrix the bound is taken at, the linear maximum a, and the
        multiplier behind it; the bound is ``log det + p log(a / p)``. log det is -inf
        where every selection of the node is singular.
    """
    num_rows, p = rows.shape
    gram_of(rows, c, gram)
    value = factor(gram, inverse)
    if not value > -np.inf:
        _spread(low, high, c, k)
        gram_of(rows, c, gram)
        value = factor(gram, inverse)
        if not value > -np.inf:
            return value, 0.0, 0.0
    _leverages(columns, inverse, leverage)
    most, cut = 0.0, 0.0
    for step_number in range(_MAX_STEPS):
        up, down = -1, -1
        for i in range(num_rows):
            if c[i] < high[i] and (up < 0 or leverage[i] > leverage[up]):
                up = i
            if c[i] > low[i] and (down < 0 or leverage[i] < leverage[down]):
                down = i
        solved = up < 0 or down < 0 or leverage[up] - leverage[down] <= _SOLVED
        if solved or step_number % 4 == 0 or step_number == _MAX_STEPS - 1:
            most, cut = _linear_maximum(low, high, leverage, up, down, k)
            gap = p * np.log(most / p)
            if solved or gap <= max(goal - value, 1e-11, 0.05 * (value - goal)):
                break
        _apply(columns, inverse, rows[up], cross)
        best, best_gain, best_step = -1, 0.0, 0.0
        rise = high[up] - c[up]
        for j in range(num_rows):
            fall = c[j] - low[j]
            slope = leverage[up] - leverage[j]
            if fall > 0.0 and slope > 0.0:
                curve = leverage[up] * leverage[j] - cross[j] * cross[j]
                step = min(rise, fall)
                if 2.0 * curve * step > slope:
                    step = slope / (2.0 * curve)
                gain = step * (slope - step * curve)
                if gain > best_gain:
                    best, best_gain, best_step = j, gain, step
        if best < 0:
            most, cut = _linear_maximum(low, high, leverage, up, down, k)
            break
        fall = c[best] - low[best]
        c[up] = float(high[up]) if best_step == rise else c[up] + best_step
        c[best] = float(low[best]) if best_step == fall else c[best] - best_step
        add_outer(gram, rows[up], best_step)
        add_outer(gram, rows[best], -best_step)
        value = factor(gram, inverse)
        _leverages(columns, inverse, leverage)
    return value, most, cut


@njit(cache=True, nogil=True)
def process(
    rows, columns, low, high, c, k, slack, best_counts, best_values, gram, inverse, work
):
    """Solve, tighten and, where settled, close one node.

    Args:
        rows, columns: (M, p) and (p, M).
        low, high, c: (M,) bounds and starting weights, changed in place.
        k: selections in all.
        slack: a bound this far above the incumbent still closes the node.
        best_counts, best_values: (best, M) and (best,) incumbents, changed in place.
        gram, inverse, work: (p, p), (p, p), (2, M) work space.

    Returns:
        The node's upper bound (-inf when closed) and the candidate to branch on.
    """
    num_rows, p = rows.shape
    leverage = work[1]
    last = len(best_values) - 1
    goal = best_values[last] + slack
    value, most, cut = _relax(
        rows, columns, low, high, c, k, goal, gram, inverse, leverage, work[0]
    )
    if not value > -np.inf:
        return -np.inf, -1
    bound = value + p * np.log(most / p)
    if bound <= goal:
        return -np.inf, -1
    # Reduced-cost tightening: most - units |slope| must stay above the goal's share.
    needed = p * np.exp((goal - value) / p)
    total_low = 0
    total_high = 0
    for i in range(num_rows):
        if low[i] < high[i]:
            slope = leverage[i] - cut
            if abs(slope) > 0.0:
                units = (most - needed) / abs(slope)
                if units < high[i] - low[i]:
                    if slope < 0.0:
                        high[i] = low[i] + np.int64(units)
                    else:
                        low[i] = high[i] - np.int64(units)
        total_low += low[i]
        total_high += high[i]
    if total_low > k or total_high < k:
        return -np.inf, -1
    settled = total_low == k or total_high == k
    if settled:
        for i in range(num_rows):
            c[i] = low[i] if total_low == k else high[i]
    whole = True
    branch = -1
    score = -1.0
    for i in range(num_rows):
        away = abs(c[i] - np.round(c[i]))
        if away > _WHOLE:
            whole = False
        if low[i] < high[i]:
            # The most fractional; among whole ones the one nearest to changing.
            this = away if away > _WHOLE else _WHOLE / (1.0 + abs(leverage[i] - cut))
            if this > score:
                score = this
                branch = i
    if whole:
        counts = np.empty(num_rows, dtype=np.int64)
        total = 0
        for i in range(num_rows):
            counts[i] = np.int64(np.round(c[i]))
            total += counts[i]
        if total == k:
            gram_of(rows, counts, gram)
            offer(counts, factor(gram, inverse), best_counts, best_values)
    if settled or bound <= best_values[last] + slack:
        return -np.inf, -1
    return bound, branch


@njit(cache=True, nogil=True)
def search(
    rows, columns, k, slack, lows, highs, weights, bounds, size,
    best_counts, best_values, widest, node_limit,
):  # fmt: skip
    """Branch until no open node is left, the room is full or the nodes are spent.

    Args:
        rows, columns: (M, p) and (p, M).
        k: selections in all.
        slack: see :func:`process`.
        lows, highs, weights, bounds: (room, M) x 3 and (room,) open nodes.
        size: open nodes at the start.
        best_counts, best_values: incumbents, changed in place.
        widest: open nodes up to which the best bound goes first, then the newest.
        node_limit: nodes to process at most.

    Returns:
        Open nodes left and nodes processed.
    """
    num_rows, p = rows.shape
    room = len(bounds)
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    work = np.empty((2, num_rows))
    low = np.empty(num_rows, dtype=np.int64)
    high = np.empty(num_rows, dtype=np.int64)
    c = np.empty(num_rows)
    leverage = np.empty(num_rows)
    last = len(best_values) - 1
    nodes = 0
    while size > 0 and nodes < node_limit and size + 2 <= room:
        pick = size - 1
        if size <= widest:
            for r in range(size):
                if bounds[r] > bounds[pick]:
                    pick = r
        parent = bounds[pick]
        low[:] = lows[pick]
        high[:] = highs[pick]
        c[:] = weights[pick]
        size -= 1
        if pick != size:
            lows[pick] = lows[size]
            highs[pick] = highs[size]
            weights[pick] = weights[size]
            bounds[pick] = bounds[size]
        if parent <= best_values[last] + slack:
            continue
        nodes += 1
        bound, branch = process(
            rows, columns, low, high, c, k, slack,
            best_counts, best_values, gram, inverse, work,
        )  # fmt: skip
        if branch < 0:
            continue
        bound = min(bound, parent)
        leverage[:] = work[1]
        split = np.int64(np.floor(c[branch] + _WHOLE))
        split = min(max(split, low[branch]), high[branch] - 1)
        for side in range(2):
            lows[size] = low
            highs[size] = high
            weights[size] = c
            bounds[size] = bound
            if side == 0:
                highs[size, branch] = split
            else:
                lows[size, branch] = split + 1
            if _balance(rows, lows[size], highs[size], weights[size], k, leverage):
                size += 1
    return size, nodes
