"""Breakaway: the largest step from rest at which a joint does not move, either way.

Friction holds a joint at rest until its drive is so far away that it yields; then it
follows. A test is a step from rest in a direction, and tells whether the joint moved.
What a test says of one direction says nothing of the other, so that the belief is a
histogram for each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from rig.readings.attitude import Array

OUTLIERS = 1e-3  # share of tests that carry no information


class Estimate(NamedTuple):
    """A mean and an interval, degrees."""

    mean: float
    low: float
    high: float

    @property
    def width(self) -> float:
        """Width of the interval."""
        return self.high - self.low


class Breakaway:
    """Two thresholds, up and down, by tests from rest."""

    def __init__(
        self, cell_deg: float, cells: int, sigma_deg: float, spread_deg: float
    ) -> None:
        """A uniform belief of ``cells`` of this size for each direction.

        ``sigma_deg``: noise of the difference of the readings before and after a step;
        ``spread_deg``: standard deviation of a threshold from one test to the next.
        """
        self.centres = (np.arange(cells) + 0.5) * cell_deg
        self.edges = np.arange(cells + 1) * cell_deg
        self.steps = np.arange(1, cells) * cell_deg  # (S,) that may be tried
        self.weights = np.full((2, cells), 1.0 / cells)  # up, down
        yields = special.ndtr((self.steps[:, None] - self.centres) / spread_deg)
        misread = special.ndtr(-self.steps / (2.0 * sigma_deg))[:, None]
        moved = misread + (1.0 - 2.0 * misread) * yields
        # (S, cells) probability that a step is seen to move the joint.
        self.moved = OUTLIERS / 2.0 + (1.0 - OUTLIERS) * moved

    def propose(self, limit_deg: float, risk: float) -> tuple[int, int]:
        """Direction, 0 up or 1 down, and number of the step that tells most.

        Of the steps whose probability to exceed the threshold by more than
        ``limit_deg`` is at most ``risk``; where there is none, of the least risky.
        """
        past = self.steps[:, None] - self.centres > limit_deg
        risks = self.weights @ past.T  # (2, S)
        chances = self.weights @ self.moved.T
        unsure = self.weights @ _entropy(self.moved).T
        gains = _entropy(chances) - unsure
        safe = risks <= max(risk, risks.min() + 1e-6)
        direction, number = np.unravel_index(
            np.where(safe, gains, -np.inf).argmax(), gains.shape
        )
        return int(direction), int(number)

    def saw(self, direction: int, number: int, moved: bool) -> None:
        """A step in a direction moved the joint, or did not."""
        told = self.moved[number] if moved else 1.0 - self.moved[number]
        self.weights[direction] *= told
        self.weights[direction] /= self.weights[direction].sum()

    def estimate(self, direction: int, level: float) -> Estimate:
        """Mean and equal-tailed interval of a threshold, uniform within each cell."""
        mass = self.weights[direction]
        below = np.concatenate([[0.0], np.cumsum(mass)])
        low, high = np.interp([0.5 - level / 2, 0.5 + level / 2], below, self.edges)
        return Estimate(float(mass @ self.centres), float(low), float(high))


def _entropy(probability: Array) -> Array:
    """Nats of an outcome that has this probability, or not."""
    return special.entr(probability) + special.entr(1.0 - probability)
