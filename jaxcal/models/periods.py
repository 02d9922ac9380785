"""Readings that wrap, as an angle does at 180 degrees."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, one_or_each, require_none


def within_half(off: Array, periods: ArrayLike | None) -> Array:
    """(..., q) differences, those of readings that wrap within half a period (q,)."""
    if periods is None:
        return off
    wraps = np.isfinite(periods)
    whole = np.where(wraps, periods, 1.0)
    return np.asarray(np.where(wraps, off - whole * np.round(off / whole), off))


def checked_periods(periods: ArrayLike, count: int) -> Array:
    """(q,) positive numbers, one for all or one each, inf of what does not wrap."""
    given = one_or_each("periods", periods, count)
    require_none(~(given > 0.0), given, "periods must be positive (inf: does not wrap)")
    return given
