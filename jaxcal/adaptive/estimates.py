"""Mean and credible interval of each unknown, from a belief on a grid."""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxcal.adaptive.grid import GridBelief, GridTask

__all__ = ["Estimate", "estimates"]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One unknown."""

    mean: float
    low: float
    high: float

    @property
    def width(self) -> float:
        """Of the interval."""
        return self.high - self.low


def estimates(
    task: GridTask, belief: GridBelief, level: float = 0.95
) -> dict[str, Estimate]:
    """Mean and equal-tailed interval of each unknown, by name.

    Each value of theta stands for a cell that ends half way to the next value, with a
    uniform density.

    Args:
        task: whose theta it is about.
        belief: after some measurements.
        level: probability that the unknown lies in the interval.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), got {level:g}")
    weights = np.asarray(belief.weights, np.float64)
    tails = (0.5 - level / 2.0, 0.5 + level / 2.0)
    found = {}
    for name, values in zip(task.theta_names, np.asarray(task.theta).T, strict=True):
        cells, cell = np.unique(values.astype(np.float64), return_inverse=True)
        mass = np.bincount(cell, weights=weights) / weights.sum()
        middle = (cells[1:] + cells[:-1]) / 2.0
        first, last = (
            (2.0 * cells[0] - middle[0], 2.0 * cells[-1] - middle[-1])
            if len(cells) > 1
            else (cells[0], cells[0])
        )
        edges = np.concatenate([[first], middle, [last]])
        below = np.concatenate([[0.0], np.cumsum(mass)])
        # Quantiles of the piecewise linear distribution function.
        low = float(np.interp(tails[0], below, edges))
        high = float(np.interp(tails[1], below, edges))
        found[name] = Estimate(float(mass @ cells), low, high)
    return found
