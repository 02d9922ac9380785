"""Mean and credible interval of each unknown, from a belief."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxcal.adaptive.particles import ParticleBelief

__all__ = ["Estimate", "estimates"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One unknown."""

    mean: float
    low: float
    high: float

    @property
    def width(self) -> float:
        """Width of the interval."""
        return self.high - self.low


def estimates(task: Any, belief: Any, level: float = 0.95) -> dict[str, Estimate]:
    """Mean and equal-tailed interval of each unknown, by name.

    On a grid each value of theta stands for a cell that ends half way to the next
    value, with a uniform density. Of a ``ParticleTask`` the model must have ``names``
    of its unknowns, as one made by ``ParticleTask.of`` has.

    Args:
        task: whose unknowns they are.
        belief: after some measurements.
        level: probability that the unknown lies in the interval.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), got {level:g}")
    tails = (0.5 - level / 2.0, 0.5 + level / 2.0)
    if isinstance(belief, ParticleBelief):
        return _of_particles(belief, tails)
    weights = np.asarray(belief.weights, np.float64)
    columns = np.asarray(task.theta, np.float64).T
    return {
        name: _of_cells(values, weights, tails)
        for name, values in zip(task.theta_names, columns, strict=True)
    }


def _of_cells(values: Array, weights: Array, tails: tuple[float, float]) -> Estimate:
    cells, cell = np.unique(values, return_inverse=True)
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
    low, high = np.interp(tails, below, edges)
    return Estimate(float(mass @ cells), float(low), float(high))


def _of_particles(
    belief: ParticleBelief, tails: tuple[float, float]
) -> dict[str, Estimate]:
    names = getattr(belief.model, "names", None)
    if names is None:
        raise ValueError("the task's model must have names of its unknowns")
    unknowns = np.asarray(jax.vmap(belief.model.unknowns)(belief.z), np.float64)
    weights = np.exp(np.asarray(belief.log_weight, np.float64))
    weights /= weights.sum()
    estimate_of = {}
    for name, values in zip(names, unknowns.T, strict=True):
        order = np.argsort(values)
        # Half of a particle's weight lies below it.
        below = np.cumsum(weights[order]) - weights[order] / 2.0
        low, high = np.interp(tails, below, values[order])
        estimate_of[name] = Estimate(float(weights @ values), float(low), float(high))
    return estimate_of
