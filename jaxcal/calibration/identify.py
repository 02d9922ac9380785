"""Identify ``y = A u + b`` from measured postures, with honest uncertainty.

``identify`` is weighted least squares by a singular value decomposition of centred and
scaled regressors, so encoder pulses and degrees fit equally well. With as many postures
as regressors (four for three inputs) the model fits exactly, no residual is left and no
noise can be estimated; the calibration then says so and has no covariance, unless the
noise was given.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import platform
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration.base import Calibration
from jaxcal.calibration.result import AffineCalibration
from jaxcal.checks import axis_names, noise_levels, relative_weights, table, text
from jaxcal.information.excitation import require_excited

__all__ = ["identify"]

Array = NDArray[np.float64]


def identify(
    commands: ArrayLike,
    measured: ArrayLike,
    *,
    noise_std: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    common_noise: bool = False,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    command_unit: str = "",
    measured_unit: str = "",
    notes: Mapping[str, Any] | None = None,
) -> Calibration:
    """Fit ``y = A u + b`` by weighted least squares.

    Args:
        commands: (N, n) what the device was told, in any unit; N >= n + 1.
        measured: (N, m) what it reached, in any unit.
        noise_std: () or (m,) known standard deviation of a measurement of weight 1, in
            the measured unit; estimated from the residuals when not given.
        weights: (N,) a measurement of weight w has variance noise_std^2 / w (the number
            of readings averaged, say); 0 leaves it out. All 1 when not given.
        common_noise: estimate one noise level for all outputs (they must share a unit),
            which has m times the degrees of freedom. With five postures of three axes
            a 95 % interval is 3.2 standard errors wide instead of 12.7.
        input_names: n names; u_x, u_y, u_z or u_1 ... u_n when not given.
        output_names: m names, likewise y_x or y_1.
        command_unit: stored with the result.
        measured_unit: stored with the result.
        notes: anything JSON can hold, stored under ``provenance["notes"]``.

    Returns:
        The calibration; its covariance is None where N = n + 1 and no noise was given.

    Raises:
        ValueError: naming the argument, the rule and the value; for commands that leave
            a direction unexcited, naming that direction.
    """
    commands = table("commands", commands)
    measured = table("measured", measured)
    if len(commands) != len(measured):
        raise ValueError(
            "commands and measured must have as many rows, got "
            f"{len(commands)} and {len(measured)}"
        )
    n, m = commands.shape[1], measured.shape[1]
    inputs = axis_names("input_names", input_names, "u", n)
    outputs = axis_names("output_names", output_names, "y", m)
    weight = relative_weights(weights, len(commands))
    noise = noise_levels(noise_std, m)
    if noise is not None and common_noise:
        raise ValueError(
            "common_noise says how to estimate the noise and noise_std what it is: "
            "give one of them"
        )
    used = weight > 0.0
    u, y, w = commands[used], measured[used], weight[used]
    require_excited(u, inputs)

    total = float(w.sum())
    share = w / total
    centre = share @ u
    offset = u - centre
    scale = np.sqrt(share @ offset**2)
    at_centre = share @ y
    root = np.sqrt(w)[:, None]
    left, singular, right = np.linalg.svd(root * (offset / scale), full_matrices=False)
    inverse = right.T / singular
    slopes = inverse @ (left.T @ (root * (y - at_centre)))
    matrix = (slopes / scale[:, None]).T
    fitted = at_centre + ((commands - centre) / scale) @ slopes
    residuals = measured - fitted

    dof = len(u) - (n + 1)
    squares = share @ residuals[used] ** 2 * total
    residual_std = np.sqrt(squares / dof) if dof else None
    overall = float(np.sqrt(squares.sum() / (m * dof))) if dof else None
    known, noise_dof = noise is not None, 0
    if not known and dof:
        noise = np.full(m, overall) if common_noise else residual_std
        noise_dof = m * dof if common_noise else dof

    weighted_rows = root * np.column_stack([u, np.ones(len(u))])
    scaled = np.append(singular, np.sqrt(total))
    return AffineCalibration(
        matrix=matrix,
        bias=at_centre - matrix @ centre,
        residuals=residuals,
        noise_std=noise,
        noise_known=known,
        noise_dof=noise_dof,
        residual_std=residual_std,
        residual_std_overall=overall,
        dof=dof,
        condition_number=float(np.linalg.cond(weighted_rows)),
        scaled_condition_number=float(scaled.max() / scaled.min()),
        num_measurements=len(u),
        centre=centre,
        scale=scale,
        slope_covariance=inverse @ inverse.T,
        total_weight=total,
        input_names=inputs,
        output_names=outputs,
        command_unit=text("command_unit", command_unit),
        measured_unit=text("measured_unit", measured_unit),
        provenance=_provenance(commands, measured, weight, notes),
    )


def _provenance(
    commands: Array, measured: Array, weight: Array, notes: Mapping[str, Any] | None
) -> dict[str, Any]:
    try:
        noted = json.loads(json.dumps(dict(notes or {}), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"notes must be what JSON can hold: {error}") from None
    digest = hashlib.sha256()
    for array in (commands, measured, weight):
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "packages": {
            "jaxcal": sys.modules["jaxcal"].__version__,  # an import would be a circle
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "data_sha256": digest.hexdigest(),
        "notes": noted,
    }
