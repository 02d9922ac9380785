"""Compiled greedy and exchange for log det and trace of any C M^-1 C.T.

V is the inverse information, D_jj = B_j V B_j.T. Of a candidate j that comes in and one
i that goes out (or none), with K = (I + D_jj)^-1, Z = D_ij K,

    Y = I - D_ii + Z D_ji,          det grows by det(I + D_jj) det Y,

and with X = V C.T C V and H_ij = B_i X B_j.T the trace of C V C.T falls by

    trace(K H_jj) - trace(Y^-1 (H_ii + Q Z.T + Z Q.T)),      Q = Z H_jj / 2 - H_ij.

The information without i is never inverted: it may be singular. For a subset of the
parameters, log det of (C V C.T)^-1 is that of the information less that of the nuisance
parameters, whose inverse is X = V - V C.T (C V C.T)^-1 C V: the formula for det, once
with V and once with X. What does not depend on i (D_jj, H_jj, K, and the gain of j
alone) is kept until a swap is made. A swap is made only where phi, computed from the
chosen blocks and not from the formulas above, has risen, so rounding cannot
make two equal candidates swap endlessly.

Removing i never helps: the gain of a swap is at most that of j alone. For det, with t
the trace of D_jj, Y <= I - D_ii / (1 + t), so det Y is at most the q-th power of the
mean of that matrix's diagonal. A group in which no gain can be the largest is skipped.

E, the smallest eigenvalue in the metric of R = C.T C, has no such formula. phi is
concave: of what is left when i goes out, with y its weakest direction, ``y.T R y = 1``,
adding B_j gives at most ``y.T M y + |B_j y|^2``. Candidates are looked at in the order
of that bound until it falls to the best phi found, and j is better than that where
``M + B_j.T B_j - phi R`` has a Cholesky factor.

Candidates are held in groups of ``WIDE``, arrays (q, q, WIDE) or (q, p, WIDE), with
innermost loops over a group: their length is known to the compiler, and what belongs to
a group stays in the first cache.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import (
    cholesky,
    copy,
    factor,
    multiply,
)
from cython.cimports.jaxcal.selection.exchange.kernel import WIDE
from cython.cimports.jaxcal.watch import begin, late
from cython.cimports.libc.math import INFINITY, fabs, sqrt
from cython.cimports.scipy.linalg.cython_lapack import dsyevd

__all__ = ["DET", "SUBSET", "TRACE", "Climber"]

DET, SUBSET, TRACE = 0, 1, 2  # log det of all, or of some parameters; a trace
# Compiled functions read C variables, which Python does not see.
_DET = cython.declare(cython.int, 0)
_SUBSET = cython.declare(cython.int, 1)
_TRACE = cython.declare(cython.int, 2)

_IMPROVES = cython.declare(cython.double, 1e-11)  # by which a swap must raise phi
_MOST_SWAPS = cython.declare(cython.int, 100)  # of each place, where a few are usual
_RIDGE = cython.declare(cython.double, 1e-6)  # to climb from a singular start
# Fall of the largest D_jj after which updated ones have lost digits.
_CANCELLED = cython.declare(cython.double, 1e-3)
_LIFTS = cython.declare(cython.double, 1e-9)  # share by which a swap must raise E
# Added to what is left of E, so that its bounds are true where that is singular.
_SLIGHT = cython.declare(cython.double, 1e-10)
_PATIENCE = cython.declare(cython.int, 16)  # groups between two looks at the clock


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def _weigh(
    into: cython.p_double,
    weights: cython.p_double,
    rows: cython.p_double,
    count: cython.Py_ssize_t,
) -> cython.void:
    """``into = weights @ rows``, of (count,) and (count, WIDE)."""
    total = cython.declare(cython.double[16])  # kept in registers
    for b in range(WIDE // 16):
        for j in range(16):
            total[j] = 0.0
        for a in range(count):
            x = rows + a * WIDE + 16 * b
            for j in range(16):
                total[j] += weights[a] * x[j]
        for j in range(16):
            into[16 * b + j] = total[j]


@cython.cfunc
@cython.nogil
@cython.inline
@cython.exceptval(check=False)
def _lane_dots(
    into: cython.p_double,
    left: cython.p_double,
    right: cython.p_double,
    count: cython.Py_ssize_t,
) -> cython.void:
    """``into_j = left_j @ right_j``, of (count, WIDE) both."""
    total = cython.declare(cython.double[16])
    for b in range(WIDE // 16):
        for j in range(16):
            total[j] = 0.0
        for a in range(count):
            x, y = left + a * WIDE + 16 * b, right + a * WIDE + 16 * b
            for j in range(16):
                total[j] += x[j] * y[j]
        for j in range(16):
            into[16 * b + j] = total[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _fill(
    columns: cython.p_double,
    halved: cython.p_double,
    part: cython.p_double,
    grown: cython.p_double,
    q: cython.int,
    p: cython.int,
) -> cython.void:
    """``B_j (L + L.T) B_j.T`` (q, q, WIDE) of a lower triangle L; part (p, WIDE)."""
    for s in range(q):
        for a in range(p):
            _weigh(part + a * WIDE, halved + a * p, columns + s * p * WIDE, a + 1)
        for r in range(q):
            _lane_dots(grown + (r * q + s) * WIDE, columns + r * p * WIDE, part, p)
    for r in range(q):
        for s in range(r + 1):
            x, y = grown + (r * q + s) * WIDE, grown + (s * q + r) * WIDE
            for j in range(WIDE):
                x[j] += y[j]
                y[j] = x[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _times(
    into: cython.p_double,
    weight: cython.double,
    left: cython.p_double,
    right: cython.p_double,
    turned: cython.bint,
    q: cython.int,
) -> cython.void:
    """``into_j += weight left_j @ right_j``, or ``right_j.T``, of (q, q, WIDE)."""
    for r in range(q):
        for s in range(q):
            out = into + (r * q + s) * WIDE
            for a in range(q):
                x = left + (r * q + a) * WIDE
                y = right + (s * q + a if turned else a * q + s) * WIDE
                for j in range(WIDE):
                    out[j] += weight * x[j] * y[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _dots(
    into: cython.p_double,
    weight: cython.double,
    left: cython.p_double,
    right: cython.p_double,
    q: cython.int,
) -> cython.void:
    """``into_j += weight trace(left_j right_j.T)``, (WIDE,) of (q, q, WIDE)."""
    for a in range(q * q):
        x, y = left + a * WIDE, right + a * WIDE
        for j in range(WIDE):
            into[j] += weight * x[j] * y[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _invert(
    matrices: cython.p_double, det: cython.p_double, q: cython.int
) -> cython.void:
    """Invert positive (q, q, WIDE) in place by sweeps; ``det`` (WIDE,) is filled."""
    for j in range(WIDE):
        det[j] = 1.0
    for a in range(q):
        pivot = matrices + (a * q + a) * WIDE
        for j in range(WIDE):
            det[j] *= pivot[j]
            pivot[j] = 1.0 / pivot[j]
        for r in range(q):
            if r != a:
                side = matrices + (r * q + a) * WIDE
                for j in range(WIDE):
                    side[j] *= pivot[j]
                for s in range(q):
                    if s != a:
                        into = matrices + (r * q + s) * WIDE
                        over = matrices + (a * q + s) * WIDE
                        for j in range(WIDE):
                            into[j] -= side[j] * over[j]
        for s in range(q):
            if s != a:
                over = matrices + (a * q + s) * WIDE
                for j in range(WIDE):
                    over[j] *= -pivot[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _invert_small(matrix: cython.p_double, size: cython.int) -> cython.void:
    """Invert (size, size) in place by sweeps, in the order of its rows."""
    for a in range(size):
        pivot = 1.0 / matrix[a * size + a]
        matrix[a * size + a] = pivot
        for r in range(size):
            if r != a:
                side = matrix[r * size + a] * pivot
                matrix[r * size + a] = side
                for s in range(size):
                    if s != a:
                        matrix[r * size + s] -= side * matrix[a * size + s]
        for s in range(size):
            if s != a:
                matrix[a * size + s] *= -pivot


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _mix(
    into: cython.p_double,
    weight: cython.double,
    matrix: cython.p_double,
    these: cython.p_double,
    rows: cython.int,
    q: cython.int,
) -> cython.void:
    """``into_j += weight matrix @ these_j`` of (rows, rows) and (rows, q, WIDE)."""
    for r in range(rows):
        for a in range(rows):
            scaled = weight * matrix[r * rows + a]
            for s in range(q):
                out, x = into + (r * q + s) * WIDE, these + (a * q + s) * WIDE
                for j in range(WIDE):
                    out[j] += scaled * x[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _lower(
    grown: cython.p_double,
    left: cython.p_double,
    right: cython.p_double,
    rows: cython.int,
    q: cython.int,
) -> cython.void:
    """``grown_j -= left_j.T @ right_j + right_j.T @ left_j`` of (rows, q, WIDE)."""
    for s in range(q):
        for t in range(s + 1):
            out = grown + (s * q + t) * WIDE
            for a in range(rows):
                x, y = left + (a * q + s) * WIDE, right + (a * q + t) * WIDE
                u, v = right + (a * q + s) * WIDE, left + (a * q + t) * WIDE
                for j in range(WIDE):
                    out[j] -= x[j] * y[j] + u[j] * v[j]
            other = grown + (t * q + s) * WIDE
            if t < s:
                for j in range(WIDE):
                    other[j] = out[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _largest(values: cython.p_double) -> cython.double:
    """Of (WIDE,), by halves: the compiler knows how to compare vectors."""
    half = cython.declare(cython.double[32])
    for j in range(32):
        half[j] = values[j] if values[j] > values[j + 32] else values[j + 32]
    for j in range(16):
        half[j] = half[j] if half[j] > half[j + 16] else half[j + 16]
    for j in range(8):
        half[j] = half[j] if half[j] > half[j + 8] else half[j + 8]
    top = half[0]
    for j in range(1, 8):
        top = half[j] if half[j] > top else top
    return top


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _best_of(
    gain: cython.p_double, closed: cython.p_double, most: cython.double
) -> cython.Py_ssize_t:
    """Which of a group has the largest ``gain - closed`` above ``most``; -1: none."""
    open_ = cython.declare(cython.double[64])
    for j in range(WIDE):
        open_[j] = gain[j] - closed[j]
    top = _largest(open_)
    if top > most:
        for j in range(WIDE):
            if open_[j] == top:
                return j
    return -1


class Climber:
    """The candidates of a problem, and the work space that ``kernel.pxd`` describes.

    Args:
        kind: DET, SUBSET or TRACE.
        blocks: (M, q, p) available candidates, whitened.
        prior: (p, p).
        root: C (s, p).
        cap: how often each may be chosen.
        required: (r,) candidates that are chosen in any case.
        span: (r, p) orthonormal directions that the prior informs.
        k: candidates to choose.
        seed: of the random starts.
    """

    def __init__(self, kind, blocks, prior, root, cap, required, span, k, seed):
        count: cython.Py_ssize_t = blocks.shape[0]
        q: cython.Py_ssize_t = blocks.shape[1]
        p: cython.Py_ssize_t = blocks.shape[2]
        i: cython.Py_ssize_t
        r: cython.Py_ssize_t
        a: cython.Py_ssize_t
        self.kind, self.k, self.q, self.p, self.s = kind, k, q, p, len(root)
        self.fixed, self.groups = len(required), (count + WIDE - 1) // WIDE
        self.size = q * q * WIDE
        self.rows = q == 1 and kind == DET
        self.blocks, self.prior, self.root, self.span = blocks, prior, root, span
        wide = self.groups * WIDE
        self.upper = np.zeros(wide, dtype=np.intp)
        self.counts = np.zeros(wide, dtype=np.intp)
        self.chosen, self.best = np.zeros((2, k), dtype=np.intp)
        for r in range(len(required)):
            self.chosen[r] = required[r]
        for i in range(count):
            self.upper[i] = cap
        self.order = np.arange(count)
        self.whole = np.empty(3 + 5 * p, dtype=np.intc)
        self.used = 0
        self._lay_out()
        self.room = np.zeros(self.used)
        self.used = 0
        self._lay_out()
        for i in range(count):
            for r in range(q):
                for a in range(p):
                    at = ((i // WIDE * q + r) * p + a) * WIDE + i % WIDE
                    self.columns[at] = self.blocks[i, r, a]
        multiply(True, False, p, p, self.s, cython.address(self.root[0, 0]),
                 cython.address(self.root[0, 0]), self.metric)  # fmt: skip
        # Any seed is a good start of a xorshift generator but zero.
        self.state = (seed * 2685821657736338717 + 88172645463325252) % 2**64 or 1
        for _ in range(8):
            self._draw(2)

    def _take(self, count):
        """Where the next ``count`` numbers of the room are."""
        self.used += count
        if self.room is None:
            return cython.NULL
        return cython.address(self.room[0]) + (self.used - count)

    def _lay_out(self):
        """Share the room out; before there is one, count how much is needed."""
        q, p, s, wide = self.q, self.p, self.s, self.groups * WIDE
        self.columns = self._take(q * p * wide)
        self.grown = self._take(2 * self.groups * self.size)
        self.kept = self._take(2 * self.groups * self.size)
        self.alone, self.bounds = self._take(wide), self._take(wide)
        self.closed, self.tops = self._take(wide), self._take(2 * self.groups)
        self.gain, self.det = self._take(WIDE), self._take(WIDE)
        self.part = self._take(p * WIDE)
        self.cross, self.work = self._take(4 * self.size), self._take(4 * self.size)
        self.mixed, self.middle = self._take(2 * self.size), self._take(12 * q * q)
        self.at_out, self.changed = self._take(2 * q * q), self._take(2 * q * p)
        self.tall = self._take(4 * q * p)
        self.now, self.trial = self._take(2 * p * p), self._take(2 * p * p)
        self.halved = self._take(2 * p * p)
        self.known, self.gram = self._take(p * p), self._take(p * p)
        self.lower, self.basis = self._take(p * p), self._take(p * p)
        self.rest, self.metric = self._take(p * p), self._take(p * p)
        self.half, self.solved = self._take(s * p), self._take(s * p)
        self.small, self.weakest = self._take(s * s), self._take(p)
        self.values, self.lapack = self._take(p), self._take(1 + 6 * p + 2 * p * p)

    def climb_from(self, start, share, climbs, seconds):
        """Complete ``start`` (size,), required first, and swap while that helps.

        Args:
            share: of the information of k mean candidates, what stands in for those
                not chosen yet while the selection grows.
            climbs: whether to swap.
            seconds: after which no more swaps are made.

        Returns:
            (k,) chosen, and phi; -inf where that is singular.
        """
        self.watch = begin(seconds)
        size: cython.Py_ssize_t = len(start)
        kept: cython.double = share
        swaps: cython.bint = climbs
        for r in range(size):
            self.chosen[r] = start[r]
        with cython.nogil:
            phi = self._finish(size, kept, swaps)
        return np.array(self.chosen), phi

    def random_climbs(self, count, chosen, phi, seconds, full):
        """The best of ``chosen`` (k,) with its phi, and ``count`` random starts.

        ``full`` is the rank that a block can have.
        """
        self.full = full
        self.watch = begin(seconds)
        for r in range(len(chosen)):
            self.best[r] = chosen[r]
        starts: cython.int = count
        found: cython.double = phi
        with cython.nogil:
            found = self._random(starts, found)
        return np.array(self.best), found

    def random_start(self, full):
        """(k,) required first, then at random, rarely singular; ``full`` as above."""
        self.full = full
        self._random_start()
        return np.array(self.chosen)

    def _set_known(self, share, ridge):
        """Fill ``known``: prior, ``share`` of k mean candidates' information, ridge."""
        p = self.p
        weight = share * self.k / self.blocks.shape[0]
        for a in range(p):
            for b in range(p):
                self.known[a * p + b] = (1.0 - weight) * self.prior[a, b]
            self.known[a * p + a] += weight + ridge

    def _sum(self, size, skipped):
        """Information of the first ``size`` chosen but one, into ``gram``."""
        p = self.p
        copy(self.gram, self.known, p * p)
        for c in range(size):
            if c != skipped:
                self._add(self.chosen[c])

    def _add(self, i):
        """Add candidate i to ``gram``."""
        p = self.p
        gram = self.gram
        for r in range(self.q):
            row = cython.address(self.blocks[i, r, 0])
            for a in range(p):
                for b in range(p):
                    gram[a * p + b] += row[a] * row[b]

    def _evaluate(self, size, into):
        """phi of the first ``size`` chosen, summed from their blocks; fills V and X."""
        p = self.p
        self._sum(size, -1)
        inverse = into
        value: cython.double = factor(
            self.gram, inverse,
            self.lower, p,
        )  # fmt: skip
        if self.kind == _DET or not value > -INFINITY:
            return value
        half = self.half
        multiply(False, False, self.s, p, p, cython.address(self.root[0, 0]), inverse,
                 half)  # fmt: skip
        if self.kind == _SUBSET:
            return self._subset(into)
        multiply(True, False, p, p, self.s, half, half, into + p * p)
        value = 0.0
        for r in range(self.s):
            for a in range(p):
                value -= self.half[r * p + a] * self.root[r, a]
        return value

    def _subset(self, into):
        """The same for log det of some parameters; C V is there."""
        s, p = self.s, self.p
        half, small = self.half, self.small
        solved, other = self.solved, into + p * p
        # The covariance C V C.T in ``solved``, which has room for it, as s <= p.
        multiply(False, True, s, s, p, half, cython.address(self.root[0, 0]), solved)
        value = -factor(solved, small, self.lower, s)
        multiply(False, False, s, p, s, small, half, solved)
        multiply(True, False, p, p, s, half, solved, other)
        for a in range(p):
            for b in range(p):
                into[(p + a) * p + b] = into[a * p + b] - into[(p + a) * p + b]
        return value

    def _refresh(self):
        """D_jj, H_jj, K and the gain of every candidate alone, of V and X."""
        q, p = self.q, self.p
        self.tallest = 0.0
        for m in range(1 if self.kind == _DET else 2):
            for a in range(p):
                for b in range(a):
                    self.halved[(m * p + a) * p + b] = self.now[(m * p + a) * p + b]
                self.halved[(m * p + a) * p + a] = 0.5 * self.now[(m * p + a) * p + a]
        for c in range(self.groups):
            for m in range(1 if self.kind == _DET else 2):
                _fill(self.columns + c * q * p * WIDE,
                      self.halved + m * p * p,
                      self.part,
                      self.grown + (2 * c + m) * self.size,
                      self.q, self.p)  # fmt: skip
            self._keep(c)

    def _keep(self, c):
        """K, and the gain of each alone: a factor, or the fall of a trace."""
        q = self.q
        alone, det = self.alone + c * WIDE, self.det
        grown = self.grown + 2 * c * self.size
        if self.rows:
            for j in range(WIDE):
                alone[j] = 1.0 + grown[j]
            self.tops[2 * c + 1] = _largest(grown)
            self.tops[2 * c] = 1.0 + self.tops[2 * c + 1]
            self.tallest = max(self.tallest, self.tops[2 * c + 1])
            return
        self._invert_grown(c, 0, alone)
        if self.kind == _SUBSET:
            self._invert_grown(c, 1, det)
            for j in range(WIDE):
                alone[j] /= det[j]
        elif self.kind == _TRACE:
            for j in range(WIDE):
                alone[j] = 0.0
            _dots(alone, 1.0, self.kept + 2 * c * self.size,
                  self.grown + (2 * c + 1) * self.size, q)  # fmt: skip
        for j in range(WIDE):
            det[j] = 0.0
        for r in range(q):
            for j in range(WIDE):
                det[j] += grown[(r * q + r) * WIDE + j]
        self.tops[2 * c], self.tops[2 * c + 1] = _largest(alone), _largest(det)
        self.tallest = max(self.tallest, self.tops[2 * c + 1])

    def _invert_grown(self, c, m, det):
        """K of the group, and the determinant of what it inverts."""
        q = self.q
        grown = self.grown + (2 * c + m) * self.size
        kept = self.kept + (2 * c + m) * self.size
        for a in range(self.size):
            kept[a] = grown[a]
        for r in range(q):
            for j in range(WIDE):
                kept[(r * q + r) * WIDE + j] += 1.0
        _invert(kept, det, q)

    def _carry(self, came, went):
        """What is kept, for V and X (``trial``) after a swap; -1: none went.

        With A the blocks that came and went, W = A V, U = A X and S of diagonal 1 and
        -1, V falls by ``W.T P W``, P = inverse(S + W A.T). So does X of a subset, by U,
        and X of a trace by ``W.T P U + U.T P W - W.T P U A.T P W``.
        """
        q, p = self.q, self.p
        r: cython.int = q if went < 0 else 2 * q
        peak = self.tallest
        if 2 * p > 5 * r:
            copy(self.changed,
                 cython.address(self.blocks[came, 0, 0]), q * p)  # fmt: skip
            if went >= 0:
                copy(self.changed + q * p,
                     cython.address(self.blocks[went, 0, 0]), q * p)  # fmt: skip
            self._middles(r)
            self.tallest = 0.0
            for c in range(self.groups):
                self._update(c, r)
                self._keep(c)
        copy(self.now, self.trial,
             2 * p * p)  # fmt: skip
        if 2 * p <= 5 * r or self.tallest < _CANCELLED * peak:
            self._refresh()
        self.tallest = max(self.tallest, peak)

    def _middles(self, r):
        """``tall`` W and U, and in ``middle`` P of both; of a trace P U A.T P / 2."""
        q, p = self.q, self.p
        changed = self.changed
        for m in range(1 if self.kind == _DET else 2):
            tall = self.tall + 2 * m * q * p
            middle = self.middle + 4 * m * q * q
            multiply(False, False, r, p, p, changed, self.now + m * p * p,
                     tall)  # fmt: skip
            multiply(False, True, r, r, p, tall, changed, middle)
            if m == 1 and self.kind == _TRACE:
                first = self.middle
                part = self.middle + 8 * q * q
                multiply(False, False, r, r, r, first, middle, part)
                multiply(False, False, r, r, r, part, first, middle)
                continue
            for s in range(r):
                middle[s * r + s] += 1.0 if s < q else -1.0
            _invert_small(middle, r)

    def _update(self, c, r):
        """D_jj and H_jj of the group."""
        q, p = self.q, self.p
        mixed = self.mixed
        cross = self.cross
        for m in range(1 if self.kind == _DET else 2):
            own = self.cross + 2 * m * self.size
            for s in range(q):
                for a in range(r):
                    _weigh(own + (a * q + s) * WIDE, self.tall + (2 * m * q + a) * p,
                           self.columns + (c * q + s) * p * WIDE, p)  # fmt: skip
            for a in range(r * q * WIDE):
                mixed[a] = 0.0
            if m == 1 and self.kind == _TRACE:
                _mix(mixed, 1.0, self.middle, own, r, q)
                _mix(mixed, -0.5, self.middle + 4 * q * q, cross, r, q)
                own = cross
            else:
                _mix(mixed, 0.5, self.middle + 4 * m * q * q, own, r, q)
            _lower(self.grown + (2 * c + m) * self.size, own, mixed, r, q)

    def _shrink(self, c, m):
        """Z and Y^-1 into ``work``, det Y into ``det``; m = 1: of X in place of V."""
        q = self.q
        solved = self.work
        middle = self.work + self.size
        cross = self.cross + 2 * m * self.size
        for a in range(self.size):
            solved[a] = 0.0
        _times(solved, 1.0, cross, self.kept + (2 * c + m) * self.size, False, q)
        for r in range(q):
            for s in range(q):
                stays = (1.0 if r == s else 0.0) - self.at_out[(m * q + r) * q + s]
                into = middle + (r * q + s) * WIDE
                for j in range(WIDE):
                    into[j] = stays
        _times(middle, 1.0, solved, cross, True, q)
        _invert(middle, self.det, q)

    def _swaps(self, c):
        """Gains of the group when i, whose ``tall`` is there, goes out."""
        q, p = self.q, self.p
        gain, det = self.gain, self.det
        alone = self.alone + c * WIDE
        for m in range(1 if self.kind == _DET else 2):
            for s in range(q):
                for r in range(q):
                    _weigh(self.cross + 2 * m * self.size + (r * q + s) * WIDE,
                           self.tall + (2 * m * q + r) * p,
                           self.columns + (c * q + s) * p * WIDE, p)  # fmt: skip
        if self.rows:
            cross = self.cross
            stays = 1.0 - self.at_out[0]
            for j in range(WIDE):
                gain[j] = alone[j] * stays + cross[j] * cross[j]
            return
        self._shrink(c, 0)
        if self.kind != _TRACE:
            for j in range(WIDE):
                gain[j] = alone[j] * det[j]
            if self.kind == _SUBSET:
                self._shrink(c, 1)
                for j in range(WIDE):
                    gain[j] /= max(det[j], 1e-300)
            return
        solved = self.work
        part = self.work + 2 * self.size
        lost = self.work + 3 * self.size
        other = self.cross + 2 * self.size
        for a in range(self.size):
            part[a] = -other[a]
        _times(part, 0.5, solved, self.grown + (2 * c + 1) * self.size, False, q)
        for a in range(q * q):
            constant = self.at_out[q * q + a]
            for j in range(WIDE):
                lost[a * WIDE + j] = constant
        _times(lost, 2.0, part, solved, True, q)
        for j in range(WIDE):
            gain[j] = alone[j]
        _dots(gain, -1.0, self.work + self.size, lost, q)
        for j in range(WIDE):
            if not det[j] > 1e-14:  # singular without i
                gain[j] = -INFINITY

    def _count(self, i, more):
        """Candidate i is chosen once more, or once less."""
        self.counts[i] += more
        self.closed[i] = 0.0 if self.counts[i] < self.upper[i] else INFINITY

    def _late(self):
        """``late`` of the watch, asked after some work."""
        self.looked += self.groups
        if self.looked < _PATIENCE:
            return 0
        self.looked = 0
        return late(cython.address(self.watch))

    def _grow(self, size, share):
        """Complete the first ``size`` chosen, the largest gain first."""
        if size == self.k:
            return 0
        self._set_known(share, 0.0)
        self._evaluate(size, self.now)
        self._refresh()
        while True:
            self._late()
            best: cython.Py_ssize_t = -1
            most: cython.double = -INFINITY
            for c in range(self.groups):
                alone = self.alone + c * WIDE
                j = _best_of(alone, self.closed + c * WIDE, most)
                if j >= 0:
                    best, most = c * WIDE + j, alone[j]
            self.chosen[size] = best
            self._count(best, 1)
            size += 1
            if size == self.k:
                return 0
            self._evaluate(size, self.trial)
            self._carry(best, -1)

    def _climb(self):
        """Swap each chosen for its best replacement until none helps; phi."""
        k = self.k
        value = self._evaluate(k, self.now)
        if k == self.fixed or not value > -INFINITY:
            return value
        self._refresh()
        position, since, swaps = self.fixed, 0, 0
        while since < k - self.fixed and swaps < _MOST_SWAPS * k:
            if self._late():
                break
            at, out = position, self.chosen[position]
            since += 1
            position = position + 1 if position + 1 < k else self.fixed
            least = _IMPROVES * max(1.0, fabs(value))
            best = self._replacement(out, least)
            if best < 0:
                continue
            self.chosen[at] = best
            after = self._evaluate(k, self.trial)
            if not after > value + least:  # the formulas promised more than there is
                self.chosen[at] = out
                continue
            value, since = after, 0
            swaps += 1
            self._count(out, -1)
            self._count(best, 1)
            self._carry(best, out)
        return value

    def _replacement(self, out, least):
        """Who raises phi most in the place of ``out``, by over ``least``; -1: none."""
        q, p = self.q, self.p
        g, e = out // WIDE, out % WIDE
        taken: cython.double = 0.0
        for m in range(1 if self.kind == _DET else 2):
            multiply(False, False, q, p, p, cython.address(self.blocks[out, 0, 0]),
                     self.now + m * p * p,
                     self.tall + 2 * m * q * p)  # fmt: skip
            of_out = self.grown + (2 * g + m) * self.size
            for r in range(q):
                for s in range(q):
                    self.at_out[(m * q + r) * q + s] = of_out[(r * q + s) * WIDE + e]
        for r in range(q):
            taken += self.at_out[r * q + r] / q
        most: cython.double = least if self.kind == _TRACE else 1.0 + least
        best: cython.Py_ssize_t = -1
        gain = self.gain
        for c in range(self.groups):
            bound: cython.double = self.tops[2 * c]
            if self.kind == _DET:
                stays: cython.double = 1.0 - taken / (1.0 + self.tops[2 * c + 1])
                for _ in range(q):
                    bound *= stays
            if bound <= most:
                continue
            self._swaps(c)
            j = _best_of(gain, self.closed + c * WIDE, most)
            if j >= 0:
                best, most = c * WIDE + j, gain[j]
        return -1 if best == out else best

    def _clear(self):
        """Nothing is chosen."""
        for i in range(self.counts.shape[0]):
            self.counts[i] = 0
            self.closed[i] = 0.0 if self.upper[i] else INFINITY

    # --- E --------------------------------------------------------------------------

    def climb_least(self, start, seconds):
        """The local optimum of E that ``start`` (k,), required first, climbs to.

        Returns:
            (k,) chosen, and E; -inf where that is singular.
        """
        self.watch = begin(seconds)
        for r in range(self.k):
            self.chosen[r] = start[r]
        value: cython.double = 0.0
        with cython.nogil:
            value = self._climb_least()
        return np.array(self.chosen), value

    def _climb_least(self):
        """Swap each chosen for its best replacement until none helps; E."""
        k = self.k
        self._clear()
        for c in range(k):
            self._count(self.chosen[c], 1)
        self._set_known(0.0, 0.0)
        self._sum(k, -1)
        value = self._least()
        position, since, swaps = self.fixed, 0, 0
        while since < k - self.fixed and swaps < _MOST_SWAPS * k and value > 0.0:
            if late(cython.address(self.watch)):
                break
            out = self.chosen[position]
            self._sum(k, position)
            since += 1
            found: cython.double = (1.0 + _LIFTS) * value
            best = self._strongest(cython.address(found))
            if best >= 0:
                value, since = found, 0
                swaps += 1
                self._count(out, -1)
                self._count(best, 1)
                self.chosen[position] = best
            position = position + 1 if position + 1 < k else self.fixed
        return value

    def _least(self):
        """E of ``gram``; V, C V and what ``_eigen`` fills are there."""
        p = self.p
        inverse = self.now
        half, root = self.half, cython.address(self.root[0, 0])
        if not factor(self.gram, inverse, self.lower, p) > -INFINITY:
            return -INFINITY  # fmt: skip
        multiply(False, False, p, p, p, root, inverse, half)
        multiply(False, True, p, p, p, half, root, self.small)
        info: cython.int = 0
        room: cython.int = 1 + 6 * p + 2 * p * p
        whole: cython.int = self.whole.shape[0]
        dsyevd(b"V", b"L", cython.address(p), self.small,
               cython.address(p), self.values,
               self.lapack, cython.address(room),
               cython.address(self.whole[0]), cython.address(whole),
               cython.address(info))  # fmt: skip
        return 1.0 / self.values[p - 1]

    def _strongest(self, found):
        """Who gives the largest E beside ``gram``, over ``found``; -1: none."""
        p, q = self.p, self.q
        gram, rest = self.gram, self.rest
        copy(rest, gram, p * p)
        for a in range(p):
            self.gram[a * p + a] += _SLIGHT
        value = self._least()
        if not value > -INFINITY:
            return -1
        # A block of q readings leaves the variances after the q largest no smaller.
        cap = 1.0 / self.values[p - 1 - q] if q < p else INFINITY
        multiply(
            False, False, 1, p, p, self.small + (p - 1) * p, self.half, self.weakest
        )
        for a in range(p):
            self.weakest[a] *= value
        part = self.part
        for c in range(self.groups):
            bound = self.bounds + c * WIDE
            closed = self.closed + c * WIDE
            for j in range(WIDE):
                bound[j] = value
            for s in range(q):
                _weigh(part, self.weakest,
                       self.columns + (c * q + s) * p * WIDE, p)  # fmt: skip
                for j in range(WIDE):
                    bound[j] += part[j] * part[j]
            for j in range(WIDE):
                bound[j] = min(bound[j], cap) - closed[j]
            self.tops[2 * c] = _largest(bound)
        best: cython.Py_ssize_t = -1
        while True:
            g: cython.Py_ssize_t = 0
            for c in range(1, self.groups):
                if self.tops[2 * c] > self.tops[2 * g]:
                    g = c
            if not self.tops[2 * g] > found[0]:
                return best
            bound = self.bounds + g * WIDE
            e: cython.Py_ssize_t = 0
            while bound[e] != self.tops[2 * g]:
                e += 1
            bound[e] = -INFINITY
            self.tops[2 * g] = _largest(bound)
            copy(gram, rest, p * p)
            self._add(g * WIDE + e)
            for a in range(p):
                for b in range(a + 1):
                    self.lower[a * p + b] = (
                        self.gram[a * p + b] - found[0] * self.metric[a * p + b]
                    )
            lower = self.lower
            if cholesky(lower, lower, p, 0.0) > -INFINITY:
                value = self._least()
                if value > found[0]:
                    best, found[0] = g * WIDE + e, value

    # --------------------------------------------------------------------------------

    def _finish(self, size, share, climbs):
        """Grow and climb from the first ``size`` chosen; phi."""
        self._clear()
        for c in range(size):
            self._count(self.chosen[c], 1)
        self._grow(size, share)
        value = 0.0
        # Swaps may mend a singular start, the more surely the smaller the ridge.
        for attempt in range(5):
            ridge = 0.0
            if attempt % 2:
                ridge = _RIDGE if attempt == 1 else 1e-4 * _RIDGE
            self._set_known(0.0, ridge)
            if not climbs:
                return self._evaluate(self.k, self.now)
            value = self._climb()
            if ridge == 0.0 and value > -INFINITY:
                break
        return value

    # --- random starts --------------------------------------------------------------

    def _draw(self, below):
        """A whole number in [0, below) from a xorshift generator."""
        self.state ^= self.state << 13
        self.state ^= self.state >> 7
        self.state ^= self.state << 17
        return ((self.state >> 32) * below) >> 32

    def _random_start(self):
        """Fill ``chosen`` at random, rarely singular.

        An orthonormal basis grows with what is chosen: first the required ones, then at
        random what leaves the span by enough.
        """
        p = self.p
        count: cython.Py_ssize_t = self.blocks.shape[0]
        size: cython.Py_ssize_t = self.fixed
        for i in range(count):
            self.counts[i] = 0
        rank: cython.int = self.span.shape[0]
        for r in range(rank):
            for a in range(p):
                self.basis[r * p + a] = self.span[r, a]
        for r in range(size):
            self.counts[self.chosen[r]] += 1
            rank = self._extend(self.chosen[r], rank, 1e-18)
        for position in range(count):
            if rank == p or size == self.k:
                break
            other = position + self._draw(count - position)
            i = self.order[other]
            self.order[other], self.order[position] = self.order[position], i
            if self.counts[i] < self.upper[i]:
                grown = self._extend(i, rank, 1e-6 / count)
                if grown - rank >= min(self.full, p - rank):
                    rank = grown
                    self.chosen[size] = i
                    self.counts[i] += 1
                    size += 1
        while size < self.k:
            i = self.order[self._draw(count)]
            if self.counts[i] < self.upper[i]:
                self.chosen[size] = i
                self.counts[i] += 1
                size += 1
        return size

    def _extend(self, i, rank, least):
        """Add to the basis the rows of block i that are new by over ``least``; rank."""
        p = self.p
        for s in range(self.q):
            if rank == p:
                break
            row = self.basis + rank * p
            square: cython.double = 0.0
            for a in range(p):
                row[a] = self.blocks[i, s, a]
                square += row[a] * row[a]
            for _ in range(2):  # twice is enough for orthogonality to rounding
                before: cython.double = square
                for r in range(rank):
                    dot: cython.double = 0.0
                    for a in range(p):
                        dot += self.basis[r * p + a] * row[a]
                    for a in range(p):
                        row[a] -= dot * self.basis[r * p + a]
                square = 0.0
                for a in range(p):
                    square += row[a] * row[a]
                if square > 0.5 * before:
                    break
            if square > least:
                scale = 1.0 / sqrt(square)
                for a in range(p):
                    row[a] *= scale
                rank += 1
        return rank

    def _random(self, count, value):
        """The best of ``best``, of phi value, and of random starts climbed."""
        for _ in range(count):
            if self._late() and value > -INFINITY:
                break
            self._random_start()
            found = self._finish(self.k, 0.0, True)
            if found > value + 1e-10 * max(1.0, fabs(value)) or not value > -INFINITY:
                value = found
                for r in range(self.k):
                    self.best[r] = self.chosen[r]
        return value
