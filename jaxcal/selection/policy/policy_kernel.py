"""What the compact network reads of a decision, compiled: CONTRIBUTING.md says how.

Letters: E episodes, M candidates, p regressors, c choices made, F = 13 or 16 features.
Everything is float64; docs/policy.md describes every part.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, exp, log, sqrt

CLOSE = (32.0, 256.0, 2048.0)  # scales at which near-equal look-aheads differ

# Compiled functions read C variables, which Python does not see.
_close = cython.declare(cython.double[3], [32.0, 256.0, 2048.0])
_LOWEST = cython.declare(cython.double, -30.0)  # log-volume where none is computed
_FLOOR = cython.declare(cython.double, -8.0)  # least, behind the best, a feature shows
_RIDGE = cython.declare(cython.double, 0.01)  # of the metric of c < p choices
_LEAST_RIDGE = cython.declare(cython.double, 1e-6)  # of the metric of more
# As in training, where float32 shows the rounding of zero below it:
_LEAST_GAIN = cython.declare(cython.double, 1e-5)
_ALL_START = cython.declare(cython.int, 1024)  # M up to which all are looked ahead from
_STARTS = cython.declare(cython.int, 512)  # of more, those of largest gain that are


def describe(x, chosen, active, k, depth, best_only, features, moments, ahead):
    """Geometry of E decisions.

    Args:
        x: (E, p, M) whitened regressors with mean square 1, 0 where masked.
        chosen, active: (E, c) int64 choices made, of k; (E, M) who counts.
        depth: choices to look ahead, the next included; at least 1.
        best_only: write ``ahead`` alone, and that as ``look_ahead`` says.
        features: (E, M, F) float32 written, 0 where not active; close-ups if F = 16.
        moments: (E, p (p + 1) / 2, M) float32 written, scaled second moments.
        ahead: (E, M) written: log-volume at the end of the look-ahead, behind the best.
    """
    p, m = x.shape[1:]
    vectors: cython.double[:, :, ::1] = np.ascontiguousarray(x)
    made: cython.Py_ssize_t[:, :] = chosen
    active_bytes: cython.uchar[:, ::1] = np.ascontiguousarray(active).view(np.uint8)
    shown: cython.float[:, :, ::1] = features
    second: cython.float[:, :, ::1] = moments
    behind: cython.double[:, ::1] = ahead
    y: cython.double[:, ::1] = np.empty((p, m))
    values: cython.double[:, ::1] = np.empty((4, m))
    work: cython.double[:, ::1] = np.empty((p + depth + 2, m))
    weights: cython.double[::1] = np.empty(p + depth)
    all_of: cython.Py_ssize_t = k
    far: cython.Py_ssize_t = depth
    spanned: cython.bint = k > p
    only: cython.bint = best_only
    b: cython.Py_ssize_t
    with cython.nogil:
        for b in range(vectors.shape[0]):
            _conditional(vectors[b], made[b], active_bytes[b], all_of, y, work[0])
            _look_ahead(y, active_bytes[b], spanned, far, only, values, work, weights)
            _behind_best(values)
            behind[b] = values[3]
            if not only:
                _features(y, active_bytes[b], values, shown[b], second[b])


def _behind_best(values):
    """Values less the largest of their row, at least ``_LOWEST``."""
    for d in range(values.shape[0]):
        best: cython.double = _LOWEST
        for j in range(values.shape[1]):
            best = max(best, values[d, j])
        for j in range(values.shape[1]):
            values[d, j] = max(values[d, j] - best, _LOWEST)


def _features(y, active, values, features, moments):
    """What ``describe`` writes of one decision."""
    p, m = y.shape[0], y.shape[1]
    number: cython.Py_ssize_t = 0
    f: cython.Py_ssize_t = 0
    total: cython.double = 0.0
    for c in range(p):
        for j in range(m):
            total += y[c, j] * y[c, j]
    for j in range(m):
        number += active[j]
    mean_square = max(total / max(number, 1), 1e-8)
    scale = 1.0 / (mean_square * sqrt(max(number, 1)))
    for c in range(p):
        for e in range(c, p):
            # Their inner product for x and y is (x . y)^2.
            factor = scale if c == e else sqrt(2.0) * scale
            for j in range(m):
                moments[f, j] = y[c, j] * y[e, j] * factor
            f += 1
    for j in range(m):
        if not active[j]:
            features[j, :] = 0.0
            continue
        square: cython.double = 0.0
        for c in range(p):
            square += y[c, j] * y[c, j]
        for d in range(4):
            short = max(values[d, j], _FLOOR)
            grown = exp(short)
            features[j, d] = short / 2.0
            features[j, 4 + d] = grown
            features[j, 8 + d] = grown * grown * grown * grown
        level = log(max(square, 1e-6) / mean_square)
        features[j, 12] = min(max(level, _FLOOR), 4.0) / 2.0
        for d in range(13, features.shape[1]):
            # Float32 below exp(-80) would be subnormal, with which sums are slow.
            features[j, d] = exp(max(_close[d - 13] * values[3, j], -80.0))


def _conditional(x, chosen, active, k, y, inner):
    """y (p, M): what is left of every active candidate after the choices, else 0.

    With k = p every choice is a new direction, which leaves the other candidates. With
    more, the result is in the metric of the chosen, ``|y_i|^2 = x_i.T G^-1 x_i`` with
    ``G = C.T C + ridge I``: each choice shortens its direction.
    """
    p, m = x.shape[0], x.shape[1]
    least = _RIDGE if chosen.shape[0] < p else _LEAST_RIDGE
    shrink = 1.0 / sqrt(least) if k > p else 1.0
    for c in range(p):
        for j in range(m):
            y[c, j] = x[c, j] * shrink
    for i in range(chosen.shape[0]):
        newest = chosen[i]
        size: cython.double = 0.0
        whole: cython.double = 0.0
        for c in range(p):
            size += y[c, newest] * y[c, newest]
            whole += x[c, newest] * x[c, newest]
        if size <= 1e-9 * whole:
            continue
        keep = 1.0 / sqrt(1.0 + size) if k > p else 0.0
        inner[:] = 0.0
        for c in range(p):
            unit = y[c, newest]
            for j in range(m):
                inner[j] += unit * y[c, j]
        for c in range(p):
            along = (1.0 - keep) / size * y[c, newest]
            for j in range(m):
                y[c, j] -= along * inner[j]
    for c in range(p):
        for j in range(m):
            y[c, j] *= active[j]


def look_ahead(y, active, spanned, depth, best_only, values):
    """Log of the factor by which the determinant grows over 1, 2, 3 and all choices,
    the first of them a given candidate and the others greedy.

    From every start it is Cholesky's factorisation of the candidates' inner products,
    the largest pivot next. One start at a time: memory grows with M, not its square. Of
    more than 1,024 candidates only the 512 of largest gain are looked ahead from.

    Args:
        y, active: (p, M) vectors given what was chosen, 0 where not active; (M,) bool.
        spanned: choosing i multiplies the determinant by ``1 + |y_i|^2``; if False by
            ``|y_i|^2``.
        depth: choices to look at, the start included; at least 1.
        best_only: skip the starts that cannot lead furthest: gains only fall.
        values: (4, M) written: after ``min(d, depth)`` choices for d = 1, 2, 3 and
            ``depth``; -30 where not active, and after the first where skipped.
    """
    vectors: cython.double[:, ::1] = y
    active_bytes: cython.uchar[::1] = active.view(np.uint8)
    to: cython.double[:, ::1] = values
    work: cython.double[:, ::1] = np.empty((len(y) + depth + 2, len(active)))
    factor: cython.double[::1] = np.empty(len(y) + depth)
    grows: cython.bint = spanned
    ahead: cython.Py_ssize_t = depth
    only: cython.bint = best_only
    with cython.nogil:
        _look_ahead(vectors, active_bytes, grows, ahead, only, to, work, factor)


def _look_ahead(y, active, spanned, depth, best_only, values, work, weights):
    """``look_ahead``, with room (p + depth + 2, M) and (p + depth,)."""
    p, m = y.shape[0], y.shape[1]
    base = 1.0 if spanned else 0.0
    square = work[p + depth]
    gains = work[p + depth + 1]  # of every candidate, after choices from a start
    # The vectors, then the factor's rows: the next is a sum of what stands above it.
    work[:p] = y
    square[:] = 0.0
    for c in range(p):
        for j in range(m):
            square[j] += y[c, j] * y[c, j]
    values[:, :] = _LOWEST
    largest: cython.double = 0.0
    for j in range(m):
        if active[j]:
            values[0, j] = log(max(base + square[j], _LEAST_GAIN))
        else:
            square[j] = -1.0
        largest = max(largest, square[j])
    least = _least_start(square, largest) if m > _ALL_START else 0.0
    most_per_choice = log(max(base + largest, _LEAST_GAIN))
    best: cython.double = _LOWEST
    watch: Watch = begin(INFINITY)
    for i in range(m):
        late(cython.address(watch))
        if square[i] < least or (
            best_only and values[0, i] + (depth - 1) * most_per_choice < best
        ):
            continue
        gains[:] = square
        reached: cython.double = values[0, i]
        newest: cython.Py_ssize_t = i
        for d in range(1, depth):
            factor = 1.0 / sqrt(max(base + gains[newest], _LEAST_GAIN))
            gains[newest] = -1.0
            for c in range(p):
                weights[c] = factor * y[c, newest]
            for c in range(p, p + d - 1):
                weights[c] = -factor * work[c, newest]
            _combine(weights, work, p + d - 1)
            row = work[p + d - 1]
            gain: cython.double = 0.0
            for j in range(m):
                gains[j] -= row[j] * row[j]
                gain = max(gain, gains[j])
            newest = 0
            while newest < m - 1 and gains[newest] != gain:
                newest += 1
            reached += log(max(base + gain, _LEAST_GAIN))
            if d < 3:
                values[d, i] = reached
        for d in range(min(depth, 3), 4):
            values[d, i] = reached
        best = max(best, reached)
    return 0


def _combine(weights, rows, count):
    """``rows[count]`` is the weighted sum of those before it, four at a time."""
    m = rows.shape[1]
    out = rows[count]
    out[:] = 0.0
    done: cython.Py_ssize_t = 0
    while done + 4 <= count:
        w0, w1 = weights[done], weights[done + 1]
        w2, w3 = weights[done + 2], weights[done + 3]
        for j in range(m):
            out[j] += (
                w0 * rows[done, j]
                + w1 * rows[done + 1, j]
                + w2 * rows[done + 2, j]
                + w3 * rows[done + 3, j]
            )
        done += 4
    while done < count:
        w0 = weights[done]
        for j in range(m):
            out[j] += w0 * rows[done, j]
        done += 1


def _least_start(square, largest):
    """The least squared length of a start, among (M,) of them, by bisection."""
    low: cython.double = 0.0
    high = largest
    for _ in range(60):
        middle = 0.5 * (low + high)
        count: cython.Py_ssize_t = 0
        for j in range(square.shape[0]):
            count += square[j] >= middle
        if count > _STARTS:
            low = middle
        else:
            high = middle
    return high
