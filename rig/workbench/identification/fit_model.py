"""What a session of a device with a ``[model]`` comes to: parameters and verdict."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.config import RigConfig
from rig.journal import Record
from rig.model import DeviceModel
from rig.readings.attitude import Array
from rig.readings.geometry import geometry_of
from rig.workbench.identification.fit_affine import fit_quietly, spread
from rig.workbench.outputs.messages import recalibrate

WIDE = 1.96  # standard errors, of 95 %


def outputs(config: RigConfig, records: list[Record]) -> tuple[Array, Array]:
    """(N, n) commands and (N, m) of what the model predicts, of N posture records."""
    geometry = geometry_of(config)
    commands = np.array([r["commanded_deg"] for r in records], dtype=np.float64)
    values = [
        geometry.outputs(np.array(r["attitude"]), np.array(r["measured_deg"]))
        for r in records
    ]
    return commands, np.array(values)


def identify_model(config: RigConfig, model: DeviceModel, records: list[Record]) -> Any:
    """The parameters of the model from chosen postures: a ``jaxcal.Calibration``."""
    return fit_quietly(
        *outputs(config, records),
        model=model.model,
        prior=model.prior,
        input_names=config.axis_names,
        output_names=config.output_names,
        command_unit=config.axis_unit,
        measured_unit=config.output_unit,
        accuracy=config.session.verify_limit_deg,
    )


def held_out_errors(
    config: RigConfig, model: DeviceModel, calibration: Any, records: list[Record]
) -> Record:
    """Errors of the predictions at held-out postures: of the device as designed, and
    of the calibration; nothing where there are none."""
    if not records:
        return {}
    commands, measured = outputs(config, records)
    designed = model.model.predict(commands)
    predicted = calibration.predict(commands)
    return {
        "before": spread(measured - designed),
        "prediction": spread(measured - predicted),
    }


def conclude(
    config: RigConfig,
    model: DeviceModel,
    postures: dict[str, Record],
    notes: Record,
    told: Record,
) -> tuple[Any, Record]:
    """The calibration, with ``notes`` in its file, and its summary with what is
    ``told`` of any session."""
    chosen, held = (
        [record for record in postures.values() if record["role"] == role]
        for role in ("select", "held")
    )
    calibration = identify_model(config, model, chosen)
    errors = held_out_errors(config, model, calibration, held)
    verdict = calibration.verdict
    summary = told | errors | {
        "model": calibration.model.title,
        "parameters": parameters(calibration),
        "noise_std_deg": np.ravel(calibration.noise_std).tolist()
        if calibration.noise_std is not None else None,
        "fit": {"good": bool(verdict.good), "reasons": list(verdict.reasons)},
    }  # fmt: skip
    reasons = recalibrate(summary, config.session.verify_limit_deg)
    mispairing = calibration.mispairing
    if mispairing is not None and mispairing.reason not in reasons:
        reasons.insert(0, mispairing.reason)
    notes |= {"verdict": {"good": not reasons, "reasons": reasons}}
    provenance = {**calibration.provenance, "notes": notes}
    return dataclasses.replace(calibration, provenance=provenance), summary


def parameters(calibration: Any) -> dict[str, Record]:
    """What was fitted, by its name: designed, found, half-width of its interval."""
    fixed = np.zeros(len(calibration.names), dtype=bool)
    errors = calibration.standard_errors
    if errors is not None:
        fixed = np.asarray(errors) == 0.0
    return {
        name: {
            "designed": float(calibration.model.nominal[i]),
            "value": float(calibration.parameters[i]),
            "half_width": None if errors is None else WIDE * float(errors[i]),
        }
        for i, name in enumerate(calibration.names)
        if not fixed[i]
    }
