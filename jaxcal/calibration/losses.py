"""How much a measurement counts that lies far from the fit: the losses of ``identify``.

Iteratively reweighted least squares needs of a loss its weight of a measurement and
the slope of that. A loss of one's own is a class here and a row in ``LOSSES``. At the
fit its weight is one, so that where no residual is large the fit is least squares'.

Source: Lange, Little and Taylor, 1989 (Student).
"""

from __future__ import annotations

import functools

import numpy as np

from jaxcal.checks import Array


class Loss:
    """Student's distribution: outliers count little, all others nearly in full."""

    degrees_of_freedom = 4.0

    def weight(self, square: Array, q: int) -> Array:
        """(N,) of measurements of q readings, at squared distances (N,) in noise."""
        size = self.degrees_of_freedom + q
        return np.asarray(size / (size + square))

    def slope(self, square: Array, q: int) -> Array:
        """(N,) derivative of the weight by the squared distance."""
        size = self.degrees_of_freedom + q
        return np.asarray(-size / (size + square) ** 2)


@functools.lru_cache
def constants(loss: Loss, q: int) -> tuple[float, float, float]:
    """What a loss does where the noise of q readings is normal.

    Returns:
        Mean weighted squared residual of a reading of unit noise; mean weight;
        efficiency relative to least squares.
    """
    from scipy import linalg

    # Golub and Welsch: Gauss-Laguerre nodes, whatever q is (gamma(q / 2) overflows).
    index, order = np.arange(60.0), q / 2.0 - 1.0
    beside = np.sqrt(index[1:] * (index[1:] + order))
    node, vectors = linalg.eigh_tridiagonal(2.0 * index + 1.0 + order, beside)
    share, square = vectors[0] ** 2, 2.0 * node
    weight = loss.weight(square, q)
    slope = share @ (weight + 2.0 * square * loss.slope(square, q) / q)
    efficiency = slope**2 / (share @ (weight**2 * square) / q)
    return float(share @ (weight * square) / q), float(share @ weight), efficiency


LOSSES: dict[str, Loss | None] = {"student": Loss(), "gaussian": None}
"""The losses by name; None is least squares."""
