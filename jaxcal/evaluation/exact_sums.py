"""Sums of floats without rounding, which therefore do not depend on their order.

A float64 is a whole number times a power of two, so a sum of them is one too; only the
last step, to a float, rounds. Partial sums made anywhere add up to the same total.
"""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["ExactSum", "exact_sum"]

_DIGITS = 53  # bits of a float64's mantissa
_LOW = 27  # bits of its lower half: 2**36 halves fit into 64 bits


@dataclasses.dataclass(frozen=True)
class ExactSum:
    """``mantissa * 2**exponent``, the mantissa odd or zero."""

    mantissa: int = 0
    exponent: int = 0

    def __add__(self, other: ExactSum) -> ExactSum:
        """The exact sum of both."""
        exponent = min(self.exponent, other.exponent)
        return _reduced(
            (self.mantissa << (self.exponent - exponent))
            + (other.mantissa << (other.exponent - exponent)),
            exponent,
        )

    def fraction(self) -> Fraction:
        """The value, for further exact arithmetic."""
        return Fraction(self.mantissa) * Fraction(2) ** self.exponent


def exact_sum(values: ArrayLike) -> ExactSum:
    """The exact sum of finite floats of any shape.

    Raises:
        ValueError: one of them is infinite or not a number.
    """
    array = np.asarray(values, np.float64).ravel()
    if not np.isfinite(array).all():
        raise ValueError("values must be finite to be summed exactly")
    mantissas, exponents = np.frexp(array)
    whole = (mantissas * 2.0**_DIGITS).astype(np.int64)
    levels, level = np.unique(exponents, return_inverse=True)
    high = np.zeros(len(levels), np.int64)
    low = np.zeros(len(levels), np.int64)
    np.add.at(high, level, whole >> _LOW)
    np.add.at(low, level, whole & ((1 << _LOW) - 1))
    total = ExactSum()
    for exponent, upper, lower in zip(
        levels.tolist(), high.tolist(), low.tolist(), strict=True
    ):
        total += _reduced((upper << _LOW) + lower, exponent - _DIGITS)
    return total


def _reduced(mantissa: int, exponent: int) -> ExactSum:
    """Without trailing zero bits, so that equal sums are equal objects."""
    if mantissa == 0:
        return ExactSum()
    zeros = (mantissa & -mantissa).bit_length() - 1
    return ExactSum(mantissa >> zeros, exponent + zeros)
