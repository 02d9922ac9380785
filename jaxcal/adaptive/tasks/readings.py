"""Readings of an instrument as the few outcomes of a grid task: bins."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from jaxcal.checks import whole_number

__all__ = ["Bins"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Bins:
    """``count`` equal bins from ``low`` to ``high``; the outer two are unbounded."""

    low: float
    high: float
    count: int

    def __post_init__(self) -> None:
        whole_number("bins", self.count, 2)
        if not self.low < self.high:
            raise ValueError(
                f"bins must have low under high, got {self.low:g} and {self.high:g}"
            )

    @property
    def edges(self) -> Array:
        """(count - 1,) between neighbours."""
        return np.linspace(self.low, self.high, self.count + 1)[1:-1]

    def outcome(self, reading: float) -> int:
        """The bin of a reading."""
        return int(np.searchsorted(self.edges, reading, side="right"))

    def likelihood(self, mean: ArrayLike, sigma: float, outliers: float = 0.0) -> Array:
        """(A, count, S) probability of each bin, integrated over it.

        Args:
            mean: (A, S) readings without noise.
            sigma: standard deviation of the normal noise.
            outliers: share of readings that fall into every bin with equal probability.
        """
        if not sigma > 0.0:
            raise ValueError(f"sigma must be above 0, got {sigma:g}")
        if not 0.0 <= outliers < 1.0:
            raise ValueError(f"outliers must be in [0, 1), got {outliers:g}")
        below = special.ndtr(
            (self.edges[None, :, None] - np.asarray(mean)[:, None]) / sigma
        )
        inside = np.diff(below, axis=1, prepend=0.0, append=1.0)
        return outliers / self.count + (1.0 - outliers) * inside
