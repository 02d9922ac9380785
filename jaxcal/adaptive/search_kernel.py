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
by ``doubt`` of what is estimated, so a tree that reaches every session's end is exact.

Trees are tried from the smallest, as long as ``effort`` multiplications suffice.

Designs are padded to D, a multiple of 8: loops over them run in whole vectors.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.adaptive.search_kernel import State
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, expf, fmax, fmin
from cython.cimports.libc.string import memcpy

__all__ = ["NODE", "SUM", "Tree"]

_DEPTH = cython.declare(cython.int, 4)
# Measurements that are followed at each level.
_WIDTHS = (
    (6,), (4, 1), (6, 1, 1), (6, 2, 1), (6, 2, 1, 1), (6, 3, 2, 1), (12, 4, 2, 1),
    (24, 8, 3, 2), (48, 12, 6, 4),
)  # fmt: skip
# Multiplications that take as long as the rest of a node: of each sum, and of all.
_EACH = cython.declare(cython.double, 35.0)
_NODE = cython.declare(cython.double, 2400.0)
SUM, NODE = _EACH, _NODE
_LIKELY = cython.declare(cython.float, 1e-4)  # of 1 / S: less weight is left out
_NO_CHANCE = cython.declare(cython.double, 1e-6)  # of an outcome that is not followed
_USES = cython.declare(cython.int, 64)  # from which on a use costs the same
# m is _FIT price^-_BEND; k is _FALL g / entropy + _FLAT.
_FIT = cython.declare(cython.double, 2.4)
_BEND = cython.declare(cython.double, 0.9)
_FALL = cython.declare(cython.double, 1.2)
_FLAT = cython.declare(cython.double, 0.015)


def _log(x):
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


def _largest(values, count, sign):
    """Largest of ``sign`` times (count,), a multiple of 8, in eight lanes."""
    lanes = cython.declare(cython.float[8])
    for j in range(8):
        lanes[j] = sign * values[j]
    for b in range(8, count, 8):
        for j in range(8):
            x = sign * values[b + j]
            lanes[j] = x if x > lanes[j] else lanes[j]
    top = lanes[0]
    for j in range(1, 8):
        top = lanes[j] if lanes[j] > top else top
    return top


def _argmax(values, count):
    top = _largest(values, count, 1.0)
    for a in range(count):
        if values[a] == top:
            return a
    return 0


class Tree:
    """A task, the constants of ``Ahead`` and the work space of one path."""

    def __init__(
        self, likelihood, travel, extra, uses, place_after, most_extra, most_uses,
        horizon, constants, hints, effort,
    ):  # fmt: skip
        # As in GridTask, but for extra and uses, (Y, A). Hints are (N, A), the last for
        # the Nth measurement and all that follow.
        designs, outcomes, states = likelihood.shape
        more = -designs % 8
        self.designs, self.outcomes = designs + more, outcomes
        self.likelihood, self.place_after = likelihood, place_after
        self.horizon, self.effort, self.cut = horizon, effort, _LIKELY / states
        self.time, use, self.a, b, self.haste, self.doubt = constants
        e = np.arange(1.0, _USES + 1)
        self.use_of = use * e ** (b - 1.0)
        self.travel, self.extra, self.uses, self.most_extra, self.hints = (
            np.pad(table, [(0, 0)] * (table.ndim - 1) + [(0, more)])
            for table in (travel, extra, uses, most_extra, hints)
        )
        # What is padded can never be paid.
        self.most_uses = np.pad(most_uses, (0, more), constant_values=1e30)
        # Of each state L of all outcomes but the first, then the sum of L log L.
        noise = likelihood * np.log(np.where(likelihood > 0.0, likelihood, 1.0))
        rows = [*likelihood.transpose(1, 2, 0)[1:], noise.sum(axis=1).T]
        parts = [np.pad(row, [(0, 0), (0, more)]) for row in rows]
        self.rows = np.concatenate(parts, axis=1)
        self.wide = self.rows.shape[1]
        levels = _DEPTH + 1
        table = np.zeros((len(_WIDTHS), levels), np.int32)
        for number, widths in enumerate(_WIDTHS):
            table[number, : len(widths)] = widths
        self.widths = table
        self.likely = np.zeros(levels, np.int32)
        self.which = np.zeros((levels, states + 3), np.int32)
        self.weights = np.zeros((levels, states + 3), np.float32)
        self.sums, self.rest = np.zeros((2, levels, self.wide), np.float32)
        five = np.zeros((5, levels, self.designs), np.float32)
        self.gains, self.scores, self.seconds, self.needs, self.open = five
        self.guess = np.zeros(levels)
        self.belief = np.zeros(states, np.float32)

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
        now = cython.declare(State)
        watch: Watch = begin(INFINITY)
        with cython.nogil:
            for i in range(beliefs.shape[0]):
                late(cython.address(watch))
                now.place, now.seconds = place[i], seconds[i]
                now.uses, now.made = uses[i], made[i]
                a = self._best(cython.address(beliefs[i, 0]), now)
                chosen[i] = a if a > 0 else 0

    def play(
        self,
        prior: cython.float[::1],
        place: cython.int,
        seconds: cython.float[::1],
        uses: cython.int[::1],
        truth: cython.int[::1],
        draws: cython.float[:, ::1],
        gains: cython.float[:, ::1],
        chosen: cython.int[:, ::1],
    ):
        """Whole sessions (B,) of at most T measurements.

        What is chosen and its expected gain are written; after a session's end nothing
        is. ``draws`` (B, T) in [0, 1) decide the outcomes.
        """
        now = cython.declare(State)
        states = self.likelihood.shape[2]
        belief = cython.address(self.belief[0])
        watch: Watch = begin(INFINITY)
        with cython.nogil:
            for i in range(truth.shape[0]):
                now.place, now.seconds = place, seconds[i]
                now.uses, now.made = uses[i], 0
                for s in range(states):
                    belief[s] = prior[s]
                while now.seconds > 0.0 and now.uses > 0 and now.made < self.horizon:
                    late(cython.address(watch))
                    a = self._best(belief, now)
                    if a < 0:
                        break
                    chosen[i, now.made] = a
                    gains[i, now.made] = self.gains[0, a]
                    y: cython.int = 0
                    below: cython.float = self.likelihood[a, 0, truth[i]]
                    while y < self.outcomes - 1 and draws[i, now.made] >= below:
                        y += 1
                        below += self.likelihood[a, y, truth[i]]
                    mass: cython.float = 0.0
                    for s in range(states):
                        belief[s] *= self.likelihood[a, y, s]
                        mass += belief[s]
                    mass = 1.0 / mass
                    for s in range(states):
                        belief[s] *= mass
                    now.seconds -= self.travel[now.place, a] + self.extra[y, a]
                    now.uses -= cython.cast(cython.int, self.uses[y, a])
                    now.place = self.place_after[a, y]
                    now.made += 1

    def _best(self, belief, now):
        """The choice of the largest tree within ``effort``; -1: nothing can be paid."""
        states = self.likelihood.shape[2]
        n: cython.int = 0
        p: cython.float = 0.0
        for i in range(states):
            if belief[i] * states > _LIKELY:
                self.which[0, n] = i
                self.weights[0, n] = belief[i]
                p += belief[i]
                n += 1
        self.likely[0] = n
        entropy: cython.float = 0.0
        for i in range(n):
            entropy -= self.weights[0, i] * _log(self.weights[0, i] / p)
        entropy /= p
        self.work = 0.0
        self._sum(0)
        self.width = cython.address(self.widths[0, _DEPTH])  # 0
        best: cython.int = 0
        self._value(0, p, now, entropy, cython.address(best))
        if self.scores[0, best] == 0.0:
            return -1
        if now.made + 1 >= self.horizon:
            return best
        spent = self.work
        # The largest that surely fits, then larger ones by what this one took.
        number: cython.int = self.widths.shape[0] - 1
        while number > 0 and self._size(number) > self.effort:
            number -= 1
        work = self._size(number)
        while number < self.widths.shape[0] and spent + work <= self.effort:
            self.work = 0.0
            self.width = cython.address(self.widths[number, 0])
            self._value(0, p, now, entropy, cython.address(best))
            spent += self.work
            number += 1
            if number < self.widths.shape[0]:
                work = self.work * self._size(number) / self._size(number - 1)
        return best

    def _size(self, number):
        """Multiplications of a tree of which no session ends."""
        size: cython.double = 0.0
        nodes: cython.double = 1.0
        for level in range(_DEPTH):
            nodes *= self.widths[number, level]
            size += nodes * (self.outcomes - 1) * self.wide * self.likely[0]
            nodes *= self.outcomes
            size += nodes * (_EACH * self.wide + _NODE)
        return size

    def _sum(self, level):
        """The sums over the likely states, four at a time."""
        which = cython.address(self.which[level, 0])
        weights = cython.address(self.weights[level, 0])
        rows = cython.address(self.rows[0, 0])
        sums = cython.address(self.sums[level, 0])
        wide = self.wide
        count = self.likely[level]
        for i in range(count, count + 3):
            which[i] = 0
            weights[i] = 0.0
        for r in range(wide):
            sums[r] = 0.0
        for i in range(0, count, 4):
            u, v, w, x = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
            a = rows + which[i] * wide
            b = rows + which[i + 1] * wide
            c = rows + which[i + 2] * wide
            d = rows + which[i + 3] * wide
            for r in range(wide):
                sums[r] += (u * a[r] + v * b[r]) + (w * c[r] + x * d[r])
        self.work += wide * count

    def _value(self, level, p, now, entropy, best):
        """p times the nats still to gain after sums; the best measurement."""
        gains = cython.address(self.gains[level, 0])
        scores = cython.address(self.scores[level, 0])
        price = self._propose(level, p, now, best)
        first: cython.int = best[0]
        value: cython.double = -1.0
        if scores[first] == 0.0:  # nothing can be paid
            return 0.0
        if now.made + 1 >= self.horizon:  # nothing follows: no price counts
            for a in range(self.designs):
                if scores[a] > 0.0 and gains[a] > value:
                    value = gains[a]
                    best[0] = a
            return value
        if self.width[level] == 0:
            m: cython.double = fmax(1.0, _FIT * expf(-_BEND * _log(price)))
            m = fmin(m, self.horizon - now.made)
            k: cython.double = _FALL * gains[first] / (p * fmax(entropy, 1e-3)) + _FLAT
            rest: cython.double = gains[first] * (
                (1.0 - expf(-k * m)) / (1.0 - expf(-k)) - 1.0
            )
            self.guess[level] += rest
            return gains[first] + rest
        kept: cython.double = 0.0
        guess: cython.double = 0.0
        kept_guess: cython.double = 0.0
        for number in range(self.width[level]):
            first = _argmax(scores, self.designs)
            if scores[first] == 0.0:
                break
            scores[first] = 0.0
            self.guess[level + 1] = 0.0
            total: cython.double = gains[first] + self._follow(
                level, p, first, now, entropy - gains[first] / p
            )
            mine: cython.double = self.guess[level + 1]
            if number == 0:
                value = kept = total
                guess = kept_guess = mine
            elif total > value and total > kept + self.doubt * fmax(kept_guess, mine):
                value = total
                guess = mine
                best[0] = first
        self.guess[level] += guess
        return value

    def _propose(self, level, p, now, best):
        """Gains times p and scores of ``shares``; the best by them, and its price."""
        designs = self.designs
        outcomes = self.outcomes
        sums = cython.address(self.sums[level, 0])
        gains = cython.address(self.gains[level, 0])
        scores = cython.address(self.scores[level, 0])
        seconds = cython.address(self.seconds[level, 0])
        needs = cython.address(self.needs[level, 0])
        travel = cython.address(self.travel[now.place, 0])
        open = cython.address(self.open[level, 0])
        hints = cython.address(self.hints[min(now.made, self.hints.shape[0] - 1), 0])
        share: cython.float = 1.0 / p
        tiny: cython.float = 1e-12
        nothing: cython.float = 1e-9
        zero: cython.float = 0.0
        one: cython.float = 1.0
        closed: cython.float = 1e9
        # One array is written in each loop: more, and the compiler doubts that they are
        # apart.
        self._open(level, now)
        for a in range(designs):
            gains[a] = sums[(outcomes - 1) * designs + a]
        for a in range(designs):
            scores[a] = p
        for a in range(designs):
            seconds[a] = zero
        for a in range(designs):
            needs[a] = zero
        for y in range(outcomes - 1):
            for a in range(designs):
                scores[a] -= sums[y * designs + a]
        for y in range(outcomes):
            chances = sums + (y - 1) * designs if y else scores
            extra = cython.address(self.extra[y, 0])
            uses = cython.address(self.uses[y, 0])
            for a in range(designs):
                q = chances[a] if chances[a] > tiny else tiny
                gains[a] -= q * _log(q * share)
            for a in range(designs):
                seconds[a] += chances[a] * extra[a]
            for a in range(designs):
                needs[a] += chances[a] * uses[a]
        for a in range(designs):
            gains[a] = gains[a] if gains[a] > zero else zero
        for a in range(designs):
            s = travel[a] + seconds[a] * share
            seconds[a] = s if s > nothing else nothing
        for a in range(designs):
            scores[a] = open[a] * (gains[a] * share + nothing) / seconds[a]
        for a in range(designs):
            needs[a] = needs[a] * share + closed * (one - open[a])
        always = -_largest(needs, designs, -1.0)
        e: cython.int = max(now.uses, 1)
        n: cython.double = fmax(self.horizon - now.made, 1.0)
        n = fmin(n, fmax(now.uses / fmax(always, 1e-6), 1.0))
        seconds_each: cython.double = seconds[_argmax(scores, designs)]
        limited: cython.bint = now.seconds < 1e30
        t: cython.double = fmax(now.seconds, 1e-9) if limited else n * seconds_each
        number = fmin(n, fmax(t / seconds_each, 0.1))
        use: cython.float = self.use_of[min(e, _USES) - 1] * expf(self.a * _log(number))
        last: cython.float = e
        time: cython.float = (self.time if limited else self.haste) / t
        end: cython.float = t
        fixed: cython.float = 1.0 / n
        least: cython.float = nothing * p
        for a in range(designs):
            s = seconds[a] if seconds[a] < end else end
            u = needs[a] - always
            u = u if u < last else last
            price = fixed + time * s + use * u
            scores[a] = open[a] * hints[a] * (gains[a] + least) / price
        self.work += _EACH * self.wide + _NODE
        best[0] = _argmax(scores, designs)
        return (gains[best[0]] + least) / fmax(scores[best[0]], 1e-30)

    def _open(self, level, now):
        """Which designs are paid for by what is left, whatever comes."""
        travel = cython.address(self.travel[now.place, 0])
        most_extra = cython.address(self.most_extra[0])
        most_uses = cython.address(self.most_uses[0])
        open = cython.address(self.open[level, 0])
        zero: cython.float = 0.0
        one: cython.float = 1.0
        rounding: cython.float = 0.9999  # as ``session.pays``
        seconds_left: cython.float = now.seconds
        uses_left: cython.float = now.uses
        for a in range(self.designs):
            cost = rounding * (travel[a] + most_extra[a])
            open[a] = one if cost <= seconds_left else zero
        for a in range(self.designs):
            open[a] = open[a] if most_uses[a] <= uses_left else zero

    def _follow(self, level, p, a, now, entropy):
        """p times the nats that are gained after a measurement."""
        designs = self.designs
        outcomes = self.outcomes
        wide = self.wide
        then = level + 1
        came = cython.address(self.which[level, 0])
        which = cython.address(self.which[then, 0])
        before = cython.address(self.weights[level, 0])
        weights = cython.address(self.weights[then, 0])
        mine = cython.address(self.sums[level, 0])
        sums = cython.address(self.sums[then, 0])
        rest = cython.address(self.rest[level, 0])
        best: cython.int = 0
        total: cython.double = 0.0
        mass: cython.float = p
        after = cython.declare(State)
        after.made = now.made + 1
        for r in range(wide):
            rest[r] = mine[r]
        for y in range(1, outcomes + 1):
            q: cython.float = mass
            if y < outcomes:
                q = mine[(y - 1) * designs + a]
                mass -= q
            if q < _NO_CHANCE * p:
                continue
            z = y % outcomes
            after.seconds = now.seconds - self.travel[now.place, a] - self.extra[z, a]
            after.uses = now.uses - cython.cast(cython.int, self.uses[z, a])
            going: cython.bint = after.seconds > 0.0 and after.uses > 0
            going = going and after.made < self.horizon
            if y == outcomes:
                if not going:
                    break
                for r in range(wide):
                    sums[r] = rest[r]
            if y < outcomes or self.width[then] > 0:
                like = cython.address(self.likelihood[a, z, 0])
                least: cython.float = q * self.cut
                n: cython.int = 0
                for i in range(self.likely[level]):
                    w = before[i] * like[came[i]]
                    weights[n] = w
                    which[n] = came[i]
                    n += w > least
                self.likely[then] = n
            if y < outcomes:
                self._sum(then)
                for r in range(wide):
                    rest[r] -= sums[r]
            if going:
                after.place = self.place_after[a, z]
                total += self._value(then, q, after, entropy, cython.address(best))
        return total
