"""Compiled branch and bound on the concave relaxation; the front is branch_and_bound.

A node bounds the count of every candidate, ``low_i <= c_i <= high_i``, sum k. Its
relaxation lets counts be real numbers: the criterion phi is concave, so at any counts
c, with G the gradient at the information M and leverages ``d_i = trace(B_i G B_i.T)``,

    phi(any c') <= phi(c) + max over c' of sum of (c'_i - c_i) d_i

within the bounds: true wherever the climb stops, tight at the relaxed optimum. The
climb is Newton's, on the fractional counts and those the leverages ask to move; its
quadratic programme is solved by an active set. With W = inverse(M) and <.,.> the
entrywise product, the Hessian over the counts is

    D       -|X|^2           X = B_i W B_j.T
    Ds      |X|^2 - 2 <X, Y> X = B_i G B_j.T, Y = B_i W B_j.T
    A I As  -2 <X, Y>        the same.

Three bounds go by eigenvalues. E is 1 / the largest eigenvalue of V = C W C.T, which
double precision holds where it does not hold the smallest one of inverse(V): commands
far from zero. With v an eigenvector of V, ``y = W C.T v`` scaled to |C y| = 1 makes
``y.T M y`` its reciprocal at M, and at every other M a bound on E. E is smoothed over
all reciprocals l, ``-log(sum of exp(-b l)) / b``; its gradient is a mean of such y y.T
and so a bound too, however good the smoothing is.

D, A, I and As where what is still to be chosen has fewer readings t than there are
parameters: with P what is chosen for certain, the rest N = M - P of a selection has
rank t at most. Of the eigenvalues l of N in the metric of P (of H N H.T, H P H.T = I)
the smallest are replaced by their total in equal shares among what is left of the t,

    F(N) = sum over the i largest of f(l) + (t - i) f(rest / (t - i)),

which is concave where f is, exact at every selection, and nowhere below the sum of f
over the t largest. ``f = log(1 + l)`` bounds D, beside log det P. Source: Li and Xie,
Best principal submatrix selection (the augmented factorization bound), 2023.

A, I and As are trace(U inverse(I + H N H.T)) with U = H C.T C H.T. For every mu >= 0,
U is at most (U - mu)+ + mu I, and I - inverse(I + H N H.T) is at most 1 and of rank t:

    trace >= trace((U - mu)+ inverse(I + H N H.T)) + sum of min(u, mu) - mu t
             + mu (sum of 1 / (1 + l) over the t places of F).

mu = 0 is the natural bound. At a given N the best mu is an eigenvalue of U, the first
whose eigenvector no longer finds room among the t readings.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import (
    cholesky,
    copy,
    dot,
    factor,
    multiply,
)
from cython.cimports.jaxcal.watch import begin, late
from cython.cimports.libc.math import INFINITY, exp, fabs, floor, log, log1p, sqrt
from cython.cimports.scipy.linalg.cython_lapack import dsyevd

__all__ = ["DS", "TRACE", "D", "E", "Search"]

D, DS, TRACE, E = range(4)
# Compiled functions read C variables, which Python does not see. RANK and RANK_TRACE
# are D and TRACE in their sharper forms.
_D = cython.declare(cython.int, 0)
_DS = cython.declare(cython.int, 1)
_TRACE = cython.declare(cython.int, 2)
_E = cython.declare(cython.int, 3)
_RANK = cython.declare(cython.int, 4)
_RANK_TRACE = cython.declare(cython.int, 5)

_EPS = cython.declare(cython.double, 2.0**-52)

_SOLVED = cython.declare(cython.double, 1e-11)  # a bound this near the value is solved
_CLOSE = cython.declare(cython.double, 0.05)  # share of the way to the goal left open
_MAX_STEPS = cython.declare(cython.int, 80)
_FRACTIONAL = cython.declare(cython.int, 400)  # counts that a Newton step moves at most
_RIDGE = cython.declare(cython.double, 1e-10)  # share of the largest curvature
_ROUNDING = cython.declare(cython.double, 1e-12)  # of a count that is whole
_TUNES = cython.declare(cython.int, 2)  # of mu of RANK_TRACE in one node
_SMOOTHING = cython.declare(
    cython.double, 30.0
)  # b of E at first, where phi is about 1
_SHARPEST = cython.declare(cython.double, 1e5)
_TAKEN = cython.declare(cython.double, 1e-6)  # of a reading, in what eigenvectors take
_WHOLE = cython.declare(cython.double, 1e-9)  # a count this near a whole number is it
_SAME = cython.declare(cython.double, 1e-7)  # apart in value, selections are two


class Search:
    """A problem, where the relaxation of a node is, and the work space of both.

    ``kernel.pxd`` says what each attribute is.
    """

    def __init__(self, kind, blocks, prior, root, k, rank):
        # Arrays are C-contiguous float64. (A docstring here would be a global symbol of
        # C, of which a module that holds its code twice has two.)
        num_blocks, q, p = blocks.shape
        self.kind, self.k, self.rank = kind, k, rank
        self.blocks, self.prior, self.root = blocks, prior, root
        square = np.zeros((11, p, p))
        self.known, self.rest, self.gram, self.gradient = square[:4]
        self.inverse, self.other, self.half, self.basis = square[4:8]
        self.bend, self.lines, self.share = square[8:]
        self.vectors, self.reach, self.scaled, self.small = np.zeros((4, p, p))
        self.values, self.slopes, self.own, self.tail, self.weights = np.zeros((5, p))
        self.lapack = np.empty(1 + 6 * p + 2 * p * p)
        self.whole = np.empty(3 + 5 * p, dtype=np.intc)
        self.leverage, self.wish = np.zeros((2, num_blocks))
        m = min(num_blocks, _FRACTIONAL + 2 * p + 4)
        self.which, self.free = np.empty((2, m), dtype=np.intp)
        self.side = np.empty(m, dtype=np.intc)
        self.picked, self.turned = np.empty((2, m * q, p))
        crossed = max(m * q * m * q, m * p * (p + 1) // 2)
        self.crossed, self.bent = np.empty((2, crossed))
        self.curvature, self.face = np.empty((2, m * m))
        self.ends, self.move, self.before, self.slope = np.empty((4, m))
        self.least, self.most = np.empty((2, m))
        self.right = np.empty(2 * m)
        self.node = np.empty((3, num_blocks))

    # --- the criterion at fractional counts -----------------------------------------

    def _sum(self, low, counts, start, gram):
        """``gram = start + sum of (counts_i - low_i) B_i.T B_i``, of zeros if None."""
        num_blocks, q, p = self.blocks.shape[0], self.blocks.shape[1], gram.shape[0]
        for a in range(p):
            for b in range(a + 1):
                gram[a, b] = 0.0
        for i in range(num_blocks):
            count = counts[i] if low is cython.NULL else counts[i] - low[i]
            if count != 0.0:
                for r in range(q):
                    for a in range(p):
                        scaled = count * self.blocks[i, r, a]
                        for b in range(a + 1):
                            gram[a, b] += scaled * self.blocks[i, r, b]
        for a in range(p):
            for b in range(a + 1):
                if start is not None:
                    gram[a, b] += start[a, b]
                gram[b, a] = gram[a, b]

    def _evaluate(self, kind):
        """Value to climb by at P, N and M, -inf where M is singular; sets ``base``.

        The base differs from it by rounding, and for E.
        """
        p: cython.int = self.gram.shape[0]
        value: cython.double = 0.0
        self.base = 0.0
        if kind != _RANK:
            value = factor(
                cython.address(self.gram[0, 0]), cython.address(self.inverse[0, 0]),
                cython.address(self.vectors[0, 0]), p,
            )  # fmt: skip
            if not value > -INFINITY:
                return value
        if kind == _D:
            copy(cython.address(self.gradient[0, 0]),
                 cython.address(self.inverse[0, 0]), p * p)  # fmt: skip
        elif kind == _DS or kind == _TRACE:
            value = self._covariance(kind, self.root, self.root.shape[0], self.gradient)
        elif kind == _RANK_TRACE:
            value = self._covariance(kind, self.share, self.size, self.other)
        else:
            value = 0.0
        self.base = value
        if kind >= _E:
            value += self._spectrum(kind)
            if kind == _RANK_TRACE:
                for a in range(p):
                    for b in range(p):
                        self.gradient[a, b] += self.other[a, b]
        return value

    def _covariance(self, kind, root, s, gradient):
        """Value of Ds and the traces by C (s, p), W being there, and their gradient."""
        p: cython.int = gradient.shape[0]
        value: cython.double = 0.0
        reach = cython.address(self.reach[0, 0])  # C W
        scaled = reach
        multiply(False, False, s, p, p, cython.address(root[0, 0]),
                  cython.address(self.inverse[0, 0]), reach)  # fmt: skip
        if kind == _DS:
            small = cython.address(self.small[0, 0])
            multiply(False, True, s, s, p, reach, cython.address(root[0, 0]), small)
            scaled = cython.address(self.scaled[0, 0])
            value = -factor(small, scaled, cython.address(self.vectors[0, 0]), s)
            for a in range(s * s):
                small[a] = scaled[a]
            if not value < INFINITY:
                return -INFINITY
            multiply(False, False, s, p, s, small, reach, scaled)
        else:
            for r in range(s):
                for a in range(p):
                    value -= root[r, a] * reach[r * p + a]
        multiply(True, False, p, p, s, scaled, reach, cython.address(gradient[0, 0]))
        return value

    def _eigen(self):
        """Eigenvalues of ``vectors``, smallest first, and eigenvectors in its rows."""
        p: cython.int = self.vectors.shape[0]
        room: cython.int = self.lapack.shape[0]
        whole: cython.int = self.whole.shape[0]
        info: cython.int = 0
        dsyevd(b"V", b"L", cython.address(p), cython.address(self.vectors[0, 0]),
               cython.address(p), cython.address(self.values[0]),
               cython.address(self.lapack[0]), cython.address(room),
               cython.address(self.whole[0]), cython.address(whole),
               cython.address(info))  # fmt: skip

    def _weakest(self):
        """Set the reciprocals l, their y in ``basis``, slopes and base; the value of E.

        Eigenvalues of V below rounding have no slope, whatever they are.
        """
        p: cython.int = self.gram.shape[0]
        root = cython.address(self.root[0, 0])
        inverse = cython.address(self.inverse[0, 0])
        scaled = cython.address(self.scaled[0, 0])
        basis = cython.address(self.basis[0, 0])
        multiply(False, False, p, p, p, root, inverse, scaled)
        multiply(False, True, p, p, p, scaled, root, cython.address(self.vectors[0, 0]))
        self._eigen()
        largest = self.values[p - 1]
        for a in range(p):
            self.own[a] = 1.0 / max(self.values[p - 1 - a], _EPS * largest)
            for b in range(p):
                self.reach[a, b] = self.vectors[p - 1 - a, b]
        for a in range(p):
            self.values[a] = self.own[a]
        multiply(False, False, p, p, p, cython.address(self.reach[0, 0]), scaled, basis)
        multiply(False, True, p, p, p, basis, root, cython.address(self.reach[0, 0]))
        total: cython.double = 0.0
        for a in range(p):
            length: cython.double = 0.0
            for b in range(p):
                length += self.reach[a, b] * self.reach[a, b]
            scale = 1.0 / sqrt(length) if length > 0.0 else 0.0
            for b in range(p):
                self.basis[a, b] *= scale
            apart = self.values[a] - self.values[0]
            self.slopes[a] = exp(-self.smoothing * apart) if apart > 0.0 else 1.0
            total += self.slopes[a]
        multiply(False, False, p, p, p, basis, cython.address(self.gram[0, 0]),
                  cython.address(self.reach[0, 0]))  # fmt: skip
        for a in range(p):
            self.slopes[a] /= total
            self.tail[a] = self.slopes[a]
            self.own[a] = -self.smoothing * self.slopes[a]
            if self.slopes[a] > 0.0:
                for b in range(p):
                    self.base += self.slopes[a] * self.reach[a, b] * self.basis[a, b]
        self.tail_weight = self.smoothing
        return self.values[0] - log(total) / self.smoothing

    def _shared_out(self, kind):
        """The same of F at N in the metric of P; the f of A is ``-mu / (1 + l)``."""
        p: cython.int = self.gram.shape[0]
        half = cython.address(self.half[0, 0])
        scaled = cython.address(self.scaled[0, 0])
        vectors = cython.address(self.vectors[0, 0])
        multiply(False, False, p, p, p, half, cython.address(self.rest[0, 0]), scaled)
        multiply(False, True, p, p, p, scaled, half, vectors)
        self._eigen()
        multiply(False, False, p, p, p, vectors, half,
                  cython.address(self.basis[0, 0]))  # fmt: skip
        kept: cython.int = 0
        places: cython.int = self.places
        rest: cython.double = 0.0
        shares: cython.double = 0.0
        logs: cython.double = 0.0
        for a in range(p):
            self.values[a] = max(self.values[a], 0.0)
            rest += self.values[a]
        while kept < places - 1 and self.values[p - 1 - kept] * (places - kept) > rest:
            rest -= self.values[p - 1 - kept]
            logs += log1p(self.values[p - 1 - kept])
            shares += 1.0 / (1.0 + self.values[p - 1 - kept])
            kept += 1
        rest /= places - kept
        logs += (places - kept) * log1p(rest)
        shares += (places - kept) / (1.0 + rest)
        mu = self.mu if kind == _RANK_TRACE else 1.0
        for a in range(p):
            held: cython.bint = a >= p - kept
            x = 1.0 / (1.0 + (self.values[a] if held else rest))
            self.slopes[a] = mu * x * x if kind == _RANK_TRACE else x
            self.own[a] = -(2.0 * mu * x if kind == _RANK_TRACE else 1.0) * x * x
            self.tail[a] = 0.0 if held else 1.0
            if not held:
                self.tail_weight = self.own[a] / (places - kept)
                self.own[a] = 0.0
        self.shares = shares
        value = self.constant + (-mu * shares if kind == _RANK_TRACE else logs)
        # Eigenvalues are rounded by p eps of the largest.
        self.base += value + mu * p * _EPS * self.values[p - 1]
        return value

    def _spectrum(self, kind):
        """Value of E or F; fills the gradient, and basis and bend of the Hessian."""
        p: cython.int = self.gram.shape[0]
        value = self._weakest() if kind == _E else self._shared_out(kind)
        for a in range(p):
            for b in range(a):
                apart = self.values[a] - self.values[b]
                if apart > 1e-7 * self.values[a]:
                    self.bend[a, b] = (self.slopes[a] - self.slopes[b]) / apart
                else:
                    self.bend[a, b] = 0.5 * (self.own[a] + self.own[b])
            self.bend[a, a] = self.own[a]
            for b in range(p):
                self.scaled[a, b] = self.slopes[a] * self.basis[a, b]
        multiply(True, False, p, p, p, cython.address(self.scaled[0, 0]),
                  cython.address(self.basis[0, 0]),
                  cython.address(self.gradient[0, 0]))  # fmt: skip
        return value

    # --- the bounds by rank ---------------------------------------------------------

    def _kind_of(self, low):
        """Set P; RANK or RANK_TRACE where few readings are left to choose."""
        p: cython.int = self.gram.shape[0]
        left = self.k
        self._sum(cython.NULL, low, self.prior, self.known)
        self.smoothing = _SMOOTHING
        for i in range(low.shape[0]):
            left -= low[i]
        self.places = cython.cast(cython.int, left) * self.rank
        sharper: cython.bint = self.kind == _D or self.kind == _TRACE
        if not sharper or self.places >= p or self.places == 0:
            return self.kind
        self.constant = factor(
            cython.address(self.known[0, 0]), cython.address(self.inverse[0, 0]),
            cython.address(self.half[0, 0]), p,
        )  # fmt: skip
        if not self.constant > -INFINITY:
            return self.kind
        if self.kind == _D:
            return _RANK
        self._weigh()
        return _RANK_TRACE if self._choose_mu(p - 1 - self.places) else _TRACE

    def _weigh(self):
        """Fill ``weights`` and ``lines``: u and ``v.T inverse(H)``, by rows.

        Then ``C.T C`` is the sum of u times the outer product of a row with itself.
        """
        p: cython.int = self.gram.shape[0]
        s: cython.int = self.root.shape[0]
        half = cython.address(self.half[0, 0])
        root = cython.address(self.root[0, 0])
        reach = cython.address(self.reach[0, 0])
        vectors = cython.address(self.vectors[0, 0])
        multiply(False, True, s, p, p, root, half, reach)
        multiply(True, False, p, p, s, reach, reach, vectors)
        self._eigen()
        copy(cython.address(self.weights[0]), cython.address(self.values[0]), p)
        multiply(False, False, p, p, p, vectors, half, reach)
        multiply(False, False, p, p, p, reach, cython.address(self.known[0, 0]),
                  cython.address(self.lines[0, 0]))  # fmt: skip

    def _choose_mu(self, place):
        """Let mu be the eigenvalue ``place`` of U (-1: none); is the bound sharper?"""
        p: cython.int = self.gram.shape[0]
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
            if self.weights[a] > mu:
                self.constant -= mu
                scale = sqrt(self.weights[a] - mu)
                for c in range(p):
                    self.share[self.size, c] = scale * self.lines[a, c]
                self.size += 1
            else:
                self.constant -= max(self.weights[a], 0.0)
        return True

    def _best_place(self):
        """Of the eigenvalues of U the best mu at the present N; -1: the natural bound.

        The bound is convex and piecewise linear in mu, with slope minus the total that
        the eigenvectors above mu lose by N, plus what F allows the t readings to take.
        At a whole selection several are best, and the largest serves its neighbours.
        """
        p: cython.int = self.gram.shape[0]
        allowed = self.places - self.shares
        for d in range(p):
            j = p - 1 - d
            taken: cython.double = 1.0
            for a in range(p):
                total: cython.double = 0.0
                for b in range(p):
                    total += self.inverse[a, b] * self.lines[j, b]
                taken -= self.lines[j, a] * total
            allowed -= taken
            if allowed < _TAKEN * self.places:
                return cython.cast(cython.int, j)
        return -1

    # --- a Newton step --------------------------------------------------------------

    def _turn(self, m, matrix, turn):
        """``turned = B_i @ matrix`` of the ``picked`` blocks, or ``matrix.T``."""
        q: cython.int = self.blocks.shape[1]
        p: cython.int = self.blocks.shape[2]
        multiply(False, turn, m * q, p, p, cython.address(self.picked[0, 0]),
                  cython.address(matrix[0, 0]),
                  cython.address(self.turned[0, 0]))  # fmt: skip

    def _hessian(self, kind, m):
        """Fill ``curvature`` (m, m): minus the Hessian over the counts of ``which``."""
        q: cython.int = self.blocks.shape[1]
        p: cython.int = self.blocks.shape[2]
        wide: cython.int = m * q
        x = cython.address(self.crossed[0])
        y = cython.address(self.bent[0])
        out = cython.address(self.curvature[0])
        picked = cython.address(self.picked[0, 0])
        turned = cython.address(self.turned[0, 0])
        for i in range(m):
            copy(picked + i * q * p,
                 cython.address(self.blocks[self.which[i], 0, 0]), q * p)  # fmt: skip
        for i in range(m * m):
            out[i] = 0.0
        if kind >= _E:
            self._turn(m, self.basis, True)
            self._spectral_hessian(m)
            if kind != _RANK_TRACE:
                return
        self._turn(m, self.inverse, False)
        multiply(False, True, wide, wide, p, turned, picked, y)
        if kind != _D:
            if kind == _RANK_TRACE:
                self._turn(m, self.other, False)
            else:
                self._turn(m, self.gradient, False)
            multiply(False, True, wide, wide, p, turned, picked, x)
        for i in range(m):
            for j in range(m):
                total: cython.double = 0.0
                for r in range(q):
                    at = (i * q + r) * wide + j * q
                    for s in range(q):
                        if kind == _D:
                            total += y[at + s] * y[at + s]
                        elif kind == _DS:
                            total += (2.0 * y[at + s] - x[at + s]) * x[at + s]
                        else:
                            total += 2.0 * x[at + s] * y[at + s]
                out[i * m + j] += total

    def _spectral_hessian(self, m):
        """Minus the Hessian of E or F, of blocks turned into the basis."""
        q: cython.int = self.blocks.shape[1]
        p: cython.int = self.blocks.shape[2]
        size: cython.int = p * (p + 1) // 2
        plain = cython.address(self.crossed[0])
        bent = cython.address(self.bent[0])
        at: cython.Py_ssize_t = 0
        for i in range(m):
            self.ends[i] = 0.0
            for a in range(p):
                into, bend = plain + at, cython.address(self.bend[a, 0])
                for b in range(a + 1):
                    into[b] = 0.0
                for r in range(q):
                    row = cython.address(self.turned[i * q + r, 0])
                    weight = row[a]
                    for b in range(a + 1):
                        into[b] += weight * row[b]
                for b in range(a):
                    bent[at + b] = -2.0 * into[b] * bend[b]
                bent[at + a] = -into[a] * bend[a]
                self.ends[i] += self.tail[a] * into[a]
                at += a + 1
        out = cython.address(self.curvature[0])
        multiply(False, True, m, m, size, plain, bent, out)
        for i in range(m):
            for j in range(m):
                out[i * m + j] -= self.tail_weight * self.ends[i] * self.ends[j]

    def _leverages(self, low, high):
        """``trace(B_i G B_i.T)`` where the count is not fixed."""
        q: cython.int = self.blocks.shape[1]
        p: cython.int = self.blocks.shape[2]
        picked = cython.address(self.picked[0, 0])
        turned = cython.address(self.turned[0, 0])
        count: cython.Py_ssize_t = low.shape[0]
        i: cython.Py_ssize_t = 0
        while i < count:
            m: cython.int = 0
            while i < count and m < self.which.shape[0]:
                self.leverage[i] = 0.0
                if low[i] < high[i]:
                    copy(
                        picked + m * q * p, cython.address(self.blocks[i, 0, 0]), q * p
                    )
                    self.which[m] = i
                    m += 1
                i += 1
            self._turn(m, self.gradient, False)
            for f in range(m):
                at = f * q * p
                self.leverage[self.which[f]] = dot(picked + at, turned + at, q * p)

    def _linear_gain(self, low, high, c):
        """Largest ``sum of (c'_i - c_i) d_i`` within the bounds; sets the multiplier.

        The multiplier minimises ``k cut + sum of max(low_i (d_i - cut), high_i (d_i -
        cut))``, by bisection; any value of it gives a true bound.
        """
        least: cython.double = INFINITY
        most: cython.double = -INFINITY
        for i in range(c.shape[0]):
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
            for i in range(c.shape[0]):
                room += high[i] if self.leverage[i] > cut else low[i]
            if room > self.k:
                least = cut
            elif room < self.k:
                most = cut
            else:
                break
            cut = 0.5 * (least + most)
        gain: cython.double = 0.0
        total: cython.double = 0.0
        for i in range(c.shape[0]):
            slope = self.leverage[i] - cut
            total += c[i]
            gain += ((high[i] if slope > 0.0 else low[i]) - c[i]) * slope
        self.cut = cut
        return gain + (self.k - total) * cut

    def _working_set(self, low, high, c):
        """Counts to move: the fractional ones and some of those that should move."""
        num_blocks = c.shape[0]
        extra: cython.int = 2 * self.gram.shape[0] + 4
        fractional: cython.int = 0
        count: cython.int = 0
        largest: cython.double = 0.0
        for i in range(num_blocks):
            slope = self.leverage[i] - self.cut
            self.wish[i] = 0.0
            if low[i] < c[i] and c[i] < high[i]:
                fractional += 1
            if low[i] < high[i] and (c[i] < high[i] if slope > 0.0 else c[i] > low[i]):
                self.wish[i] = fabs(slope)
                largest = max(largest, self.wish[i])
        if fractional <= _FRACTIONAL:
            for i in range(num_blocks):
                if low[i] < c[i] and c[i] < high[i]:
                    self.wish[i] = 0.0
        else:
            fractional, extra = 0, _FRACTIONAL
        least = largest
        for _ in range(40):
            count = 0
            for i in range(num_blocks):
                count += self.wish[i] > 0.5 * least
            if count > extra:
                break
            least *= 0.5
        size: cython.int = 0
        room: cython.int = fractional + extra
        for i in range(num_blocks):
            inside: cython.bint = fractional > 0 and low[i] < c[i] and c[i] < high[i]
            wanted: cython.bint = self.wish[i] > 0.0 and self.wish[i] >= least
            if inside or (wanted and size < room):
                self.which[size] = i
                size += 1
        return size

    def _solve(self, m, size):
        """Where the free counts would go: ``right``; the multiplier of their sum.

        Solves by the curvature at ``free[:size]`` for the slope and for ones.
        """
        face = cython.address(self.face[0])
        right = cython.address(self.right[0])
        ones = right + size
        for f in range(size):
            right[f], ones[f] = self.slope[self.free[f]], 1.0
            row = self.free[f] * m
            for g in range(f + 1):
                face[f * size + g] = self.curvature[row + self.free[g]]
        cholesky(face, face, size, max(1e-3 * _RIDGE * self.curvature[0], 1e-300))
        for f in range(size):
            for g in range(f):
                right[f] -= face[f * size + g] * right[g]
                ones[f] -= face[f * size + g] * ones[g]
            right[f] *= face[f * size + f]
            ones[f] *= face[f * size + f]
        for b in range(size):
            f = size - 1 - b
            right[f] *= face[f * size + f]
            ones[f] *= face[f * size + f]
            for g in range(f):
                right[g] -= face[f * size + g] * right[f]
                ones[g] -= face[f * size + g] * ones[f]
        total: cython.double = 0.0
        weight: cython.double = 0.0
        for f in range(size):
            total += self.right[f]
            weight += self.right[size + f]
        for f in range(size):
            self.right[f] -= total / weight * self.right[size + f]
        return total / weight

    def _quadratic_step(self, m):
        """Maximise ``slope.x - x.curvature.x / 2``, sum x = 0, least <= x <= most.

        ``move`` is filled with x, the slope changed to that at the solution.
        """
        curvature = cython.address(self.curvature[0])
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
            cut: cython.double = 0.0
            if size:
                cut = self._solve(m, size)
                part: cython.double = 1.0
                hit: cython.Py_ssize_t = -1
                at: cython.int = 0
                for f in range(size):
                    i = self.free[f]
                    up: cython.bint = self.right[f] > 0.0
                    room = (self.most[i] if up else self.least[i]) - self.move[i]
                    if fabs(self.right[f]) * part > fabs(room):
                        part, hit, at = fabs(room / self.right[f]), f, 1 if up else -1
                if size > 1:
                    for f in range(size):
                        weight = part * self.right[f]
                        self.move[self.free[f]] += weight
                        row = self.free[f] * m
                        for i in range(m):
                            self.slope[i] -= weight * curvature[row + i]
                    if hit >= 0:
                        i = self.free[hit]
                        self.side[i] = at
                        self.move[i] = self.most[i] if at > 0 else self.least[i]
                        continue
            # At rest on this face: let go of the count that pulls most from its bound.
            pull: cython.double = 1e-9 * fabs(cut)
            best: cython.Py_ssize_t = -1
            other: cython.Py_ssize_t = -1
            highest: cython.double = -INFINITY
            lowest: cython.double = INFINITY
            for i in range(m):
                wish = self.side[i] * (cut - self.slope[i])
                if self.side[i] != 0 and size > 0 and wish > pull:
                    pull, best = wish, i
                if self.side[i] < 0 and self.slope[i] > highest and size == 0:
                    highest, best = self.slope[i], i
                if self.side[i] > 0 and self.slope[i] < lowest and size == 0:
                    lowest, other = self.slope[i], i
            if size == 0:
                if best < 0 or other < 0 or not highest > lowest:
                    break
                self.side[other] = 0
            if best < 0:
                break
            self.side[best] = 0

    def _at(self, kind, low, c):
        """N and M of the counts, P being there, and the value."""
        self._sum(cython.address(low[0]), c, None, self.rest)
        for a in range(self.gram.shape[0]):
            for b in range(self.gram.shape[0]):
                self.gram[a, b] = self.known[a, b] + self.rest[a, b]
        return self._evaluate(kind)

    def _spread(self, low, high, c):
        """Share what the lower bounds leave in proportion to the room of each count."""
        room: cython.double = 0.0
        fixed: cython.double = 0.0
        for i in range(c.shape[0]):
            room += high[i] - low[i]
            fixed += low[i]
        for i in range(c.shape[0]):
            c[i] = low[i] + (self.k - fixed) * (high[i] - low[i]) / max(room, 1.0)

    def _relax(self, kind, low, high, c, goal, share):
        """Climb the relaxation of a node until it is pruned, or solved well enough.

        Args:
            kind: of the criterion, or RANK or RANK_TRACE; P has been set for it.
            low, high, c: (M,) bounds, and the counts to start from, changed.
            goal: a bound at or below it ends the climb.
            share: so does a bound this share of its distance to the goal from solved.

        Returns:
            The bound, -inf where every selection of the node is singular.
        """
        value = self._at(kind, low, c)
        if not value > -INFINITY:
            self._spread(low, high, c)
            value = self._at(kind, low, c)
            if not value > -INFINITY:
                return value
        bound: cython.double = INFINITY
        after: cython.double = value
        tunes = _TUNES
        for step in range(_MAX_STEPS):
            self._leverages(low, high)
            gain = self._linear_gain(low, high, c)
            bound = self.base + gain
            if bound <= goal or step == _MAX_STEPS - 1:
                break
            if late(cython.address(self.watch)):
                break
            solved: cython.bint = bound - value <= max(_SOLVED, share * (value - goal))
            changed: cython.bint = False
            if kind == _RANK_TRACE:
                changed = tunes > 0 and (solved or step == 0)
                if changed:
                    tunes -= 1
                    sharper: cython.bint = self._choose_mu(self._best_place())
                    kind = _RANK_TRACE if sharper else _TRACE
            elif kind == _E and not solved:
                changed = gain <= 0.3 * (self.base - value)
                if changed and self.smoothing >= _SHARPEST:
                    break
                self.smoothing *= 4.0 if changed else 1.0
            if changed:
                value = self._evaluate(kind)
                continue
            if solved:
                break
            m = self._working_set(low, high, c)
            for i in range(m):
                j = self.which[i]
                self.before[i], self.slope[i] = c[j], self.leverage[j]
                self.least[i], self.most[i] = low[j] - c[j], high[j] - c[j]
            self._hessian(kind, m)
            self._quadratic_step(m)
            promised: cython.double = 0.0
            part: cython.double = 1.0
            for i in range(m):
                promised += self.move[i] * self.leverage[self.which[i]]
            while True:
                for i in range(m):
                    j = self.which[i]
                    c[j] = self.before[i] + part * self.move[i]
                    near = floor(c[j] + 0.5)
                    if fabs(c[j] - near) < _ROUNDING:
                        c[j] = near
                after = self._at(kind, low, c)
                if after >= value + 1e-4 * part * promised or part < 1e-6:
                    break
                part *= 0.5
            if not after > value:
                break
            value = after
        return bound

    # --- branching ------------------------------------------------------------------

    def _value_of(self, counts):
        """The criterion of a selection, -inf where it is singular."""
        self._sum(cython.NULL, counts, self.prior, self.gram)
        self.smoothing = INFINITY  # E itself
        return self._evaluate(self.kind)

    def _offer(self, counts, best_counts, best_values):
        """Insert a selection into the sorted list of the best, once."""
        size = best_values.shape[0]
        value = self._value_of(counts)
        if not value > best_values[size - 1]:
            return
        for r in range(size):
            same: cython.bint = fabs(best_values[r] - value) < _SAME
            for i in range(counts.shape[0]):
                same = same and best_counts[r, i] == counts[i]
            if same:
                return
        place: cython.Py_ssize_t = size - 1
        while place > 0 and best_values[place - 1] < value:
            best_values[place] = best_values[place - 1]
            best_counts[place, :] = best_counts[place - 1]
            place -= 1
        best_values[place] = value
        best_counts[place, :] = counts

    def offer(self, low, high, counts, best_counts, best_values):
        """Offer a selection and, where several are wanted, all one swap away from it.

        Args:
            low, high, counts: (M,) float64 bounds and counts.
            best_counts, best_values: (best, M) and (best,) incumbents, changed.
        """
        self.watch = begin(INFINITY)
        self._offer_near(low, high, counts.copy(), best_counts, best_values)

    def _offer_near(self, low, high, counts, best_counts, best_values):
        num_blocks = counts.shape[0]
        self._offer(counts, best_counts, best_values)
        for i in range(num_blocks if best_values.shape[0] > 1 else 0):
            late(cython.address(self.watch))
            for j in range(num_blocks):
                if i != j and counts[i] > low[i] and counts[j] < high[j]:
                    counts[i] -= 1.0
                    counts[j] += 1.0
                    self._offer(counts, best_counts, best_values)
                    counts[i] += 1.0
                    counts[j] -= 1.0

    def _balance(self, low, high, c):
        """Move c into its bounds and back to sum k, keeping it near where it was."""
        total: cython.double = 0.0
        for i in range(c.shape[0]):
            c[i] = min(max(c[i], low[i]), high[i])
            total += c[i]
        while fabs(total - self.k) > 1e-12:
            best: cython.Py_ssize_t = -1
            for i in range(c.shape[0]):
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

    def _process(self, low, high, c, slack, share, best_counts, best_values, bound):
        """Solve, tighten and, where settled, close one node.

        Forcing one count away from the side the multiplier puts it on costs the bound
        |d_i - cut| a unit, which tightens low and high (reduced-cost fixing).

        Args:
            low, high, c: (M,) bounds and starting counts, changed.
            slack: a bound this far above the incumbent still closes the node.
            share: see ``_relax``.
            best_counts, best_values: incumbents, changed.
            bound: written.

        Returns:
            The candidate to branch on, -1 where the node is closed.
        """
        last = best_values.shape[0] - 1
        goal = best_values[last] + slack
        bound[0] = self._relax(self._kind_of(low), low, high, c, goal, share)
        if bound[0] <= goal:
            return -1
        room = bound[0] - goal
        total_low: cython.double = 0.0
        total_high: cython.double = 0.0
        for i in range(c.shape[0]):
            if low[i] < high[i]:
                slope = self.leverage[i] - self.cut
                if room < fabs(slope) * (high[i] - low[i]):
                    units = floor(room / fabs(slope))
                    if slope < 0.0:
                        high[i] = low[i] + units
                    else:
                        low[i] = high[i] - units
            total_low += low[i]
            total_high += high[i]
        if total_low > self.k or total_high < self.k:
            return -1
        settled: cython.bint = total_low == self.k or total_high == self.k
        if settled:
            for i in range(c.shape[0]):
                c[i] = low[i] if total_low == self.k else high[i]
        whole: cython.bint = True
        branch: cython.Py_ssize_t = -1
        score: cython.double = -1.0
        total: cython.double = 0.0
        for i in range(c.shape[0]):
            away = fabs(c[i] - floor(c[i] + 0.5))
            if away > _WHOLE:
                whole = False
            total += floor(c[i] + 0.5)
            if low[i] < high[i]:
                # The nearest below a whole number: with it chosen the bound is sharper.
                # Among whole ones the one nearest to changing.
                this = _WHOLE / (1.0 + fabs(self.leverage[i] - self.cut))
                if away > _WHOLE:
                    this = c[i] - floor(c[i])
                if this > score:
                    score, branch = this, i
        if whole and total == self.k:
            for i in range(c.shape[0]):
                c[i] = floor(c[i] + 0.5)
            self._offer(c, best_counts, best_values)
        if settled or bound[0] <= best_values[last] + slack:
            return -1
        return branch

    def run(
        self, nodes, bounds, size, best_counts, best_values, slack, widest, tries,
        seconds, slope, shift
    ):  # fmt: skip
        """Branch until no open node is left, the room is full or the time is over.

        Args:
            nodes, bounds: (room, 3, M) and (room,) open nodes: lower and upper bounds
                of the counts, and counts to start from.
            size: open nodes at the start.
            best_counts, best_values: (best, M) and (best,) incumbents, changed.
            slack: a bound this far above the last incumbent still closes a node.
            widest: open nodes up to which the best bound goes first, then the newest.
            tries: nodes before which a bound that is good enough ends nothing; of the
                first one alone the relaxation is solved.
            seconds: to stop after.
            slope, shift: good enough is a bound of slope times the best, plus shift.

        Returns:
            Open nodes left, nodes processed, and whether to go on.
        """
        self.watch = begin(seconds)
        done: cython.Py_ssize_t = 0
        left: cython.Py_ssize_t = size
        ended: cython.int = self._run(
            nodes, bounds, cython.address(left), cython.address(done), best_counts,
            best_values, slack, widest, tries, slope, shift,
        )  # fmt: skip
        return left, done, not ended

    def _run(
        self, nodes, bounds, size, done, best_counts, best_values, slack, widest, tries,
        slope, shift
    ):  # fmt: skip
        last = best_values.shape[0] - 1
        low, high, c = self.node[0], self.node[1], self.node[2]
        bound: cython.double = INFINITY
        with cython.nogil:
            while size[0] > 0 and size[0] + 2 <= bounds.shape[0]:
                pick = size[0] - 1
                if size[0] <= widest:
                    for r in range(size[0]):
                        if bounds[r] > bounds[pick]:
                            pick = r
                    enough = max(bounds[pick], best_values[0])
                    if done[0] >= tries and enough <= slope * best_values[0] + shift:
                        return 1
                if done[0] and late(cython.address(self.watch)):
                    return 1
                parent = bounds[pick]
                self.node[:, :] = nodes[pick]
                size[0] -= 1
                if pick != size[0]:
                    nodes[pick, :, :] = nodes[size[0]]
                    bounds[pick] = bounds[size[0]]
                if parent <= best_values[last] + slack:
                    continue
                done[0] += 1
                share = 0.0 if parent == INFINITY else _CLOSE
                branch = self._process(
                    low, high, c, slack, share, best_counts, best_values,
                    cython.address(bound),
                )  # fmt: skip
                if branch < 0:
                    continue
                split = floor(c[branch] + _WHOLE)
                split = min(max(split, low[branch]), high[branch] - 1.0)
                for side in range(2):
                    nodes[size[0], :, :] = self.node
                    bounds[size[0]] = min(bound, parent)
                    nodes[size[0], 1 - side, branch] = split + side
                    if self._balance(
                        nodes[size[0], 0], nodes[size[0], 1], nodes[size[0], 2]
                    ):
                        size[0] += 1
        return 0
