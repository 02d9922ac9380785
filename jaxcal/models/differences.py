"""Derivatives by finite differences with steps chosen from the noise of f.

Noise: what higher differences leave of the values at seven points so close together
that f is a polynomial there. Values of few digits were printed: the unit of the last
one is noise. Step: derivatives of fourth order at steps halved until noise is all that
changes them; taken is the one where the change from one step to the next and what noise
does to it are least together, or the shortest where both are below 1e-8, which meets
the fewest kinks. Parameters that may go to one side only, as a friction of zero, get
differences to that side.

Sources: Moré and Wild, Estimating computational noise, 2011; Ridders, 1982.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from decimal import Decimal
from typing import NamedTuple

import numpy as np

from jaxcal.checks import Array, aligned
from jaxcal.models.model import within_half

Evaluate = Callable[[Array], Array]  # points (S, p) -> values (S, N, q), NaN: refused

_FIRST, _RUNGS = 0.25, 22  # of the scale, the largest step; halvings tried
_EXACT = 1e-8  # share of a derivative: errors below it are as good as none
_POINTS, _CLOSE = 7, (1e-7, 1e-5, 1e-3, 1e-2)  # of the noise; of the scale, distances
_DIGITS = 12  # significant ones, up to which all readings show that they were printed
_FAR = -4  # halvings of the largest step of an f whose noise is seen
_SEEN = 1e-11  # of a reading, noise that is not rounding
_JUMP = 4.0  # of the noise, that the largest of many changes may be
_TWICE = 2.0  # standard deviations of noise that are stated as an error
_EPS = float(np.finfo(np.float64).eps)


class Stencil(NamedTuple):
    """Where f is asked, in steps, and what makes a derivative of the values."""

    offsets: Array  # (4,)
    fine: Array  # (4,) weights of the derivative times the step
    coarse: Array  # (4,) of a lower order, to see by how much they differ

    @property
    def amplifies(self) -> float:
        """Noise of f, by the step."""
        return float(np.sqrt((self.fine**2).sum()))


_FORWARD = np.array(
    [[0.0, 0.25, 0.5, 1.0], [-7.0, 32 / 3, -4.0, 1 / 3], [-6.0, 8.0, -2.0, 0.0]]
)
_CENTRAL = np.array(
    [[1.0, 0.5, -0.5, -1.0], [-1 / 6, 4 / 3, -4 / 3, 1 / 6], [0.0, 1.0, -1.0, 0.0]]
)
STENCILS = {
    "central": Stencil(*_CENTRAL),
    "forward": Stencil(*_FORWARD),
    "backward": Stencil(*-_FORWARD),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Differences:
    """The steps that were chosen; printed, a table of them and of their errors."""

    names: tuple[str, ...]  # p
    steps: Array  # (p,)
    sides: tuple[str, ...]  # p, of ``STENCILS``
    errors: Array  # (p,) of the derivatives, as a share of them
    noise: Array  # (q,) standard deviation of f itself, in the readings' units
    size: Array  # (q,) largest reading seen, beside which the noise is one

    @property
    def error(self) -> float:
        """The largest of ``errors`` of a parameter that has an effect."""
        return float(np.nanmax(self.errors, initial=0.0))

    def rounding(self) -> Array:
        """(q, p) below which a derivative is the noise of f."""
        size = [STENCILS[side].amplifies for side in self.sides]
        return np.asarray(4.0 * self.noise[:, None] * size / self.steps)

    def __str__(self) -> str:
        rows = [("parameter", "step", "side", "error")]
        for name, step, side, error in zip(
            self.names, self.steps, self.sides, self.errors, strict=True
        ):
            shown = "no effect" if np.isnan(error) else f"{error:.1e}"
            rows.append((name, f"{step:.3g}", side, shown))
        share = float((self.noise / np.where(self.size > 0, self.size, 1.0)).max())
        return "\n".join(
            [*aligned(rows, "<"), f"noise of f: {share:.1e} of its readings (relative)"]
        )


def combined(values: Array, weights: Array, periods: Array | None) -> Array:
    """(..., ...) sums of weights (..., 4), which add up to 0, times values (4, ...)."""
    return np.tensordot(weights, within_half(values - values[:1], periods), 1)


def look(
    evaluate: Evaluate,
    at: Array,
    scale: Array,
    names: Sequence[str],
    periods: Array | None = None,
) -> Differences:
    """Choose steps for derivatives at ``at`` (p,), where values are finite. ``scale``
    (p,) is by which the parameters may change, ``periods`` (q,) of readings that
    wrap."""
    noise, size = _noise(evaluate, at, scale, periods)
    ladders = [
        _Ladder(evaluate, at, scale, j, periods, noise, size) for j in range(len(at))
    ]
    effects = [ladder.effect for ladder in ladders]
    largest = np.max(effects, axis=0, initial=0.0)  # (q,) by a change of the scale
    weights = 1.0 / np.where(largest > 0.0, largest, 1.0)
    chosen = [ladder.chosen(weights) for ladder in ladders]
    steps, sides, errors = zip(*chosen, strict=True)
    return Differences(
        tuple(names), np.array(steps), sides, np.array(errors), noise, size
    )


def _noise(
    evaluate: Evaluate, at: Array, scale: Array, periods: Array | None
) -> tuple[Array, Array]:
    """(q,) standard deviation of f's noise, and the largest reading. Where most of an
    output's values are alike, as those of a program that prints six digits, points that
    are farther apart say more."""
    least = 64.0 * _EPS * np.abs(at)
    along = np.where(np.arange(len(at)) % 2, -1.0, 1.0)
    noise = size = np.zeros(0)
    seen: list[Array] = []
    for close in _CLOSE:
        step = np.maximum(close * scale, least) * along
        points = at + np.arange(_POINTS)[:, None] * step
        values = evaluate(points)
        if not np.isfinite(values).all():  # at the edge of what f takes
            values = evaluate(at - np.arange(_POINTS)[:, None] * step)
        values = values[:, np.isfinite(values).all(axis=(0, 2))]
        seen.append(values.reshape(-1, values.shape[-1]))
        off = within_half(values - values[:1], periods)
        moves = (np.diff(off, axis=0) != 0.0).mean(axis=(0, 1)) if off.size else 1.0
        new = _of_differences(off)
        if not len(noise):
            noise, settled = new, np.zeros(len(new), dtype=np.bool_)
            size = np.abs(values).max(axis=(0, 1), initial=0.0)
        noise = np.where(settled, noise, new)
        settled = settled | (moves > 0.5)
        if settled.all():
            break
    quantum = _printed(np.concatenate(seen))
    return np.maximum(
        np.maximum(noise, quantum / math.sqrt(12.0)), 0.25 * _EPS * size
    ), size


def _of_differences(off: Array) -> Array:
    """(q,) noise of values (7, N, q) at points in a row, by their differences."""
    levels, table = [], off
    for k in range(1, _POINTS):
        table = np.diff(table, axis=0)
        factor = math.factorial(k) ** 2 / math.factorial(2 * k)
        square = (table**2).mean(axis=(0, 1)) if table.size else np.zeros(off.shape[2])
        levels.append(np.sqrt(factor * square))
    by_order = np.array(levels)  # (6, q)
    noise = by_order[-1]
    for k in range(len(by_order) - 3, 0, -1):  # the first three that are alike
        near = by_order[k : k + 3]
        noise = np.where(near.max(axis=0) <= 4.0 * near.min(axis=0), near[0], noise)
    return noise


def _printed(values: Array) -> Array:
    """(q,) unit of the last digit of values (R, q) that were printed, else 0. Of the
    largest value; both significant digits and decimals are counted."""
    units = np.zeros(values.shape[1])
    for q, column in enumerate(values.T):
        shown = np.unique(np.abs(column[column != 0.0]))
        if len(shown) < 2:  # a constant shows nothing
            continue
        printed = [Decimal(repr(x)).normalize().as_tuple() for x in shown.tolist()]
        most = max(len(x.digits) for x in printed)
        if most > _DIGITS:
            continue
        top = math.floor(math.log10(shown[-1]))
        units[q] = 10.0 ** max(top + 1 - most, min(int(x.exponent) for x in printed))
    return units


class _Ladder:
    """Derivatives by one parameter at steps halved from the largest on."""

    def __init__(
        self,
        evaluate: Evaluate,
        at: Array,
        scale: Array,
        j: int,
        periods: Array | None,
        noise: Array,
        size: Array,
    ) -> None:
        self.scale, self.noise = float(scale[j]), noise
        least = 1e4 * _EPS * abs(at[j])
        self.side, self.rungs = "", []
        # Rounded values jump where steps are short: the longest say most.
        self.noisy = bool((noise > _SEEN * size).any())
        first, most = (_FAR, _JUMP) if self.noisy else (0, 1.0)
        values: dict[float, Array] = {}
        for side, stencil in STENCILS.items():
            rungs: list[tuple[float, Array]] = []
            for i in range(first, _RUNGS):
                step = _FIRST * self.scale * 2.0**-i
                if step < least and rungs:
                    break
                steps = [o * step for o in stencil.offsets.tolist()]
                new = [o for o in steps if o not in values]
                points = np.tile(at, (len(new), 1))
                points[:, j] += new
                if new:
                    values |= dict(zip(new, evaluate(points), strict=True))
                stack = np.array([values[o] for o in steps])
                slope = combined(stack, stencil.fine, periods) / step
                if not np.isfinite(slope).all():
                    continue
                rungs.append((step, slope))
                if len(rungs) > 1:
                    change = np.abs(rungs[-1][1] - rungs[-2][1]).max(axis=0)
                    if (change <= most * stencil.amplifies * noise / step).all():
                        break  # noise is all that changes
            if len(rungs) > 1:
                self.side, self.rungs = side, rungs
                return
        if not self.rungs:
            self.side = "central"

    @property
    def effect(self) -> Array:
        """(q,) of a change of the scale."""
        if not self.rungs:
            return np.zeros_like(self.noise)
        return np.asarray(np.abs(self._surest).max(axis=0) * self.scale)

    @property
    def _surest(self) -> Array:
        """(N, q) the derivative at the shortest step, of a noisy f at the longest."""
        return self.rungs[0 if self.noisy else -1][1]

    def chosen(self, weights: Array) -> tuple[float, str, float]:
        """Step, side, and error as a share of the derivative (NaN: no effect)."""
        if not self.rungs:
            return 1e-3 * self.scale, self.side, np.inf
        amplifies = STENCILS[self.side].amplifies
        size = float(np.sqrt(((self._surest * weights) ** 2).mean()))
        best = (np.inf, *self.rungs[0])
        for (step, slope), (_, finer) in zip(self.rungs, self.rungs[1:], strict=False):
            change = float(np.sqrt((((slope - finer) * weights) ** 2).mean()))
            of_noise = float(np.sqrt(((self.noise * weights) ** 2).mean()))
            error = change + _TWICE * amplifies * of_noise / step
            if error < max(best[0], _EXACT * size):
                best = (error, step, slope)
        error, step, slope = best
        size = float(np.sqrt(((slope * weights) ** 2).mean()))
        if not size or not (np.abs(slope) > 4.0 * amplifies * self.noise / step).any():
            return step, self.side, np.nan
        return step, self.side, error / size
