"""Compiled greedy and exchange for log det and trace of any C M^-1 C.T, and for E.

V is the inverse information, D_jj = B_j V B_j.T. Of a candidate j that comes in and one
i that goes out (or none), with K = (I + D_jj)^-1, Z = D_ij K,

    Y = I - D_ii + Z D_ji, (1)      det grows by det(I + D_jj) det Y, (2)

and with X = V C.T C V and H_ij = B_i X B_j.T the trace of C V C.T falls by

    trace(K H_jj) - trace(Y^-1 (H_ii + Q Z.T + Z Q.T)), (3)  Q = Z H_jj / 2 - H_ij. (4)

The information without i is never inverted: it may be singular. For a subset of the
parameters, log det of (C V C.T)^-1 is that of the information less that of the nuisance
parameters, whose inverse is X = V - V C.T (C V C.T)^-1 C V (5): the formula for det,
once with V and once with X. What does not depend on i (D_jj, H_jj, K, and the gain of j
alone) is kept until a swap is made. A swap is made only where phi, computed from the
chosen blocks and not from the formulas above, has risen, so rounding cannot
make two equal candidates swap endlessly.

Removing i never helps: the gain of a swap is at most that of j alone. For det, with t
the trace of D_jj, Y <= I - D_ii / (1 + t) (6), so det Y is at most the q-th power of
the mean of that matrix's diagonal. A group in which no gain can be the largest is
skipped.

E, the smallest eigenvalue in the metric of R = C.T C, has no such formula. phi is
concave: of what is left when i goes out, with y its weakest direction, ``y.T R y = 1``,
adding B_j gives at most ``y.T M y + |B_j y|^2`` (7). Candidates are looked at in the
order of that bound until it falls to the best phi found, and j is better than that
where ``M + B_j.T B_j - phi R`` (8) has a Cholesky factor.

Candidates are held in groups of ``WIDE``, arrays (q, q, WIDE) or (q, p, WIDE), with
innermost loops over a group: their length is known to the compiler, and what belongs to
a group stays in the first cache.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython import address, cast, declare
from cython.cimports.jaxcal.information.linear_algebra import (
    add,
    cholesky,
    copy,
    covariance,
    eigen,
    factor,
    multiply,
    take,
)
from cython.cimports.jaxcal.selection.criterion_kinds import DET, SUBSET, TRACE
from cython.cimports.jaxcal.selection.exchange.exchange_kernel import WIDE
from cython.cimports.jaxcal.watch import begin, late
from cython.cimports.libc.math import INFINITY, fabs, log

_KINDS = {"det": DET, "subset": SUBSET, "trace": TRACE}

_IMPROVES = declare(cython.double, 1e-11)  # by which a swap must raise phi
_MOST_SWAPS = declare(cython.int, 100)  # of each place, where a few are usual
_RIDGE = declare(cython.double, 1e-6)  # to climb from a singular start
# Fall of the largest D_jj after which updated ones have lost digits.
_CANCELLED = declare(cython.double, 1e-3)
_LIFTS = declare(cython.double, 1e-9)  # share by which a swap must raise E
# Added to what is left of E, so that its bounds are true where that is singular.
_SLIGHT = declare(cython.double, 1e-10)
_TRIED = declare(cython.int, 3)  # by E in a place, in all of several scenarios
_PATIENCE = declare(cython.int, 16)  # groups between two looks at the clock


def _weigh(into, weights, rows, count):
    """``into = weights @ rows``, of (count,) and (count, WIDE)."""
    total = declare(cython.double[16])  # kept in registers
    for b in range(WIDE // 16):
        for j in range(16):
            total[j] = 0.0
        for a in range(count):
            x = rows + a * WIDE + 16 * b
            for j in range(16):
                total[j] += weights[a] * x[j]
        for j in range(16):
            into[16 * b + j] = total[j]


def _dots(into, left, right, count):
    """``into_j = left_j @ right_j``, of (count, WIDE) both."""
    total = declare(cython.double[16])
    for b in range(WIDE // 16):
        for j in range(16):
            total[j] = 0.0
        for a in range(count):
            x, y = left + a * WIDE + 16 * b, right + a * WIDE + 16 * b
            for j in range(16):
                total[j] += x[j] * y[j]
        for j in range(16):
            into[16 * b + j] = total[j]


def _times(into, weight, left, right, turned, q):
    """``into_j += weight left_j @ right_j``, or ``right_j.T``, of (q, q, WIDE)."""
    for r in range(q):
        for s in range(q):
            out = into + (r * q + s) * WIDE
            for a in range(q):
                x = left + (r * q + a) * WIDE
                y = right + (s * q + a if turned else a * q + s) * WIDE
                for j in range(WIDE):
                    out[j] += weight * x[j] * y[j]


def _invert(matrices, det, q, wide):
    """Invert (q, q, wide) in place by sweeps in the order of the rows; fill ``det``."""
    for j in range(wide):
        det[j] = 1.0
    for a in range(q):
        pivot = matrices + (a * q + a) * wide
        for j in range(wide):
            det[j] *= pivot[j]
            pivot[j] = 1.0 / pivot[j]
        for r in range(q):
            if r != a:
                side = matrices + (r * q + a) * wide
                for j in range(wide):
                    side[j] *= pivot[j]
                for s in range(q):
                    if s != a:
                        into = matrices + (r * q + s) * wide
                        over = matrices + (a * q + s) * wide
                        for j in range(wide):
                            into[j] -= side[j] * over[j]
        for s in range(q):
            if s != a:
                over = matrices + (a * q + s) * wide
                for j in range(wide):
                    over[j] *= -pivot[j]


def _mix(into, weight, matrix, these, rows, q):
    """``into_j += weight matrix @ these_j`` of (rows, rows) and (rows, q, WIDE)."""
    for r in range(rows):
        for a in range(rows):
            scaled = weight * matrix[r * rows + a]
            for s in range(q):
                out, x = into + (r * q + s) * WIDE, these + (a * q + s) * WIDE
                for j in range(WIDE):
                    out[j] += scaled * x[j]


def _lower(grown, left, right, rows, q):
    """``grown_j -= left_j.T @ right_j + right_j.T @ left_j`` of (rows, q, WIDE)."""
    for s in range(q):
        for t in range(s + 1):
            out, other = grown + (s * q + t) * WIDE, grown + (t * q + s) * WIDE
            for a in range(rows):
                x, y = left + (a * q + s) * WIDE, right + (a * q + t) * WIDE
                u, v = right + (a * q + s) * WIDE, left + (a * q + t) * WIDE
                for j in range(WIDE):
                    out[j] -= x[j] * y[j] + u[j] * v[j]
            if t < s:
                copy(other, out, WIDE)


def _largest(values):
    """The largest of (WIDE,), by halves: compilers know how to compare vectors."""
    half = declare(cython.double[32])
    for j in range(32):
        half[j] = values[j] if values[j] > values[j + 32] else values[j + 32]
    for j in range(16):
        half[j] = half[j] if half[j] > half[j + 16] else half[j + 16]
    top = half[0]
    for j in range(1, 16):
        top = half[j] if half[j] > top else top
    return top


def _best_of(gain, closed, most):
    """Which of a group has the largest ``gain - closed`` above ``most``; -1: none."""
    open_ = declare(cython.double[64])
    for j in range(WIDE):
        open_[j] = gain[j] - closed[j]
    top = _largest(open_)
    if top > most:
        for j in range(WIDE):
            if open_[j] == top:
                return j
    return -1


class Climber:
    """One scenario, with its work space; ``exchange_kernel.pxd`` says what is where.

    Args:
        form: "det", "subset" or "trace", of the criterion.
        blocks, prior, root: whitened (M, q, p), (p, p) and C (s, p).
        caps: (M,) how often each may be chosen; blocks of those that may not are zero.
        required: (r,) candidates that are chosen in any case.
        k, seed: candidates to choose; of the random starts.
        rules, most, order: (r, M) ``rules @ counts <= most`` (r,); the cheapest first.
    """

    def __init__(
        self, form, blocks, prior, root, caps, required, k, seed, rules, most, order
    ):  # fmt: skip
        self.blocks, self.prior, self.root = blocks, prior, root
        count, q, p = self.blocks.shape[0], self.blocks.shape[1], self.blocks.shape[2]
        self.kind = _KINDS[form]
        self.k, self.q, self.p, self.s = k, q, p, len(root)
        self.parts, self.dets = 1 + (self.kind != DET), 1 + (self.kind == SUBSET)
        self.fixed, self.groups = len(required), (count + WIDE - 1) // WIDE
        self.size = q * q * WIDE
        self.rows = q == 1 and self.kind == DET
        self.available = np.count_nonzero(caps)
        self.caps, self.counts = caps, np.zeros(count, dtype=np.intp)
        self.rules, self.most, self.order = rules, most, order
        self.sweep = self.groups
        self.chosen = np.zeros(k, dtype=np.intp)
        self.times, self.tried = np.zeros((2, count), dtype=np.intp)
        for r in range(len(required)):
            self.chosen[r] = required[r]
        self.whole = np.empty(3 + 5 * p, dtype=np.intc)
        self.room = np.zeros(self._lay_out(cython.NULL))
        self._lay_out(address(self.room[0]))
        for i in range(count):
            for r in range(q):
                for a in range(p):
                    at = ((i // WIDE * q + r) * p + a) * WIDE + i % WIDE
                    self.columns[at] = self.blocks[i, r, a]
        for i in range(count, self.groups * WIDE):
            self.closed[i] = INFINITY
        add(self.metric, 1.0, address(self.root[0, 0]), self.s, p)
        # Any seed is a good start of a xorshift generator but zero.
        self.state = (seed * 2685821657736338717 + 88172645463325252) % 2**64 or 1
        for _ in range(8):
            self._draw(2)

    def _lay_out(self, room):
        """Share the room out, and how many numbers that takes; of NULL only that."""
        at, first = address(room), room
        q, p, s, wide = self.q, self.p, self.s, self.groups * WIDE
        self.columns = take(at, q * p * wide)
        self.grown = take(at, 2 * self.groups * self.size)
        self.kept = take(at, 2 * self.groups * self.size)
        self.alone, self.bounds = take(at, wide), take(at, wide)
        self.closed, self.tops = take(at, wide), take(at, 2 * self.groups)
        self.gain, self.det = take(at, WIDE), take(at, WIDE)
        self.part = take(at, p * WIDE)
        self.cross, self.work = take(at, 4 * self.size), take(at, 4 * self.size)
        self.mixed, self.middle = take(at, 2 * self.size), take(at, 12 * q * q)
        self.at_out, self.changed = take(at, 2 * q * q), take(at, 2 * q * p)
        self.tall = take(at, 4 * q * p)
        self.now, self.trial = take(at, 2 * p * p), take(at, 2 * p * p)
        self.halved = take(at, p * p)
        self.known, self.gram = take(at, p * p), take(at, p * p)
        self.lower, self.metric = take(at, p * p), take(at, p * p)
        self.rest = take(at, p * p)
        self.half, self.solved = take(at, s * p), take(at, s * p)
        self.small, self.other = take(at, s * s), take(at, s * s)
        self.values, self.weakest = take(at, p), take(at, p)
        self.lapack = take(at, 1 + 6 * p + 2 * p * p)
        return room - first

    def climb(self, start, share: cython.double, swaps: cython.int, seconds):
        """Complete ``start`` (size,), required first, and swap while that helps: (k,)
        chosen, and phi, or E; -inf where that is singular.

        Args:
            share: of k mean candidates' information, for those not chosen yet.
            swaps: 0 none, 1 those that raise phi, 2 those that raise E.
        """
        self.watch = begin(seconds)
        size, value = len(start), 0.0
        for r in range(size):
            self.chosen[r] = start[r]
        with cython.nogil:
            self._clear()
            for c in range(size):
                self._count(self.chosen[c], 1)
            if swaps == 2:
                self._set_known(0.0, 0.0)
                value = self._climb(True)
            else:
                self._grow(size, share)
                value = self._finish(swaps)
        return np.array(self.chosen), value

    def random_climbs(
        self, count: cython.Py_ssize_t, chosen, phi: cython.double, seconds
    ):
        """The best of ``chosen`` (k,) with its phi, and ``count`` random starts."""
        self.watch = begin(seconds)
        best: cython.Py_ssize_t[::1] = np.array(chosen)
        with cython.nogil:
            for _ in range(count):
                if self._late() and phi > -INFINITY:
                    break
                self._random_start()
                reached = self._finish(True)
                if not self._allowed():
                    continue
                least = phi + 1e-10 * max(1.0, fabs(phi))
                if reached > least or not phi > -INFINITY:
                    phi = reached
                    best[:] = self.chosen
        return np.asarray(best), phi

    def random_start(self):
        """(k,) the required, then others at random."""
        self._random_start()
        return np.array(self.chosen)

    # --- what is chosen -------------------------------------------------------------

    def _clear(self):
        """Nothing is chosen."""
        for i in range(self.counts.shape[0]):
            self.counts[i] = 0
            self.closed[i] = 0.0 if self.caps[i] > 0 else INFINITY

    def _count(self, i, more):
        """Candidate i is chosen once more, or once less."""
        self.counts[i] += more
        self.closed[i] = 0.0 if self.counts[i] < self.caps[i] else INFINITY

    def _restrict(self, out, more):
        """Close what breaks a rule once ``out`` (-1: none) has gone, with ``more`` to
        come at the cheapest; true where one remains open."""
        for i in range(self.counts.shape[0]):
            self._count(i, 0)
        if out >= 0:
            self.closed[out] = 0.0
        for r in range(self.rules.shape[0]):
            room: cython.double = self.most[r]
            to_come: cython.Py_ssize_t = more
            for i in range(self.counts.shape[0]):
                room -= self.counts[i] * self.rules[r, i]
            if out >= 0:
                room += self.rules[r, out]
            for t in range(self.counts.shape[0]):
                i = self.order[r, t]
                if to_come <= 0:
                    break
                taken = min(self.caps[i] - self.counts[i], to_come)
                room -= taken * self.rules[r, i]
                to_come -= taken
            for i in range(self.counts.shape[0]):
                if self.rules[r, i] > room:
                    self.closed[i] = INFINITY
        for i in range(self.counts.shape[0]):
            if self.closed[i] == 0.0:
                return True
        return False

    def _allowed(self):
        """Whether what is chosen keeps the rules."""
        for r in range(self.rules.shape[0]):
            room: cython.double = self.most[r]
            for i in range(self.counts.shape[0]):
                room -= self.counts[i] * self.rules[r, i]
            if room < 0.0:
                return False
        return True

    def _draw(self, below):
        """A whole number in [0, below) from a xorshift generator."""
        self.state ^= self.state << 13
        self.state ^= self.state >> 7
        self.state ^= self.state << 17
        return ((self.state >> 32) * below) >> 32

    def _random_start(self):
        """Fill ``chosen`` at random, distinct where there are enough candidates."""
        ruled: cython.bint = self.rules.shape[0] > 0
        distinct: cython.bint = self.k <= self.available and not ruled
        self._clear()
        for c in range(self.k):
            if ruled and c >= self.fixed and not self._restrict(-1, self.k - c - 1):
                for i in range(self.counts.shape[0]):  # a selection of no use
                    self._count(i, 0)
            i = self.chosen[c] if c < self.fixed else self._draw(self.counts.shape[0])
            while c >= self.fixed and (
                self.closed[i] > 0.0 or (distinct and self.counts[i] > 0)
            ):
                i = self._draw(self.counts.shape[0])
            self.chosen[c] = i
            self._count(i, 1)

    def _late(self):
        self.looked += self.sweep
        if self.looked < _PATIENCE:
            return 0
        self.looked = 0
        return late(address(self.watch))

    # --- greedy and exchange --------------------------------------------------------

    def _grow(self, size, share):
        """Complete the first ``size`` chosen, the largest gain first."""
        if size == self.k:
            return 0
        self._set_known(share, 0.0)
        self._evaluate(size, False)
        self._refresh()
        while True:
            best = -1
            if self.rules.shape[0] > 0:
                self._restrict(-1, self.k - size - 1)
            if not self._late():
                best = self._addition()
            if best < 0:
                for i in range(self.counts.shape[0]):
                    self._count(i, 0)
                self._fill(size)
                return 0
            self.chosen[size] = best
            self._count(best, 1)
            size += 1
            if size == self.k:
                return 0
            self._evaluate(size, True)
            self._carry(best, -1)

    def _fill(self, size):
        """Complete the first ``size`` chosen, each candidate in turn: time is over."""
        i: cython.Py_ssize_t = 0
        while size < self.k:
            if self.closed[i] == 0.0:
                self.chosen[size] = i
                self._count(i, 1)
                size += 1
            i = i + 1 if i + 1 < self.counts.shape[0] else 0

    def _finish(self, climbs):
        """phi of the chosen, climbed; swaps mend a singular start, surer by a smaller
        ridge."""
        value: cython.double = 0.0
        for attempt in range(5):
            ridge: cython.double = 0.0
            if attempt % 2:
                ridge = _RIDGE if attempt == 1 else 1e-4 * _RIDGE
            self._set_known(0.0, ridge)
            if not climbs:
                return self._evaluate(self.k, False)
            value = self._climb(False)
            if ridge == 0.0 and value > -INFINITY:
                break
        return value

    def _climb(self, least):
        """Swap each chosen for its best replacement until none helps; phi, or E."""
        k, value = self.k, 0.0
        if least:
            value = self._least_of_chosen()
        else:
            value = self._evaluate(k, False)
        if k == self.fixed or not value > -INFINITY:
            return value
        if not least:
            self._refresh()
        position, since, swaps = self.fixed, 0, 0
        for i in range(self.tried.shape[0]):
            self.tried[i] = -1
        while since < k - self.fixed and swaps < _MOST_SWAPS * k:
            if late(address(self.watch)) if least else self._late():
                break
            at, out, after = position, self.chosen[position], value
            since += 1
            position = position + 1 if position + 1 < k else self.fixed
            if self.tried[out] == swaps:  # another measurement of the same
                continue
            self.tried[out] = swaps
            rise = _IMPROVES * max(1.0, fabs(value))
            if self.rules.shape[0] > 0:
                self._restrict(out, 0)
            if least:
                best = self._strongest(at, address(after))
            else:
                best = self._replacement(out, value, rise)
            if best < 0:
                continue
            self.chosen[at] = best
            if not least:
                after = self._evaluate(k, True)
                if not after > value + rise:  # the formulas promised more
                    self.chosen[at] = out
                    continue
            value, since = after, 0
            swaps += 1
            self._count(out, -1)
            self._count(best, 1)
            if not least:
                self._carry(best, out)
        return value

    # --- phi ------------------------------------------------------------------------

    def _set_known(self, share, ridge):
        p = self.p
        weight = share * self.k / self.available
        for a in range(p):
            for b in range(p):
                self.known[a * p + b] = (1.0 - weight) * self.prior[a, b]
            self.known[a * p + a] += weight + ridge

    def _sum(self, size, skipped):
        """Information of the first ``size`` chosen but one, into ``gram``."""
        copy(self.gram, self.known, self.p * self.p)
        count = self.times.shape[0]
        if size <= count:
            for c in range(size):
                if c != skipped:
                    self._add(self.chosen[c])
            return
        for i in range(count):  # many replicates
            self.times[i] = 0
        for c in range(size):
            if c != skipped:
                self.times[self.chosen[c]] += 1
        for i in range(count):
            if self.times[i] > 0:
                add(self.gram, self.times[i], address(self.blocks[i, 0, 0]),
                    self.q, self.p)  # fmt: skip

    def _add(self, i):
        """Add candidate i to ``gram``."""
        add(self.gram, 1.0, address(self.blocks[i, 0, 0]), self.q, self.p)

    def _evaluate(self, size, trial):
        """phi of the first ``size`` chosen, summed from their blocks; fills V and X."""
        p, into = self.p, self.trial if trial else self.now
        self._sum(size, -1)
        value: cython.double = factor(self.gram, into, self.lower, p)
        if self.kind == DET or not value > -INFINITY:
            return value
        other = into + p * p
        value = covariance(
            self.kind == SUBSET, address(self.root[0, 0]), into, self.s, p,
            self.half, self.solved, self.small, self.other, self.lower, other,
        )  # fmt: skip
        for a in range(p * p if self.kind == SUBSET else 0):
            other[a] = into[a] - other[a]  # X, (5)
        return value

    # --- gains ----------------------------------------------------------------------

    def _refresh(self):
        """D_jj, H_jj, K and the gain of every candidate alone, of V and X."""
        q, p = self.q, self.p
        self.tallest = 0.0
        for m in range(self.parts):
            for a in range(p):
                copy(self.halved + a * p, self.now + (m * p + a) * p, a + 1)
                self.halved[a * p + a] *= 0.5
            for c in range(self.groups):
                # B_j (L + L.T) B_j.T of a lower triangle L.
                columns, part = self.columns + c * q * p * WIDE, self.part
                grown = self.grown + (2 * c + m) * self.size
                for s in range(q):
                    for a in range(p):
                        _weigh(part + a * WIDE, self.halved + a * p,
                               columns + s * p * WIDE, a + 1)  # fmt: skip
                    for r in range(q):
                        into = grown + (r * q + s) * WIDE
                        _dots(into, columns + r * p * WIDE, part, p)
                for r in range(q):
                    for s in range(r + 1):
                        x, y = grown + (r * q + s) * WIDE, grown + (s * q + r) * WIDE
                        for j in range(WIDE):
                            x[j] += y[j]
                            y[j] = x[j]
        for c in range(self.groups):
            self._keep(c)

    def _keep(self, c):
        """K, and the gain of each alone: a factor, or the fall of a trace."""
        q = self.q
        alone, det = self.alone + c * WIDE, self.det
        grown, kept = self.grown + 2 * c * self.size, self.kept + 2 * c * self.size
        if self.rows:
            for j in range(WIDE):
                alone[j] = 1.0 + grown[j]
            self.tops[2 * c + 1] = _largest(grown)
            self.tops[2 * c] = 1.0 + self.tops[2 * c + 1]
            self.tallest = max(self.tallest, self.tops[2 * c + 1])
            return
        copy(kept, grown, self.dets * self.size)
        for m in range(self.dets):
            for r in range(q):
                diagonal = kept + m * self.size + (r * q + r) * WIDE
                for j in range(WIDE):
                    diagonal[j] += 1.0
            _invert(kept + m * self.size, det, q, WIDE)  # K
            for j in range(WIDE):
                alone[j] = alone[j] / det[j] if m else det[j]  # of (2)
        if self.kind == TRACE:
            _dots(alone, kept, grown + self.size, q * q)  # trace(K H_jj) of (3)
        for j in range(WIDE):
            det[j] = 0.0
        for r in range(q):
            for j in range(WIDE):
                det[j] += grown[(r * q + r) * WIDE + j]
        self.tops[2 * c], self.tops[2 * c + 1] = _largest(alone), _largest(det)
        self.tallest = max(self.tallest, self.tops[2 * c + 1])

    def _carry(self, came, went):
        """What is kept, for V and X (``trial``) after a swap; -1: none went.

        With A the blocks that came and went, W = A V, U = A X and S of diagonal 1 and
        -1, V falls by ``W.T P W``, P = inverse(S + W A.T) (9). So does X of a subset,
        by U, and X of a trace by ``W.T P U + U.T P W - W.T P U A.T P W`` (10).
        """
        q, p, changed = self.q, self.p, self.changed
        r: cython.int = q if went < 0 else 2 * q
        peak = self.tallest
        updates: cython.bint = 2 * p > 5 * r
        if updates:
            copy(changed, address(self.blocks[came, 0, 0]), q * p)
            if went >= 0:
                copy(changed + q * p, address(self.blocks[went, 0, 0]), q * p)
            for m in range(self.parts):
                tall, middle = self.tall + 2 * m * q * p, self.middle + 4 * m * q * q
                multiply(False, False, r, p, p, changed, self.now + m * p * p, tall)
                multiply(False, True, r, r, p, tall, changed, middle)
                if m < self.dets:
                    for s in range(r):
                        middle[s * r + s] += 1.0 if s < q else -1.0
                    _invert(middle, self.det, r, 1)  # P
                else:  # P U A.T P
                    part = self.middle + 8 * q * q
                    multiply(False, False, r, r, r, self.middle, middle, part)
                    multiply(False, False, r, r, r, part, self.middle, middle)
            self.tallest = 0.0
            for c in range(self.groups):
                self._update(c, r)
                self._keep(c)
        copy(self.now, self.trial, 2 * p * p)
        if not updates or self.tallest < _CANCELLED * peak:
            self._refresh()
        self.tallest = max(self.tallest, peak)

    def _update(self, c, r):
        """D_jj and H_jj of the group."""
        q, mixed = self.q, self.mixed
        for m in range(self.parts):
            cross, middle = self.cross + 2 * m * self.size, self.middle + 4 * m * q * q
            self._cross(c, m, r)
            for a in range(r * q * WIDE):
                mixed[a] = 0.0
            if m < self.dets:
                _mix(mixed, 0.5, middle, cross, r, q)  # (9)
            else:
                _mix(mixed, 1.0, self.middle, cross, r, q)
                cross = self.cross
                _mix(mixed, -0.5, middle, cross, r, q)  # (10)
            _lower(self.grown + (2 * c + m) * self.size, cross, mixed, r, q)

    def _cross(self, c, m, r):
        """``tall`` times the blocks of a group, (r, q, WIDE): V, or m = 1: X."""
        q, p = self.q, self.p
        for s in range(q):
            for a in range(r):
                _weigh(self.cross + 2 * m * self.size + (a * q + s) * WIDE,
                       self.tall + (2 * m * q + a) * p,
                       self.columns + (c * q + s) * p * WIDE, p)  # fmt: skip

    def _swaps(self, c):
        """Gains of the group when i, whose ``tall`` is there, goes out."""
        q = self.q
        gain, det, alone = self.gain, self.det, self.alone + c * WIDE
        solved, y, cross = self.work, self.work + self.size, self.cross
        for m in range(self.parts):
            self._cross(c, m, q)
        if self.rows:
            stays = 1.0 - self.at_out[0]
            for j in range(WIDE):
                gain[j] = alone[j] * stays + cross[j] * cross[j]  # (2)
            return
        for m in range(self.dets):
            for a in range(self.size):
                solved[a] = 0.0
            kept = self.kept + (2 * c + m) * self.size
            _times(solved, 1.0, cross + 2 * m * self.size, kept, False, q)  # Z
            for r in range(q):
                for s in range(q):
                    stays = (1.0 if r == s else 0.0) - self.at_out[(m * q + r) * q + s]
                    for j in range(WIDE):
                        y[(r * q + s) * WIDE + j] = stays
            _times(y, 1.0, solved, cross + 2 * m * self.size, True, q)  # (1)
            _invert(y, det, q, WIDE)
            for j in range(WIDE):
                # (2), of a subset divided by that of X
                gain[j] = gain[j] / max(det[j], 1e-300) if m else alone[j] * det[j]
        if self.kind != TRACE:
            return
        part, lost = self.work + 2 * self.size, self.work + 3 * self.size
        for a in range(self.size):
            part[a] = -cross[2 * self.size + a]
        grown = self.grown + (2 * c + 1) * self.size
        _times(part, 0.5, solved, grown, False, q)  # Q, (4)
        for a in range(q * q):
            for j in range(WIDE):
                lost[a * WIDE + j] = self.at_out[q * q + a]
        _times(lost, 2.0, part, solved, True, q)  # both halves: Y is symmetric
        _dots(gain, y, lost, q * q)  # of (3)
        for j in range(WIDE):  # none where it is singular without i
            gain[j] = alone[j] - gain[j] if det[j] > 1e-14 else -INFINITY

    def _take_out(self, out):
        """B_i V, B_i X, D_ii and H_ii of the candidate that goes out."""
        q, p = self.q, self.p
        g, e = out // WIDE, out % WIDE
        for m in range(self.parts):
            multiply(False, False, q, p, p, address(self.blocks[out, 0, 0]),
                     self.now + m * p * p, self.tall + 2 * m * q * p)  # fmt: skip
            grown = self.grown + (2 * g + m) * self.size + e
            for a in range(q * q):
                self.at_out[m * q * q + a] = grown[a * WIDE]

    def _addition(self):
        """The candidate of the largest gain alone, any where no gain is a number."""
        best, most = -1, -INFINITY
        for c in range(self.groups):
            alone = self.alone + c * WIDE
            j = _best_of(alone, self.closed + c * WIDE, most)
            if j >= 0:
                best, most = c * WIDE + j, alone[j]
        if best < 0:
            best = 0
            while best < self.counts.shape[0] and self.closed[best] > 0.0:
                best += 1
        return best if best < self.counts.shape[0] else -1

    def _replacement(self, out, value, rise):
        """The candidate that raises phi most in the place of ``out``; -1: none."""
        q, taken = self.q, 0.0
        self._take_out(out)
        for r in range(q):
            taken += self.at_out[r * q + r] / q
        most: cython.double = rise if self.kind == TRACE else 1.0 + rise
        best: cython.Py_ssize_t = -1
        for c in range(self.groups):
            bound: cython.double = self.tops[2 * c]
            if self.kind == DET:
                # (6) by the mean of the diagonal
                stays: cython.double = 1.0 - taken / (1.0 + self.tops[2 * c + 1])
                for _ in range(q):
                    bound *= stays
            if bound <= most:
                continue
            self._swaps(c)
            j = _best_of(self.gain, self.closed + c * WIDE, most)
            if j >= 0:
                best, most = c * WIDE + j, self.gain[j]
        return -1 if best == out else best

    # --- E --------------------------------------------------------------------------

    def _least_of_chosen(self):
        """E of the chosen; -inf where it is singular."""
        self._sum(self.k, -1)
        return self._least(False)

    def _least(self, vectors):
        """E of ``gram``; C V and, where wanted, eigenvectors of C V C.T are there."""
        p, inverse = self.p, self.now
        root = address(self.root[0, 0])
        if not factor(self.gram, inverse, self.lower, p) > -INFINITY:
            return -INFINITY
        multiply(False, False, p, p, p, root, inverse, self.half)
        multiply(False, True, p, p, p, self.half, root, self.small)
        eigen(self.small, self.values, self.lapack, self.whole, p, vectors)
        return 1.0 / self.values[p - 1]

    def _strongest(self, at, least):
        """The candidate of the largest E in place ``at``, over ``least``; -1: none."""
        p = self.p
        least[0] *= 1.0 + _LIFTS
        gram, rest = self.gram, self.rest
        if not self._bound_without(at):
            return -1
        best: cython.Py_ssize_t = -1
        while True:
            e = self._next(least[0])
            if e < 0:
                return best
            copy(gram, rest, p * p)
            self._add(e)
            lower = self.lower
            for a in range(p * p):
                lower[a] = gram[a] - least[0] * self.metric[a]  # (8)
            if cholesky(lower, lower, p, 0.0) > -INFINITY:
                value = self._least(False)
                if value > least[0]:
                    best, least[0] = e, value

    def _next(self, least):
        """The candidate of the largest bound over ``least``, each once; -1: none."""
        g: cython.Py_ssize_t = 0
        for c in range(1, self.groups):
            if self.tops[2 * c] > self.tops[2 * g]:
                g = c
        if not self.tops[2 * g] > least:
            return -1
        bound, e = self.bounds + g * WIDE, 0
        while bound[e] != self.tops[2 * g]:
            e += 1
        bound[e] = -INFINITY
        self.tops[2 * g] = _largest(bound)
        return g * WIDE + e

    def _bound_without(self, at):
        """Bound E with each candidate in place ``at``; false where all are singular."""
        p, q = self.p, self.q
        gram, rest = self.gram, self.rest
        self._sum(self.k, at)
        copy(rest, gram, p * p)
        for a in range(p):
            gram[a * p + a] += _SLIGHT
        value = self._least(True)
        if not value > -INFINITY:
            return False
        # A block of q readings leaves the variances after the q largest no smaller.
        cap = 1.0 / self.values[p - 1 - q] if q < p else INFINITY
        strong = self.small + (p - 1) * p
        multiply(False, False, 1, p, p, strong, self.half, self.weakest)
        for a in range(p):
            self.weakest[a] *= value
        part = self.part
        for c in range(self.groups):
            bound, closed = self.bounds + c * WIDE, self.closed + c * WIDE
            for j in range(WIDE):
                bound[j] = value
            for s in range(q):
                columns = self.columns + (c * q + s) * p * WIDE
                _weigh(part, self.weakest, columns, p)
                for j in range(WIDE):
                    bound[j] += part[j] * part[j]  # (7)
            for j in range(WIDE):
                bound[j] = min(bound[j], cap) - closed[j]
            self.tops[2 * c] = _largest(bound)
        return True


class JointClimber(Climber):
    """One choice in several scenarios, the mean or the least of whose phi counts.

    phi of a scenario counts as ``scale phi + shift``. What is chosen is held in common
    with the first of the ``climbers``, which are of one shape, with the same rules.
    """

    def __init__(self, climbers, weights, least):
        count: cython.Py_ssize_t = len(climbers)
        s: cython.Py_ssize_t
        self.climbers, self.least = list(climbers), least
        self.addresses = np.zeros(count, dtype=np.intp)
        self.weights = np.array(weights, dtype=np.float64)
        self.scale, self.shift = np.ones(count), np.zeros(count)
        self.phi, self.after = np.zeros((2, count))
        self.total = np.zeros(WIDE)
        lead: Climber = self.climbers[0]
        self.k, self.fixed, self.groups = lead.k, lead.fixed, lead.groups
        self.available, self.caps = lead.available, lead.caps
        self.rules, self.most, self.order = lead.rules, lead.most, lead.order
        self.counts, self.tried, self.chosen = lead.counts, lead.tried, lead.chosen
        self.closed, self.state = lead.closed, lead.state
        self.ahead, self.p = np.zeros((count, self.groups * WIDE)), lead.p
        self.sweep = lead.groups * cast(cython.int, count)
        for s in range(count):
            member: Climber = self.climbers[s]
            member.chosen = self.chosen
            self.addresses[s] = cast(cython.Py_ssize_t, cast(cython.p_void, member))
        self.members = cast(cython.pointer(cython.p_void), address(self.addresses[0]))

    def weigh(self, scale, shift):
        """Let phi of the scenarios count as ``scale phi + shift``, (S,) both."""
        self.scale = np.array(scale, dtype=np.float64)
        self.shift = np.array(shift, dtype=np.float64)

    # --- the joined phi -------------------------------------------------------------

    def _set_known(self, share, ridge):
        for s in range(self.addresses.shape[0]):
            cast(Climber, self.members[s])._set_known(share, ridge)

    def _join(self, phi):
        """The mean, or the least, of (S,) phi."""
        value: cython.double = INFINITY if self.least else 0.0
        for s in range(self.addresses.shape[0]):
            if self.least:
                value = min(value, phi[s])
            else:
                value += self.weights[s] * phi[s]
        return value

    def _evaluate(self, size, trial):
        phi = self.after if trial else self.phi
        for s in range(self.addresses.shape[0]):
            value = cast(Climber, self.members[s])._evaluate(size, trial)
            if not value > -INFINITY:
                return -INFINITY
            phi[s] = self.scale[s] * value + self.shift[s]
        return self._join(address(phi[0]))

    def _refresh(self):
        for s in range(self.addresses.shape[0]):
            cast(Climber, self.members[s])._refresh()

    def _carry(self, came, went):
        for s in range(self.addresses.shape[0]):
            self.phi[s] = self.after[s]
            cast(Climber, self.members[s])._carry(came, went)

    def _totals(self, c, swaps):
        """The joined phi with each of a group, alone or in the place that is left."""
        total = address(self.total[0])
        for j in range(WIDE):
            total[j] = INFINITY if self.least else 0.0
        for s in range(self.addresses.shape[0]):
            kind = cast(Climber, self.members[s]).kind
            gain = cast(Climber, self.members[s]).alone + c * WIDE
            if swaps:
                cast(Climber, self.members[s])._swaps(c)
                gain = cast(Climber, self.members[s]).gain
            scale, phi, weight = self.scale[s], self.phi[s], self.weights[s]
            for j in range(WIDE):
                rise: cython.double = gain[j]
                if kind != TRACE:
                    rise = log(rise) if rise > 1e-300 else -INFINITY
                rise = phi + scale * rise
                if self.least:
                    total[j] = min(total[j], rise)
                else:
                    total[j] += weight * rise

    def _addition(self):
        return self._best(False, -INFINITY)

    def _replacement(self, out, value, rise):
        for s in range(self.addresses.shape[0]):
            cast(Climber, self.members[s])._take_out(out)
        best = self._best(True, value + rise)
        return -1 if best == out else best

    def _best(self, swaps, most):
        """Which candidate gives the largest joined phi above ``most``; -1: none."""
        best, total = -1, address(self.total[0])
        for c in range(self.groups):
            self._totals(c, swaps)
            j = _best_of(total, self.closed + c * WIDE, most)
            if j >= 0:
                best, most = c * WIDE + j, total[j]
        return best

    # --- E --------------------------------------------------------------------------

    def _least_of_chosen(self):
        """The joined E of the chosen; -inf where a scenario is singular."""
        for s in range(self.addresses.shape[0]):
            value = cast(Climber, self.members[s])._least_of_chosen()
            if not value > -INFINITY:
                return -INFINITY
            self.after[s] = self.scale[s] * value + self.shift[s]
        return self._join(address(self.after[0]))

    def _strongest(self, at, least):
        """The candidate of the largest joined E in place ``at``; -1: none over it."""
        lift = max(_LIFTS * fabs(least[0]), _IMPROVES * max(1.0, fabs(least[0])))
        least[0] += lift
        groups = self.groups
        bounds = cast(Climber, self.members[0]).bounds
        tops = cast(Climber, self.members[0]).tops
        for s in range(self.addresses.shape[0]):
            if not cast(Climber, self.members[s])._bound_without(at):
                return -1
            bound = cast(Climber, self.members[s]).bounds
            scale, shift, weight = self.scale[s], self.shift[s], self.weights[s]
            for i in range(groups * WIDE):
                value: cython.double = scale * bound[i] + shift
                self.ahead[s, i] = value
                if not self.least:
                    value *= weight
                if s == 0:
                    bounds[i] = value
                elif self.least:
                    bounds[i] = min(bounds[i], value)
                else:
                    bounds[i] += value
        for c in range(groups):
            tops[2 * c] = _largest(bounds + c * WIDE)
        best: cython.Py_ssize_t = -1
        for _ in range(_TRIED):
            e = cast(Climber, self.members[0])._next(least[0])
            if e < 0:
                return best
            if self._betters(e, least):
                best = e
        return best

    def _betters(self, e, least):
        """Whether the joined E with candidate e is over ``least``, which then is it.

        Bounds give way to values one scenario after the other, until it cannot be.
        """
        total: cython.double = INFINITY if self.least else 0.0
        for s in range(0 if self.least else self.addresses.shape[0]):
            total += self.weights[s] * self.ahead[s, e]
        for s in range(self.addresses.shape[0]):
            gram = cast(Climber, self.members[s]).gram
            copy(gram, cast(Climber, self.members[s]).rest, self.p * self.p)
            cast(Climber, self.members[s])._add(e)
            value = cast(Climber, self.members[s])._least(False)
            if not value > -INFINITY:
                return False
            value = self.scale[s] * value + self.shift[s]
            if self.least:
                total = min(total, value)
            else:
                total += self.weights[s] * (value - self.ahead[s, e])
            if not total > least[0]:
                return False
        least[0] = total
        return True
