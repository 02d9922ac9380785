"""What follows from the readings: A and b, and whether they can be a sound device's."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.config import AXIS_NAMES
from rig.core.attitude import Array
from rig.core.faults import MotionFault
from rig.journal import Record

USUAL = (1 / 3, 3.0)  # degrees of a joint for one commanded; outside it is told


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


def check_matrix(matrix: ArrayLike) -> list[str]:
    """A (3, 3) fitted matrix A is one of a device whose axes turn as they are named.

    Returns:
        Warnings: gains that are far from 1.

    Raises:
        MotionFault: an axis answers the other way, or another axis's command.
    """
    gains = np.asarray(matrix, dtype=np.float64)
    faults, warnings = [], []
    for i, name in enumerate(AXIS_NAMES):
        gain, strongest = gains[i, i], int(np.abs(gains[i]).argmax())
        if strongest != i:
            faults.append(
                f"{name} follows the command of {AXIS_NAMES[strongest]} "
                f"({gains[i, strongest]:.2f} deg for each degree) more than its own "
                f"({gain:.2f}): units, cables or `rotates` are exchanged"
            )
        elif gain <= 0:
            faults.append(
                f"{name} turns {gain:.2f} deg for each degree commanded, the other "
                f"way: check axes.{name}.direction, wiring and imu.signs"
            )
        elif not USUAL[0] <= gain <= USUAL[1]:
            warnings.append(
                f"{name} turns {gain:.2f} deg for each degree commanded: check "
                f"pulses_per_rev and reduction of axes.{name}"
            )
    if faults:
        raise MotionFault(f"no calibration is saved: {'; '.join(faults)}")
    return warnings
