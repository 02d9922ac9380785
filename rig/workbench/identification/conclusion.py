"""What a calibration session comes to: calibration and summary from its records."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.config import AXIS_NAMES, RigConfig
from rig.core.attitude import ORDERS, Frame, frame_at
from rig.core.faults import MotionFault
from rig.journal import Record
from rig.workbench.identification.drift import estimate_drift, without_drift
from rig.workbench.identification.fit import (
    held_out_errors,
    identify,
    pairs,
    uncertainty,
)
from rig.workbench.identification.noise import (
    autocorrelation_time,
    correlation,
    effective_samples,
)
from rig.workbench.readings import angles

USUAL = (1 / 3, 3.0)  # degrees of a joint for one commanded; outside it is told


@dataclasses.dataclass(frozen=True)
class Evidence:
    """All that a calibration is identified from."""

    zero: Record
    chosen: list[Record]  # postures measured to identify from
    held: list[Any]  # pairs of pulses held out, raw and compensated
    held_out: list[Record]  # measured there
    references: list[Record]  # later visits of the zero posture, in order of time


def conclude(
    config: RigConfig, evidence: Evidence, notes: dict[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """The calibration, with ``notes`` in its file, and what its summary says of it."""
    zero = evidence.zero
    frame = frame_at(config, np.array(zero["attitude"]))
    measured = [zero, *evidence.chosen, *evidence.held_out, *evidence.references]
    phi = correlation([angles(record, frame) for record in measured])
    visits = [zero, *evidence.references]
    drift = estimate_drift(visits, phi, config.session.drift_limit_deg)
    chosen = without_drift(evidence.chosen, drift, zero, frame)
    found = without_drift(evidence.held_out, drift, zero, frame)
    held_out, off = held_out_errors(
        config, evidence.held, {r["name"]: r for r in found}
    )
    limits = uncertainty(identify(chosen), chosen, held_out, zero, phi)
    shared = {
        "zero_pulses": zero["pulses"],
        "zero_attitude": zero["attitude"],
        "device": config.device_fingerprint(),
        "postures": [record["name"] for record in chosen],
    }
    notes = notes | shared
    notes |= {
        "mechanism_order": config.mechanism.order,
        "approach_overshoot_deg": config.motion.approach_overshoot_deg,
        "noise_from": limits["basis"],
        "drift_corrected": drift is not None and drift.corrected,
    }
    noise = np.array(limits["noise_std_deg"])
    calibration = identify(chosen, noise, notes, np.array(limits["zero_std_deg"]) ** 2)
    count = config.settle.samples
    summary = {
        "schema": 1,
        "measured_at": zero["time"],
        "axes": list(AXIS_NAMES),
        "unit": "deg",
        "A": np.asarray(calibration.matrix).tolist(),
        "b": np.asarray(calibration.bias).tolist(),
        **limits,
        "autocorrelation_readings": autocorrelation_time(phi).tolist(),
        "effective_samples": effective_samples(phi, count).tolist(),
        "samples": count,
        **shared,
        "orders": order_residuals(config, frame, chosen + held_out),
        **off,
        **(_predicted(calibration, held_out) if held_out else {}),
        "drift": None if drift is None else dataclasses.asdict(drift),
        "drift_deg": None,
    }
    if evidence.references:
        last = evidence.references[-1]["measured_deg"]
        summary["drift_deg"] = float(np.abs(last).max())
    return calibration, summary


def _predicted(calibration: Any, held_out: list[Record]) -> dict[str, float]:
    """Errors of the prediction at held-out postures, degrees."""
    commands, measured = pairs(held_out)
    off = measured - calibration.predict(commands)
    rms, worst = np.sqrt((off**2).mean()), np.abs(off).max()
    return {"prediction_rms": float(rms), "prediction_max": float(worst)}


def order_residuals(
    config: RigConfig, frame: Frame, records: list[Record]
) -> dict[str, Any]:
    """Residual of the linear fit under each of the six mechanism orders.

    The right order leaves noise; a wrong one leaves degrees. Needs more than four
    postures; with four every order fits exactly.

    Returns:
        rms (order to degrees), configured, best, warning (empty where all is well).
    """
    configured = config.mechanism.order
    if len(records) < 6:
        return {"rms": {}, "configured": configured, "warning": ""}
    design = np.column_stack([pairs(records)[0], np.ones(len(records))])
    across = np.eye(len(records)) - design @ np.linalg.pinv(design)
    attitudes = np.array([r["attitude"] for r in records])
    rms: dict[str, float] = {}
    for order in ORDERS:
        left = across @ frame.angles(attitudes, order)
        rms[order] = float(np.sqrt((left**2).sum() / (3 * (len(records) - 4))))
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
    return {"rms": rms, "configured": configured, "best": best, "warning": warning}


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
