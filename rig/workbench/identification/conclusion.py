"""What a calibration session comes to: calibration and summary from its records."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES, RigConfig
from rig.core.attitude import angles, frame_at
from rig.core.identify import identify, pairs
from rig.journal import Record
from rig.workbench.identification.drift import estimate_drift, without_drift
from rig.workbench.identification.fit import held_out_errors, uncertainty
from rig.workbench.identification.noise import (
    autocorrelation_time,
    correlation,
    effective_samples,
)
from rig.workbench.identification.orders import order_residuals


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
        "fingerprint": config.fingerprint(),
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
