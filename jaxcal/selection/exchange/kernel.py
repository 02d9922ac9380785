"""Compiled greedy and exchange for log det and trace of any C M^-1 C.T.

V is the inverse information, D_jj = B_j V B_j.T. Of a candidate j that comes in and one
i that goes out (or none), with K = (I + D_jj)^-1, Z = D_ij K,

    Y = I - D_ii + Z D_ji,          det grows by det(I + D_jj) det Y,

and with X = V C.T C V and H_ij = B_i X B_j.T the trace of C V C.T falls by

    trace(K H_jj) - trace(Y^-1 (H_ii + Q Z.T + Z Q.T)),      Q = Z H_jj / 2 - H_ij.

No removal alone is inverted, so a chosen block that is indispensable does no harm. For
a subset of the parameters, log det of (C V C.T)^-1 is that of the information less that
of the nuisance parameters, whose inverse is X = V - V C.T (C V C.T)^-1 C V: the same
formula twice. What does not depend on i (D_jj, H_jj, K, and the gain of j alone) is
kept until a swap is made. A swap is made only where phi of sums made anew has risen:
two candidates that are equal but for rounding are not swapped for ever.

Candidates are held in groups of ``WIDE``, arrays (q, q, WIDE) or (q, p, WIDE), with
innermost loops over a group: their length is known to the compiler, and what belongs to
a group stays in the first cache.
"""

# Sums in any order.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import factor, multiply
from cython.cimports.jaxcal.selection.exchange.kernel import WIDE
from cython.cimports.jaxcal.watch import begin, late
from cython.cimports.libc.math import INFINITY, fabs, log, sqrt

__all__ = ["DET", "SUBSET", "TRACE", "Climber"]

DET, SUBSET, TRACE = 0, 1, 2  # log det of all, or of some parameters; a trace
# Compiled functions read C variables, which Python does not see.
_DET = cython.declare(cython.int, 0)
_SUBSET = cython.declare(cython.int, 1)
_TRACE = cython.declare(cython.int, 2)

_IMPROVES = cython.declare(cython.double, 1e-11)  # by which a swap must raise phi
_MOST_SWAPS = cython.declare(cython.int, 100)  # of each place, where a few are usual
_RIDGE = cython.declare(cython.double, 1e-6)  # to climb from a singular start


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
    whole = count - count % 4
    for j in range(WIDE):
        into[j] = 0.0
    for b in range(whole // 4):
        w, x = weights + 4 * b, rows + 4 * b * WIDE
        for j in range(WIDE):
            into[j] += (w[0] * x[j] + w[1] * x[WIDE + j]) + (
                w[2] * x[2 * WIDE + j] + w[3] * x[3 * WIDE + j]
            )
    for a in range(whole, count):
        x = rows + a * WIDE
        for j in range(WIDE):
            into[j] += weights[a] * x[j]


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _fill(
    columns: cython.p_double,
    matrix: cython.p_double,
    part: cython.p_double,
    grown: cython.p_double,
    q: cython.int,
    p: cython.int,
) -> cython.void:
    """``B_j matrix B_j.T`` (q, q, WIDE) of a symmetric matrix; part (q, WIDE)."""
    for a in range(q * q * WIDE):
        grown[a] = 0.0
    for a in range(p):
        half = 0.5 * matrix[a * p + a]
        for s in range(q):
            x = columns + s * p * WIDE
            _weigh(part + s * WIDE, matrix + a * p, x, a)
            for j in range(WIDE):
                part[s * WIDE + j] += half * x[a * WIDE + j]
        for r in range(q):
            for s in range(r + 1):
                x, y = columns + (r * p + a) * WIDE, columns + (s * p + a) * WIDE
                u, v = part + r * WIDE, part + s * WIDE
                into = grown + (r * q + s) * WIDE
                for j in range(WIDE):
                    into[j] += x[j] * v[j] + u[j] * y[j]
    for r in range(q):
        for s in range(r):
            into, x = grown + (s * q + r) * WIDE, grown + (r * q + s) * WIDE
            for j in range(WIDE):
                into[j] = x[j]


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


class Climber:
    """The candidates of a problem, and the work space that ``kernel.pxd`` describes.

    Args:
        kind: DET, SUBSET or TRACE.
        blocks: (M, q, p) available candidates, whitened.
        prior: (p, p).
        root: C (s, p).
        upper: (M,) how often each may be chosen.
        required: (r,) candidates that are chosen in any case.
        span: (r, p) orthonormal directions that the prior informs.
        k: candidates to choose.
        seed: of the random starts.
    """

    def __init__(self, kind, blocks, prior, root, upper, required, span, k, seed):
        count, q, p = blocks.shape
        groups, s = -(-count // WIDE), len(root)
        self.kind, self.k, self.q, self.p, self.s = kind, k, q, p, s
        self.fixed, self.groups = len(required), groups
        padded = np.zeros((groups * WIDE, q, p))
        padded[:count] = blocks
        self.blocks, self.prior, self.root = blocks.copy(), prior.copy(), root.copy()
        self.columns = np.ascontiguousarray(
            padded.reshape(groups, WIDE, q, p).transpose(0, 2, 3, 1)
        )
        room = np.zeros(groups * WIDE, dtype=np.intp)
        room[:count] = upper
        self.upper, self.counts = room, np.zeros_like(room)
        self.chosen, self.best = np.zeros((2, k), dtype=np.intp)
        for r in range(len(required)):
            self.chosen[r] = required[r]
        self.known, self.gram, self.lower, self.basis = np.zeros((4, p, p))
        self.now, self.trial = np.empty((2, 2, p, p))
        self.half, self.solved = np.empty((2, s, p))
        self.small = np.empty((s, s))
        self.grown, self.kept = np.empty((2, groups, 2, q, q, WIDE))
        self.alone, self.gain = np.empty((2, groups, WIDE))
        self.cross, self.work = np.empty((2, q, q, WIDE)), np.empty((4, q, q, WIDE))
        self.at_out, self.tall = np.zeros((2, q, q)), np.empty((2, q, p))
        self.det, self.part = np.empty(WIDE), np.empty((q, WIDE))
        self.span, self.order = span, np.arange(count)
        # Any seed is a good start of a xorshift generator but zero.
        self.state = (seed * 2685821657736338717 + 88172645463325252) % 2**64 or 1
        for _ in range(8):
            self._draw(2)

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
        for r in range(len(start)):
            self.chosen[r] = start[r]
        phi = self._finish(len(start), share, climbs)
        return np.array(self.chosen), phi

    def random_climbs(self, count, chosen, phi, seconds, full):
        """The best of ``chosen`` (k,) with its phi, and ``count`` random starts.

        ``full`` is the rank that a block can have.
        """
        self.full = full
        self.watch = begin(seconds)
        for r in range(len(chosen)):
            self.best[r] = chosen[r]
        phi = self._random(count, phi)
        return np.array(self.best), phi

    def random_start(self, full):
        """(k,) required first, then at random, rarely singular; ``full`` as above."""
        self.full = full
        self._random_start()
        return np.array(self.chosen)

    def _set_known(self, share, ridge):
        """What counts beside the chosen: the prior, diluted by share, and a ridge."""
        weight = share * self.k / self.blocks.shape[0]
        for a in range(self.p):
            for b in range(self.p):
                self.known[a, b] = (1.0 - weight) * self.prior[a, b]
            self.known[a, a] += weight + ridge

    def _evaluate(self, size, into):
        """phi of the first ``size`` chosen from sums made anew; V and X are filled."""
        p = self.p
        for a in range(p):
            for b in range(a + 1):
                self.gram[a, b] = self.known[a, b]
        for c in range(size):
            i = self.chosen[c]
            for r in range(self.q):
                for a in range(p):
                    weight = self.blocks[i, r, a]
                    for b in range(a + 1):
                        self.gram[a, b] += weight * self.blocks[i, r, b]
        for a in range(p):
            for b in range(a):
                self.gram[b, a] = self.gram[a, b]
        inverse = cython.address(into[0, 0, 0])
        value: cython.double = factor(
            cython.address(self.gram[0, 0]), inverse,
            cython.address(self.lower[0, 0]), p,
        )  # fmt: skip
        if self.kind == _DET or not value > -INFINITY:
            return value
        half = cython.address(self.half[0, 0])
        multiply(False, False, self.s, p, p, cython.address(self.root[0, 0]), inverse,
                 half)  # fmt: skip
        if self.kind == _SUBSET:
            return self._subset(into)
        multiply(True, False, p, p, self.s, half, half, cython.address(into[1, 0, 0]))
        value = 0.0
        for r in range(self.s):
            for a in range(p):
                value -= self.half[r, a] * self.root[r, a]
        return value

    def _subset(self, into):
        """The same for log det of some parameters; C V is there."""
        half, small = cython.address(self.half[0, 0]), cython.address(self.small[0, 0])
        solved, other = cython.address(self.solved[0, 0]), cython.address(into[1, 0, 0])
        s, p = self.s, self.p
        # The covariance C V C.T in ``solved``, which has room for it, as s <= p.
        multiply(False, True, s, s, p, half, cython.address(self.root[0, 0]), solved)
        value = -factor(solved, small, cython.address(self.lower[0, 0]), s)
        multiply(False, False, s, p, s, small, half, solved)
        multiply(True, False, p, p, s, half, solved, other)
        for a in range(p):
            for b in range(p):
                into[1, a, b] = into[0, a, b] - into[1, a, b]
        return value

    def _refresh(self, matrices):
        """D_jj, H_jj, K and the gain of every candidate alone, of V and X."""
        for c in range(self.groups):
            for m in range(1 if self.kind == _DET else 2):
                _fill(cython.address(self.columns[c, 0, 0, 0]),
                      cython.address(matrices[m, 0, 0]),
                      cython.address(self.part[0, 0]),
                      cython.address(self.grown[c, m, 0, 0, 0]),
                      self.q, self.p)  # fmt: skip
            self._keep(c)

    def _keep(self, c):
        """K, and the gain of each alone: a factor, or the fall of a trace."""
        q = self.q
        alone, det = cython.address(self.alone[c, 0]), cython.address(self.det[0])
        for m in range(2 if self.kind == _SUBSET else 1):
            grown = cython.address(self.grown[c, m, 0, 0, 0])
            kept = cython.address(self.kept[c, m, 0, 0, 0])
            for a in range(q * q * WIDE):
                kept[a] = grown[a]
            for r in range(q):
                into = kept + (r * q + r) * WIDE
                for j in range(WIDE):
                    into[j] += 1.0
            _invert(kept, det if m else alone, q)
        if self.kind == _SUBSET:
            for j in range(WIDE):
                alone[j] /= det[j]
        elif self.kind == _TRACE:
            for j in range(WIDE):
                alone[j] = 0.0
            _dots(alone, 1.0, cython.address(self.kept[c, 0, 0, 0, 0]),
                  cython.address(self.grown[c, 1, 0, 0, 0]), q)  # fmt: skip

    def _shrink(self, c, m):
        """Z and Y^-1 into ``work``, det Y into ``det``; m = 1: of X in place of V."""
        q = self.q
        solved = cython.address(self.work[0, 0, 0, 0])
        middle = cython.address(self.work[1, 0, 0, 0])
        cross = cython.address(self.cross[m, 0, 0, 0])
        for a in range(q * q * WIDE):
            solved[a] = 0.0
        _times(solved, 1.0, cross, cython.address(self.kept[c, m, 0, 0, 0]), False, q)
        for r in range(q):
            for s in range(q):
                stays = (1.0 if r == s else 0.0) - self.at_out[m, r, s]
                into = middle + (r * q + s) * WIDE
                for j in range(WIDE):
                    into[j] = stays
        _times(middle, 1.0, solved, cross, True, q)
        _invert(middle, cython.address(self.det[0]), q)

    def _swaps(self, c):
        """Gains of the group when i, whose ``tall`` is there, goes out."""
        q, p = self.q, self.p
        gain, det = cython.address(self.gain[c, 0]), cython.address(self.det[0])
        alone = cython.address(self.alone[c, 0])
        for m in range(1 if self.kind == _DET else 2):
            for s in range(q):
                for r in range(q):
                    _weigh(cython.address(self.cross[m, r, s, 0]),
                           cython.address(self.tall[m, r, 0]),
                           cython.address(self.columns[c, s, 0, 0]), p)  # fmt: skip
        self._shrink(c, 0)
        if self.kind != _TRACE:
            for j in range(WIDE):
                gain[j] = alone[j] * det[j]
            if self.kind == _SUBSET:
                self._shrink(c, 1)
                for j in range(WIDE):
                    gain[j] /= max(det[j], 1e-300)
            return
        solved = cython.address(self.work[0, 0, 0, 0])
        part = cython.address(self.work[2, 0, 0, 0])
        lost = cython.address(self.work[3, 0, 0, 0])
        other = cython.address(self.cross[1, 0, 0, 0])
        for a in range(q * q * WIDE):
            part[a] = -other[a]
        _times(part, 0.5, solved, cython.address(self.grown[c, 1, 0, 0, 0]), False, q)
        for a in range(q * q):
            constant = cython.address(self.at_out[1, 0, 0])[a]
            for j in range(WIDE):
                lost[a * WIDE + j] = constant
        _times(lost, 2.0, part, solved, True, q)
        for j in range(WIDE):
            gain[j] = alone[j]
        _dots(gain, -1.0, cython.address(self.work[1, 0, 0, 0]), lost, q)
        for j in range(WIDE):
            if not det[j] > 1e-14:  # singular without i
                gain[j] = -INFINITY

    def _largest(self, gain):
        """The candidate of the largest gain that may be chosen once more, or -1."""
        best: cython.Py_ssize_t = -1
        most: cython.double = -INFINITY
        for c in range(self.groups):
            for j in range(WIDE):
                i = c * WIDE + j
                if gain[c, j] > most and self.counts[i] < self.upper[i]:
                    best, most = i, gain[c, j]
        return best

    def _grow(self, size, share):
        """Complete the first ``size`` chosen, the largest gain first."""
        self._set_known(share, 0.0)
        while size < self.k:
            late(cython.address(self.watch))
            self._evaluate(size, self.now)
            self._refresh(self.now)
            best = self._largest(self.alone)
            self.chosen[size] = best
            self.counts[best] += 1
            size += 1
        return 0

    def _climb(self):
        """Swap each chosen for its best replacement until none helps; phi."""
        q, p, k = self.q, self.p, self.k
        value = self._evaluate(k, self.now)
        if k == self.fixed or not value > -INFINITY:
            return value
        self._refresh(self.now)
        position, since, swaps = self.fixed, 0, 0
        while since < k - self.fixed and swaps < _MOST_SWAPS * k:
            if late(cython.address(self.watch)):
                break
            out = self.chosen[position]
            c, j = out // WIDE, out % WIDE
            for m in range(1 if self.kind == _DET else 2):
                multiply(False, False, q, p, p, cython.address(self.blocks[out, 0, 0]),
                         cython.address(self.now[m, 0, 0]),
                         cython.address(self.tall[m, 0, 0]))  # fmt: skip
                for r in range(q):
                    for s in range(q):
                        self.at_out[m, r, s] = self.grown[c, m, r, s, j]
            for c in range(self.groups):
                self._swaps(c)
            best = self._largest(self.gain)
            at = position
            since += 1
            position = position + 1 if position + 1 < k else self.fixed
            if best < 0 or best == out:
                continue
            rise = self.gain[best // WIDE, best % WIDE]
            if self.kind != _TRACE:
                rise = log(rise) if rise > 0.0 else -INFINITY
            least = _IMPROVES * max(1.0, fabs(value))
            if not rise > least:
                continue
            self.chosen[at] = best
            after = self._evaluate(k, self.trial)
            if not after > value + least:  # rounding promised more than there is
                self.chosen[at] = out
                continue
            value, since = after, 0
            swaps += 1
            self.counts[out] -= 1
            self.counts[best] += 1
            self.now[:, :, :] = self.trial
            self._refresh(self.now)
        return value

    def _finish(self, size, share, climbs):
        """Grow and climb from the first ``size`` chosen; phi."""
        for i in range(self.counts.shape[0]):
            self.counts[i] = 0
        for c in range(size):
            self.counts[self.chosen[c]] += 1
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
        return (self.state >> 11) % below

    def _random_start(self):
        """Fill ``chosen`` at random, rarely singular.

        An orthonormal basis grows with what is chosen: first the required ones, then at
        random what leaves the span by enough.
        """
        count: cython.Py_ssize_t = self.blocks.shape[0]
        size: cython.Py_ssize_t = self.fixed
        for i in range(count):
            self.counts[i] = 0
        for a in range(count - 1, 0, -1):
            b = self._draw(a + 1)
            self.order[a], self.order[b] = self.order[b], self.order[a]
        rank: cython.int = self.span.shape[0]
        for r in range(rank):
            for a in range(self.p):
                self.basis[r, a] = self.span[r, a]
        for r in range(size):
            self.counts[self.chosen[r]] += 1
            rank = self._extend(self.chosen[r], rank, 1e-18)
        for position in range(count):
            if rank == self.p or size == self.k:
                break
            i = self.order[position]
            if self.counts[i] < self.upper[i]:
                grown = self._extend(i, rank, 1e-6 / count)
                if grown - rank >= min(self.full, self.p - rank):
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
        for s in range(self.q):
            if rank == self.p:
                break
            for a in range(self.p):
                self.basis[rank, a] = self.blocks[i, s, a]
            for _ in range(2):  # twice is enough for orthogonality to rounding
                for r in range(rank):
                    dot: cython.double = 0.0
                    for a in range(self.p):
                        dot += self.basis[r, a] * self.basis[rank, a]
                    for a in range(self.p):
                        self.basis[rank, a] -= dot * self.basis[r, a]
            square: cython.double = 0.0
            for a in range(self.p):
                square += self.basis[rank, a] * self.basis[rank, a]
            if square > least:
                for a in range(self.p):
                    self.basis[rank, a] /= sqrt(square)
                rank += 1
        return rank

    def _random(self, count, value):
        """The best of ``best``, of phi value, and of random starts climbed."""
        for _ in range(count):
            if late(cython.address(self.watch)) and value > -INFINITY:
                break
            self._random_start()
            found = self._finish(self.k, 0.0, True)
            if found > value + 1e-10 * max(1.0, fabs(value)) or not value > -INFINITY:
                value = found
                self.best[:] = self.chosen
        return value
