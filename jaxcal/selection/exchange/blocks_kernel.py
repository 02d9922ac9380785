"""Compiled greedy and exchange on blocks, for log det and trace of any C M^-1 C.T.

V is the inverse information, D_jj = B_j V B_j.T. Of a candidate j that comes in and one
i that goes out (or none), with K = (I + D_jj)^-1, Z = D_ij K,

    Y = I - D_ii + Z D_ji,          det grows by det(I + D_jj) det Y,

and with X = V C.T C V and H_ij = B_i X B_j.T the trace of C V C.T falls by

    trace(K H_jj) - trace(Y^-1 (H_ii + Q Z.T + Z Q.T)),      Q = Z H_jj / 2 - H_ij.

No removal alone is inverted, so a chosen block that is indispensable does no harm. For
a subset of the parameters, log det of (C V C.T)^-1 is that of the information less that
of the nuisance parameters, whose inverse is X = V - V C.T (C V C.T)^-1 C V: the same
formula twice. What does not depend on i (D_jj, H_jj, K, and the gain of j alone) is
kept; a swap changes V and X by Woodbury's formula, and both are made anew where
cancellation could show, and before the climb ends. A swap is accepted only where phi of
the sums made anew has risen, so no selection comes back.

Candidates are held in groups of ``WIDE``, arrays (q, q, WIDE) or (q, p, WIDE), with
innermost loops over a group: their length is known to the compiler, and what belongs to
a group stays in the first cache.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import INNER, add_block, factor

__all__ = ["DET", "SUBSET", "TRACE", "WIDE", "grow_and_climb"]

DET, SUBSET, TRACE = 0, 1, 2  # log det of all, or of some parameters; a trace
WIDE = 64  # candidates in a group

_IMPROVES = 1e-11  # by which a swap must raise phi, relative above 1
_MOST_SWAPS = 100  # of each place, where a few are usual
_CANCELLED = 1e-3  # fall of the largest leverage that costs up to six digits of X
_LEAST = 1e-14  # a determinant below it is that of a singular matrix
_UNKNOWN = 1e13  # variance, in that of all candidates together, of mere rounding
_NONE = -1
_FUSED = {**INNER, "fastmath": {"contract"}}  # a product and a sum in one operation


@njit(**_FUSED)
def _add(into, weight, left, right):
    """``into += weight left.T @ right``, of (r, a) and (r, b)."""
    for r in range(len(left)):
        for a in range(left.shape[1]):
            scaled = weight * left[r, a]
            for b in range(right.shape[1]):
                into[a, b] += scaled * right[r, b]


@njit(**_FUSED)
def _product(left, right):
    """``left @ right`` of small matrices."""
    out = np.zeros((len(left), right.shape[1]))
    for a in range(len(left)):
        for b in range(len(right)):
            for c in range(right.shape[1]):
                out[a, c] += left[a, b] * right[b, c]
    return out


@njit(**_FUSED)
def _transposed(matrix):
    out = np.empty((matrix.shape[1], len(matrix)))
    for a in range(len(matrix)):
        for b in range(matrix.shape[1]):
            out[b, a] = matrix[a, b]
    return out


@njit(**_FUSED)
def _value(kind, root, information, inverse, other):
    """phi of the information (p, p), -inf where singular to rounding.

    Args:
        kind: DET, SUBSET or TRACE.
        root: C (s, p).
        inverse, other: V and X (p, p), filled.
    """
    value = factor(information, inverse)
    if not value > -np.inf:
        return value
    for a in range(len(inverse)):
        if inverse[a, a] > _UNKNOWN:
            return -np.inf
    if kind == DET:
        return value
    half = _product(root, inverse)
    other[:] = 0.0
    if kind == TRACE:
        _add(other, 1.0, half, half)
        value = 0.0
        for r in range(len(half)):
            for a in range(len(inverse)):
                value -= half[r, a] * root[r, a]
        return value
    inner = _product(half, _transposed(root))
    small = np.empty(inner.shape)
    value = -factor(inner, small)
    for a in range(len(inverse)):
        for b in range(len(inverse)):
            other[a, b] = inverse[a, b]
    _add(other, -1.0, half, _product(small, half))
    return value


@njit(**_FUSED)
def _weigh(into, weights, rows, count):
    """``into = weights[:count] @ rows[:count]``, of (count,) and (count, WIDE)."""
    for j in range(WIDE):
        into[j] = 0.0
    whole = count - count % 4
    for a in range(0, whole, 4):
        w0, w1, w2, w3 = weights[a], weights[a + 1], weights[a + 2], weights[a + 3]
        x0, x1, x2, x3 = rows[a], rows[a + 1], rows[a + 2], rows[a + 3]
        for j in range(WIDE):
            into[j] += (w0 * x0[j] + w1 * x1[j]) + (w2 * x2[j] + w3 * x3[j])
    for a in range(whole, count):
        w, x = weights[a], rows[a]
        for j in range(WIDE):
            into[j] += w * x[j]


@njit(**_FUSED)
def _cross(columns, tall, out):
    """``tall @ B_j.T`` (r, q, WIDE) of (r, p) and (q, p, WIDE)."""
    q, p, _ = columns.shape
    for s in range(q):
        for r in range(len(tall)):
            _weigh(out[r, s], tall[r], columns[s], p)


@njit(**_FUSED)
def _fill(columns, matrix, part, grown):
    """``B_j matrix B_j.T`` (q, q, WIDE) of a symmetric matrix; part (q, WIDE)."""
    q, p, _ = columns.shape
    grown[:] = 0.0
    for a in range(p):
        half = 0.5 * matrix[a, a]
        for s in range(q):
            _weigh(part[s], matrix[a], columns[s], a)
            into, x = part[s], columns[s, a]
            for j in range(WIDE):
                into[j] += half * x[j]
        for r in range(q):
            for s in range(r + 1):
                into, x, y = grown[r, s], columns[r, a], columns[s, a]
                u, v = part[r], part[s]
                for j in range(WIDE):
                    into[j] += x[j] * v[j] + u[j] * y[j]
    for r in range(q):
        for s in range(r):
            into, x = grown[s, r], grown[r, s]
            for j in range(WIDE):
                into[j] = x[j]


@njit(**_FUSED)
def _times(into, weight, left, right, turned):
    """``into_j += weight left_j @ right_j``, or ``right_j.T``, of (q, q, WIDE)."""
    q = len(into)
    whole = q - q % 3
    for r in range(q):
        for s in range(q):
            out = into[r, s]
            for a in range(0, whole, 3):
                x0, x1, x2 = left[r, a], left[r, a + 1], left[r, a + 2]
                if turned:
                    y0, y1, y2 = right[s, a], right[s, a + 1], right[s, a + 2]
                else:
                    y0, y1, y2 = right[a, s], right[a + 1, s], right[a + 2, s]
                for j in range(WIDE):
                    out[j] += weight * (x0[j] * y0[j] + x1[j] * y1[j] + x2[j] * y2[j])
            for a in range(whole, q):
                x = left[r, a]
                y = right[s, a] if turned else right[a, s]
                for j in range(WIDE):
                    out[j] += weight * x[j] * y[j]


@njit(**_FUSED)
def _dots(into, weight, left, right):
    """``into_j += weight trace(left_j right_j.T)``, (WIDE,) of (q, q, WIDE)."""
    for r in range(len(left)):
        for s in range(len(left)):
            x, y = left[r, s], right[r, s]
            for j in range(WIDE):
                into[j] += weight * x[j] * y[j]


@njit(**_FUSED)
def _plus(into, weight, these, matrix):
    """``into_j = matrix + weight these_j`` of (q, q, WIDE) and (q, q)."""
    for r in range(len(into)):
        for s in range(len(into)):
            out, x, constant = into[r, s], these[r, s], matrix[r, s]
            for j in range(WIDE):
                out[j] = constant + weight * x[j]


@njit(**_FUSED)
def _invert(matrices, det):
    """Invert positive (q, q, WIDE) in place by sweeps; ``det`` (WIDE,) is filled."""
    q = len(matrices)
    for j in range(WIDE):
        det[j] = 1.0
    for a in range(q):
        pivot = matrices[a, a]
        for j in range(WIDE):
            det[j] *= pivot[j]
            pivot[j] = 1.0 / pivot[j]
        for r in range(q):
            if r != a:
                side = matrices[r, a]
                for j in range(WIDE):
                    side[j] *= pivot[j]
                for s in range(q):
                    if s != a:
                        into, over = matrices[r, s], matrices[a, s]
                        for j in range(WIDE):
                            into[j] -= side[j] * over[j]
        for s in range(q):
            if s != a:
                over = matrices[a, s]
                for j in range(WIDE):
                    over[j] *= -pivot[j]


@njit(**_FUSED)
def _keep(kind, grown, kept, alone, det):
    """Fill K (2, q, q, WIDE) and the gain of each candidate alone (WIDE,).

    The gain is the factor of the determinant, or the fall of the trace.
    """
    unit = np.eye(grown.shape[1])
    _plus(kept[0], 1.0, grown[0], unit)
    _invert(kept[0], alone)
    if kind == SUBSET:
        _plus(kept[1], 1.0, grown[1], unit)
        _invert(kept[1], det)
        for j in range(WIDE):
            alone[j] /= det[j]
    elif kind == TRACE:
        for j in range(WIDE):
            alone[j] = 0.0
        _dots(alone, 1.0, kept[0], grown[1])


@njit(**_FUSED)
def _shrink(grown, cross, at_out, kept, work, det):
    """Z and Y^-1 into ``work``, det Y into ``det``."""
    solved = work[0]
    solved[:] = 0.0
    _times(solved, 1.0, cross, kept, False)
    stay = np.eye(len(at_out))
    for r in range(len(stay)):
        for s in range(len(stay)):
            stay[r, s] -= at_out[r, s]
    _plus(work[1], 0.0, grown, stay)
    _times(work[1], 1.0, solved, cross, True)
    _invert(work[1], det)


@njit(**_FUSED)
def _swaps(kind, grown, cross, cross_other, at_out, kept, alone, work, det, gain):
    """gain_j (WIDE,) when j comes in and i goes out; as ``alone`` is of j alone.

    Args:
        grown, kept: D_jj and H_jj, and K, (2, q, q, WIDE).
        cross, cross_other: D_ij and H_ij (q, q, WIDE).
        at_out: D_ii and H_ii (2, q, q).
        work, det: (4, q, q, WIDE) and (WIDE,) work space.
    """
    _shrink(grown[0], cross, at_out[0], kept[0], work, det)
    if kind == DET:
        for j in range(WIDE):
            gain[j] = alone[j] * det[j]
        return
    if kind == SUBSET:
        for j in range(WIDE):
            gain[j] = alone[j] * det[j]
        _shrink(grown[1], cross_other, at_out[1], kept[1], work, det)
        for j in range(WIDE):
            gain[j] /= max(det[j], 1e-300)
        return
    part, lost = work[2], work[3]
    _plus(part, -1.0, cross_other, np.zeros(at_out[1].shape))
    _times(part, 0.5, work[0], grown[1], False)
    _plus(lost, 0.0, grown[1], at_out[1])
    _times(lost, 2.0, part, work[0], True)
    for j in range(WIDE):
        gain[j] = alone[j]
    _dots(gain, -1.0, work[1], lost)
    for j in range(WIDE):
        if not det[j] > _LEAST:  # singular without i
            gain[j] = -np.inf


@njit(**_FUSED)
def _inverse(matrix):
    """Invert a small matrix in place by sweeps, in the order of its rows."""
    size = len(matrix)
    for a in range(size):
        pivot = 1.0 / matrix[a, a]
        matrix[a, a] = pivot
        for r in range(size):
            if r != a:
                side = matrix[r, a] * pivot
                matrix[r, a] = side
                for s in range(size):
                    if s != a:
                        matrix[r, s] -= side * matrix[a, s]
        for s in range(size):
            if s != a:
                matrix[a, s] *= -pivot


@njit(**_FUSED)
def _middle(tall, changed, num_added):
    """``(I + A V A.T)^-1`` of blocks A (r, p) added, with -I for those removed."""
    middle = _product(tall, _transposed(changed))
    for r in range(len(middle)):
        middle[r, r] += 1.0 if r < num_added else -1.0
    _inverse(middle)
    return middle


@njit(**_FUSED)
def _mix(into, matrix, these):
    """``into_j += matrix @ these_j`` of (r, r) and (r, q, WIDE)."""
    for r in range(len(into)):
        for s in range(into.shape[1]):
            out = into[r, s]
            for a in range(len(into)):
                weight, x = matrix[r, a], these[a, s]
                for j in range(WIDE):
                    out[j] += weight * x[j]


@njit(**_FUSED)
def _lower(grown, left, right):
    """``grown_j -= left_j.T @ right_j + right_j.T @ left_j`` of (r, q, WIDE)."""
    for s in range(len(grown)):
        for t in range(s + 1):
            out = grown[s, t]
            for a in range(len(left)):
                x, y, u, v = left[a, s], right[a, t], right[a, s], left[a, t]
                for j in range(WIDE):
                    out[j] -= x[j] * y[j] + u[j] * v[j]
            if t < s:
                other = grown[t, s]
                for j in range(WIDE):
                    other[j] = out[j]


@njit(**_FUSED)
def _change(
    kind, columns, changed, num_crossed, matrices, grown, kept, alone, cross, work, det
):  # fmt: skip
    """Carry V, X and all that is kept over to other blocks chosen.

    Args:
        changed: (r, p) the block that comes in, then that which goes, if any.
        num_crossed: leading rows of ``cross`` (groups, 2, r, q, WIDE) to be filled.
        matrices: (2, p, p) V and X.
        work: (r, q, WIDE).
    """
    q = columns.shape[1]
    size = len(changed)
    tall = _product(changed, matrices[0])
    middle = _middle(tall, changed, q)
    half, mixed = 0.5 * middle, _product(middle, tall)
    wide, inside, outer, mixed_other = tall, middle, half, mixed
    if kind != DET:
        wide = _product(changed, matrices[1])
    if kind == TRACE:
        inside = _product(_product(middle, _product(wide, _transposed(changed))), half)
        outer = middle
        mixed_other = _product(middle, wide)
        _add(mixed_other, -1.0, _transposed(inside), tall)
    elif kind == SUBSET:
        outer = 0.5 * _middle(wide, changed, q)
        mixed_other = _product(outer, wide)
    for c in range(len(columns)):
        _cross(columns[c], tall[:num_crossed], cross[c, 0])
        under = work
        if kind != DET:
            _cross(columns[c], wide[:num_crossed], cross[c, 1])
            under[:] = 0.0
            _mix(under, outer, cross[c, 1, :size])
            if kind == TRACE:
                _mix(under, -inside, cross[c, 0, :size])
                _lower(grown[c, 1], cross[c, 0, :size], under)
            else:
                _lower(grown[c, 1], cross[c, 1, :size], under)
        under[:] = 0.0
        _mix(under, half, cross[c, 0, :size])
        _lower(grown[c, 0], cross[c, 0, :size], under)
        _keep(kind, grown[c], kept[c], alone[c], det)
    if kind != DET:
        first = tall if kind == TRACE else wide
        _add(matrices[1], -1.0, first, mixed_other)
        _add(matrices[1], -1.0, mixed_other, first)
    for r in range(size):
        for a in range(mixed.shape[1]):
            mixed[r, a] *= 0.5
    _add(matrices[0], -1.0, tall, mixed)
    _add(matrices[0], -1.0, mixed, tall)


@njit(**_FUSED)
def _best(gain, counts, upper):
    """The candidate of the largest gain that may be chosen once more, or none."""
    best, most = _NONE, -np.inf
    for c in range(len(gain)):
        for j in range(WIDE):
            if gain[c, j] > most and counts[c * WIDE + j] < upper[c * WIDE + j]:
                best, most = c * WIDE + j, gain[c, j]
    return best


@njit(**_FUSED)
def _largest(grown):
    """The largest diagonal entry of any D_jj."""
    largest = 0.0
    for c in range(len(grown)):
        for a in range(grown.shape[2]):
            for value in grown[c, 0, a, a]:
                largest = max(largest, value)
    return largest


@njit(**INNER)
def _sum(known, blocks, chosen, gram):
    """``gram = known + sum of B_i.T B_i`` of the chosen."""
    for a in range(len(gram)):
        for b in range(len(gram)):
            gram[a, b] = known[a, b]
    for i in chosen:
        add_block(gram, blocks, i, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def grow_and_climb(
    kind, root, blocks, columns, growing, swapping, upper, num_fixed, chosen, size,
    climbs,
):  # fmt: skip
    """Complete a selection greedily, then swap each for its best replacement.

    Args:
        kind, root: DET, SUBSET or TRACE, and C (s, p).
        blocks: (M, q, p).
        columns: (groups, q, p, WIDE) the same, with zeros after them.
        growing, swapping: (p, p) what is known while a selection grows, and then.
        upper: (groups WIDE,) how often each may be chosen, 0 after the M.
        num_fixed: leading entries of ``chosen`` that stay.
        chosen: (k,) of which the first ``size`` are there; changed in place.
        climbs: whether to swap, until no swap helps.

    Returns:
        phi of the selection; -inf where it, or the start of the swaps, is singular.
    """
    num_groups, q, p, _ = columns.shape
    k = len(chosen)
    shape = (num_groups, 2, q, q, WIDE)
    grown, kept = np.empty(shape), np.empty(shape)
    cross = np.empty((num_groups, 2, 2 * q, q, WIDE))
    alone, gain = np.empty((num_groups, WIDE)), np.empty((num_groups, WIDE))
    work, change = np.empty((4, q, q, WIDE)), np.empty((2 * q, q, WIDE))
    det, part = np.empty(WIDE), np.empty((q, WIDE))
    gram, matrices = np.empty((p, p)), np.empty((2, p, p))
    at_out, changed = np.empty((2, q, q)), np.empty((2 * q, p))
    counts = np.zeros(num_groups * WIDE, dtype=np.int64)
    for i in chosen[:size]:
        counts[i] += 1
    trial = np.empty((2, p, p))
    value, peak = -np.inf, 0.0
    stale, fresh = True, False
    since, position, swaps = 0, num_fixed, 0
    while size < k or climbs:
        grows = size < k
        if not grows and since == k - num_fixed:
            if fresh:
                return value
            stale = True
        if stale:
            _sum(growing if grows else swapping, blocks, chosen[:size], gram)
            now = _value(kind, root, gram, matrices[0], matrices[1])
            if not grows:
                if k == num_fixed or not now > -np.inf:
                    return now
                value, since = now, 0
            for c in range(num_groups):
                _fill(columns[c], matrices[0], part, grown[c, 0])
                if kind != DET:
                    _fill(columns[c], matrices[1], part, grown[c, 1])
                _keep(kind, grown[c], kept[c], alone[c], det)
            peak = _largest(grown)
            stale, fresh = False, True
        out = _NONE
        if grows:
            best = _best(alone, counts, upper)
        else:
            out = chosen[position]
            for r in range(q):
                for a in range(p):
                    changed[q + r, a] = blocks[out, r, a]
                for s in range(q):
                    for m in range(2):
                        at_out[m, r, s] = grown[out // WIDE, m, r, s, out % WIDE]
            tall, wide = _product(changed[q:], matrices[0]), changed
            if kind != DET:
                wide = _product(changed[q:], matrices[1])
            for c in range(num_groups):
                _cross(columns[c], tall, cross[c, 0, q:])
                if kind != DET:
                    _cross(columns[c], wide, cross[c, 1, q:])
                _swaps(
                    kind, grown[c], cross[c, 0, q:], cross[c, 1, q:], at_out, kept[c],
                    alone[c], work, det, gain[c],
                )  # fmt: skip
            best = _best(gain, counts, upper)
        at = size if grows else position
        if grows:
            size += 1
            stale = size == k
        else:
            since += 1
            position = position + 1 if position + 1 < k else num_fixed
            if best == _NONE or best == out:
                continue
            rise = gain[best // WIDE, best % WIDE]
            if kind != TRACE:
                rise = np.log(rise)
            least = _IMPROVES * max(1.0, abs(value))
            if not rise > least:
                continue
            # Woodbury's formula may promise what is not there: sums made anew tell.
            chosen[at] = best
            _sum(swapping, blocks, chosen, gram)
            now = _value(kind, root, gram, trial[0], trial[1])
            if not now > value + least or swaps == _MOST_SWAPS * k:
                chosen[at] = out
                continue
            value, since = now, 0
            swaps += 1
            counts[out] -= 1
        counts[best] += 1
        chosen[at] = best
        if stale:
            continue
        for r in range(q):
            for a in range(p):
                changed[r, a] = blocks[best, r, a]
        _change(
            kind, columns, changed[: q if grows else 2 * q], q, matrices, grown, kept,
            alone, cross, change[: q if grows else 2 * q], det,
        )  # fmt: skip
        fresh = False
        largest = _largest(grown)
        stale = largest < _CANCELLED * peak
        peak = max(peak, largest)
    _sum(swapping, blocks, chosen, gram)
    return _value(kind, root, gram, matrices[0], matrices[1])
