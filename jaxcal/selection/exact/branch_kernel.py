"""Compiled branch and bound on the concave relaxation; the front is branch_and_bound.

A node bounds the count of every candidate, ``low_i <= c_i <= high_i``, sum k. Its
relaxation lets counts be real numbers: the criterion phi is concave, so at any counts
c, with G the gradient at the information M and leverages ``d_i = trace(B_i G B_i.T)``,

    phi(any c') <= phi(c) + max over c' of sum of (c'_i - c_i) d_i              (1)

within the bounds: true wherever the climb stops, tight at the relaxed optimum. The
climb is Newton's, on the fractional counts and those the leverages ask to move; its
quadratic programme is solved by an active set. With W = inverse(M) and <.,.> the
entrywise product, the Hessian over the counts is

    D       -|X|^2           X = B_i W B_j.T                        (2)
    Ds      |X|^2 - 2 <X, Y> X = B_i G B_j.T, Y = B_i W B_j.T       (3)
    A I As  -2 <X, Y>        the same.                              (4)

Three bounds go by eigenvalues. E is 1 / the largest eigenvalue of V = C W C.T, which
double precision holds where it does not hold the smallest one of inverse(V): commands
far from zero. With v an eigenvector of V, ``y = W C.T v`` scaled to |C y| = 1 makes
``y.T M y`` its reciprocal at M, and at every other M a bound on E. E is smoothed over
all reciprocals l, ``-log(sum of exp(-b l)) / b`` (5); its gradient is a mean of such
y y.T and so a bound too, however good the smoothing is.

D, A, I and As where what is still to be chosen has fewer readings t than there are
parameters: with P what is chosen for certain, the rest N = M - P of a selection has
rank t at most. Of the eigenvalues l of N in the metric of P (of H N H.T, H P H.T = I)
the smallest are replaced by their total in equal shares among what is left of the t,

    F(N) = sum over the i largest of f(l) + (t - i) f(rest / (t - i)),          (6)

which is concave where f is, exact at every selection, and nowhere below the sum of f
over the t largest. ``f = log(1 + l)`` bounds D, beside log det P (7). Source: Li and
Xie, Best principal submatrix selection (the augmented factorization bound), 2023.

A, I and As are trace(U inverse(I + H N H.T)) with U = H C.T C H.T. For every mu >= 0,
U is at most (U - mu)+ + mu I, and I - inverse(I + H N H.T) is at most 1 and of rank t:

    trace >= trace((U - mu)+ inverse(I + H N H.T)) + sum of min(u, mu) - mu t
             + mu (sum of 1 / (1 + l) over the t places of F).                  (8)

mu = 0 is the natural bound. At a given N the best mu is an eigenvalue of U, the first
whose eigenvector no longer finds room among the t readings.

Where the readings of open counts are fewer than the parameters, (7) works with rows L
of the same inner products, ``L L.T = G = B H.T H B.T`` (9). A selection of t of them,
each once, has with g the least eigenvalue of G

    log det(I + G_S) = t log(1 + g) + log det(I + (G - g I)_S / (1 + g)),      (10)

of which F bounds the last.
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
    dot,
    eigen,
    factor,
    invert_lower,
    multiply,
    take,
)
from cython.cimports.jaxcal.selection.criterion_kinds import DET, LEAST, SUBSET, TRACE
from cython.cimports.jaxcal.watch import begin, late
from cython.cimports.libc.math import INFINITY, exp, fabs, floor, log, log1p, sqrt

_KINDS = {"det": DET, "subset": SUBSET, "trace": TRACE, "least": LEAST}
# Sharper forms of DET and TRACE, which compiled functions read.
_RANK = declare(cython.int, 4)
_RANK_TRACE = declare(cython.int, 5)
# Of several scenarios: their mean, and what is smoothed, their least or a mean of E.
_JOINT = declare(cython.int, 6)
_SMOOTHED = declare(cython.int, 7)

_EPS = declare(cython.double, 2.0**-52)
_SAMPLED = declare(cython.Py_ssize_t, 8)  # scenarios that curvature is of
_FAINT = declare(cython.double, 1e-3)  # of an equal share: it does not count
_UNSEEN = declare(cython.double, 1e-12)  # a share of the mixture left out

_SOLVED = declare(cython.double, 1e-11)  # a bound this near the value is solved
_CLOSE = declare(cython.double, 0.05)  # share of the way to the goal left open
_MAX_STEPS = declare(cython.int, 80)
_LATEST = declare(cython.int, 30)  # steps to a useful bound, time or not
_FRACTIONAL = declare(cython.int, 400)  # counts that a Newton step moves at most
_RIDGE = declare(cython.double, 1e-10)  # share of the largest curvature
_ROUNDING = declare(cython.double, 1e-12)  # of a count that is whole
_REDUCED = declare(cython.Py_ssize_t, 4_000_000)  # numbers of blocks held twice
_TUNES = declare(cython.int, 2)  # of mu of RANK_TRACE in one node
# b of E at first, where phi is about 1, and at most
_SMOOTHING = declare(cython.double, 30.0)
_SHARPEST = declare(cython.double, 1e5)
_TAKEN = declare(cython.double, 1e-6)  # of a reading, in what eigenvectors take
_WHOLE = declare(cython.double, 1e-9)  # a count this near a whole number is it
_SAME = declare(cython.double, 1e-7)  # apart in value, selections are two


class Search:
    """A problem, where a node's relaxation is, and work space: see
    ``branch_kernel.pxd``."""

    def __init__(
        self, form, blocks, prior, root, k, rank, useful, incumbents, lent, packs
    ):
        # Arrays are C-contiguous float64; the best (best, M) and (best,) are written.
        # (A docstring here would be a global symbol of C, of which a module that holds
        # its code twice has two.)
        self.count, self.q, self.p = blocks.shape
        self.kind = _KINDS[form]
        self.k, self.rank, self.s = k, rank, len(root)
        self.best_counts, self.best_values, self.order = incumbents
        self.useful = useful
        self.most_moved = min(self.count, _FRACTIONAL + 2 * self.p + 4)
        self.lent, self.packs = lent, packs
        self.whole = np.empty(3 + 5 * self.p, dtype=np.intc)
        self.which, self.free = np.empty((2, self.most_moved), dtype=np.intp)
        self.open = np.empty(self.count, dtype=np.intp)
        self.side = np.empty(self.most_moved, dtype=np.intc)
        self.room = np.zeros(self._lay_out(cython.NULL))
        self._lay_out(address(self.room[0]))
        given: cython.double[::1] = np.concatenate(
            [blocks.ravel(), prior.ravel(), root.ravel()]
        )
        copy(self.blocks, address(given[0]), given.shape[0])
        self.ruled = False
        for i in range(self.count if self.packs else 0):
            block = self.blocks + i * self.q * self.p
            for a in range(self.p * self.p):
                self.gram[a] = 0.0
            add(self.gram, 1.0, block, self.q, self.p)
            self._pack(self.gram, self.squares + i * self.triangle, 1.0)

    def _lay_out(self, room):
        """Share the room out, and how many numbers that takes; of NULL only that."""
        at, first = address(room), room
        p, m, square = self.p, self.most_moved, self.p * self.p
        wide: cython.Py_ssize_t = m * self.q
        crossed = max(wide * wide, m * p * (p + 1) // 2)
        table: cython.Py_ssize_t = m * m
        if self.lent:  # by a JointSearch
            wide = crossed = table = 0
        self.blocks = take(at, self.count * self.q * p)  # as given, in this order
        self.prior, self.root = take(at, square), take(at, self.s * p)
        self.known, self.rest = take(at, square), take(at, square)
        self.gram, self.gradient = take(at, square), take(at, square)
        self.inverse, self.other = take(at, square), take(at, square)
        self.half, self.basis = take(at, square), take(at, square)
        self.bend, self.lines = take(at, square), take(at, square)
        self.share, self.vectors = take(at, square), take(at, square)
        self.reach, self.scaled = take(at, square), take(at, square)
        self.small, self.spare = take(at, square), take(at, square)
        self.values, self.slopes = take(at, p), take(at, p)
        self.own, self.tail = take(at, p), take(at, p)
        self.weights = take(at, p)
        self.lapack = take(at, 1 + 6 * p + 2 * square)
        self.leverage, self.wish = take(at, self.count), take(at, self.count)
        self.picked, self.turned = take(at, wide * p), take(at, wide * p)
        self.crossed, self.bent = take(at, crossed), take(at, crossed)
        self.curvature, self.face = take(at, table), take(at, table)
        self.ends, self.move = take(at, m), take(at, m)
        self.before, self.slope = take(at, m), take(at, m)
        self.least, self.most = take(at, m), take(at, m)
        self.right = take(at, 2 * m)
        self.node = take(at, 3 * self.count)
        self.triangle = p * (p + 1) // 2
        self.packed = take(at, self.triangle)
        self.squares = take(at, self.count * self.triangle if self.packs else 0)
        fewer: cython.bint = self.kind == DET and not self.lent
        size: cython.Py_ssize_t = self.count * self.q * p
        self.reducible = fewer and size <= _REDUCED
        self.reduced = take(at, size if self.reducible else 0)
        self.given, self.dimensions = self.blocks, p
        return room - first

    def _pack(self, matrix, into, times):
        """The lower triangle in a row, what is off the diagonal ``times`` as large."""
        at: cython.Py_ssize_t = 0
        for a in range(self.p):
            for b in range(a):
                into[at] = times * matrix[a * self.p + b]
                at += 1
            into[at] = matrix[a * self.p + a]
            at += 1

    # --- linear rules of the counts -------------------------------------------------

    def limit(self, rules, most, order, prices):
        """Let ``rules @ counts <= most`` hold, which a bound pays ``prices`` (r,) for:
        phi of a selection is at most ``phi - prices @ (rules @ counts - most)``, for
        prices from 0 (Lagrange). ``order`` (r, M): the cheapest of each rule first."""
        self.ruled = True
        self.rules, self.most_of, self.order_of = rules, most, order
        self.price, self.paid = np.asarray(prices) @ rules, prices @ most

    def relaxed(self, begun: cython.double[:, ::1], seconds):
        """The bound of a node (3, M), bounds and counts, these as they end."""
        self.watch = begin(seconds)
        low, high, c = self.node, self.node + self.count, self.node + 2 * self.count
        copy(low, address(begun[0, 0]), 3 * self.count)
        kind = self._kind_of(low)
        self._reduce(kind, low, high)
        bound = self._relax(kind, low, high, c, -1e300, 0.0)
        copy(address(begun[2, 0]), c, self.count)
        return bound

    def _priced(self, value, c):
        """The value with what the counts c pay; the base likewise."""
        if not self.ruled:
            return value
        paid: cython.double = self.paid
        for i in range(self.count):
            paid -= self.price[i] * c[i]
        self.base += paid
        return value + paid

    def _keeps(self, low, high):
        """Whether a choice of k within the bounds can keep each rule by itself."""
        for r in range(self.rules.shape[0] if self.ruled else 0):
            room: cython.double = self.most_of[r]
            to_choose: cython.double = self.k
            for i in range(self.count):
                room -= low[i] * self.rules[r, i]
                to_choose -= low[i]
            for t in range(self.count):
                if to_choose <= 0.0:
                    break
                i = self.order_of[r, t]
                taken = min(high[i] - low[i], to_choose)
                room -= taken * self.rules[r, i]
                to_choose -= taken
            if room < 0.0:
                return False
        return True

    # --- the criterion at fractional counts -----------------------------------------

    def _sum(self, low, counts, start, gram):
        """``gram = start + sum of (counts_i - low_i) B_i.T B_i``, of zeros if NULL."""
        p, size = self.p, self.q * self.p
        packed, at = self.packed, 0
        for a in range(self.triangle):
            packed[a] = 0.0
        for a in range(p * p):
            gram[a] = 0.0
        for i in range(self.count):
            count = counts[i] if low is cython.NULL else counts[i] - low[i]
            if count == 0.0:
                continue
            if self.packs:
                square = self.squares + i * self.triangle
                for a in range(self.triangle):
                    packed[a] += count * square[a]
            else:
                add(gram, count, self.blocks + i * size, self.q, p)
        for a in range(p if self.packs else 0):
            for b in range(a + 1):
                gram[a * p + b] = packed[at]
                at += 1
        for a in range(p):
            for b in range(a + 1):
                if start is not cython.NULL:
                    gram[a * p + b] += start[a * p + b]
                gram[b * p + a] = gram[a * p + b]

    def _evaluate(self, kind):
        """Value to climb by at P, N and M, -inf where M is singular; sets ``base``,
        which differs from it by rounding, and for E."""
        p, value = self.p, 0.0
        self.base = 0.0
        if kind != _RANK:
            value = factor(self.gram, self.inverse, self.vectors, p)
            if not value > -INFINITY:
                return value
        if kind == DET:
            copy(self.gradient, self.inverse, p * p)
        elif kind == SUBSET or kind == TRACE:
            value = self._covariance(kind == SUBSET, self.root, self.s, self.gradient)
        elif kind == _RANK_TRACE:
            value = self._covariance(False, self.share, self.size, self.other)
        else:
            value = 0.0
        self.base = value
        if kind < LEAST:
            share = -value if kind == TRACE else p if kind == DET else self.s
            self.base += self._rounded(share)
        if kind >= LEAST:
            value += self._weakest() if kind == LEAST else self._shared_out(kind)
            self._bends()
            if kind == _RANK_TRACE:
                for a in range(p * p):
                    self.gradient[a] += self.other[a]
        return value

    def _rounded(self, share):
        """What makes a bound true where G is rounded and trace(G M) not ``share``.

        -log det G + trace(G M) - p bounds log det M whatever G is, and
        ``trace(Y M Y.T - 2 C Y.T)`` -trace(C W C.T) whatever Y is, with G = Y.T Y.
        """
        total, size = 0.0, 0.0
        for a in range(self.p * self.p):
            part = self.gradient[a] * self.gram[a]
            total += part
            size += fabs(part)
        return max(total - share, 0.0) + 8.0 * _EPS * size

    def _covariance(self, det, root, s, gradient):
        return covariance(
            det, root, self.inverse, s, self.p, self.reach, self.scaled, self.small,
            self.spare, self.vectors, gradient,
        )  # fmt: skip

    def _weakest(self):
        """Reciprocals l, their y in ``basis``, slopes and base; the value of E.
        Eigenvalues of V below rounding have no slope."""
        p: cython.int = self.p
        basis, reach, values, slopes = self.basis, self.reach, self.values, self.slopes
        multiply(False, False, p, p, p, self.root, self.inverse, self.scaled)
        multiply(False, True, p, p, p, self.scaled, self.root, self.vectors)
        eigen(self.vectors, values, self.lapack, self.whole, p)
        for a in range(p):
            self.own[a] = 1.0 / max(values[p - 1 - a], _EPS * values[p - 1])
            copy(reach + a * p, self.vectors + (p - 1 - a) * p, p)
        copy(values, self.own, p)
        multiply(False, False, p, p, p, reach, self.scaled, basis)
        multiply(False, True, p, p, p, basis, self.root, reach)
        total: cython.double = 0.0
        for a in range(p):
            length: cython.double = dot(reach + a * p, reach + a * p, p)
            for b in range(p):  # |C y| = 1
                basis[a * p + b] *= 1.0 / sqrt(length) if length > 0.0 else 0.0
            apart = values[a] - values[0]
            slopes[a] = exp(-self.smoothing * apart) if apart > 0.0 else 1.0
            total += slopes[a]  # of (5), without its largest part
        multiply(False, False, p, p, p, basis, self.gram, reach)
        for a in range(p):
            slopes[a] /= total
            self.tail[a] = slopes[a]
            self.own[a] = -self.smoothing * slopes[a]
            if slopes[a] > 0.0:  # y.T M y
                self.base += slopes[a] * dot(reach + a * p, basis + a * p, p)
        self.tail_weight = self.smoothing
        return values[0] - log(total) / self.smoothing  # (5)

    def _shared_out(self, kind):
        """Bound F at N in the metric of P, slopes and base; f of A is -mu / (1 + l)."""
        p, values = self.p, self.values
        if p < self.dimensions:
            copy(self.vectors, self.rest, p * p)
            eigen(self.vectors, values, self.lapack, self.whole, p)
            copy(self.basis, self.vectors, p * p)
        else:
            multiply(False, False, p, p, p, self.half, self.rest, self.scaled)
            multiply(False, True, p, p, p, self.scaled, self.half, self.vectors)
            eigen(self.vectors, values, self.lapack, self.whole, p)
            multiply(False, False, p, p, p, self.vectors, self.half, self.basis)
        kept, places, rest, shares, logs = 0, self.places, 0.0, 0.0, 0.0
        for a in range(p):
            values[a] = max(values[a], 0.0)
            rest += values[a]
        while kept < places - 1 and values[p - 1 - kept] * (places - kept) > rest:
            rest -= values[p - 1 - kept]
            logs += log1p(values[p - 1 - kept])
            shares += 1.0 / (1.0 + values[p - 1 - kept])
            kept += 1
        rest /= places - kept
        logs += (places - kept) * log1p(rest)  # (6) of D
        self.shares = shares + (places - kept) / (1.0 + rest)  # (6) of 1 / (1 + l)
        trace: cython.bint = kind == _RANK_TRACE
        mu = self.mu if trace else 1.0
        for a in range(p):
            held: cython.bint = a >= p - kept
            x = 1.0 / (1.0 + (values[a] if held else rest))
            self.slopes[a] = mu * x * x if trace else x
            self.own[a] = -(2.0 * mu * x if trace else 1.0) * x * x
            self.tail[a] = 0.0 if held else 1.0
            if not held:
                self.tail_weight = self.own[a] / (places - kept)
                self.own[a] = 0.0
        # (8), but for what _covariance adds; (7)
        value = self.constant + (-mu * self.shares if trace else logs)
        # Eigenvalues are rounded by p eps of the largest.
        self.base += value + mu * p * _EPS * values[p - 1]
        return value

    def _bends(self):
        """Fill the gradient of E or F, and the bend of the Hessian."""
        p, values, slopes = self.p, self.values, self.slopes
        for a in range(p):
            for b in range(a):
                apart = values[a] - values[b]
                bend = 0.5 * (self.own[a] + self.own[b])
                if apart > 1e-7 * values[a]:
                    bend = (slopes[a] - slopes[b]) / apart  # as eigenvectors turn
                self.bend[a * p + b] = bend
            self.bend[a * p + a] = self.own[a]
            for b in range(p):
                self.scaled[a * p + b] = slopes[a] * self.basis[a * p + b]
        multiply(True, False, p, p, p, self.scaled, self.basis, self.gradient)

    # --- the bounds by rank ---------------------------------------------------------

    def _kind_of(self, low):
        """Set P; RANK or RANK_TRACE where few readings are left to choose."""
        to_choose = self.k
        self.blocks, self.p = self.given, self.dimensions
        self._sum(cython.NULL, low, self.prior, self.known)
        self.smoothing = _SMOOTHING
        for i in range(self.count):
            to_choose -= low[i]
        self.places = cast(cython.int, to_choose) * self.rank
        sharper: cython.bint = self.kind == DET or self.kind == TRACE
        if not sharper or self.places >= self.p or self.places == 0:
            return self.kind
        self.constant = factor(self.known, self.inverse, self.half, self.p)
        if not self.constant > -INFINITY:
            return self.kind
        if self.kind == DET:
            return _RANK
        self._weigh()
        sharper = self._choose_mu(self.p - 1 - self.places)
        return _RANK_TRACE if sharper else TRACE

    def _reduce(self, kind, low, high):
        """Let the open blocks of RANK be L until the next node, where it is smaller."""
        q, p, m, top = self.q, self.dimensions, 0, 0.0
        once: cython.bint = True
        for i in range(self.count if kind == _RANK and self.reducible else 0):
            if low[i] < high[i]:
                if (m + 1) * q >= p:
                    return
                once = once and high[i] - low[i] == 1.0  # else it may be twice
                self.open[m] = i
                copy(self.picked + m * q * p, self.given + i * q * p, q * p)
                m += 1
        if m == 0:
            return
        self._turn(m, self.half, True)
        r: cython.int = m * q
        lower = self.reach
        multiply(False, True, r, r, p, self.turned, self.turned, lower)  # G of (9)
        for a in range(r):
            top = max(top, lower[a * r + a])
        self.places = min(self.places, r)
        shift = 0.0
        if once and q == self.rank:
            copy(self.vectors, lower, r * r)
            eigen(self.vectors, self.values, self.lapack, self.whole, r, False)
            shift = max(self.values[0] - r * _EPS * top, 0.0)
            for a in range(r):
                lower[a * r + a] -= shift
            self.constant += self.places * log1p(shift)  # (10)
        cholesky(lower, lower, r, max(r * _EPS * top, 1e-300))
        self.constant += 4.0 * r * _EPS * top
        scale = 1.0 / sqrt(1.0 + shift)
        for f in range(m):
            for s in range(q):
                a = f * q + s
                row = self.reduced + (self.open[f] * q + s) * r
                for b in range(r):
                    row[b] = scale * lower[a * r + b] if b < a else 0.0
                row[a] = scale / lower[a * r + a]
        self.blocks, self.p = self.reduced, r

    def _weigh(self):
        """Fill ``weights`` and ``lines``: u and ``v.T inverse(H)``, by rows: ``C.T C``
        is the sum of u times the outer product of a row with itself."""
        p, s = self.p, self.s
        multiply(False, True, s, p, p, self.root, self.half, self.reach)
        multiply(True, False, p, p, s, self.reach, self.reach, self.vectors)
        eigen(self.vectors, self.weights, self.lapack, self.whole, p)
        multiply(False, False, p, p, p, self.vectors, self.half, self.reach)
        multiply(False, False, p, p, p, self.reach, self.known, self.lines)

    def _choose_mu(self, place):
        """Let mu be the eigenvalue ``place`` of U (-1: none); is the bound sharper?"""
        p: cython.int = self.p
        rounding = p * _EPS * self.weights[p - 1]
        mu = self.weights[place] if place >= 0 else 0.0
        if not mu > rounding:
            return False
        self.mu = mu
        self.size = 0
        # Eigenvalues of U are rounded by p eps times the largest, t of them count.
        self.constant = (rounding + mu) * self.places
        for b in range(p):
            a = p - 1 - b
            self.constant -= min(max(self.weights[a], 0.0), mu)  # of (8)
            if self.weights[a] > mu:
                scale = sqrt(self.weights[a] - mu)
                for c in range(p):
                    self.share[self.size * p + c] = scale * self.lines[a * p + c]
                self.size += 1
        return True

    def _best_place(self):
        """The best mu at N, of the eigenvalues of U; -1: the natural bound.

        The bound is convex and piecewise linear in mu, with slope minus the total that
        the eigenvectors above mu lose by N, plus what F allows the t readings to take.
        """
        p, allowed = self.p, self.places - self.shares
        for d in range(p):
            line, taken = self.lines + (p - 1 - d) * p, 1.0
            for a in range(p):
                taken -= line[a] * dot(self.inverse + a * p, line, p)
            allowed -= taken
            if allowed < _TAKEN * self.places:
                return cast(cython.int, p - 1 - d)
        return -1

    # --- a Newton step --------------------------------------------------------------

    def _turn(self, m, matrix, turn):
        """``turned = B_i @ matrix`` of the ``picked`` blocks, or ``matrix.T``."""
        p: cython.int = self.p
        multiply(False, turn, m * self.q, p, p, self.picked, matrix, self.turned)

    def _hessian(self, kind, m):
        """Fill ``curvature`` (m, m): minus the Hessian over the counts of ``which``."""
        q, p = self.q, self.p
        wide, x, y, out = m * q, self.crossed, self.bent, self.curvature
        for i in range(m):
            block = self.blocks + self.which[i] * q * p
            copy(self.picked + i * q * p, block, q * p)
        for i in range(m * m):
            out[i] = 0.0
        if kind >= LEAST:
            self._turn(m, self.basis, True)
            self._spectral_hessian(m)
            if kind != _RANK_TRACE:
                return
        self._turn(m, self.inverse, False)
        multiply(False, True, wide, wide, p, self.turned, self.picked, y)
        if kind != DET:
            self._turn(m, self.other if kind == _RANK_TRACE else self.gradient, False)
            multiply(False, True, wide, wide, p, self.turned, self.picked, x)
        for i in range(m):
            for j in range(m):
                total: cython.double = 0.0
                for r in range(q):
                    at = (i * q + r) * wide + j * q
                    for s in range(q):
                        if kind == DET:
                            total += y[at + s] * y[at + s]  # (2)
                        elif kind == SUBSET:  # (3)
                            total += (2.0 * y[at + s] - x[at + s]) * x[at + s]
                        else:
                            total += 2.0 * x[at + s] * y[at + s]  # (4)
                out[i * m + j] += total

    def _spectral_hessian(self, m):
        """Minus the Hessian of E or F, of blocks turned into the basis."""
        q, p = self.q, self.p
        size, at = p * (p + 1) // 2, 0
        for i in range(m):
            self.ends[i] = 0.0
            for a in range(p):
                into, bend = self.crossed + at, self.bend + a * p
                for b in range(a + 1):
                    into[b] = 0.0
                for r in range(q):
                    row = self.turned + (i * q + r) * p
                    weight = row[a]
                    for b in range(a + 1):
                        into[b] += weight * row[b]
                for b in range(a):
                    self.bent[at + b] = -2.0 * into[b] * bend[b]
                self.bent[at + a] = -into[a] * bend[a]
                self.ends[i] += self.tail[a] * into[a]
                at += a + 1
        out = self.curvature
        multiply(False, True, m, m, size, self.crossed, self.bent, out)
        for i in range(m):
            for j in range(m):
                out[i * m + j] -= self.tail_weight * self.ends[i] * self.ends[j]

    def _leverages(self):
        """``trace(B_i G B_i.T)`` where the count is not fixed."""
        size, done = self.q * self.p, 0
        if self.packs:
            self._pack(self.gradient, self.packed, 2.0)
            for o in range(self.opened):
                i = self.open[o]
                square = self.squares + i * self.triangle
                self.leverage[i] = dot(square, self.packed, self.triangle)
            return
        while done < self.opened:
            m = min(self.opened - done, self.most_moved)
            for f in range(m):
                block = self.blocks + self.open[done + f] * size
                copy(self.picked + f * size, block, size)
            self._turn(m, self.gradient, False)
            for f in range(m):
                at = f * size
                leverage = dot(self.picked + at, self.turned + at, size)
                self.leverage[self.open[done + f]] = leverage
            done += m

    def _linear_gain(self, low, high, c):
        """Largest ``sum of (c'_i - c_i) d_i`` within the bounds; sets the multiplier.

        It minimises ``k cut + sum of max(low_i (d_i - cut), high_i (d_i - cut))``, by
        bisection; any value of it gives a true bound.
        """
        least: cython.double = INFINITY
        most: cython.double = -INFINITY
        to_choose = self.k
        for i in range(self.count):
            to_choose -= c[i]
        for o in range(self.opened):
            i = self.open[o]
            if c[i] < high[i]:
                most = max(most, self.leverage[i])
            if c[i] > low[i]:
                least = min(least, self.leverage[i])
        if not (least < INFINITY and most > -INFINITY):  # there is no other choice
            self.cut = most if most > -INFINITY else least
            return 0.0
        cut = 0.5 * (least + most)
        for _ in range(30):
            if most - least <= 1e-13 * fabs(most):
                break
            room: cython.double = 0.0
            for o in range(self.opened):
                i = self.open[o]
                room += (high[i] if self.leverage[i] > cut else low[i]) - c[i]
            if room > to_choose:
                least = cut
            elif room < to_choose:
                most = cut
            else:
                break
            cut = 0.5 * (least + most)
        gain: cython.double = 0.0
        for o in range(self.opened):
            i = self.open[o]
            slope = self.leverage[i] - cut
            gain += ((high[i] if slope > 0.0 else low[i]) - c[i]) * slope
        self.cut = cut
        return gain + to_choose * cut  # of (1)

    def _working_set(self, low, high, c):
        """Counts to move: the fractional ones and some of those that should move."""
        extra, fractional = 2 * self.p + 4, 0
        count: cython.int = 0
        largest: cython.double = 0.0
        for o in range(self.opened):
            i = self.open[o]
            slope = self.leverage[i] - self.cut
            self.wish[i] = 0.0
            if low[i] < c[i] and c[i] < high[i]:
                fractional += 1
            if c[i] < high[i] if slope > 0.0 else c[i] > low[i]:
                self.wish[i] = fabs(slope)
                largest = max(largest, self.wish[i])
        if fractional <= _FRACTIONAL:
            for o in range(self.opened):
                i = self.open[o]
                if low[i] < c[i] and c[i] < high[i]:
                    self.wish[i] = 0.0
        else:
            fractional, extra = 0, _FRACTIONAL
        least = largest
        for _ in range(40):
            count = 0
            for o in range(self.opened):
                count += self.wish[self.open[o]] > 0.5 * least
            if count > extra:
                break
            least *= 0.5
        size, room = 0, fractional + extra
        for o in range(self.opened):
            i = self.open[o]
            inside: cython.bint = fractional > 0 and low[i] < c[i] and c[i] < high[i]
            wished: cython.bint = self.wish[i] > 0.0 and self.wish[i] >= least
            if inside or (wished and size < room):
                self.which[size] = i
                size += 1
        if fractional == 0:
            self._two_sided(size)
        return size

    def _two_sided(self, size):
        """Let counts of ``which`` that all wish to grow, or all to shrink, give half of
        their places to others, without which they can hardly move."""
        grows: cython.int = 0
        wishes: cython.int = 0
        for g in range(size):
            if self.wish[self.which[g]] > 0.0:
                wishes += 1
                grows += self.leverage[self.which[g]] > self.cut
        if wishes == 0 or (0 < grows and grows < wishes):
            return
        for f in range(size // 2, size):
            best: cython.Py_ssize_t = -1
            for o in range(self.opened):
                i = self.open[o]
                up: cython.bint = self.leverage[i] > self.cut
                if self.wish[i] > 0.0 and up == (grows == 0):
                    if best < 0 or self.wish[i] > self.wish[best]:
                        best = i
            if best < 0:
                return
            self.which[f] = best
            self.wish[best] = 0.0

    def _solve(self, m, size):
        """Where the free counts would go, ``right``, by the curvature at
        ``free[:size]``; the multiplier of their sum."""
        face, right, ones = self.face, self.right, self.right + size
        for f in range(size):
            right[f], ones[f] = self.slope[self.free[f]], 1.0
            row = self.free[f] * m
            for g in range(f + 1):
                face[f * size + g] = self.curvature[row + self.free[g]]
        cholesky(face, face, size, max(1e-3 * _RIDGE * self.curvature[0], 1e-300))
        for f in range(size):
            row = f * size
            right[f] = (right[f] - dot(face + row, right, f)) * face[row + f]
            ones[f] = (ones[f] - dot(face + row, ones, f)) * face[row + f]
        total, weight = 0.0, 0.0
        for b in range(size):
            f = size - 1 - b
            row = f * size
            right[f] *= face[row + f]
            ones[f] *= face[row + f]
            total += right[f]
            weight += ones[f]
            for g in range(f):
                right[g] -= face[row + g] * right[f]
                ones[g] -= face[row + g] * ones[f]
        for f in range(size):
            right[f] -= total / weight * ones[f]
        return total / weight

    def _quadratic_step(self, m):
        """Fill ``move`` by max ``slope.x - x.curvature.x / 2``, sum x = 0, least <= x
        <= most; the slope becomes that at the solution."""
        curvature = self.curvature
        largest: cython.double = 0.0
        for i in range(m):
            largest = max(largest, curvature[i * m + i])
            self.move[i] = 0.0
            self.side[i] = 0  # -1, 1 where held at that bound
        for i in range(m):
            curvature[i * m + i] += _RIDGE * largest
        for _ in range(4 * m + 8):
            size: cython.int = 0
            for i in range(m):
                if self.side[i] == 0:
                    self.free[size] = i
                    size += 1
            cut, hit = 0.0, -1
            if size:
                cut, part = self._solve(m, size), 1.0
                for f in range(size):
                    i, step = self.free[f], self.right[f]
                    room = self.most[i] if step > 0.0 else self.least[i]
                    room -= self.move[i]
                    if fabs(step) * part > fabs(room):
                        part, hit = fabs(room / step), f
                for f in range(size if size > 1 else 0):
                    weight = part * self.right[f]
                    self.move[self.free[f]] += weight
                    row = curvature + self.free[f] * m
                    for i in range(m):
                        self.slope[i] -= weight * row[i]
            if size > 1 and hit >= 0:
                i = self.free[hit]
                self.side[i] = 1 if self.right[hit] > 0.0 else -1
                self.move[i] = self.most[i] if self.side[i] > 0 else self.least[i]
                continue
            # At rest on this face: let go of the count that pulls most from its bound.
            pull, best, other, highest = 1e-9 * fabs(cut), -1, -1, -INFINITY
            lowest: cython.double = INFINITY
            for i in range(m):
                wish = self.side[i] * (cut - self.slope[i])
                if self.side[i] != 0 and size > 0 and wish > pull:
                    pull, best = wish, i
                if self.side[i] < 0 and self.slope[i] > highest and size == 0:
                    highest, best = self.slope[i], i
                if self.side[i] > 0 and self.slope[i] < lowest and size == 0:
                    lowest, other = self.slope[i], i
            if best < 0 or (size == 0 and not (other >= 0 and highest > lowest)):
                break
            self.side[best] = 0
            if size == 0:
                self.side[other] = 0

    def _gather(self, low, c):
        self._sum(low, c, cython.NULL, self.rest)
        for a in range(self.p * self.p):
            self.gram[a] = self.known[a] + self.rest[a]

    def _at(self, kind, low, c):
        self._gather(low, c)
        return self._evaluate(kind)

    def _spread(self, low, high, c):
        """Share what the lower bounds leave in proportion to the room of each count."""
        room, fixed = 0.0, 0.0
        for i in range(self.count):
            room += high[i] - low[i]
            fixed += low[i]
        for i in range(self.count):
            c[i] = low[i] + (self.k - fixed) * (high[i] - low[i]) / max(room, 1.0)

    def _relax(self, kind, low, high, c, goal, share):
        """The bound of a node, climbed until it is pruned (at or below ``goal``), or
        solved to this ``share`` of its distance to the goal; -inf: all is singular."""
        value = self._begin(kind, low, high, c)
        if not value > -INFINITY:
            return value
        sharpest: cython.double = INFINITY
        bound, after, tunes = INFINITY, value, _TUNES
        for step in range(_MAX_STEPS):
            self.now = kind
            self._leverages()
            for o in range(self.opened if self.ruled else 0):
                self.leverage[self.open[o]] -= self.price[self.open[o]]
            gain = self._linear_gain(low, high, c)
            bound = self.base + gain  # (1)
            if not bound > -INFINITY:  # rounding left no number
                bound = INFINITY
            self.linear = bound
            sharpest = min(sharpest, bound)
            if bound <= goal or step == _MAX_STEPS - 1:
                break
            over: cython.bint = late(address(self.watch))
            if over and (step >= _LATEST or sharpest <= self.useful):
                break
            solved: cython.bint = bound - value <= max(_SOLVED, share * (value - goal))
            changed: cython.bint = False
            if kind == _RANK_TRACE:
                changed = tunes > 0 and (solved or step == 0)
                if changed:
                    tunes -= 1
                    sharper: cython.bint = self._choose_mu(self._best_place())
                    kind = _RANK_TRACE if sharper else TRACE
            elif (kind == LEAST or kind == _SMOOTHED) and not solved:
                changed = gain <= 0.3 * (self.base - value)
                if changed and self.smoothing >= _SHARPEST:
                    break
                self.smoothing *= 4.0 if changed else 1.0
            if changed:
                value = self._priced(self._evaluate(kind), c)
                continue
            if solved:
                break
            after = self._step(kind, low, high, c, value)
            if not after > value:
                break
            value = after
        return sharpest

    def _begin(self, kind, low, high, c):
        """phi at the start of a climb; -inf where every selection is singular."""
        self.opened = 0
        for i in range(self.count):
            self.leverage[i] = 0.0
            if low[i] < high[i]:
                self.open[self.opened] = i
                self.opened += 1
        value = self._at(kind, low, c)
        if not value > -INFINITY:
            self._spread(low, high, c)
            value = self._at(kind, low, c)
        return self._priced(value, c)

    def _step(self, kind, low, high, c, value):
        """phi after a step of the working set, which is halved while it falls short."""
        m, after, promised, part = self._working_set(low, high, c), value, 0.0, 1.0
        for i in range(m):
            j = self.which[i]
            self.before[i], self.slope[i] = c[j], self.leverage[j]
            self.least[i], self.most[i] = low[j] - c[j], high[j] - c[j]
        self._hessian(kind, m)
        self._quadratic_step(m)
        for i in range(m):
            promised += self.move[i] * self.leverage[self.which[i]]
        while True:
            for i in range(m):
                j = self.which[i]
                c[j] = self.before[i] + part * self.move[i]
                near = floor(c[j] + 0.5)
                if fabs(c[j] - near) < _ROUNDING:
                    c[j] = near
            after = self._priced(self._at(kind, low, c), c)
            if after >= value + 1e-4 * part * promised or part < 1e-6:
                return after
            part *= 0.5

    # --- branching ------------------------------------------------------------------

    def _worth(self, counts):
        """phi of a selection; -inf where it is singular."""
        self._gather_whole(counts)
        self.smoothing = INFINITY  # E itself
        return self._evaluate(self.kind)

    def _gather_whole(self, counts):
        self.now = self.kind
        self.blocks, self.p = self.given, self.dimensions
        self._sum(cython.NULL, counts, self.prior, self.gram)

    def _offer(self, counts):
        """Insert a selection into the sorted list of the best, once."""
        best = self.best_values
        place: cython.Py_ssize_t = best.shape[0] - 1
        if not self._keeps(counts, counts):
            return
        value = self._worth(counts)
        if not value > best[place]:
            return
        for r in range(best.shape[0]):
            same: cython.bint = fabs(best[r] - value) < _SAME
            for i in range(self.count if same else 0):
                same = same and self.best_counts[self.order[r], i] == counts[i]
            if same:
                return
        row = self.order[place]
        while place > 0 and best[place - 1] < value:
            best[place], self.order[place] = best[place - 1], self.order[place - 1]
            place -= 1
        best[place], self.order[place] = value, row
        copy(address(self.best_counts[row, 0]), counts, self.count)

    def offer(self, begun: cython.double[:, ::1], seconds: cython.double):
        """Offer a selection (3, M), its bounds first, and, if several are wanted, all
        one swap away from it."""
        self.watch = begin(seconds)
        low, high = address(begun[0, 0]), address(begun[1, 0])
        counts = address(begun[2, 0])
        self._offer(counts)
        for i in range(self.count if self.best_values.shape[0] > 1 else 0):
            if not counts[i] > low[i]:
                continue
            for j in range(self.count):
                if i != j and counts[j] < high[j]:
                    if late(address(self.watch)):
                        return
                    counts[i] -= 1.0
                    counts[j] += 1.0
                    self._offer(counts)
                    counts[i] += 1.0
                    counts[j] -= 1.0

    def _balance(self, low, high, c):
        """Move c into its bounds and back to sum k, keeping it near where it was."""
        total: cython.double = 0.0
        for i in range(self.count):
            c[i] = min(max(c[i], low[i]), high[i])
            total += c[i]
        while fabs(total - self.k) > 1e-12:
            best: cython.Py_ssize_t = -1
            for i in range(self.count):
                d = self.leverage[i]
                if total < self.k:
                    if c[i] < high[i] and (best < 0 or d > self.leverage[best]):
                        best = i
                elif c[i] > low[i] and (best < 0 or d < self.leverage[best]):
                    best = i
            if best < 0:
                return False
            before = c[best]
            c[best] = min(max(before + (self.k - total), low[best]), high[best])
            total += c[best] - before
        return True

    def _stiffen(self, c):
        """Let ``wish`` be how much the bound bends as a fractional count is forced: a
        count that moves by d, the others following, costs ``d^2 / 2`` over its entry in
        the inverse of the curvature among counts of one sum."""
        m: cython.int = 0
        largest: cython.double = 1e-300
        total, lower = 0.0, self.curvature
        for o in range(self.opened):
            i = self.open[o]
            self.wish[i] = 0.0
            if fabs(c[i] - floor(c[i] + 0.5)) > _WHOLE and m < self.most_moved:
                self.which[m] = i
                m += 1
        self._hessian(self.now, m)
        for f in range(m):
            largest = max(largest, lower[f * m + f])
            self.ends[f] = self.move[f] = 0.0
        for f in range(m):
            lower[f * m + f] += _RIDGE * largest
        cholesky(lower, lower, m, _RIDGE * largest)
        invert_lower(lower, m)
        for r in range(m):
            row, across = lower + r * m, 0.0
            for f in range(r + 1):
                across += row[f]
            for f in range(r + 1):
                self.ends[f] += row[f] * row[f]
                self.move[f] += row[f] * across
            total += across * across
        for f in range(m):
            free = self.ends[f] - self.move[f] * self.move[f] / total
            self.wish[self.which[f]] = 1.0 / (largest * max(free, 1e-300))

    def _process(self, low, high, c, slack, share, bound):
        """Solve, tighten and, if settled, close one node; the candidate to branch on,
        or -1. Forcing one count away from the side the multiplier puts it on costs the
        bound |d_i - cut| a unit, which tightens low and high (reduced-cost fixing)."""
        last = self.best_values.shape[0] - 1
        goal = self.best_values[last] + slack
        kind = self._kind_of(low)
        self._reduce(kind, low, high)
        bound[0] = self._relax(kind, low, high, c, goal, share)
        if bound[0] <= goal:
            return -1
        room, total_low, total_high = self.linear - goal, 0.0, 0.0
        for i in range(self.count):
            slope = self.leverage[i] - self.cut
            if low[i] < high[i] and room < fabs(slope) * (high[i] - low[i]):
                units = floor(room / fabs(slope))
                if slope < 0.0:
                    high[i] = low[i] + units
                else:
                    low[i] = high[i] - units
            total_low += low[i]
            total_high += high[i]
        if total_low > self.k or total_high < self.k or not self._keeps(low, high):
            return -1
        settled: cython.bint = total_low == self.k or total_high == self.k
        if settled:
            copy(c, low if total_low == self.k else high, self.count)
        whole, branch, score = True, -1, -1.0
        if not settled:
            self._stiffen(c)
        total: cython.double = 0.0
        for i in range(self.count):
            away = fabs(c[i] - floor(c[i] + 0.5))
            if away > _WHOLE:
                whole = False
            total += floor(c[i] + 0.5)
            if low[i] < high[i]:
                # What both branches cost the bound, one times the other. With few
                # readings left a count that is nearly chosen, which sharpens the bound.
                # Among whole ones the one nearest to changing.
                this = _WHOLE / (1.0 + fabs(self.leverage[i] - self.cut))
                if away > _WHOLE:
                    part = c[i] - floor(c[i])
                    weight = part if self.now == _RANK else 1.0 - part
                    this = 1.0 + part * weight * self.wish[i]
                if branch < 0 or this > score:
                    score, branch = this, i
        if whole and total == self.k:
            for i in range(self.count):
                c[i] = floor(c[i] + 0.5)
            self._offer(c)
        if settled or bound[0] <= self.best_values[last] + slack:
            return -1
        return branch

    def run(
        self,
        nodes: cython.double[:, :, ::1],
        bounds: cython.double[::1],
        size: cython.Py_ssize_t,
        slack: cython.double,
        widest: cython.Py_ssize_t,
        tries: cython.Py_ssize_t,
        seconds: cython.double,
        slope: cython.double,
        shift: cython.double,
    ):
        """Branch until no open node is left, the room is full or the time is over: open
        nodes left, nodes processed, and whether to go on.

        Args:
            nodes, bounds: (room, 3, M) and (room,) open nodes: bounds of the counts,
                and counts to start from; ``size`` of them at the start.
            slack: a bound this far above the last incumbent still closes a node.
            widest: open nodes up to which the best bound goes first, then the newest.
            tries: nodes before which a bound that is good enough ends nothing.
            slope, shift: good enough is a bound of slope times the best, plus shift.
        """
        self.watch = begin(seconds)
        values, m = self.best_values, self.count
        low, high, c = self.node, self.node + m, self.node + 2 * m
        bound: cython.double = INFINITY
        done: cython.Py_ssize_t = 0
        going: cython.bint = True
        with cython.nogil:
            while size > 0 and size + 2 <= bounds.shape[0]:
                pick = size - 1
                if size <= widest:
                    for r in range(size):
                        if bounds[r] > bounds[pick]:
                            pick = r
                    enough = max(bounds[pick], values[0])
                    going = done < tries or enough > slope * values[0] + shift
                if not going or (done and late(address(self.watch))):
                    going = False
                    break
                parent = bounds[pick]
                copy(low, address(nodes[pick, 0, 0]), 3 * m)
                size -= 1
                if pick != size:
                    nodes[pick, :, :] = nodes[size]
                    bounds[pick] = bounds[size]
                if parent <= values[values.shape[0] - 1] + slack:
                    continue
                done += 1
                share = 0.0 if parent == INFINITY else _CLOSE
                branch = self._process(low, high, c, slack, share, address(bound))
                if branch < 0:
                    continue
                split = floor(c[branch] + _WHOLE)
                split = min(max(split, low[branch]), high[branch] - 1.0)
                for side in range(2):
                    begun = address(nodes[size, 0, 0])
                    copy(begun, low, 3 * m)
                    bounds[size] = min(bound, parent)
                    begun[(1 - side) * m + branch] = split + side
                    size += self._balance(begun, begun + m, begun + 2 * m)
        return size, done, going


class JointSearch(Search):
    """A choice in several scenarios: the weighted mean of their phi, or the least.

    The mean is concave and so is its relaxation. The least is smoothed,
    ``-log(sum of exp(-b phi_s)) / b``, whose gradient mixes those of the scenarios: a
    mixture of their bounds is a bound, whatever b is. phi of a scenario counts as
    ``scale phi + shift``.
    """

    def join(self, members, weights, scale, shift, least):
        # A Search each, made with ``lent``, over the same candidates.
        count: cython.Py_ssize_t = len(members)
        s: cython.Py_ssize_t
        self.keep, self.least_counts = list(members), least
        self.addresses = np.zeros(count, dtype=np.intp)
        self.weights_of = np.array(weights, dtype=np.float64)
        self.scale, self.shift = np.array([scale, shift], dtype=np.float64)
        self.mixture, self.worth, self.bases = np.zeros((3, count))
        self.sample, self.turn = np.zeros(count, dtype=np.uint8), 0
        for s in range(count):
            member: Search = self.keep[s]
            member.open, member.which = self.open, self.which
            member.picked, member.turned = self.picked, self.turned
            member.crossed, member.bent = self.crossed, self.bent
            member.curvature = self.face
            self.addresses[s] = cast(cython.Py_ssize_t, cast(cython.p_void, member))
        self.members = cast(cython.pointer(cython.p_void), address(self.addresses[0]))

    def _kind_of(self, low):
        smoothed: cython.bint = self.least_counts
        self.smoothing = _SMOOTHING
        for s in range(self.addresses.shape[0]):
            kind: cython.int = cast(Search, self.members[s])._kind_of(low)
            cast(Search, self.members[s]).now = kind
            if kind == LEAST:
                smoothed = True
        return _SMOOTHED if smoothed else _JOINT

    def _gather(self, low, c):
        for s in range(self.addresses.shape[0]):
            cast(Search, self.members[s])._gather(low, c)

    def _gather_whole(self, counts):
        for s in range(self.addresses.shape[0]):
            cast(Search, self.members[s])._gather_whole(counts)

    def _evaluate(self, kind):
        lowest: cython.double = INFINITY
        value, total = 0.0, 0.0
        for s in range(self.addresses.shape[0]):
            cast(Search, self.members[s]).smoothing = self.smoothing
            now = cast(Search, self.members[s]).now
            value = cast(Search, self.members[s])._evaluate(now)
            if not value > -INFINITY:
                return -INFINITY
            base = cast(Search, self.members[s]).base
            self.worth[s] = self.scale[s] * value + self.shift[s]
            self.bases[s] = self.scale[s] * base + self.shift[s]
            lowest = min(lowest, self.worth[s])
        for s in range(self.addresses.shape[0]):
            share: cython.double = self.weights_of[s]
            if self.least_counts:
                apart = self.worth[s] - lowest
                share = exp(-self.smoothing * apart) if apart > 0.0 else 1.0
            self.mixture[s] = share
            total += share
        value, seen = lowest - log(total) / self.smoothing, 0.0
        for s in range(self.addresses.shape[0]):
            self.mixture[s] /= total
            if self.mixture[s] < _UNSEEN:
                self.mixture[s] = 0.0
            seen += self.mixture[s]
        if not self.least_counts:
            value = 0.0
        self.base = 0.0
        for s in range(self.addresses.shape[0]):
            self.mixture[s] /= seen
            self.base += self.mixture[s] * self.bases[s]
            if not self.least_counts:
                value += self.mixture[s] * self.worth[s]
        return value

    def _leverages(self):
        for o in range(self.opened):
            self.leverage[self.open[o]] = 0.0
        for s in range(self.addresses.shape[0]):
            share = self.mixture[s] * self.scale[s]
            if share > 0.0:
                cast(Search, self.members[s]).opened = self.opened
                cast(Search, self.members[s])._leverages()
                one = cast(Search, self.members[s]).leverage
                for o in range(self.opened):
                    self.leverage[self.open[o]] += share * one[self.open[o]]

    def _hessian(self, kind, m):
        """The curvature in some scenarios in place of all: only a step depends on it.

        Which these are changes with every call. The part of a smoothed least that the
        slopes of its scenarios make is of all.
        """
        out, one, count = self.curvature, self.face, self.addresses.shape[0]
        for a in range(m * m):
            out[a] = 0.0
        many: cython.Py_ssize_t = 0
        for s in range(count):
            many += self.mixture[s] * count > _FAINT
        stride, at, whole, sampled = max(1, many // _SAMPLED), self.turn, 0.0, 0.0
        for s in range(count):
            share: cython.double = self.mixture[s] * self.scale[s]
            self.sample[s] = False
            if self.mixture[s] * count > _FAINT:
                at += 1
                whole += share
                if at % stride == 0:
                    self.sample[s] = True
                    sampled += share
        self.turn = (self.turn + 1) % stride
        for s in range(count):
            share = self.mixture[s] * self.scale[s]
            if self.sample[s]:
                now = cast(Search, self.members[s]).now
                cast(Search, self.members[s])._hessian(now, m)
                for a in range(m * m):
                    out[a] += share * whole / sampled * one[a]
            if not self.least_counts or not share > 0.0:
                continue
            weight = self.smoothing * self.mixture[s]
            leverage, ends = cast(Search, self.members[s]).leverage, self.ends
            for i in range(m):
                c = self.which[i]
                ends[i] = self.scale[s] * leverage[c] - self.leverage[c]
                if self.ruled:
                    ends[i] -= self.price[c]
            for i in range(m):
                for j in range(m):
                    out[i * m + j] += weight * ends[i] * ends[j]
