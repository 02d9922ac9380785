"""Compiled branch and bound; ``jaxcal.selection.exact.branch_and_bound`` is its front.

A node bounds the count of every candidate, ``low_i <= c_i <= high_i``, sum k, and is
closed where the bound of its relaxation is no better than the incumbents. Forcing one
count away from the side the multiplier of that bound puts it on costs |d_i - cut| a
unit, d the leverages, which tightens ``low`` and ``high`` (reduced-cost fixing). All
counts are float64, whole or not, which compiles every function once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import INNER, gram_of
from jaxcal.selection.exact.criterion_kernel import (
    RANK,
    RANK_TRACE,
    TRACE,
    D,
    evaluate,
    new_local,
)
from jaxcal.selection.exact.relaxation_kernel import relax
from jaxcal.selection.exact.spectral_kernel import share_out, weigh, whiten

__all__ = ["offer_start", "process", "search"]

_WHOLE = 1e-9  # a count this near a whole number is that number
_SAME = 1e-7  # apart in value, selections are two without a look at their counts
_SMOOTHING = 30.0  # of E at first, where the eigenvalue is about 1


@njit(inline="always")
def value_of(problem, counts, local):
    """The criterion of a selection, -inf where it is singular."""
    gram_of(problem.blocks, counts, problem.prior, local.gram)
    local.settings[1] = np.inf  # E itself
    return evaluate(problem.kind, problem.root, local)[0]


@njit(**INNER)
def offer(value, counts, best_counts, best_values):
    """Insert a selection into the sorted list of the best, once."""
    size = len(best_values)
    if not value > best_values[size - 1]:
        return
    for r in range(size):
        same = abs(best_values[r] - value) < _SAME
        for i in range(len(counts)):
            same = same and best_counts[r, i] == counts[i]
        if same:
            return
    r = size - 1
    while r > 0 and best_values[r - 1] < value:
        best_values[r] = best_values[r - 1]
        for i in range(len(counts)):
            best_counts[r, i] = best_counts[r - 1, i]
        r -= 1
    best_values[r] = value
    for i in range(len(counts)):
        best_counts[r, i] = counts[i]


@njit(inline="always")
def offer_start(problem, low, high, counts, local, best_counts, best_values):
    """Offer a selection and, where several are wanted, all one swap away from it."""
    num_blocks = len(counts)
    swaps = num_blocks * num_blocks if len(best_values) > 1 else 1
    for swap in range(swaps):  # from i to j; the first is none
        i, j = swap // num_blocks, swap % num_blocks
        if (i != j and counts[i] > low[i] and counts[j] < high[j]) or swap == 0:
            counts[i] -= 1
            counts[j] += 1
            value = value_of(problem, counts, local)
            offer(value, counts, best_counts, best_values)
            counts[i] += 1
            counts[j] -= 1


@njit(**INNER)
def _copy(node, out):
    """A loop: slice assignments take numba seconds to compile."""
    for a in range(len(node)):
        for i in range(node.shape[1]):
            out[a, i] = node[a, i]


@njit(**INNER)
def _balance(node, k, leverage):
    """Move c into its bounds and back to sum k, keeping it near where it was."""
    low, high, c = node[0], node[1], node[2]
    num_blocks = len(c)
    total = 0.0
    for i in range(num_blocks):
        c[i] = min(max(c[i], low[i]), high[i])
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
        c[best] = min(max(moved, low[best]), high[best])
        total += c[best] - before
    return True


@njit(**INNER)
def _kind_of(problem, root, low, local):
    """Set P; RANK or RANK_TRACE where too few readings are left for the natural bound.

    That is where what is still to be chosen has fewer readings than parameters.
    """
    gram_of(problem.blocks, low, problem.prior, local.known)
    if root is None:
        return problem.kind
    local.settings[1] = _SMOOTHING
    p = problem.blocks.shape[2]
    left = problem.k
    for i in range(len(low)):
        left -= low[i]
    places = int(left) * problem.rank
    sharper = problem.kind == D or problem.kind == TRACE
    if not sharper or places >= p or places == 0:
        return problem.kind
    log_det = whiten(local.known, local.half)
    if not log_det > -np.inf:
        return problem.kind
    local.settings[2], local.settings[3] = places, log_det
    if problem.kind == D:
        return RANK
    weigh(root, local)
    return RANK_TRACE if share_out(local, p - 1 - places) else TRACE


@njit(inline="always")
def process(
    problem, low, high, c, slack, share, best_counts, best_values, local, leverage
):
    """Solve, tighten and, where settled, close one node.

    Args:
        problem: a Relaxation of M candidates.
        low, high, c: (M,) bounds and starting counts, changed in place.
        slack: a bound this far above the incumbent still closes the node.
        share: see :func:`relax`.
        best_counts, best_values: (best, M) and (best,) incumbents, changed in place.
        local, leverage: work space; leverage (M,) is used to branch.

    Returns:
        The node's upper bound (-inf when closed) and the candidate to branch on.
    """
    num_blocks, k = len(c), problem.k
    last = len(best_values) - 1
    goal = best_values[last] + slack
    kind = _kind_of(problem, problem.root, low, local)
    bound, cut = relax(problem, kind, low, high, c, goal, share, local, leverage)
    if bound <= goal:
        return -np.inf, -1
    total_low, total_high = 0.0, 0.0
    for i in range(num_blocks):
        if low[i] < high[i]:
            slope = leverage[i] - cut
            if (bound - goal) < abs(slope) * (high[i] - low[i]):
                units = np.floor((bound - goal) / abs(slope))
                if slope < 0.0:
                    high[i] = low[i] + units
                else:
                    low[i] = high[i] - units
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
        away = abs(c[i] - np.floor(c[i] + 0.5))
        if away > _WHOLE:
            whole = False
        if low[i] < high[i]:
            # The nearest below a whole number: with it chosen the bound is sharper.
            # Among whole ones the one nearest to changing.
            this = _WHOLE / (1.0 + abs(leverage[i] - cut))
            if away > _WHOLE:
                this = c[i] - np.floor(c[i])
            if this > score:
                score = this
                branch = i
    if whole:
        total = 0.0
        for i in range(num_blocks):
            c[i] = np.floor(c[i] + 0.5)
            total += c[i]
        if total == k:
            offer(value_of(problem, c, local), c, best_counts, best_values)
    if settled or bound <= best_values[last] + slack:
        return -np.inf, -1
    return bound, branch


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    problem, slack, share, nodes, bounds, size, best_counts, best_values, widest,
    node_limit,
):  # fmt: skip
    """Branch until no open node is left, the room is full or the nodes are spent.

    Args:
        problem: a Relaxation of M candidates.
        slack, share: see :func:`process`.
        nodes, bounds: (room, 3, M) and (room,) open nodes: lower and upper bounds of
            the counts, and counts to start from.
        size: open nodes at the start.
        best_counts, best_values: incumbents, changed in place.
        widest: open nodes up to which the best bound goes first, then the newest.
        node_limit: nodes to process at most.

    Returns:
        Open nodes left and nodes processed.
    """
    room, last = len(bounds), len(best_values) - 1
    local = new_local(problem.blocks.shape[2])
    node = np.empty(nodes.shape[1:])
    low, high, c = node[0], node[1], node[2]
    leverage = np.empty(len(c))
    done = 0
    if not best_values[0] > -np.inf:  # the root, and its weights are the start
        _copy(nodes[0], node)
        offer_start(problem, low, high, c, local, best_counts, best_values)
    while size > 0 and done < node_limit and size + 2 <= room:
        pick = size - 1
        if size <= widest:
            for r in range(size):
                if bounds[r] > bounds[pick]:
                    pick = r
        parent = bounds[pick]
        _copy(nodes[pick], node)
        size -= 1
        if pick != size:
            _copy(nodes[size], nodes[pick])
            bounds[pick] = bounds[size]
        if parent <= best_values[last] + slack:
            continue
        done += 1
        bound, branch = process(
            problem, low, high, c, slack, share, best_counts, best_values, local,
            leverage,
        )  # fmt: skip
        if branch < 0:
            continue
        split = np.floor(c[branch] + _WHOLE)
        split = min(max(split, low[branch]), high[branch] - 1.0)
        for side in range(2):
            _copy(node, nodes[size])
            bounds[size] = min(bound, parent)
            nodes[size, 1 - side, branch] = split + side
            if _balance(nodes[size], problem.k, leverage):
                size += 1
    return size, done
