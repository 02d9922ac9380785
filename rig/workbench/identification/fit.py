"""A and b of ``y = A u + b``, how uncertain they are, and errors held out.

A phone's fused attitude is filtered, so neighbouring readings err alike and n of them
average out less than n independent ones. Their noise is taken for a first-order
autoregression, whose correlation after k readings is ``phi ** k``. Source: Sokal, Monte
Carlo methods in statistical mechanics, 1989, section 3 (integrated autocorrelation
time).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import special
from scipy.optimize import brentq

from rig.config import AXIS_NAMES, RigConfig
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


def mean_share(phi: Any, samples: Any) -> Array:
    """Variance of the mean of ``samples`` readings, as a share of one reading's.

    One by the number of independent readings whose mean is as good.
    """
    tail = 2.0 * phi * (1.0 - phi**samples) / (samples * (1.0 - phi) ** 2)
    return ((1.0 + phi) / (1.0 - phi) - tail) / samples


def correlation(series: Sequence[Array]) -> Array:
    """phi of each axis, in [0, 0.999], from (n, axes) readings of each record.

    Taking each record's mean away hides slow noise. So phi is where the scatter at a
    distance of one reading, relative to that at none, is what a first-order
    autoregression of the same lengths leaves about its means.
    """
    rest = [np.asarray(values) - np.mean(values, axis=0) for values in series]
    none = np.sum([(values**2).sum(axis=0) for values in rest], axis=0)
    one = np.sum([(values[1:] * values[:-1]).sum(axis=0) for values in rest], axis=0)
    found = np.divide(one, none, out=np.full(none.shape, -1.0), where=none > 0.0)
    phi = np.linspace(0.0, 0.999, 1000)
    n, times = np.unique([len(values) for values in series], return_counts=True)
    share = mean_share(phi[:, None], n)
    # A first and a last reading, of which each has one neighbour only.
    ends = (1.0 - phi[:, None] ** n) / (1.0 - phi[:, None]) / n
    at_one = (n - 1) * (phi[:, None] - share) - 2.0 * share + 2.0 * ends
    at_none = np.maximum(n * (1.0 - share) @ times, 1e-12)
    return np.interp(found, at_one @ times / at_none, phi)


def mean_variance(record: Record, phi: Array) -> Array:
    """(3,) degrees squared, of the mean of a posture's or the zero's readings.

    Args:
        record: ``std_deg`` (3,) of its readings about their mean, and ``samples``.
        phi: (3,) of ``correlation``.
    """
    samples = record["samples"]
    share = mean_share(phi, samples)
    about_mean = np.array(record["std_deg"]) ** 2 * (samples - 1) / samples
    return about_mean * share / (1.0 - share) if samples > 1 else about_mean


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
    drift), with the residuals of the chosen where there are more than four. Without
    held-out postures only the scatter of single readings is known, which is too
    optimistic; ``basis`` says which it was. The noise of the zero reference shifts all
    postures equally and leaves no trace in them, so it is added to the bias from the
    zero's own scatter.

    Args:
        calibration: fitted to ``chosen``.
        chosen: posture records.
        held_out: posture records.
        zero: record of the zero posture.
        phi: (3,) ``correlation`` of the readings.

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
        off = y - calibration.predict(u)
        squares += (np.linalg.solve(np.linalg.cholesky(joint), off) ** 2).sum(axis=0)
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
        counts = [1.0 / mean_share(phi, r["samples"]) - 1.0 for r in chosen]
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


def held_out_errors(
    config: RigConfig, held: list[Any], found: dict[str, Record], calibration: Any
) -> tuple[list[Record], dict[str, Any]]:
    """Errors at held-out targets ``before`` and ``after`` compensation, in degrees.

    Args:
        config: the device's.
        held: pairs of pulses, raw and compensated.
        found: records by the names ``before:0``, ``after:0``, ...
        calibration: what predicts the measurements.

    Returns:
        The records of the targets of which both could be reached, and their errors and
        those of the prediction; nothing where there are none.
    """
    roles = ("before", "after")
    both = [i for i in range(len(held)) if found.keys() >= {f"{r}:{i}" for r in roles}]
    if not both:
        return [], {}
    desired = config.to_deg([held[i][0] for i in both])
    records, errors = [], {}  # type: list[Record], dict[str, Any]
    for role in roles:
        visited = [found[f"{role}:{i}"] for i in both]
        records += visited
        off = pairs(visited)[1] - desired
        errors[role] = {
            "rms_axis": np.sqrt((off**2).mean(axis=0)).tolist(),
            "rms": float(np.sqrt((off**2).mean())),
            "max": float(np.abs(off).max()),
            "each": off.tolist(),
        }
    commands, measured = pairs(records)
    off = measured - calibration.predict(commands)
    errors["prediction_rms"] = float(np.sqrt((off**2).mean()))
    errors["prediction_max"] = float(np.abs(off).max())
    return records, errors
