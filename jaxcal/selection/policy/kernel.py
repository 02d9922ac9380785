"""What the compact network reads of a decision, compiled once for sets of every size.

Letters: E episodes, M candidates, p regressors, c choices made, F = 13 or 16 features.
Everything is float64; docs/policy.md describes every part.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["CLOSE", "conditional", "describe", "look_ahead"]

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

CLOSE = (32.0, 256.0, 2048.0)  # scales at which near-equal look-aheads differ
_LOWEST = -30.0  # log-volume of a candidate that is not active or not looked ahead from
_FLOOR = -8.0  # least log-volume, relative to the best, that a feature shows
_RIDGE = 0.01  # of the metric of fewer choices than regressors
_LEAST_RIDGE = 1e-6  # of the metric of more
_LEAST_GAIN = 1e-5  # as in training, where float32 shows the rounding of zero below it
_ALL_START = 1024  # candidates up to which every one is looked ahead from
_STARTS = 512  # of more candidates, those of largest gain that are

# Sums may be taken in any order, and no number is NaN.
_FAST = {"nnan", "nsz", "contract", "reassoc"}
_compiled = njit(cache=True, nogil=True, fastmath=_FAST)


@_compiled
def describe(
    x: Array,
    chosen: Indices,
    active: Mask,
    k: int,
    depth: int,
    best_only: bool,
    features: Array32,
    moments: Array32,
    ahead: Array,
) -> Any:
    """Geometry of E decisions.

    Args:
        x: (E, p, M) whitened regressors with mean square 1, 0 where masked.
        chosen: (E, c) choices made.
        active: (E, M) True where a candidate counts.
        k: choices in all.
        depth: choices to look ahead, the next included; at least 1.
        best_only: write ``ahead`` alone, and that as ``look_ahead`` says.
        features: (E, M, F) written, 0 where not active; the close-ups if F = 16.
        moments: (E, p (p + 1) / 2, M) written: second moments of what is left of the
            candidates, scaled so that messages keep their size.
        ahead: (E, M) written: log-volume at the end of the look-ahead, behind the best.
    """
    episodes, p, m = x.shape
    values = np.empty((4, m))
    for b in range(episodes):
        y = conditional(x[b], chosen[b], active[b], k)
        look_ahead(y, active[b], k > p, depth, best_only, None, values)
        for d in range(4):
            best = _LOWEST
            for j in range(m):
                best = max(best, values[d, j])
            for j in range(m):
                values[d, j] = max(values[d, j] - best, _LOWEST)
        ahead[b] = values[3]
        if best_only:
            continue
        number, total = 0, 0.0
        for j in range(m):
            number += active[b, j]
            for c in range(p):
                total += y[c, j] * y[c, j]
        mean_square = max(total / max(number, 1), 1e-8)
        scale = 1.0 / (mean_square * math.sqrt(max(number, 1)))
        for j in range(m):
            square, f = 0.0, 0
            for c in range(p):
                square += y[c, j] * y[c, j]
                for e in range(c, p):
                    # Their inner product for x and y is (x . y)^2.
                    factor = 1.0 if c == e else math.sqrt(2.0)
                    moments[b, f, j] = y[c, j] * y[e, j] * factor * scale
                    f += 1
            if not active[b, j]:
                features[b, j] = 0.0
                continue
            for d in range(4):
                short = max(values[d, j], _FLOOR)
                grown = math.exp(short)
                features[b, j, d] = short / 2.0
                features[b, j, 4 + d] = grown
                features[b, j, 8 + d] = grown * grown * grown * grown
            level = math.log(max(square, 1e-6) / mean_square)
            features[b, j, 12] = min(max(level, _FLOOR), 4.0) / 2.0
            for d in range(13, features.shape[2]):
                # Float32 below exp(-80) would be subnormal, with which sums are slow.
                near = max(CLOSE[d - 13] * values[3, j], -80.0)
                features[b, j, d] = math.exp(near)


@_compiled
def conditional(x: Array, chosen: Indices, active: Mask, k: int) -> Any:
    """(p, M) what is left of every active candidate once some are chosen, 0 elsewhere.

    With k = p every choice is a new direction, which leaves the other candidates. With
    more, the result is in the metric of the chosen, ``|y_i|^2 = x_i.T G^-1 x_i`` with
    ``G = C.T C + ridge I``: each choice shortens its direction.

    Args:
        x: (p, M).
        chosen: (c,).
        active: (M,).
        k: choices in all.
    """
    p, m = x.shape
    y = x.copy()
    if k > p:
        ridge = _RIDGE if len(chosen) < p else _LEAST_RIDGE
        for c in range(p):
            for j in range(m):
                y[c, j] /= math.sqrt(ridge)
    inner = np.empty(m)
    unit = np.empty(p)
    for newest in chosen:
        size, whole = 0.0, 0.0
        for c in range(p):
            unit[c] = y[c, newest]
            size += unit[c] * unit[c]
            whole += x[c, newest] * x[c, newest]
        if size <= 1e-9 * whole:
            continue
        keep = 1.0 / math.sqrt(1.0 + size) if k > p else 0.0
        inner[:] = 0.0
        for c in range(p):
            for j in range(m):
                inner[j] += unit[c] * y[c, j]
        for c in range(p):
            along = (1.0 - keep) / size * unit[c]
            for j in range(m):
                y[c, j] -= along * inner[j]
    for c in range(p):
        for j in range(m):
            y[c, j] *= active[j]
    return y


@_compiled
def look_ahead(
    y: Array,
    active: Mask,
    spanned: bool,
    depth: int,
    best_only: bool,
    factors: Array | None,
    values: Array,
) -> Any:
    """Log of the factor by which the determinant grows over 1, 2, 3 and all choices,
    the first of them a given candidate and the others greedy.

    From every start it is Cholesky's factorisation of the candidates' inner products,
    the largest pivot next. One start at a time: memory grows with M, not its square. Of
    more than 1,024 candidates only the 512 of largest gain are looked ahead from.

    Args:
        y: (p, M) vectors of the candidates given what was chosen, 0 where not active.
        active: (M,).
        spanned: True where choosing i multiplies the determinant by ``1 + |y_i|^2``,
            False where by ``|y_i|^2``.
        depth: choices to look at, the start included; at least 1.
        best_only: skip the starts that cannot lead furthest: gains only fall.
        factors: (M, M), at most 1, what a move from each to each multiplies gains by
            (the toll of its time); None where moves cost nothing.
        values: (4, M) written: after ``min(d, depth)`` choices for d = 1, 2, 3 and
            ``depth``; -30 (with factors ``-inf``) where not active, and after the first
            where skipped.
    """
    p, m = y.shape
    base = 1.0 if spanned else 0.0
    square = np.zeros(m)
    gains = np.empty(m)  # of every candidate, after the choices made from a start
    rows = np.empty((depth, m))  # of the factor, one a choice
    row = np.empty(m)
    for c in range(p):
        for j in range(m):
            square[j] += y[c, j] * y[c, j]
    values[:] = _LOWEST if factors is None else -np.inf
    for j in range(m):
        if active[j]:
            values[0, j] = math.log(max(base + square[j], _LEAST_GAIN))
        else:
            square[j] = -1.0
    least = _least_start(square) if m > _ALL_START else 0.0
    best, each = _LOWEST, 0.0
    if best_only:
        each = math.log(max(base + square.max(), _LEAST_GAIN))
    for i in range(m):
        if square[i] < least or (
            best_only and values[0, i] + (depth - 1) * each < best
        ):
            continue
        gains[:] = square
        reached, newest = values[0, i], i
        for d in range(1, depth):
            factor = 1.0 / math.sqrt(max(base + gains[newest], _LEAST_GAIN))
            gains[newest] = -1.0
            row[:] = 0.0
            for c in range(p):
                weight = factor * y[c, newest]
                for j in range(m):
                    row[j] += weight * y[c, j]
            for e in range(1, d):
                weight = factor * rows[e, newest]
                for j in range(m):
                    row[j] -= weight * rows[e, j]
            gain = 0.0
            for j in range(m):
                rows[d, j] = row[j]
                gains[j] -= row[j] * row[j]
                gain = max(gain, gains[j])
            if factors is None:
                newest = 0
                while newest < m - 1 and gains[newest] != gain:
                    newest += 1
                reached += math.log(max(base + gain, _LEAST_GAIN))
            else:
                here, most = newest, -1.0
                for j in range(m):
                    grown = max(base + gains[j], _LEAST_GAIN) * factors[here, j]
                    if gains[j] > -0.5 and grown > most:  # -1 where taken
                        most, newest = grown, j
                reached += math.log(most)
            if d < 3:
                values[d, i] = reached
        for d in range(min(depth, 3), 4):
            values[d, i] = reached
        best = max(best, reached)


@_compiled
def _least_start(square: Array) -> Any:
    """The least squared length of a start, among (M,) of them, by bisection."""
    low, high = 0.0, 0.0
    for value in square:
        high = max(high, value)
    for _ in range(60):
        middle, count = 0.5 * (low + high), 0
        for value in square:
            count += value >= middle
        if count > _STARTS:
            low = middle
        else:
            high = middle
    return high
