"""Tests of readings for a change, by levels of noise, and the power of these tests."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.fit import Fit
from jaxcal.checks import Array

ALARMS = 0.05  # share of false alarms
POWER = 0.8
KNOWN = 1e9  # degrees of freedom of noise that was given
_RATIOS = 16  # quantiles of how far noise that was estimated is off
_HALVINGS = 26  # of a search for the smallest change


@dataclasses.dataclass(frozen=True)
class LevelTests:
    """An F test of whitened readings for each of G levels of noise (chi-square where it
    is known), of which the least p-value counts, by Sidak; and their power."""

    counts: NDArray[np.intp]  # (G,) readings of each level
    dof: float  # of the noise of a level
    least: float = 1.0  # mean square of a reading without a change; 1 in the test
    alarms: float = ALARMS  # share of false alarms

    def p_value(self, squares: Array) -> float:
        """Chance of sums (G,) of squared readings at least this large, unchanged."""
        from scipy import special

        of_levels = special.fdtrc(self.counts, self.dof, squares / self.counts)
        return float(-np.expm1(len(self.counts) * special.log1p(-of_levels.min())))

    def power(self, shifts: Array) -> Array:
        """(...,) chance that changes with noncentralities (..., G) are seen. The
        squared estimate of a noise over the true variance is a chi-square / dof."""
        from scipy import special

        alarms = -np.expm1(np.log1p(-self.alarms) / len(self.counts))  # of each level
        limit = special.fdtri(self.counts, self.dof, 1.0 - alarms) / self.least
        ratio = np.ones(1)
        if self.dof < KNOWN:
            chance = (np.arange(_RATIOS) + 0.5) / _RATIOS
            ratio = special.gammaincinv(self.dof / 2.0, chance) * 2.0 / self.dof
        shifts = np.asarray(shifts) / self.least
        counts, limit = (np.broadcast_to(v, shifts.shape) for v in (self.counts, limit))
        missed = np.full(shifts.shape, 1.0 - alarms)
        moved = (shifts > 0.0) | (self.least != 1.0)
        of_ratios = special.chndtr(
            (limit * counts)[moved, None] * ratio,
            counts[moved, None],
            shifts[moved, None] * ratio,
        )
        missed[moved] = np.nan_to_num(of_ratios, nan=0.0).mean(axis=-1)  # too large
        return np.asarray(1.0 - missed.prod(axis=-1))

    def smallest(self, seen: Array) -> Array:
        """(p,) changes that are seen with the power asked for, inf where none is, by
        noncentralities ``seen`` (p, G) of a change by one."""
        total = seen.sum(axis=1, keepdims=True)
        shares = np.divide(seen, total, out=np.ones_like(seen), where=total > 0.0)
        shares, of_share = np.unique(shares.round(12), axis=0, return_inverse=True)
        low, high = np.zeros((2, len(shares), 1))
        high += 1.0
        while (
            short := (self.power(high * shares) < POWER)[:, None] & (high < 1e12)
        ).any():
            low, high = np.where(short, high, low), np.where(short, 4.0 * high, high)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            short = (self.power(middle * shares) < POWER)[:, None]
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        with np.errstate(divide="ignore"):
            return np.asarray(np.sqrt(high[of_share.ravel()] / total)[:, 0])


class ChangeTests:
    """A test of all readings, and one of each slip, the largest of which counts; each
    kind has half of the false alarms."""

    def __init__(
        self, counts: NDArray[np.intp], calibration: Fit, slips: int, least: float = 1.0
    ) -> None:
        half = -np.expm1(np.log1p(-ALARMS) / 2.0)
        dof, one = calibration.noise_dof or KNOWN, np.ones(1, dtype=np.intp)
        of_each = -np.expm1(np.log1p(-half) / max(1, slips))
        self.whole = LevelTests(counts, dof, least, half if slips else ALARMS)
        self.slip = LevelTests(one, dof, least, of_each)
        self.count = slips

    def p_values(self, squares: Array, of_slips: Array) -> tuple[float, float]:
        """Chances of both kinds and of slips alone, by sums (G,), squares (S,)."""
        whole = self.whole.p_value(squares)
        if not self.count:
            return whole, 1.0
        of_one = self.slip.p_value(of_slips.max(keepdims=True))
        of_any = 1.0 - (1.0 - of_one) ** self.count
        return 1.0 - (1.0 - min(whole, of_any)) ** 2, 1.0 - (1.0 - of_any) ** 2

    def power(self, shifts: Array, along: Array) -> Array:
        """(...,) at least, of noncentralities (..., G) in all, (...,) along a slip."""
        whole = self.whole.power(shifts)
        if not self.count:
            return whole
        return np.maximum(whole, self.slip.power(along[..., None]))

    def smallest(self, seen: Array, along: Array) -> Array:
        """(p,) changes that are seen with the power asked for, by either."""
        whole = self.whole.smallest(seen)
        if not self.count:
            return whole
        return np.minimum(whole, self.slip.smallest(along[:, None]))
