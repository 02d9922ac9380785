"""Joint ranges, and the normalised coordinates in them.

Selection by D-optimality does not depend on the unit (an affine map multiplies det S
of every subset by one constant), so postures may stay in degrees; ``normalise`` is for
the paper's [0, 1] inputs.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from jaxcal.checks import Array, in_words, numbers

__all__ = ["JointRanges"]


class JointRanges:
    """Least and greatest command of each axis: ``low`` (n,), ``high`` and ``span``."""

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        self.low, self.high = numbers("low", low), numbers("high", high)
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise ValueError(
                "low and high must hold one number for each axis, got shapes "
                f"{self.low.shape} and {self.high.shape}"
            )
        if not (self.low < self.high).all():
            raise ValueError(
                f"low must be below high on every axis, got {in_words(self.low)} and "
                f"{in_words(self.high)}"
            )
        self.span = self.high - self.low

    def normalise(self, commands: ArrayLike) -> Array:
        """(..., n) commands with the ranges mapped onto [0, 1]."""
        return (numbers("commands", commands) - self.low) / self.span

    def denormalise(self, unit_commands: ArrayLike) -> Array:
        """(..., n) the inverse of ``normalise``."""
        return self.low + numbers("commands", unit_commands) * self.span
