"""Compiled greedy and exchange on blocks, for log det and trace of any C M^-1 C.T.

V is the inverse information, D_jj = B_j V B_j.T. Of a candidate j that comes in and one
i that goes out (or none), with K = (I + D_jj)^-1, Z = D_ij K,

    Y = I - D_ii + Z D_ji,          det grows by det(I + D_jj) det Y,

and with X = V C.T C V and H_ij = B_i X B_j.T the trace of C V C.T falls by

    trace(K H_jj) - trace(Y^-1 (H_ii + (Z H_jj - H_ij) Z.T - Z H_ji)).

No removal alone is inverted, so a chosen block that is indispensable does no harm. For
a subset of the parameters, log det of (C V C.T)^-1 is that of the information less that
of the nuisance parameters, whose inverse is X = V - V C.T (C V C.T)^-1 C V: the same
formula twice. V, X, D_jj and H_jj are updated by Woodbury's formula after a change and
made anew where cancellation could show. Matrices of all candidates are (q, q, M), with
loops over candidates inside, which the compiler vectorises; whole arrays are copied by
loops too, since a slice assignment of two axes takes numba five seconds to compile.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import add_block, factor

__all__ = ["DET", "SUBSET", "TRACE", "grow_and_climb"]

DET, SUBSET, TRACE = 0, 1, 2  # log det of all, or of some parameters; a trace

_IMPROVES = 1e-11  # by which a swap must raise phi, relative above 1
_SAME = 1e-9  # how far phi summed over swaps may be from phi computed at the end
_CANCELLED = 1e-3  # fall of the largest leverage that costs up to six digits of X
_NONE = -1
compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def _product(left, right):
    """``left @ right`` of small matrices."""
    out = np.zeros((len(left), right.shape[1]))
    for a in range(len(left)):
        for b in range(len(right)):
            for c in range(right.shape[1]):
                out[a, c] += left[a, b] * right[b, c]
    return out


@compiled
def _transposed(matrix):
    out = np.empty((matrix.shape[1], len(matrix)))
    for a in range(len(matrix)):
        for b in range(matrix.shape[1]):
            out[b, a] = matrix[a, b]
    return out


@compiled
def _add(into, weight, left, right):
    """``into += weight left.T @ right``, of (r, a) and (r, b)."""
    for r in range(len(left)):
        for a in range(left.shape[1]):
            scaled = weight * left[r, a]
            for b in range(right.shape[1]):
                into[a, b] += scaled * right[r, b]


@compiled
def _value(kind, root, information, inverse, other):
    """phi of the information (p, p), -inf where singular.

    Args:
        kind: DET, SUBSET or TRACE.
        root: C (s, p).
        inverse, other: V and X (p, p), filled.
    """
    value = factor(information, inverse)
    if kind == DET or not value > -np.inf:
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


@compiled
def _cross(columns, tall, flip, out):
    """``tall B_j.T``, transposed where ``flip``, (q, q, M) of (q, p) and (q, p, M)."""
    q, p, count = columns.shape
    out[:] = 0.0
    for s in range(q):
        for a in range(p):
            column = columns[s, a]
            for r in range(q):
                weight, into = tall[r, a], out[s, r] if flip else out[r, s]
                for j in range(count):
                    into[j] += weight * column[j]


@compiled
def _fill(columns, matrix, grown):
    """``B_j matrix B_j.T`` (q, q, M)."""
    q, p, count = columns.shape
    grown[:] = 0.0
    part = np.empty(count)
    for s in range(q):
        for a in range(p):
            part[:] = 0.0
            for b in range(p):
                weight, column = matrix[a, b], columns[s, b]
                for j in range(count):
                    part[j] += weight * column[j]
            for r in range(q):
                into, column = grown[r, s], columns[r, a]
                for j in range(count):
                    into[j] += part[j] * column[j]


@compiled
def _times(into, weight, left, right):
    """``into_j += weight left_j @ right_j.T`` of (q, q, M)."""
    q, _, count = into.shape
    for r in range(q):
        for s in range(q):
            out = into[r, s]
            for a in range(q):
                x, y = left[r, a], right[s, a]
                for j in range(count):
                    out[j] += weight * x[j] * y[j]


@compiled
def _dots(into, weight, left, right):
    """``into_j += weight trace(left_j right_j.T)``, (M,) of (q, q, M)."""
    q, _, count = left.shape
    for r in range(q):
        for s in range(q):
            x, y = left[r, s], right[r, s]
            for j in range(count):
                into[j] += weight * x[j] * y[j]


@compiled
def _plus(into, sign, these, matrix):
    """``into_j = matrix + sign these_j`` of (q, q, M) and (q, q)."""
    q, _, count = into.shape
    for r in range(q):
        for s in range(q):
            out, x, constant = into[r, s], these[r, s], matrix[r, s]
            for j in range(count):
                out[j] = constant + sign * x[j]


@compiled
def _invert(matrices, det):
    """Invert positive (q, q, M) in place by sweeps; ``det`` (M,) is filled."""
    q, _, count = matrices.shape
    det[:] = 1.0
    for a in range(q):
        pivot = matrices[a, a]
        for j in range(count):
            det[j] *= pivot[j]
            pivot[j] = 1.0 / pivot[j]
        for r in range(q):
            if r != a:
                side = matrices[r, a]
                for j in range(count):
                    side[j] *= pivot[j]
                for s in range(q):
                    if s != a:
                        into, over = matrices[r, s], matrices[a, s]
                        for j in range(count):
                            into[j] -= side[j] * over[j]
        for s in range(q):
            if s != a:
                over = matrices[a, s]
                for j in range(count):
                    over[j] *= -pivot[j]


@compiled
def _ratios(grown, cross, out, work, det, gain):
    """gain_j = what det is multiplied by when j comes in and ``out``, if any, goes.

    Args:
        grown, cross: D_jj and D_ij (q, q, M), i = ``out``, ignored where that is none.
        work: (3, q, q, M), becomes K, Z and Y^-1.
        det: (M,) work space.
    """
    inner, solved, left = work[0], work[1], work[2]
    _plus(inner, 1.0, grown, np.eye(len(grown)))
    _invert(inner, gain)
    if out == _NONE:
        return
    solved[:] = 0.0
    _times(solved, 1.0, cross, inner)
    stay = np.eye(len(grown))
    for r in range(len(grown)):
        for s in range(len(grown)):
            stay[r, s] -= grown[r, s, out]
    _plus(left, 0.0, grown, stay)
    _times(left, 1.0, solved, cross)
    _invert(left, det)
    for j in range(len(gain)):
        gain[j] *= det[j]


@compiled
def _falls(grown, cross, out, work, left, gain):
    """gain_j becomes the fall of the trace.

    Args:
        grown, cross: H_jj and H_ij (q, q, M).
        work, gain: as ``_ratios`` left them, changed.
        left: (3, q, q, M) work space.
    """
    part, lost, regular = left[0], left[1], left[2, 0, 0]
    for j in range(len(gain)):
        regular[j] = gain[j]
    gain[:] = 0.0
    _dots(gain, 1.0, work[0], grown)
    if out == _NONE:
        return
    solved, there = work[1], np.zeros(cross.shape[:2])
    _plus(part, -1.0, cross, there)
    _times(part, 1.0, solved, grown)
    for r in range(len(grown)):
        for s in range(len(grown)):
            there[r, s] = grown[r, s, out]
    _plus(lost, 0.0, cross, there)
    _times(lost, 1.0, part, solved)
    _times(lost, -1.0, solved, cross)
    _dots(gain, -1.0, work[2], lost)
    for j in range(len(gain)):
        if not regular[j] > 1e-14:  # singular without i
            gain[j] = -np.inf


@compiled
def _gains(
    kind, columns, block, inverse, other, grown, grown_other, out, cross, work, det,
    gain,
):  # fmt: skip
    """gain_j (M,): the rise of phi when j comes in and ``out``, if any, goes.

    ``block`` is that of ``out``; cross (2, q, q, M), work (6, q, q, M) and det (M,) are
    work space.
    """
    if out != _NONE:
        _cross(columns, _product(block, inverse), False, cross[0])
        if kind != DET:
            _cross(columns, _product(block, other), False, cross[1])
    _ratios(grown, cross[0], out, work, det, gain)
    if kind == TRACE:
        _falls(grown_other, cross[1], out, work, work[3:], gain)
        return
    for j in range(len(gain)):
        gain[j] = np.log(max(gain[j], 1e-300))
    if kind == SUBSET:
        nuisance = np.empty(len(gain))
        _ratios(grown_other, cross[1], out, work, det, nuisance)
        for j in range(len(gain)):
            gain[j] -= np.log(max(nuisance[j], 1e-300))


@compiled
def _woodbury(columns, block, sign, matrix, grown, cross, scaled):
    """Update an inverse (p, p), and its D_jj, for a block added or (-1) removed.

    Args:
        columns, block: (q, p, M) and (q, p).
        matrix, grown: (p, p) and (q, q, M), changed.
        cross: (q, q, M), becomes ``B_j matrix block.T`` of the old matrix.
        scaled: (q, q, M), becomes that times the first result.

    Returns:
        ``sign (I + sign block matrix block.T)^-1`` and the old ``block matrix``.
    """
    tall = _product(block, matrix)
    _cross(columns, tall, True, cross)
    middle, small = np.eye(len(block)), np.empty((len(block), len(block)))
    for r in range(len(block)):
        for s in range(len(block)):
            for a in range(len(matrix)):
                middle[r, s] += sign * tall[r, a] * block[s, a]
    factor(middle, small)
    for r in range(len(block)):
        for s in range(len(block)):
            small[r, s] *= sign
    _add(matrix, -1.0, tall, _product(small, tall))
    _scale(scaled, 0.0, cross, small)
    _times(grown, -1.0, cross, scaled)
    return small, tall


@compiled
def _scale(into, keep, cross, small):
    """``into_j = keep into_j + cross_j @ small`` of (q, q, M) and symmetric (q, q)."""
    q, _, count = cross.shape
    for b in range(q):
        for r in range(q):
            out = into[b, r]
            for j in range(count):
                out[j] *= keep
            for s in range(q):
                x, weight = cross[b, s], small[s, r]
                for j in range(count):
                    out[j] += weight * x[j]


@compiled
def _change(
    kind, columns, block, sign, inverse, other, grown, grown_other, cross, work
):
    """Update V, X, D_jj and H_jj for a block (q, p) added, or (-1) removed."""
    if kind == TRACE:
        wide = _product(block, other)
        _cross(columns, wide, True, cross[1])
    small, tall = _woodbury(columns, block, sign, inverse, grown, cross[0], work[0])
    if kind == SUBSET:
        _woodbury(columns, block, sign, other, grown_other, cross[1], work[0])
    elif kind == TRACE:
        inside = _product(_product(small, _product(wide, _transposed(block))), small)
        for r in range(len(block)):
            for s in range(len(block)):
                inside[r, s] *= -0.5
        mixed = _product(small, wide)
        _add(mixed, 1.0, inside, tall)
        _add(other, -1.0, tall, mixed)
        _add(other, -1.0, mixed, tall)
        _scale(work[0], 0.0, cross[1], small)
        _scale(work[0], 1.0, cross[0], inside)
        _times(grown_other, -1.0, cross[0], work[0])
        _times(grown_other, -1.0, work[0], cross[0])


@compiled
def _best(gain, counts, upper):
    """The candidate of the largest gain that may be chosen once more."""
    best = -1
    for j in range(len(gain)):
        if counts[j] < upper[j] and (best < 0 or gain[j] > gain[best]):
            best = j
    return best


@compiled
def _largest(grown):
    """The largest diagonal entry of any D_jj."""
    largest = 0.0
    for a in range(len(grown)):
        for value in grown[a, a]:
            largest = max(largest, value)
    return largest


@compiled
def _gram(blocks, chosen, prior, ridge, gram):
    """Information (p, p) of the chosen, the prior and a ridge."""
    for a in range(len(gram)):
        for b in range(len(gram)):
            gram[a, b] = prior[a, b] + (ridge if a == b else 0.0)
    for i in chosen:
        add_block(gram, blocks, i, 1.0)


@compiled
def grow_and_climb(
    kind, root, blocks, columns, prior, upper, ridge, num_fixed, chosen, size, climbs
):  # fmt: skip
    """Complete a selection greedily, then swap each for its best replacement.

    Args:
        kind, root: DET, SUBSET or TRACE, and C (s, p).
        blocks, columns, prior: (M, q, p), (q, p, M), (p, p).
        upper: (M,) how often each may be chosen.
        ridge: (2,) information that stands in for what is unknown, growing, swapping.
        num_fixed: leading entries of ``chosen`` that stay.
        chosen: (k,) of which the first ``size`` are there; changed in place.
        climbs: whether to swap, until no swap helps.

    Returns:
        phi of the local optimum, if it climbs; -inf from a singular start.
    """
    num_blocks, q, p = blocks.shape
    k = len(chosen)
    shape = (q, q, num_blocks)
    grown, grown_other = np.empty(shape), np.empty(shape)
    cross, work = np.empty((2, *shape)), np.empty((6, *shape))
    gain, det = np.empty(num_blocks), np.empty(num_blocks)
    gram, inverse, other = np.empty((p, p)), np.empty((p, p)), np.empty((p, p))
    counts = np.zeros(num_blocks, dtype=np.int64)
    for i in chosen[:size]:
        counts[i] += 1
    kept = chosen.copy()
    value, expected, peak = -np.inf, np.inf, 0.0
    stale = True
    since, position = 0, num_fixed
    while size < k or climbs:
        growing = size < k
        if not growing and since == k - num_fixed:
            stale = True
        if stale:
            _gram(blocks, chosen[:size], prior, ridge[0 if growing else 1], gram)
            now = _value(kind, root, gram, inverse, other)
            if not growing:
                if not now > value:  # rounding promised more than there is
                    for r in range(k):
                        chosen[r] = kept[r]
                    return value
                value = now
                same = abs(value - expected) <= _SAME * max(1.0, abs(value))
                if k == num_fixed or (same and since == k - num_fixed):
                    return value
                for r in range(k):
                    kept[r] = chosen[r]
                expected, since = value, 0
            _fill(columns, inverse, grown)
            if kind != DET:
                _fill(columns, other, grown_other)
            peak = _largest(grown)
        out = _NONE if growing else chosen[position]
        _gains(
            kind, columns, blocks[max(out, 0)], inverse, other, grown, grown_other, out,
            cross, work, det, gain,
        )  # fmt: skip
        best = _best(gain, counts, upper)
        stale = False
        at = size if growing else position
        if growing:
            size += 1
            stale = size == k
        else:
            since += 1
            position = position + 1 if position + 1 < k else num_fixed
            least = _IMPROVES * max(1.0, abs(expected))
            if best < 0 or best == out or not gain[best] > least:
                continue
            expected += gain[best]
            since = 0
            counts[out] -= 1
        counts[best] += 1
        chosen[at] = best
        if stale:
            continue
        for i, sign in ((best, 1.0), (out, -1.0)):
            if i != _NONE:
                _change(
                    kind, columns, blocks[i], sign, inverse, other, grown, grown_other,
                    cross, work,
                )  # fmt: skip
        largest = _largest(grown)
        stale = largest < _CANCELLED * peak
        peak = max(peak, largest)
    return value
