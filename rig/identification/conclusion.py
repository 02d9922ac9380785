"""What a calibration session comes to: calibration and summary from its records."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from rig.config import RigConfig
from rig.faults import MotionFault
from rig.journal.run_folder import Record, measured_postures
from rig.outputs.messages import recalibrate
from rig.parts import model_of
from rig.readings.geometry import Array, Geometry, geometry_of

USUAL = (1 / 3, 3.0)  # degrees of a joint for one commanded; outside it is told
SIGNIFICANT = 3.0  # standard deviations, of a drift
LEAST = 0.1  # of session.drift_limit_deg: a smaller drift is left alone
STRAIGHT = 0.25  # of a drift: what a line leaves of it, and it is still linear


def pairs(records: list[Record]) -> tuple[Array, Array]:
    """(N, n) commands and (N, m) measurements of N posture records, N >= 1."""
    commands = np.array([r["commanded_deg"] for r in records], dtype=np.float64)
    return commands, np.array([r["measured_deg"] for r in records], dtype=np.float64)


def fit_quietly(config: RigConfig, *measurements: Array, **options: Any) -> Any:
    """``jaxcal.identify``, in names and units of the device, without its warning: the
    summary holds the verdict."""
    import jaxcal

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxcal.identify(
            *measurements,
            input_names=config.axis_names,
            output_names=config.output_names,
            command_unit=config.axis_unit,
            measured_unit=config.output_unit,
            **options,
        )


def identify_affine(
    config: RigConfig,
    records: list[Record],
    noise_std: Array | None = None,
    zero_share: float = 0.0,
) -> Any:
    """Slopes A and bias b of ``y = A u + b`` from posture records: a ``Calibration``.

    ``noise_std`` (m,) is of one recorded mean, where it is known; ``zero_share`` the
    variance of the zero posture's mean over that of another's, which shifts every
    posture equally and so adds to the variance of the bias.
    """
    fitted = fit_quietly(config, *pairs(records), noise_std=noise_std)
    if noise_std is None:
        return fitted
    covariance = np.array(fitted.joint_covariance)
    bias = range(-len(noise_std), 0)
    covariance[bias, bias] += zero_share * noise_std**2
    return dataclasses.replace(fitted, joint_covariance=covariance)


def uncertainty(
    config: RigConfig, chosen: list[Record], held_out: list[Record], zero_share: float
) -> dict[str, Any]:
    """noise_std_deg (m,) of a recorded mean, dof of an axis, basis, ci95 (m, n + 1):
    95 % half-widths of [A | b] that hold all of these at once (Bonferroni).

    The noise is that of a fit of all postures, which holds play, slow noise and drift;
    without held-out ones the scatter of single readings, too small where correlated.
    """
    everything, count = [*chosen, *held_out], len(chosen[0]["commanded_deg"]) + 1
    basis, dof = f"the fit of all {len(everything)} postures", len(everything) - count
    if dof:
        noise = np.array(fit_quietly(config, *pairs(everything)).noise_std)
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
        "rms": float(np.sqrt((off**2).mean())),
        "max": float(np.abs(off).max()),
        "each": off.tolist(),
    }


def held_out_errors(
    config: RigConfig, held: list[Any], postures: dict[str, Record], calibration: Any
) -> tuple[list[Record], dict[str, Any]]:
    """Records of held-out pairs that were both reached, and their errors in degrees,
    ``before`` and ``after`` compensation and of the ``prediction``; nothing of none."""
    roles, names = ("before", "after"), postures.keys()
    both = [i for i in range(len(held)) if names >= {f"{r}:{i}" for r in roles}]
    if not both:
        return [], {}
    desired: Array = config.to_deg([held[i][0] for i in both])
    if len(config.output_names) != len(config.axes):  # no device is ideal
        desired = np.asarray(calibration.predict(desired), dtype=np.float64)
    visited = {role: [postures[f"{role}:{i}"] for i in both] for role in roles}
    errors = {role: spread(pairs(r)[1] - desired) for role, r in visited.items()}
    records = visited["before"] + visited["after"]
    commands, measured = pairs(records)
    errors["prediction"] = spread(measured - calibration.predict(commands))
    return records, errors


def estimate_drift(
    visits: list[Record], geometry: Geometry, limit_deg: float
) -> dict[str, Any] | None:
    """How far the phone's zero drifted; None where it was visited once.

    A heading that drifts turns the phone's world: a linear drift is taken out of the
    attitudes, ``R' = exp(-w t) R`` with w (3,) in that world (turn_deg_per_min), once
    three visits have told it from any other (corrected). left_deg: what remains.
    """
    zero = visits[0]
    if len(visits) < 2:
        return None
    minutes = np.array([visit["time"] - zero["time"] for visit in visits]) / 60.0
    later = [visit["measured_deg"] for visit in visits[1:]]
    angles = np.array([np.zeros(len(later[0])), *later])
    attitudes = np.array([visit["attitude"] for visit in visits])
    turn = geometry.drift(attitudes, minutes)
    rest = [without_drift(visit, turn, zero, geometry) for visit in visits[1:]]
    bend = np.abs([visit["measured_deg"] for visit in rest]).max(axis=0)
    noise = sum(np.square(v["std_deg"]) / v["samples"] for v in (zero, visits[-1]))
    least = np.maximum(SIGNIFICANT * np.sqrt(noise), LEAST * limit_deg)
    size, end = float(np.abs(angles).max()), np.abs(angles[-1])
    straight = bool((bend <= np.maximum(least, STRAIGHT * end.max())).all())
    corrected = len(visits) == 3 and straight and bool((end > least).any())
    remaining = float(bend.max()) if corrected else size
    return {
        "minutes": minutes.round(4).tolist(),
        "angles_deg": angles.tolist(),
        "size_deg": size,
        "turn_deg_per_min": turn.tolist(),
        "corrected": corrected,
        "left_deg": remaining,
        "limit_deg": limit_deg,
        "over": remaining > limit_deg,
    }


def without_drift(
    record: Record, turn: ArrayLike, zero: Record, geometry: Geometry
) -> Record:
    """A record without a drift: (3,) degrees a minute of the phone's world, or (m,)."""
    minutes = (record["time"] - zero["time"]) / 60.0
    attitude = geometry.without(np.array(record["attitude"]), turn, minutes)
    frame = geometry.frame(np.array(zero["attitude"]))
    measured = frame.angles(attitude).tolist()
    return {**record, "attitude": attitude.tolist(), "measured_deg": measured}


def conclude(
    config: RigConfig,
    records: list[Record],
    notes: dict[str, Any],
    compensated: bool = True,
) -> tuple[Any, dict[str, Any]]:
    """The calibration, with ``notes`` in its file, and its summary, of a run's records;
    ``compensated``: the held-out targets were, by this very calibration."""
    last = {record["event"]: record for record in records}
    zero, held = last["zero"], last.get("held_out", {"pairs": []})["pairs"]
    geometry, model = geometry_of(config), model_of(config)
    postures = measured_postures(records)
    references = [r for r in postures.values() if r["role"] == "reference"]
    visits = sorted([zero, *references], key=lambda record: record["seq"])
    drift = estimate_drift(visits, geometry, config.session.drift_limit_deg)
    if drift and drift["corrected"]:
        turn = drift["turn_deg_per_min"]
        postures = {
            n: without_drift(r, turn, zero, geometry) for n, r in postures.items()
        }
    chosen = [r for r in postures.values() if r["role"] == "select"]
    shared = {  # by summary and notes
        "zero_pulses": zero["pulses"],
        "zero_attitude": zero["attitude"],
        "device": config.device_fingerprint(),
        "postures": [record["name"] for record in chosen],
    }
    summary = {
        "schema": 1,
        "measured_at": zero["time"],
        "axes": list(config.axis_names),
        "outputs": list(config.output_names),
        "unit": config.output_unit,
        "drift": drift,
        **shared,
    }
    if model is not None:
        calibration, result = model.conclude(config, postures)
        mispairing = calibration.mispairing
    else:
        first = identify_affine(config, chosen)
        held_out, errors = held_out_errors(config, held, postures, first)
        if not compensated:
            errors.pop("after", None)
        # The noise is that which the held-out postures show.
        zero_share = chosen[0]["samples"] / zero["samples"]
        limits = uncertainty(config, chosen, held_out, zero_share)
        in_order = sorted([*chosen, *held_out], key=lambda record: record["seq"])
        mispairing = identify_affine(config, in_order).mispairing
        noise = np.maximum(1e-9, limits["noise_std_deg"])
        calibration = identify_affine(config, chosen, noise, zero_share)
        matrix, bias = np.asarray(calibration.matrix), np.asarray(calibration.bias)
        result = {"A": matrix.tolist(), "b": bias.tolist(), **limits, **errors}
    summary |= result | {"mispairing": mispairing and mispairing.reason}
    reasons = recalibrate(summary, config.session.verify_limit_deg)
    notes |= {
        "approach_overshoot_deg": config.motion.approach_overshoot_deg,
        **shared,
        "verdict": {"good": not reasons, "reasons": reasons},
    }
    provenance = {**calibration.provenance, "notes": notes}
    return dataclasses.replace(calibration, provenance=provenance), summary


def check_matrix(config: RigConfig, matrix: ArrayLike) -> list[str]:
    """Warnings of gains far from 1, of an (m, n) fitted matrix A; MotionFault: an axis
    answers the other way, or another axis's command."""
    gains = np.asarray(matrix, dtype=np.float64)
    faults, warnings = [], []
    names = config.axis_names
    for i, name in enumerate(config.output_names):
        if name not in names:
            continue
        column, strongest = names.index(name), int(np.abs(gains[i]).argmax())
        gain = gains[i, column]
        if strongest != column:
            faults.append(
                f"{name} follows the command of {names[strongest]} "
                f"({gains[i, strongest]:.2f} deg per degree) more than its own "
                f"({gain:.2f}): units, cables or `rotates` are exchanged"
            )
        elif gain <= 0:
            faults.append(
                f"{name} turns {gain:.2f} deg per commanded degree, in the wrong "
                f"direction: check axes.{name}.direction, wiring and imu.signs"
            )
        elif not USUAL[0] <= gain <= USUAL[1]:
            warnings.append(
                f"{name} turns {gain:.2f} deg per commanded degree: check "
                f"pulses_per_rev and reduction of axes.{name}"
            )
    if faults:
        raise MotionFault(
            f"no calibration is saved: {'; '.join(faults)}. Run `jaxcal-rig setup axes`"
        )
    return warnings
