"""Compiled relaxation of a node: counts may be real numbers between their bounds.

The criterion phi is concave, so at any counts c, with leverages d,

    phi(any c') <= phi(c) + max over c' of sum of (c'_i - c_i) d_i

within the bounds and sum k: a true bound wherever the climb stops, tight at the relaxed
optimum. The climb is Newton's, on the fractional counts and those the leverages ask to
move; what it wants is a small quadratic programme, solved by an active set.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import INNER
from jaxcal.selection.exact.criterion_kernel import (
    RANK_TRACE,
    TRACE,
    E,
    evaluate,
    hessian,
)
from jaxcal.selection.exact.eigen_kernel import FAST
from jaxcal.selection.exact.spectral_kernel import best_place, share_out

__all__ = ["linear_gain", "relax"]

_SOLVED = 1e-11  # a bound this far above the value is solved
_MAX_STEPS = 80
_FRACTIONAL = 400  # counts that a Newton step moves at most
_RIDGE = 1e-10  # share of the largest curvature
_ROUNDING = 1e-12  # of a count that is whole
_TUNES = 2  # of mu of RANK_TRACE in one node
_SHARPEST = 1e5  # smoothing of E, where the eigenvalue is about 1


@njit(**INNER)
def _leverages(blocks, gradient, low, high, leverage):
    """Fill leverage (M,), ``trace(B_i G B_i.T)``, where the count is not fixed."""
    num_blocks, q, p = blocks.shape
    reach = np.empty(p)
    for i in range(num_blocks):
        leverage[i] = 0.0
        if low[i] < high[i]:
            for r in range(q):
                for b in range(p):
                    reach[b] = 0.0
                for a in range(p):
                    weight = blocks[i, r, a]
                    for b in range(p):
                        reach[b] += weight * gradient[a, b]
                for a in range(p):
                    leverage[i] += reach[a] * blocks[i, r, a]


@njit(**INNER)
def linear_gain(low, high, c, k, leverage):
    """Largest ``sum of (c'_i - c_i) d_i`` within the bounds, and its multiplier.

    The multiplier minimises ``k cut + sum of max(low_i (d_i - cut), high_i (d_i -
    cut))``, by bisection; any value of it gives a true bound.
    """
    least, most = np.inf, -np.inf
    for i in range(len(c)):
        if c[i] < high[i]:
            most = max(most, leverage[i])
        if c[i] > low[i]:
            least = min(least, leverage[i])
    if not (least < np.inf and most > -np.inf):
        return 0.0, most if most > -np.inf else least  # there is no other choice
    cut = 0.5 * (least + most)
    for _ in range(30):
        if most - least <= 1e-13 * abs(most):
            break
        room = 0.0
        for i in range(len(c)):
            room += high[i] if leverage[i] > cut else low[i]
        if room > k:
            least = cut
        elif room < k:
            most = cut
        else:
            break
        cut = 0.5 * (least + most)
    gain, total = 0.0, 0.0
    for i in range(len(c)):
        slope = leverage[i] - cut
        total += c[i]
        gain += ((high[i] if slope > 0.0 else low[i]) - c[i]) * slope
    return gain + (k - total) * cut, cut


@njit(**INNER)
def _working_set(low, high, c, leverage, cut, extra):
    """Counts to move: the fractional ones and ``extra`` of those that should move."""
    num_blocks = len(c)
    wish = np.zeros(num_blocks)
    fractional = 0
    largest = 0.0
    for i in range(num_blocks):
        slope = leverage[i] - cut
        if low[i] < c[i] < high[i]:
            fractional += 1
        if low[i] < high[i] and (c[i] < high[i] if slope > 0.0 else c[i] > low[i]):
            wish[i] = abs(slope)
            largest = max(largest, wish[i])
    if fractional <= _FRACTIONAL:
        for i in range(num_blocks):
            if low[i] < c[i] < high[i]:
                wish[i] = 0.0
    else:
        fractional, extra = 0, _FRACTIONAL
    least = largest
    for _ in range(40):
        count = 0
        for i in range(num_blocks):
            count += wish[i] > 0.5 * least
        if count > extra:
            break
        least *= 0.5
    room, size = fractional + extra, 0
    which = np.empty(room, dtype=np.int64)
    for i in range(num_blocks):
        inside = fractional > 0 and low[i] < c[i] < high[i]
        if inside or (wish[i] > 0.0 and wish[i] >= least and size < room):
            which[size] = i
            size += 1
    return which[:size]


@njit(inline="always")
def _solve(matrix, which, size, x, y, lower):
    """x and y (m,) become their solutions by ``matrix`` at ``which[:size]``."""
    for a in range(size):
        for b in range(a + 1):
            total = matrix[which[a], which[b]]
            for c in range(b):
                total -= lower[a, c] * lower[b, c]
            if a == b:
                lower[a, a] = np.sqrt(max(total, 1e-3 * _RIDGE * matrix[0, 0]))
            else:
                lower[a, b] = total / lower[b, b]
        for c in range(a):
            x[a] -= lower[a, c] * x[c]
            y[a] -= lower[a, c] * y[c]
        x[a] /= lower[a, a]
        y[a] /= lower[a, a]
    for a in range(size - 1, -1, -1):
        x[a] /= lower[a, a]
        y[a] /= lower[a, a]
        for c in range(a):
            x[c] -= lower[a, c] * x[a]
            y[c] -= lower[a, c] * y[a]


@njit(**FAST)
def _quadratic_step(curvature, slope, least, most, move):
    """Maximise ``slope.x - x.curvature.x / 2``, sum x = 0, least <= x <= most.

    Args:
        curvature: (m, m) positive semidefinite; its diagonal is raised a little.
        slope: (m,), changed to the slope at the solution.
        least, most: (m,), zero between them.
        move: (m,) filled with x.
    """
    m = len(slope)
    lower = np.empty((m, m))
    x, ones = np.empty(m), np.empty(m)
    free = np.empty(m, dtype=np.int64)
    side = np.zeros(m, dtype=np.int64)  # -1, 1 where held at that bound
    largest = 0.0
    for i in range(m):
        largest = max(largest, curvature[i, i])
        move[i] = 0.0
    for i in range(m):
        curvature[i, i] += _RIDGE * largest
    for _ in range(4 * m + 8):
        size = 0
        for i in range(m):
            if side[i] == 0:
                free[size] = i
                x[size], ones[size] = slope[i], 1.0
                size += 1
        cut = 0.0
        if size:
            _solve(curvature, free, size, x, ones, lower)
            total, weight = 0.0, 0.0
            for f in range(size):
                total += x[f]
                weight += ones[f]
            cut = total / weight
            part, hit, at = 1.0, -1, 0
            for f in range(size):
                i = free[f]
                x[f] -= cut * ones[f]
                room = (most[i] if x[f] > 0.0 else least[i]) - move[i]
                if abs(x[f]) * part > abs(room):
                    part, hit, at = abs(room / x[f]), f, 1 if x[f] > 0.0 else -1
            if size > 1:
                for f in range(size):
                    move[free[f]] += part * x[f]
                    weight = part * x[f]
                    for i in range(m):
                        slope[i] -= weight * curvature[free[f], i]
                if hit >= 0:
                    i = free[hit]
                    side[i] = at
                    move[i] = most[i] if at > 0 else least[i]
                    continue
        # At rest on this face: let go of the count that pulls most from its bound.
        pull, best, other = 1e-9 * abs(cut), -1, -1
        up, down = -np.inf, np.inf
        for i in range(m):
            wish = side[i] * (cut - slope[i])
            if side[i] and size and wish > pull:
                pull, best = wish, i
            if side[i] < 0 and slope[i] > up and not size:
                up, best = slope[i], i
            if side[i] > 0 and slope[i] < down and not size:
                down, other = slope[i], i
        if not size:
            if best < 0 or other < 0 or not up > down:
                break
            side[other] = 0
        if best < 0:
            break
        side[best] = 0


@njit(**INNER)
def _spread(low, high, c, k):
    """Share what the lower bounds leave in proportion to the room of each count."""
    room, fixed = 0.0, 0.0
    for i in range(len(c)):
        room += high[i] - low[i]
        fixed += low[i]
    for i in range(len(c)):
        c[i] = low[i] + (k - fixed) * (high[i] - low[i]) / max(room, 1.0)


@njit(**INNER)
def _move(blocks, low, c, local):
    """N and M of the counts c, P being there."""
    _, q, p = blocks.shape
    rest, gram = local.rest, local.gram
    for a in range(p):
        for b in range(p):
            rest[a, b] = 0.0
    for i in range(len(c)):
        weight = c[i] - low[i]
        if weight != 0.0:
            for r in range(q):
                for a in range(p):
                    scaled = weight * blocks[i, r, a]
                    for b in range(a + 1):
                        rest[a, b] += scaled * blocks[i, r, b]
    for a in range(p):
        for b in range(a + 1):
            rest[b, a] = rest[a, b]
            gram[a, b] = local.known[a, b] + rest[a, b]
            gram[b, a] = gram[a, b]


@njit(inline="always")
def relax(problem, kind, low, high, c, goal, share, local, leverage):
    """Climb the relaxation of a node until it is pruned, or solved well enough.

    Args:
        problem: a Relaxation.
        kind: its kind, or RANK or RANK_TRACE, for which ``local`` has been set, as P
            always has.
        low, high, c: (M,) bounds, and the counts to start from, changed in place.
        goal: a bound at or below it ends the climb.
        share: so does a bound this share of its distance to the goal from solved.
        local: a Local.
        leverage: (M,) filled.

    Returns:
        The bound, -inf where every selection of the node is singular, and its
        multiplier.
    """
    blocks, k = problem.blocks, problem.k
    p = blocks.shape[2]
    value, base = -np.inf, -np.inf
    for attempt in range(2):
        if attempt == 1:
            _spread(low, high, c, k)
        _move(blocks, low, c, local)
        value, base = evaluate(kind, problem.root, local)
        if value > -np.inf:
            break
    if not value > -np.inf:
        return value, 0.0
    bound, cut = np.inf, 0.0
    tunes = _TUNES
    for step in range(_MAX_STEPS):
        _leverages(blocks, local.gradient, low, high, leverage)
        gain, cut = linear_gain(low, high, c, k, leverage)
        bound = base + gain
        enough = max(_SOLVED, share * (value - goal))
        if bound <= goal or step == _MAX_STEPS - 1:
            break
        solved = bound - value <= enough
        changed = False
        if problem.root is None:
            pass
        elif kind == RANK_TRACE:
            changed = tunes > 0 and (solved or step == 0)
            if changed:
                tunes -= 1
                kind = RANK_TRACE if share_out(local, best_place(local)) else TRACE
        elif kind == E and not solved:
            changed = gain <= 0.3 * (base - value)
            if changed and local.settings[1] >= _SHARPEST:
                break
            local.settings[1] *= 4.0 if changed else 1.0
        if changed:
            value, base = evaluate(kind, problem.root, local)
            continue
        if solved:
            break
        which = _working_set(low, high, c, leverage, cut, 2 * p + 4)
        m = len(which)
        curvature, move, before = np.empty((m, m)), np.empty(m), np.empty(m)
        slope, least, most = np.empty(m), np.empty(m), np.empty(m)
        for i in range(m):
            j = which[i]
            before[i], slope[i] = c[j], leverage[j]
            least[i], most[i] = low[j] - c[j], high[j] - c[j]
        hessian(kind, problem.root, blocks, which, local, curvature)
        _quadratic_step(curvature, slope, least, most, move)
        promised, part = 0.0, 1.0
        for i in range(m):
            promised += move[i] * leverage[which[i]]
        while True:
            for i in range(m):
                j = which[i]
                c[j] = before[i] + part * move[i]
                whole = np.floor(c[j] + 0.5)
                if abs(c[j] - whole) < _ROUNDING:
                    c[j] = whole
            _move(blocks, low, c, local)
            after, base = evaluate(kind, problem.root, local)
            if after >= value + 1e-4 * part * promised or part < 1e-6:
                break
            part *= 0.5
        if not after > value:
            break
        value = after
    return bound, cut
