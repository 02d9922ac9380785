"""What follows from the readings: A and b of ``y = A u + b``."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES
from rig.core.attitude import Array
from rig.journal import Record


def pairs(records: list[Record]) -> tuple[Array, Array]:
    """(N, 3) commands and (N, 3) measurements in degrees of posture records."""
    commands = np.array([r["commanded_deg"] for r in records]).reshape(-1, 3)
    return commands, np.array([r["measured_deg"] for r in records]).reshape(-1, 3)


def identify(
    records: list[Record],
    noise_std: Array | None = None,
    notes: Record | None = None,
    zero_variance: Array | None = None,
) -> Any:
    """Slopes A and bias b of ``y = A u + b`` from posture records: a ``Calibration``.

    Args:
        records: chosen postures.
        noise_std: (3,) degrees, of one recorded mean; from the scatter of its readings
            when not given.
        notes: stored in the calibration's file.
        zero_variance: (3,) degrees squared, of the zero reference. It shifts every
            posture equally, so it adds to the variance of the outputs' mean.
    """
    import jaxcal

    if noise_std is None:
        means = [np.array(r["std_deg"]) ** 2 / r["samples"] for r in records]
        noise_std = np.sqrt(np.mean(means, axis=0))
    noise_std = np.maximum(1e-9, noise_std)
    fitted: Any = jaxcal.identify(
        *pairs(records),
        noise_std=noise_std,
        input_names=AXIS_NAMES,
        output_names=AXIS_NAMES,
        command_unit="deg",
        measured_unit="deg",
        notes=notes,
    )
    if zero_variance is None:
        return fitted
    covariance = np.array(fitted.joint_covariance)
    covariance[-3:, -3:] += np.diag(zero_variance)
    return dataclasses.replace(fitted, joint_covariance=covariance)
