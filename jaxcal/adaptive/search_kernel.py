"""Look-ahead on a grid task: the measurement of the largest expected total, compiled.

A node is what may be known after some measurements: weights w over the values of theta
that are still likely, not normalised, so that their total p is the chance of the node
and every sum over its children is a plain sum. From the sums over theta

    q[y, a] = sum of w L[a, y]        h[a] = sum of w L[a, y] log L[a, y] over y, too

follow gains and costs of all measurements. They are summed anew for the children of
all outcomes but one: that one has what is left of the parent's.

``shares`` (rules.py) proposes: at each level the few measurements of its largest gain
per price are followed through all of their outcomes, at the last level its first. What
a node at the end of the tree may still gain is an estimate, g (1 - exp(-k m)) /
(1 - exp(-k)): g of the proposed measurement, m of them fit into what is left, and each
tells less than the one before since what is unknown ends; fitted to sessions of
``shares`` on tasks of the family. The first proposal is kept unless another is better
by ``_DOUBT`` of what is estimated, so a tree that reaches every session's end is exact.

Trees are tried from the smallest, as long as ``effort`` multiplications suffice.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, expf, fmax, fmin
from cython.cimports.libc.string import memcpy

__all__ = ["Tree"]

_DEPTH = cython.declare(cython.int, 4)
# Measurements that are followed at each level.
_WIDTHS = ((4, 1), (6, 1, 1), (6, 2, 1), (6, 2, 1, 1), (6, 3, 2, 1))
# Multiplications that take as long as the rest of a node: of each sum, and of all.
_EACH = cython.declare(cython.double, 16.0)
_NODE = cython.declare(cython.double, 600.0)
_LIKELY = cython.declare(cython.float, 1e-4)  # of 1 / S: less weight is left out
_NO_CHANCE = cython.declare(cython.double, 1e-6)  # of an outcome that is not followed
_DOUBT = cython.declare(cython.double, 0.3)
# m is _FIT price^-_BEND; k is _FALL g / entropy + _FLAT.
_FIT = cython.declare(cython.double, 2.4)
_BEND = cython.declare(cython.double, 0.9)
_FALL = cython.declare(cython.double, 1.2)
_FLAT = cython.declare(cython.double, 0.015)


@cython.cfunc
@cython.inline
@cython.nogil
@cython.exceptval(check=False)
def _log(x: cython.float) -> cython.float:
    """Natural logarithm of a normal number, to 1e-7; Cephes's, without branches."""
    bits: cython.int = 0
    memcpy(cython.address(bits), cython.address(x), 4)
    bits -= 0x3F3504F3  # of the root of a half
    power: cython.int = bits >> 23
    bits = (bits & 0x7FFFFF) + 0x3F3504F3
    f: cython.float = 0.0
    memcpy(cython.address(f), cython.address(bits), 4)
    one: cython.float = 1.0
    half: cython.float = 0.5
    log_2: cython.float = 0.69314718
    c8: cython.float = 7.0376836292e-2
    c7: cython.float = -1.1514610310e-1
    c6: cython.float = 1.1676998740e-1
    c5: cython.float = -1.2420140846e-1
    c4: cython.float = 1.4249322787e-1
    c3: cython.float = -1.6668057665e-1
    c2: cython.float = 2.0000714765e-1
    c1: cython.float = -2.4999993993e-1
    c0: cython.float = 3.3333331174e-1
    f -= one
    y: cython.float = ((c8 * f + c7) * f + c6) * f + c5
    y = (((y * f + c4) * f + c3) * f + c2) * f + c1
    return ((y * f + c0) * f - half) * f * f + f + power * log_2


@cython.cclass
class Tree:
    """A task, the constants of ``shares`` and the work space of one path."""

    sums_of: cython.float[:, ::1]
    likelihood: cython.float[:, :, ::1]
    travel: cython.float[:, ::1]
    extra: cython.float[:, ::1]
    uses: cython.float[:, ::1]
    place_after: cython.int[:, ::1]
    allowed: cython.float[::1]  # 1 or 0
    horizon: cython.int
    time: cython.double
    use: cython.double
    a: cython.double
    b: cython.double
    effort: cython.double

    designs: cython.int
    outcomes: cython.int
    wide: cython.int
    likely: cython.int
    which: cython.int[::1]
    widths: cython.int[:, ::1]
    width: cython.p_int
    work: cython.double
    # Of each level:
    weights: cython.float[:, ::1]
    sums: cython.float[:, ::1]
    rest: cython.float[:, ::1]
    gains: cython.float[:, ::1]
    scores: cython.float[:, ::1]
    seconds: cython.float[:, ::1]
    needs: cython.float[:, ::1]
    guess: cython.double[::1]

    def __init__(
        self, sums_of, likelihood, travel, extra, uses, place_after, allowed, horizon,
        shares, effort,
    ):  # fmt: skip
        # sums_of: (S, Y A) rows of L of all outcomes but the first, then of the sum of
        # L log L over outcomes.
        self.sums_of, self.likelihood, self.travel = sums_of, likelihood, travel
        self.extra, self.uses, self.place_after = extra, uses, place_after
        self.allowed, self.horizon, self.effort = allowed, horizon, effort
        self.time, self.use, self.a, self.b = shares
        self.designs, self.outcomes = likelihood.shape[:2]
        states, self.wide = sums_of.shape
        levels = _DEPTH + 1
        table = np.zeros((len(_WIDTHS), levels), np.int32)
        for number, widths in enumerate(_WIDTHS):
            table[number, : len(widths)] = widths
        self.widths = table
        self.which = np.zeros(states, np.int32)
        self.weights = np.zeros((levels, states), np.float32)
        self.sums, self.rest = np.zeros((2, levels, self.wide), np.float32)
        four = np.zeros((4, levels, self.designs), np.float32)
        self.gains, self.scores, self.seconds, self.needs = four
        self.guess = np.zeros(levels)

    def choose(
        self,
        beliefs: cython.float[:, ::1],
        place: cython.int[::1],
        seconds: cython.float[::1],
        uses: cython.int[::1],
        made: cython.int[::1],
        chosen: cython.int[::1],
    ):
        """Write the next measurement of each of B sessions; all are (B, ...)."""
        number: cython.Py_ssize_t
        watch: Watch = begin(INFINITY)
        with cython.nogil:
            for number in range(beliefs.shape[0]):
                late(cython.address(watch))
                chosen[number] = self._best(
                    cython.address(beliefs[number, 0]),
                    place[number],
                    seconds[number],
                    uses[number],
                    made[number],
                )

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _best(
        self,
        belief: cython.p_float,
        place: cython.int,
        t: cython.double,
        e: cython.int,
        made: cython.int,
    ) -> cython.int:
        """Of the largest tree that ``effort`` suffices for."""
        states: cython.int = self.which.shape[0]
        i: cython.int
        n: cython.int = 0
        p: cython.float = 0.0
        for i in range(states):
            if belief[i] * states > _LIKELY:
                self.which[n] = i
                self.weights[0, n] = belief[i]
                p += belief[i]
                n += 1
        self.likely = n
        entropy: cython.float = 0.0
        for i in range(n):
            entropy -= self.weights[0, i] * _log(self.weights[0, i] / p)
        self._sum(0)
        self.width = cython.address(self.widths[0, _DEPTH])  # 0
        best: cython.int = 0
        self._value(0, p, place, t, e, made, entropy / p, cython.address(best))
        if made + 1 >= self.horizon:
            return best
        spent: cython.double = 0.0
        # The largest that surely fits, then larger ones by what this one took.
        for i in range(self.widths.shape[0] - 1, -1, -1):
            work: cython.double = self._size(i)
            if work <= self.effort:
                break
        while i < self.widths.shape[0] and spent + work <= self.effort:
            self.work = 0.0
            self.width = cython.address(self.widths[i, 0])
            self._value(0, p, place, t, e, made, entropy / p, cython.address(best))
            spent += self.work
            i += 1
            if i < self.widths.shape[0]:
                work = self.work * self._size(i) / self._size(i - 1)
        return best

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _node(self) -> cython.double:
        """Multiplications that a node takes, besides those of its sums."""
        return _EACH * self.wide + _NODE

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _size(self, number: cython.int) -> cython.double:
        """Multiplications of a tree of which no session ends."""
        level: cython.int
        size: cython.double = 0.0
        nodes: cython.double = 1.0
        for level in range(_DEPTH):
            nodes *= self.widths[number, level]
            size += nodes * (self.outcomes - 1) * self.wide * self.likely
            nodes *= self.outcomes
            size += nodes * self._node()
        return size

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _sum(self, level: cython.int) -> cython.void:
        i: cython.Py_ssize_t
        r: cython.Py_ssize_t
        wide: cython.Py_ssize_t = self.wide
        sums: cython.p_float = cython.address(self.sums[level, 0])
        for r in range(wide):
            sums[r] = 0.0
        for i in range(self.likely):
            w: cython.float = self.weights[level, i]
            if w > 0.0:
                row: cython.p_float = cython.address(self.sums_of[self.which[i], 0])
                for r in range(wide):
                    sums[r] += w * row[r]
        self.work += wide * self.likely

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _value(
        self,
        level: cython.int,
        p: cython.float,
        place: cython.int,
        t: cython.double,
        e: cython.int,
        made: cython.int,
        entropy: cython.double,
        best: cython.p_int,
    ) -> cython.double:
        """p times the nats still to gain after sums; the best measurement."""
        gains: cython.p_float = cython.address(self.gains[level, 0])
        scores: cython.p_float = cython.address(self.scores[level, 0])
        a: cython.int
        price: cython.double = self._propose(level, p, place, t, e, made, best)
        value: cython.double = -1.0
        if made + 1 >= self.horizon:  # nothing follows: no price counts
            for a in range(self.designs):
                if scores[a] > 0.0 and gains[a] > value:
                    value = gains[a]
                    best[0] = a
            return value
        first: cython.int = best[0]
        if self.width[level] == 0:
            m: cython.double = fmax(1.0, _FIT * expf(-_BEND * _log(price)))
            m = fmin(m, self.horizon - made)
            k: cython.double = _FALL * gains[first] / (p * fmax(entropy, 1e-3)) + _FLAT
            rest: cython.double = gains[first] * (
                (1.0 - expf(-k * m)) / (1.0 - expf(-k)) - 1.0
            )
            self.guess[level] += rest
            return gains[first] + rest
        kept: cython.double = 0.0
        guess: cython.double = 0.0
        number: cython.int
        for number in range(self.width[level]):
            top: cython.float = 0.0
            for a in range(self.designs):
                if scores[a] > top:
                    top = scores[a]
                    first = a
            if top == 0.0:
                break
            scores[first] = 0.0
            self.guess[level + 1] = 0.0
            unknown: cython.double = entropy - gains[first] / p
            total: cython.double = gains[first] + self._follow(
                level, p, first, place, t, e, made, unknown
            )
            mine: cython.double = self.guess[level + 1]
            if number == 0:
                value = total
                kept = total
                guess = mine
                own: cython.double = mine
            elif total > value and total > kept + _DOUBT * fmax(own, mine):
                value = total
                guess = mine
                best[0] = first
        self.guess[level] += guess
        return value

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _propose(
        self,
        level: cython.int,
        p: cython.float,
        place: cython.int,
        t: cython.double,
        e: cython.int,
        made: cython.int,
        best: cython.p_int,
    ) -> cython.double:
        """Gains times p and scores of ``shares``; the best by them, and its price."""
        designs: cython.int = self.designs
        outcomes: cython.int = self.outcomes
        a: cython.int
        y: cython.int
        sums: cython.p_float = cython.address(self.sums[level, 0])
        gains: cython.p_float = cython.address(self.gains[level, 0])
        scores: cython.p_float = cython.address(self.scores[level, 0])
        seconds: cython.p_float = cython.address(self.seconds[level, 0])
        needs: cython.p_float = cython.address(self.needs[level, 0])
        share: cython.float = 1.0 / p
        tiny: cython.float = 1e-12
        zero: cython.float = 0.0
        for a in range(designs):
            gains[a] = sums[(outcomes - 1) * designs + a]
            seconds[a] = needs[a] = 0.0
            scores[a] = p  # less what the outcomes have
        for y in range(1, outcomes + 1):
            chances: cython.p_float = sums + (y - 1) * designs
            if y == outcomes:
                chances = scores
            extra: cython.p_float = cython.address(self.extra[y % outcomes, 0])
            uses: cython.p_float = cython.address(self.uses[y % outcomes, 0])
            for a in range(designs):
                q: cython.float = chances[a]
                q = q if q > tiny else tiny
                scores[a] -= q
                gains[a] -= q * _log(q * share)
                seconds[a] += q * extra[a]
                needs[a] += q * uses[a]
        travel: cython.p_float = cython.address(self.travel[place, 0])
        allowed: cython.p_float = cython.address(self.allowed[0])
        nothing: cython.float = 1e-9
        for a in range(designs):
            gains[a] = gains[a] if gains[a] > zero else zero
            s: cython.float = travel[a] + seconds[a] * share
            seconds[a] = s if s > nothing else nothing
            needs[a] *= share
            scores[a] = allowed[a] * (gains[a] * share + nothing) / seconds[a]
        rate: cython.float = 0.0
        always: cython.float = 1e9
        each: cython.double = 1.0
        for a in range(designs):
            if scores[a] > rate:
                rate = scores[a]
                each = seconds[a]
            if allowed[a] > 0.0 and needs[a] < always:
                always = needs[a]
        n: cython.double = fmax(self.horizon - made, 1.0)
        n = fmin(n, fmax(e / fmax(always, 1e-6), 1.0))
        t = fmax(t, 1e-9)
        e = max(e, 1)
        number: cython.double = fmin(n, fmax(t / each, 0.1))
        use: cython.float = (self.use / e) * expf(
            self.a * _log(number) + self.b * _log(e)
        )
        last: cython.float = e
        time: cython.float = self.time / t
        end: cython.float = fmin(t, 1e30)
        fixed: cython.float = 1.0 / n
        least: cython.float = nothing * p
        for a in range(designs):
            s = seconds[a] if seconds[a] < end else end
            u: cython.float = needs[a] - always
            u = u if u < last else last
            s = fixed + time * s + use * u
            scores[a] = allowed[a] * (gains[a] + least) / s
        self.work += self._node()
        top: cython.float = 0.0
        best[0] = 0
        for a in range(designs):
            if scores[a] > top:
                top = scores[a]
                best[0] = a
        return (gains[best[0]] + least) / fmax(top, 1e-30)

    @cython.cfunc
    @cython.nogil
    @cython.exceptval(check=False)
    def _follow(
        self,
        level: cython.int,
        p: cython.float,
        a: cython.int,
        place: cython.int,
        t: cython.double,
        e: cython.int,
        made: cython.int,
        entropy: cython.double,
    ) -> cython.double:
        """p times the nats that are gained after a measurement."""
        designs: cython.int = self.designs
        outcomes: cython.int = self.outcomes
        wide: cython.Py_ssize_t = self.wide
        y: cython.int
        i: cython.Py_ssize_t
        r: cython.Py_ssize_t
        then: cython.int = level + 1
        from_here: cython.p_float = cython.address(self.weights[level, 0])
        weights: cython.p_float = cython.address(self.weights[then, 0])
        sums: cython.p_float = cython.address(self.sums[then, 0])
        rest: cython.p_float = cython.address(self.rest[level, 0])
        mine: cython.p_float = cython.address(self.sums[level, 0])
        best: cython.int = 0
        tiny: cython.float = 1e-12
        zero: cython.float = 0.0
        total: cython.double = 0.0
        mass: cython.float = p
        for r in range(wide):
            rest[r] = mine[r]
        for y in range(1, outcomes + 1):
            q: cython.float = mass
            if y < outcomes:
                q = mine[(y - 1) * designs + a]
                mass -= q
            if q < _NO_CHANCE * p:
                continue
            z: cython.int = y % outcomes
            left: cython.double = t - self.travel[place, a] - self.extra[z, a]
            more: cython.int = e - cython.cast(cython.int, self.uses[z, a])
            going: cython.bint = left > 0.0 and more > 0 and made + 1 < self.horizon
            if y == outcomes:
                if not going:
                    break
                for r in range(wide):
                    sums[r] = rest[r]
            if y < outcomes or self.width[then] > 0:
                like: cython.p_float = cython.address(self.likelihood[a, z, 0])
                for i in range(self.likely):
                    w: cython.float = from_here[i] * like[self.which[i]]
                    weights[i] = w if w > tiny else zero
            if y < outcomes:
                self._sum(then)
                for r in range(wide):
                    rest[r] -= sums[r]
            if going:
                total += self._value(
                    then, q, self.place_after[a, z], left, more, made + 1, entropy,
                    cython.address(best),
                )  # fmt: skip
        return total
