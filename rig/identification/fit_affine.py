"""A and b of ``y = A u + b``, how uncertain they are, and errors held out."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np
from scipy import special

from rig.config import RigConfig
from rig.journal.run_folder import Record
from rig.readings.attitude import Array


def pairs(records: list[Record]) -> tuple[Array, Array]:
    """(N, n) commands and (N, m) measurements of N posture records, N >= 1."""
    commands = np.array([r["commanded_deg"] for r in records], dtype=np.float64)
    return commands, np.array([r["measured_deg"] for r in records], dtype=np.float64)


def fit_quietly(*measurements: Array, **options: Any) -> Any:
    """``jaxcal.identify`` without its warning: the summary holds the verdict."""
    import jaxcal

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxcal.identify(*measurements, **options)


def identify_affine(
    config: RigConfig,
    records: list[Record],
    noise_std: Array | None = None,
    notes: Record | None = None,
    zero_share: float = 0.0,
) -> Any:
    """Slopes A and bias b of ``y = A u + b`` from posture records: a ``Calibration``.

    Args:
        config: names axes and measurements.
        records: chosen postures.
        noise_std: (m,), of one recorded mean, where it is known.
        notes: stored in the calibration's file.
        zero_share: variance of the zero posture's mean over that of another's. It
            shifts every posture equally, so it adds to the variance of the bias.
    """
    fitted = fit_quietly(
        *pairs(records),
        noise_std=noise_std,
        input_names=config.axis_names,
        output_names=config.output_names,
        command_unit=config.axis_unit,
        measured_unit=config.output_unit,
        notes=notes,
    )
    if noise_std is None:
        return fitted
    covariance = np.array(fitted.joint_covariance)
    bias = range(-len(noise_std), 0)
    covariance[bias, bias] += zero_share * noise_std**2
    return dataclasses.replace(fitted, joint_covariance=covariance)


def mispaired(config: RigConfig, records: list[Record]) -> list[str]:
    """How readings and postures were mispaired, in the order in which they were
    measured; nothing where they belong together."""
    in_order = sorted(records, key=lambda record: record["seq"])
    found = identify_affine(config, in_order).mispairing
    return [found.reason] if found else []


def uncertainty(
    chosen: list[Record], held_out: list[Record], zero_share: float
) -> dict[str, Any]:
    """Noise of one recorded mean, and 95 % half-widths of A and b, axis by axis.

    One posture more than axes leaves no residual, so the noise is that of a fit of all
    postures, those held out too: it holds play, slow noise and drift. The parameters'
    errors are part of those residuals, which makes Student's t a little too wide.
    Without held-out postures only the scatter of single readings is known, which is too
    optimistic where they are correlated; ``basis`` says which it was.

    Args:
        chosen: posture records, from which A and b are identified.
        held_out: posture records.
        zero_share: as of ``identify_affine``.

    Returns:
        noise_std_deg (m,), dof of an axis, basis, and ci95 (m, n + 1), half-widths of
        [A | b], which hold all of these at once (Bonferroni).
    """
    everything, count = [*chosen, *held_out], len(chosen[0]["commanded_deg"]) + 1
    basis, dof = f"the fit of all {len(everything)} postures", len(everything) - count
    if dof:
        noise = np.array(fit_quietly(*pairs(everything)).noise_std)
    else:
        basis = "scatter of single readings only"
        dof = (chosen[0]["samples"] - 1) * len(chosen)
        scatter = np.mean([np.square(r["std_deg"]) for r in chosen], axis=0)
        noise = np.sqrt(scatter / chosen[0]["samples"])
    rows = np.column_stack([pairs(chosen)[0], np.ones(len(chosen))])
    variances = np.diag(np.linalg.inv(rows.T @ rows)).copy()
    variances[-1] += zero_share
    tail = 0.025 / (count * len(noise))
    width = special.stdtrit(max(1, dof), 1.0 - tail) * np.sqrt(variances)
    return {
        "noise_std_deg": noise.tolist(),
        "dof": dof,
        "basis": basis,
        "ci95": np.outer(noise, width).tolist(),
    }


def spread(off: Array) -> dict[str, Any]:
    """(N, m) errors, and how large they are."""
    return {
        "rms_axis": np.sqrt((off**2).mean(axis=0)).tolist(),
        "rms": float(np.sqrt((off**2).mean())),
        "max": float(np.abs(off).max()),
        "each": off.tolist(),
    }


def desired_at(config: RigConfig, calibration: Any, pulses: Any) -> Array:
    """(..., m) that held-out targets of (..., n) pulses should measure.

    What is commanded, as an ideal device would; of other numbers than axes there is no
    ideal, and it is what the calibration says.
    """
    degrees: Array = config.to_deg(pulses)
    if len(config.output_names) == len(config.axes):
        return degrees
    return np.asarray(calibration.predict(degrees), dtype=np.float64)


def held_out_errors(
    config: RigConfig, held: list[Any], postures: dict[str, Record], calibration: Any
) -> tuple[list[Record], dict[str, Any]]:
    """Errors at held-out targets ``before`` and ``after`` compensation, in degrees.

    Args:
        config: the device's.
        held: pairs of pulses, raw and compensated.
        postures: records by the names ``before:0``, ``after:0``, ...
        calibration: what predicts the measurements.

    Returns:
        The records of the targets of which both could be reached, and their errors and
        those of the ``prediction``; nothing where there are none.
    """
    roles = ("before", "after")
    both = [
        i for i in range(len(held)) if postures.keys() >= {f"{r}:{i}" for r in roles}
    ]
    if not both:
        return [], {}
    desired = desired_at(config, calibration, [held[i][0] for i in both])
    visited = {role: [postures[f"{role}:{i}"] for i in both] for role in roles}
    errors = {role: spread(pairs(r)[1] - desired) for role, r in visited.items()}
    records = visited["before"] + visited["after"]
    commands, measured = pairs(records)
    errors["prediction"] = spread(measured - calibration.predict(commands))
    return records, errors
