"""Simulated devices with white noise, a drifting bias and gross errors."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxcal.paper.datasets import BIAS_DEG, NOISE_STD_DEG, SCALE

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Device:
    """The robot of Table 1 and what disturbs a measurement of it."""

    noise_std_deg: float = NOISE_STD_DEG  # white, on every output
    drift_std_deg: float = 0.0  # step of the bias from one posture to the next
    outlier_share: float = 0.0  # of postures measured with an error of 3 degrees s.d.

    def record(
        self, commands: Array, rng: np.random.Generator, start: Array | None = None
    ) -> tuple[Array, Array]:
        """Measure postures one after another.

        Args:
            commands: (..., N, 3) degrees, in the order they are measured.
            rng: of everything random.
            start: (..., 3) degrees by which the bias is off at the start.

        Returns:
            (..., N, 3) measured, and (..., 3) by how much the bias is off at the end.
        """
        shape = commands.shape
        walk = np.cumsum(rng.normal(0.0, self.drift_std_deg, shape), axis=-2)
        walk += 0.0 if start is None else start[..., None, :]
        noise = rng.normal(0.0, self.noise_std_deg, shape)
        gross = rng.normal(0.0, 3.0, shape)
        outlier = rng.random((*shape[:-1], 1)) < self.outlier_share
        measured = self.true_outputs(commands) + walk + noise + gross * outlier
        return measured, walk[..., -1, :]

    @staticmethod
    def true_outputs(commands: Array) -> Array:
        """(..., N, 3) outputs without noise and drift."""
        return commands * SCALE + BIAS_DEG


def pick(values: Array, indices: NDArray[np.int64]) -> Array:
    """(E, k, n) rows of (E, M, n) by (E, k) indices."""
    return np.take_along_axis(values, indices[..., None], axis=-2)


def rms(errors: Array) -> Array:
    """(...) root mean square over the postures and axes of (..., N, 3)."""
    return np.sqrt((errors**2).mean(axis=(-2, -1)))
