"""What a calibration session comes to: calibration and summary from its records."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.config import RigConfig
from rig.faults import MotionFault
from rig.journal import Record, measured_postures
from rig.readings.attitude import ORDERS, frame_at
from rig.readings.geometry import Attitudes, Geometry, geometry_of
from rig.workbench.identification.fit import (
    held_out_errors,
    identify,
    pairs,
    uncertainty,
)
from rig.workbench.outputs.words import recalibrate

USUAL = (1 / 3, 3.0)  # degrees of a joint for one commanded; outside it is told
SIGNIFICANT = 3.0  # standard deviations, of a drift
LEAST = 0.1  # of session.drift_limit_deg: a smaller drift is left alone
STRAIGHT = 0.25  # of a drift: what a line leaves of it, and it is still linear


def conclude(
    config: RigConfig,
    records: list[Record],
    notes: dict[str, Any],
    compensated: bool = True,
) -> tuple[Any, dict[str, Any]]:
    """The calibration, with ``notes`` in its file, and what its summary says of it.

    Args:
        config: of the device.
        records: of the run's journal: the zero, the pairs held out, the postures.
        notes: for the calibration's file.
        compensated: the held-out targets were, by this very calibration.
    """
    last = {record["event"]: record for record in records}
    zero, held = last["zero"], last.get("held_out", {"pairs": []})["pairs"]
    geometry = geometry_of(config)
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
    held_out, errors = held_out_errors(config, held, postures, identify(config, chosen))
    zero_share = chosen[0]["samples"] / zero["samples"]
    limits = uncertainty(chosen, held_out, zero_share)
    shared = {
        "zero_pulses": zero["pulses"],
        "zero_attitude": zero["attitude"],
        "device": config.device_fingerprint(),
        "postures": [record["name"] for record in chosen],
    }
    if not compensated:
        errors.pop("after", None)
    judged = {**errors, "drift": drift}
    reasons = recalibrate(judged, config.session.verify_limit_deg)
    notes |= shared | {
        "mechanism_order": config.mechanism.order,
        "approach_overshoot_deg": config.motion.approach_overshoot_deg,
        "noise_from": limits["basis"],
        "drift_corrected": bool(drift and drift["corrected"]),
        "verdict": {"good": not reasons, "reasons": reasons},
    }
    noise = np.maximum(1e-9, limits["noise_std_deg"])
    calibration = identify(config, chosen, noise, notes, zero_share)
    return calibration, {
        "schema": 1,
        "measured_at": zero["time"],
        "axes": list(config.axis_names),
        "outputs": list(config.output_names),
        "unit": config.output_unit,
        "A": np.asarray(calibration.matrix).tolist(),
        "b": np.asarray(calibration.bias).tolist(),
        **limits,
        **shared,
        "orders": order_residuals(config, zero, chosen + held_out),
        **errors,
        "drift": drift,
    }


def estimate_drift(
    visits: list[Record], geometry: Geometry, limit_deg: float
) -> dict[str, Any] | None:
    """How far the phone's zero drifted; None where it was visited once.

    The zero posture is visited first, in the middle and last. A heading that drifts
    turns the phone's world, so a linear drift is taken out of the attitudes, never of
    angles: ``R' = exp(-w t) R`` with w (3,) in that world. Three visits tell a linear
    drift from any other, which cannot be taken out.

    Args:
        visits: the zero, then postures measured there, in order of time.
        geometry: of the readings.
        limit_deg: ``session.drift_limit_deg``.

    Returns:
        minutes (V,) and angles_deg (V, m) of the visits; size_deg, the largest angle;
        turn_deg_per_min (3,), w; corrected: it is linear and to be taken out; left_deg,
        what is in the measurements then; limit_deg, and whether left is over it.
    """
    zero = visits[0]
    if len(visits) < 2:
        return None
    minutes = np.array([visit["time"] - zero["time"] for visit in visits]) / 60.0
    later = [visit["measured_deg"] for visit in visits[1:]]
    seen = np.array([np.zeros(len(later[0])), *later])
    attitudes = np.array([visit["attitude"] for visit in visits])
    turn = geometry.drift(attitudes, minutes)
    rest = [without_drift(visit, turn, zero, geometry) for visit in visits[1:]]
    bend = np.abs([visit["measured_deg"] for visit in rest]).max(axis=0)
    noise = sum(np.square(v["std_deg"]) / v["samples"] for v in (zero, visits[-1]))
    least = np.maximum(SIGNIFICANT * np.sqrt(noise), LEAST * limit_deg)
    size, end = float(np.abs(seen).max()), np.abs(seen[-1])
    straight = bool((bend <= np.maximum(least, STRAIGHT * end.max())).all())
    corrected = len(visits) == 3 and straight and bool((end > least).any())
    left = float(bend.max()) if corrected else size
    return {
        "minutes": minutes.round(4).tolist(),
        "angles_deg": seen.tolist(),
        "size_deg": size,
        "turn_deg_per_min": turn.tolist(),
        "corrected": corrected,
        "left_deg": left,
        "limit_deg": limit_deg,
        "over": left > limit_deg,
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


def order_residuals(
    config: RigConfig, zero: Record, records: list[Record]
) -> dict[str, Any]:
    """Residual of the linear fit under each of the six mechanism orders.

    The right order leaves noise; a wrong one leaves degrees. Needs two postures more
    than a fit does, which without them is exact under every order.

    Returns:
        rms (order to degrees), configured, warning (empty where all is well).
    """
    configured, geometry = config.mechanism.order, geometry_of(config)
    if not isinstance(geometry, Attitudes):
        return {"rms": {}, "configured": "", "warning": ""}
    frame = frame_at(config, np.array(zero["attitude"]))
    count = len(config.axes) + 1
    if len(records) < count + 2:
        return {"rms": {}, "configured": configured, "warning": ""}
    design = np.column_stack([pairs(records)[0], np.ones(len(records))])
    across = np.eye(len(records)) - design @ np.linalg.pinv(design)
    attitudes = np.array([r["attitude"] for r in records])
    rms: dict[str, float] = {}
    for order in ORDERS:
        left = across @ frame.angles(attitudes, order)
        rms[order] = float(
            np.sqrt((left**2).sum() / (left.shape[1] * (len(records) - count)))
        )
    best = min(rms, key=lambda order: rms[order])
    noise = float(np.mean([r["std_deg"] for r in records]))
    warning = ""
    if rms[configured] > max(2.0 * rms[best], 0.02):
        warning = (
            f"the order {best} leaves {rms[best]:.3f} deg where the configured "
            f"{configured} leaves {rms[configured]:.3f}: check mechanism.order and the "
            "phone's order"
        )
    elif rms[configured] > max(10.0 * noise, 0.1):
        warning = (
            f"the fit leaves {rms[configured]:.3f} deg under the configured order "
            f"{configured}, far above the readings' scatter of {noise:.3f}: check the "
            "phone's order and signs ([imu] order), its mounting, and play"
        )
    return {"rms": rms, "configured": configured, "warning": warning}


def check_matrix(config: RigConfig, matrix: ArrayLike) -> list[str]:
    """An (m, n) fitted matrix A is one of a device whose axes turn as they are named.

    What is measured under the name of an axis follows that axis, its way.

    Returns:
        Warnings: gains that are far from 1.

    Raises:
        MotionFault: an axis answers the other way, or another axis's command.
    """
    gains = np.asarray(matrix, dtype=np.float64)
    faults, warnings = [], []
    names = config.axis_names
    for i, name in enumerate(config.output_names):
        if name not in names:
            continue
        own, strongest = names.index(name), int(np.abs(gains[i]).argmax())
        gain = gains[i, own]
        if strongest != own:
            faults.append(
                f"{name} follows the command of {names[strongest]} "
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
        raise MotionFault(
            f"no calibration is saved: {'; '.join(faults)}. Run `jaxcal-rig axes`"
        )
    return warnings
