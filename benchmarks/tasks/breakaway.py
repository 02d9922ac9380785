"""Breakaway: the largest step from rest at which a joint does not move.

Friction holds a joint at rest until its drive is so far away that it yields; then it
follows. A test is a step from rest in a direction, and tells whether the joint moved.
A joint that moves goes past the threshold, and ``Cautious`` limits by how far: it
raises the steps from below, and bisects only where that keeps within the limit.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy import special

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.rules import best
from jaxcal.adaptive.session import Options, Session
from jaxcal.adaptive.tasks.registry import Entry

__all__ = ["ENTRY", "Cautious", "breakaway"]


def breakaway(
    max_step: float = 0.64,
    cells: int = 64,
    directions: int = 2,
    *,
    sigma: float = 0.005,
    spread: float = 0.004,
    outliers: float = 1e-3,
    measurements: int = 40,
    seconds: float | tuple[float, float] = np.inf,
    test_s: float = 1.0,
    return_s: float = 2.0,
) -> GridTask:
    """The task: theta = (up, down) thresholds, design = (step, direction).

    Outcome 1 is a joint that moved: a reading nearer to the step than to none.

    Args:
        max_step: thresholds lie at the centres of equal cells from 0 to here.
        cells: of each direction.
        directions: 2, or 1 for up alone.
        sigma: noise of the difference of the readings before and after a step.
        spread: standard deviation of the threshold from one test to the next.
        outliers: share of tests that carry no information.
        measurements: that end a session.
        seconds: budget of a session, or (least, most) to draw it from.
        test_s: seconds of a test.
        return_s: seconds more until a joint that moved is back at rest.
    """
    if directions not in (1, 2):
        raise ValueError(f"directions must be 1 or 2, got {directions}")
    centres = (np.arange(cells) + 0.5) * max_step / cells
    theta = np.stack(np.meshgrid(*[centres] * directions, indexing="ij"), axis=-1)
    theta = theta.reshape(-1, directions)
    steps = np.arange(1, cells) * max_step / cells
    side = np.repeat(np.arange(directions), len(steps))
    u = np.tile(steps, directions)
    yields = special.ndtr((u[:, None] - theta[:, side].T) / spread)
    misread = special.ndtr(-u / (2.0 * sigma))[:, None]
    moved = misread + (1.0 - 2.0 * misread) * yields
    moved = outliers / 2.0 + (1.0 - outliers) * moved
    return GridTask.make(
        theta,
        np.column_stack([u, 1.0 - 2.0 * side]),
        np.stack([1.0 - moved, moved], axis=1),
        groups=side,
        travel=test_s,
        extra=[0.0, return_s],
        uses=1,
        num_uses=measurements,
        seconds=seconds,
        horizon=measurements,
        theta_names=["up", "down"][:directions],
    )


@struct.dataclass
class Cautious:
    """The largest expected gain among steps unlikely to go far past a threshold.

    The probability that the step exceeds the threshold by more than ``limit`` is at
    most ``risk``; where every step is riskier, it is the least risky ones.
    """

    limit: Any = 0.1
    risk: Any = 0.05

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        step = task.designs[:, :1]
        past = step - task.theta[:, task.groups].T > self.limit
        risk = past @ belief.weights
        gains = belief.gains(task, options, key)
        allowed = risk <= jnp.maximum(self.risk, risk.min() + 1e-6)
        safe = options.allowed & allowed
        return best(gains, Options(options.designs, options.seconds, safe))


ENTRY = Entry(breakaway, about="steps from rest that a joint does not answer")
