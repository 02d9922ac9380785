"""What a calibration session comes to: calibration and summary from its records."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.config import RigConfig
from rig.faults import MotionFault
from rig.identification.drift import estimate_drift, without_drift
from rig.identification.fit_affine import (
    held_out_errors,
    identify_affine,
    mispaired,
    pairs,
    uncertainty,
)
from rig.journal.run_folder import Record, measured_postures
from rig.outputs.messages import recalibrate
from rig.parts import model_of
from rig.readings.attitude import ORDERS, frame_at
from rig.readings.geometry import Attitudes, geometry_of

USUAL = (1 / 3, 3.0)  # degrees of a joint for one commanded; outside it is told


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
    shared = {
        "zero_pulses": zero["pulses"],
        "zero_attitude": zero["attitude"],
        "device": config.device_fingerprint(),
        "postures": [record["name"] for record in chosen],
    }
    told = {
        "schema": 1,
        "measured_at": zero["time"],
        "axes": list(config.axis_names),
        "outputs": list(config.output_names),
        "unit": config.output_unit,
        "drift": drift,
        **shared,
    }
    notes |= {
        "approach_overshoot_deg": config.motion.approach_overshoot_deg,
        "drift_corrected": bool(drift and drift["corrected"]),
        **shared,
    }
    if model is not None:
        return model.conclude(config, postures, notes, told)
    held_out, errors = held_out_errors(
        config, held, postures, identify_affine(config, chosen)
    )
    if not compensated:
        errors.pop("after", None)
    calibration, limits = _judged_affine(
        config, zero, chosen, held_out, {**errors, "drift": drift}, notes
    )
    return calibration, {
        **told,
        "A": np.asarray(calibration.matrix).tolist(),
        "b": np.asarray(calibration.bias).tolist(),
        **limits,
        "orders": order_residuals(config, zero, chosen + held_out),
        **errors,
    }


def _judged_affine(
    config: RigConfig,
    zero: Record,
    chosen: list[Record],
    held_out: list[Record],
    errors: dict[str, Any],
    notes: dict[str, Any],
) -> tuple[Any, dict[str, Any]]:
    """The affine calibration of the chosen postures, its verdict in ``notes``.

    With the uncertainty that the held-out postures show.
    """
    zero_share = chosen[0]["samples"] / zero["samples"]
    limits = uncertainty(chosen, held_out, zero_share)
    reasons = [
        *mispaired(config, [*chosen, *held_out]),
        *recalibrate(errors, config.session.verify_limit_deg),
    ]
    notes |= {
        "mechanism_order": config.mechanism.order,
        "noise_from": limits["basis"],
        "verdict": {"good": not reasons, "reasons": reasons},
    }
    noise = np.maximum(1e-9, limits["noise_std_deg"])
    return identify_affine(config, chosen, noise, notes, zero_share), limits


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
        residual = across @ frame.angles(attitudes, order)
        rms[order] = float(
            np.sqrt((residual**2).sum() / (residual.shape[1] * (len(records) - count)))
        )
    best = min(rms, key=lambda order: rms[order])
    noise = float(np.mean([r["std_deg"] for r in records]))
    warning = ""
    if rms[configured] > max(2.0 * rms[best], 0.02):
        warning = (
            f"the order {best} leaves residuals of {rms[best]:.3f} deg, the configured "
            f"order {configured} {rms[configured]:.3f} deg: check mechanism.order and "
            "the phone's order"
        )
    elif rms[configured] > max(10.0 * noise, 0.1):
        warning = (
            f"the fit with the configured order {configured} leaves residuals of "
            f"{rms[configured]:.3f} deg, far above the readings' scatter of "
            f"{noise:.3f} deg: check [imu] order and signs, mounting, backlash"
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
