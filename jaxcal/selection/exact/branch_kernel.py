"""Compiled branch and bound; ``jaxcal.selection.exact.branch_and_bound`` is its front.

A node bounds the count of every candidate, ``low_i <= c_i <= high_i``, sum k. Its
relaxation lets counts be real numbers; it is climbed by moving weight between two
candidates at a time. Any point on the way, with information M0 = P + sum c_i B_i.T B_i
and W its inverse, gives a true bound, by concavity and a scaling of W:

    log det M(c) <= log det M0 + p log(a / p),   a = max over c of trace(W M(c)),

which is tight at the relaxed optimum. With d_i = trace(B_i W B_i.T), the leverage,
``a`` is taken through one multiplier ``cut``:

    a = trace(W P) + k cut + sum of max(low_i (d_i - cut), high_i (d_i - cut)).

Forcing one count away from the side the multiplier puts it on costs |d_i - cut| a unit,
which tightens ``low`` and ``high`` wherever the bound then falls to the incumbent.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import (
    add_block,
    block_cross,
    block_products,
    factor,
    gram_of,
    row_cross,
    row_products,
)

__all__ = ["offer", "offer_swaps", "process", "relax", "search"]

_WHOLE = 1e-9  # a count this near a whole number is that number
_SOLVED = 1e-11  # spread of leverages that may move at the relaxed optimum
_MAX_STEPS = 4000
_SHARE = 0.05  # see relax: solving a node further rarely closes it


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
def offer_swaps(blocks, prior, low, high, counts, best_counts, best_values):
    """Offer every selection one swap away from ``counts`` (M,)."""
    num_blocks, _, p = blocks.shape
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    for i in range(num_blocks):
        if counts[i] > low[i]:
            counts[i] -= 1
            for j in range(num_blocks):
                if j != i and counts[j] < high[j]:
                    counts[j] += 1
                    gram_of(blocks, counts, prior, gram)
                    offer(counts, factor(gram, inverse), best_counts, best_values)
                    counts[j] -= 1
            counts[i] += 1


@njit(cache=True, nogil=True)
def _leverages(columns, inverse, products, leverage, curvature):
    """Fill leverage (M,), trace(B_j V B_j.T), and for q > 1 its curvature (M,).

    ``curvature_j`` is the squared Frobenius norm of B_j V B_j.T; ``products`` is work
    space (q, q, M).
    """
    q = len(columns)
    if q == 1:
        row_products(columns[0], columns[0], inverse, True, leverage)
        return
    block_products(columns, inverse, products)
    for j in range(len(leverage)):
        leverage[j] = 0.0
        curvature[j] = 0.0
        for r in range(q):
            leverage[j] += products[r, r, j]
            curvature[j] += products[r, r, j] ** 2
            for s in range(r):
                curvature[j] += 2.0 * products[r, s, j] ** 2


@njit(cache=True, nogil=True)
def _cross_squares(columns, inverse, block, products, out):
    """out_j = squared Frobenius norm of ``block inverse B_j.T``; products as above."""
    q = len(columns)
    if q == 1:
        row_cross(columns[0], inverse, block, 0, out)
        for j in range(len(out)):
            out[j] *= out[j]
        return
    block_cross(columns, inverse, block, products)
    for j in range(len(out)):
        out[j] = 0.0
        for r in range(q):
            for s in range(q):
                out[j] += products[r, s, j] ** 2


@njit(cache=True, nogil=True)
def _balance(low, high, c, k, leverage):
    """Move c into its bounds and back to sum k, keeping it near where it was."""
    num_blocks = len(c)
    total = 0.0
    for i in range(num_blocks):
        c[i] = min(max(c[i], float(low[i])), float(high[i]))
        total += c[i]
    while abs(total - k) > 1e-12:
        best = -1
        for i in range(num_blocks):
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
def relax(
    blocks, columns, prior, low, high, c, k, goal, share, gram, inverse, work
):  # fmt: skip
    """Climb the relaxation of a node until it is pruned, or solved well enough.

    Args:
        blocks, columns, prior: (M, q, p), (q, p, M), (p, p).
        low, high, c: (M,) bounds, and the weights to start from, changed in place.
        k: selections in all.
        goal: a bound at or below it ends the climb.
        share: so does a bound this share of its distance to the goal from solved.
        gram, inverse: (p, p) work space.
        work: (3, M); the first row holds the leverages afterwards.

    Returns:
        log det of the matrix the bound is taken at, the linear maximum a, and the
        multiplier behind it; the bound is ``log det + p log(a / p)``. log det is -inf
        where every selection of the node is singular.
    """
    num_blocks, q, p = blocks.shape
    leverage, curvature, cross = work[0], work[1], work[2]
    products = np.empty((q, q, num_blocks))
    gram_of(blocks, c, prior, gram)
    value = factor(gram, inverse)
    if not value > -np.inf:
        _spread(low, high, c, k)
        gram_of(blocks, c, prior, gram)
        value = factor(gram, inverse)
        if not value > -np.inf:
            return value, 0.0, 0.0
    most, cut = 0.0, 0.0
    for step_number in range(_MAX_STEPS):
        _leverages(columns, inverse, products, leverage, curvature)
        up, down = -1, -1
        for i in range(num_blocks):
            if c[i] < high[i] and (up < 0 or leverage[i] > leverage[up]):
                up = i
            if c[i] > low[i] and (down < 0 or leverage[i] < leverage[down]):
                down = i
        solved = up < 0 or down < 0 or leverage[up] - leverage[down] <= _SOLVED
        if solved or step_number % 4 == 0 or step_number == _MAX_STEPS - 1:
            most, cut = _linear_maximum(low, high, leverage, up, down, k)
            most += _trace(inverse, prior)
            gap = p * np.log(most / p)
            if solved or gap <= max(goal - value, 1e-11, share * (value - goal)):
                break
        _cross_squares(columns, inverse, blocks[up], products, cross)
        best, best_gain, best_step = -1, 0.0, 0.0
        rise = high[up] - c[up]
        for j in range(num_blocks):
            fall = c[j] - low[j]
            slope = leverage[up] - leverage[j]
            if fall > 0.0 and slope > 0.0:
                # One reading: det grows by 1 + step slope - step^2 curve, exactly.
                # More: the same to second order of log det, held to below.
                if q == 1:
                    curve = leverage[up] * leverage[j] - cross[j]
                else:
                    curve = 0.5 * (curvature[up] - 2.0 * cross[j] + curvature[j])
                step = min(rise, fall)
                if 2.0 * curve * step > slope:
                    step = slope / (2.0 * curve)
                gain = step * (slope - step * curve)
                if gain > best_gain:
                    best, best_gain, best_step = j, gain, step
        if best < 0:
            most, cut = _linear_maximum(low, high, leverage, up, down, k)
            most += _trace(inverse, prior)
            break
        fall = c[best] - low[best]
        before, moved = value, 0.0
        while True:
            add_block(gram, blocks, up, best_step - moved)
            add_block(gram, blocks, best, moved - best_step)
            moved = best_step
            value = factor(gram, inverse)
            if q == 1 or value >= before or best_step < 1e-12:
                break
            best_step *= 0.5
        c[up] = float(high[up]) if best_step == rise else c[up] + best_step
        c[best] = float(low[best]) if best_step == fall else c[best] - best_step
    return value, most, cut


@njit(cache=True, nogil=True)
def _trace(inverse, prior):
    """``trace(inverse prior)`` of symmetric matrices."""
    total = 0.0
    for a in range(len(prior)):
        for b in range(len(prior)):
            total += inverse[a, b] * prior[a, b]
    return total


@njit(cache=True, nogil=True)
def process(
    blocks, columns, prior, low, high, c, k, slack,
    best_counts, best_values, gram, inverse, work,
):  # fmt: skip
    """Solve, tighten and, where settled, close one node.

    Args:
        blocks, columns, prior: (M, q, p), (q, p, M), (p, p).
        low, high, c: (M,) bounds and starting weights, changed in place.
        k: selections in all.
        slack: a bound this far above the incumbent still closes the node.
        best_counts, best_values: (best, M) and (best,) incumbents, changed in place.
        gram, inverse, work: (p, p), (p, p), (3, M) work space.

    Returns:
        The node's upper bound (-inf when closed) and the candidate to branch on.
    """
    num_blocks, _, p = blocks.shape
    leverage = work[0]
    last = len(best_values) - 1
    goal = best_values[last] + slack
    value, most, cut = relax(
        blocks, columns, prior, low, high, c, k, goal, _SHARE, gram, inverse, work
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
    for i in range(num_blocks):
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
        for i in range(num_blocks):
            c[i] = low[i] if total_low == k else high[i]
    whole = True
    branch = -1
    score = -1.0
    for i in range(num_blocks):
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
        counts = np.empty(num_blocks, dtype=np.int64)
        total = 0
        for i in range(num_blocks):
            counts[i] = np.int64(np.round(c[i]))
            total += counts[i]
        if total == k:
            gram_of(blocks, counts, prior, gram)
            offer(counts, factor(gram, inverse), best_counts, best_values)
    if settled or bound <= best_values[last] + slack:
        return -np.inf, -1
    return bound, branch


@njit(cache=True, nogil=True)
def search(
    blocks, columns, prior, k, slack, lows, highs, weights, bounds, size,
    best_counts, best_values, widest, node_limit,
):  # fmt: skip
    """Branch until no open node is left, the room is full or the nodes are spent.

    Args:
        blocks, columns, prior: (M, q, p), (q, p, M), (p, p).
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
    num_blocks, _, p = blocks.shape
    room = len(bounds)
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    work = np.empty((3, num_blocks))
    low = np.empty(num_blocks, dtype=np.int64)
    high = np.empty(num_blocks, dtype=np.int64)
    c = np.empty(num_blocks)
    leverage = np.empty(num_blocks)
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
            blocks, columns, prior, low, high, c, k, slack,
            best_counts, best_values, gram, inverse, work,
        )  # fmt: skip
        if branch < 0:
            continue
        bound = min(bound, parent)
        leverage[:] = work[0]
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
            if _balance(lows[size], highs[size], weights[size], k, leverage):
                size += 1
    return size, nodes
