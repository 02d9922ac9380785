"""A and b of ``y = A u + b``, how uncertain they are, and errors held out."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import special
from scipy.optimize import brentq

from rig.config import AXIS_NAMES, RigConfig
from rig.core.attitude import Array
from rig.journal import Record
from rig.workbench.identification.noise import effective_samples, mean_variance


def pairs(records: list[Record]) -> tuple[Array, Array]:
    """(N, 3) commands and (N, 3) measurements in degrees of posture records."""
    commands = np.array([r["commanded_deg"] for r in records]).reshape(-1, 3)
    return commands, np.array([r["measured_deg"] for r in records]).reshape(-1, 3)


def identify(
    records: list[Record],
    noise_std: Array | None = None,
    notes: Record | None = None,
    zero_variance: Array | float = 0.0,
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
    fitted: Any = jaxcal.identify(
        *pairs(records),
        noise_std=np.maximum(1e-9, noise_std),
        input_names=AXIS_NAMES,
        output_names=AXIS_NAMES,
        command_unit="deg",
        measured_unit="deg",
        notes=notes,
    )
    covariance = np.array(fitted.joint_covariance)
    covariance[range(-3, 0), range(-3, 0)] += zero_variance
    return dataclasses.replace(fitted, joint_covariance=covariance)


def uncertainty(
    calibration: Any,
    chosen: list[Record],
    held_out: list[Record],
    zero: Record,
    phi: Array,
) -> dict[str, Any]:
    """Noise of one recorded mean and 95 % half-widths of A and b, axis by axis.

    ``ci95`` holds all twelve parameters at once in 95 % of sessions (Bonferroni),
    ``ci95_each`` each by itself, so that one or two of twelve may well miss.

    Four postures leave no residual, so the noise is taken from what they did not fit:
    the prediction errors at held-out postures (which also hold play, slow noise and
    drift), each made smaller by the share its own prediction variance has in it, with
    the residuals of the chosen where there are more than four. Without held-out
    postures only the scatter of single readings is known, which is too optimistic;
    ``basis`` says which it was. The noise of the zero reference shifts all postures
    equally and leaves no trace in them, so it is added to the bias from the zero's own
    scatter. Where scatter is used, correlated readings count as fewer.

    Args:
        calibration: fitted to ``chosen``.
        chosen: posture records.
        held_out: posture records.
        zero: record of the zero posture.
        phi: (3,) ``noise.correlation`` of the readings.

    Returns:
        noise_std_deg (3,), zero_std_deg (3,), dof of an axis, basis, and (3, 4)
        half-widths of [A | b] in degrees.
    """
    commands, measured = pairs(chosen)
    fitted = np.column_stack([commands, np.ones(len(commands))])
    inverse = np.linalg.inv(fitted.T @ fitted)  # of (slopes, bias), noise of 1 degree
    squares = ((measured - calibration.predict(commands)) ** 2).sum(axis=0)
    dof = len(chosen) - 4
    basis = ["residuals of the chosen postures"] if dof else []
    shared = np.zeros(4)  # of a parameter's variance: seen in the noise estimate too
    if held_out:
        u, y = pairs(held_out)
        rows = np.column_stack([u, np.ones(len(u))])
        # Prediction errors share the fitted parameters: whiten them by their joint
        # covariance, I + Z (Z_s' Z_s)^-1 Z', up to the noise variance looked for.
        joint = np.eye(len(u)) + rows @ inverse @ rows.T
        white = np.linalg.solve(
            np.linalg.cholesky(joint), y - calibration.predict(u)
        )  # fmt: skip
        squares += (white**2).sum(axis=0)
        dof += len(u)
        basis.append("held-out predictions")
        gain = inverse @ rows.T @ np.linalg.solve(joint, rows @ inverse)
        shared = np.diag(gain) / np.diag(inverse)
    levels = (0.95, 1.0 - 0.05 / (3 * len(inverse)))
    if dof:
        variance = squares / dof
        one, all_twelve = (_half_widths(level, shared, dof) for level in levels)
    else:
        variance = np.mean([mean_variance(r, phi) for r in chosen], axis=0)
        counts = [effective_samples(phi, r["samples"]) - 1.0 for r in chosen]
        free = np.maximum(1.0, np.sum(counts, axis=0))[:, None]
        one, all_twelve = (special.stdtrit(free, 0.5 + 0.5 * p) for p in levels)
        dof = int(free.min())
        basis = ["scatter of single readings only"]
    of_zero = mean_variance(zero, phi)
    spread = np.outer(variance, np.diag(inverse))
    spread[:, 3] += of_zero
    return {
        "noise_std_deg": np.sqrt(variance).tolist(),
        "zero_std_deg": np.sqrt(of_zero).tolist(),
        "dof": dof,
        "basis": " and ".join(basis),
        "ci95": (all_twelve * np.sqrt(spread)).tolist(),
        "ci95_each": (one * np.sqrt(spread)).tolist(),
    }


def _half_widths(level: float, shared: Array, dof: int) -> Array:
    """Half-widths, in standard errors, of intervals of probability ``level``.

    The errors of the parameters are part of the prediction errors from which the noise
    is estimated, so Student's t is too wide: for the share f of a parameter's variance
    that the estimate has seen, the ratio is ``sqrt(1 - f) t + sqrt(f dof) c``, with t
    of Student and c one coordinate of a random unit vector in ``dof`` dimensions,
    independent of each other.
    """
    middles, half = (np.arange(200) + 0.5) / 200, 0.5 * (dof - 1)
    c = np.sign(middles - 0.5)  # in one dimension
    if dof > 1:
        c = 2.0 * special.betaincinv(half, half, middles) - 1.0

    def excess(width: float, f: float) -> float:
        ends = np.array([[width], [-width]]) - np.sqrt(f * dof) * c
        above, below = special.stdtr(dof, ends / np.sqrt(1.0 - f))
        return float(np.mean(above - below)) - level

    widest = 2.0 * special.stdtrit(dof, 0.5 + 0.5 * level)
    return np.array([brentq(excess, 0.0, widest, args=(f,)) for f in shared])


def errors(records: list[Record], desired: Array) -> dict[str, Any]:
    """Statistics of measured minus desired, degrees, an axis and overall."""
    difference = pairs(records)[1] - desired
    return {
        "rms_axis": np.sqrt((difference**2).mean(axis=0)).tolist(),
        "rms": float(np.sqrt((difference**2).mean())),
        "max": float(np.abs(difference).max()),
        "each": difference.tolist(),
    }


def held_out_errors(
    config: RigConfig, held: list[Any], found: dict[str, Record]
) -> tuple[list[Record], dict[str, Any]]:
    """Errors ``before`` and ``after`` compensation at held-out targets.

    Args:
        config: the device's.
        held: pairs of pulses, raw and compensated.
        found: records by the names ``before:0``, ``after:0``, ...

    Returns:
        The records of the targets of which both could be reached, and their errors;
        nothing where there are none.
    """
    roles = ("before", "after")
    both = [i for i in range(len(held)) if found.keys() >= {f"{r}:{i}" for r in roles}]
    if not both:
        return [], {}
    records = {role: [found[f"{role}:{i}"] for i in both] for role in roles}
    desired = config.to_deg([held[i][0] for i in both])
    off = {role: errors(records[role], desired) for role in roles}
    return records["before"] + records["after"], off
