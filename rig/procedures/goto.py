"""goto: move to a desired orientation through a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rig.command_run import Run
from rig.config import RigConfig
from rig.core.device import Posture
from rig.core.session import visit
from rig.faults import EXIT_OK, EXIT_RECALIBRATE, LimitError, Refused
from rig.readings.attitude import Array
from rig.readings.geometry import Frame, geometry_of


def goto(run: Run, calibration: Any, to: Sequence[float]) -> int:
    """Move the end-effector to (m,) desired measurements through a calibration."""
    config, desired = run.config, np.array(to, dtype=np.float64)
    if len(desired) != len(config.output_names):
        outputs = ", ".join(config.output_names)
        raise Refused(f"--to must be {outputs}, got {len(desired)} numbers")
    command = _command(config, calibration, desired)
    for axis, value in zip(config.axes, command, strict=True):
        if not axis.min_deg <= value <= axis.max_deg:
            raise LimitError(
                f"{desired.tolist()} {config.output_unit} cannot be reached: "
                f"{axis.name} would have to be {value:.3f} {axis.unit_name} (limits "
                f"{axis.min_deg:g} to {axis.max_deg:g}). Choose a target further inside"
            )
    pulses = config.to_pulses(command)
    run.say(
        f"desired {desired.tolist()} {config.output_unit}: command "
        f"{command.round(4).tolist()} {config.axis_unit}, pulses {list(pulses)}"
    )
    if run.lacks(["goto"]):
        with run.device() as device:
            visit(device, Posture("goto", pulses), role="goto")
            counted = [drive.axis.name for drive in device.drives if drive.origin]
            names = unchecked(config, device.frame, counted)
        if names:
            run.say(
                f"NOT CHECKED: whether {', '.join(names)} was moved while without "
                "power. The drive does not report it, and a phone cannot measure "
                "rotation about the vertical. If in doubt: jaxcal-rig setup home"
            )
    record = run.postures().get("goto")
    if record is None:
        return EXIT_RECALIBRATE
    reached = np.array(record["measured_deg"])
    if run.model is not None:
        reached = run.model.outputs(config, [record])[1][0]
    run.say(
        f"reached {reached.round(4).tolist()} {config.output_unit}, off by "
        f"{(reached - desired).round(4).tolist()}"
    )
    return EXIT_OK


def _command(config: RigConfig, calibration: Any, desired: Array) -> Array:
    """(n,) what gives (m,) desired measurements."""
    more: dict[str, Any] = {}
    if config.model is None and len(desired) > len(config.axes):  # as near as they can
        at_zero, *others = calibration.predict(np.eye(len(config.axes) + 1)[:, 1:])
        matrix = np.transpose(others) - at_zero[:, None]
        return np.asarray(np.linalg.lstsq(matrix, desired - at_zero)[0])
    if config.model is not None:
        more["limits"] = [(axis.min_deg, axis.max_deg) for axis in config.axes]
    try:
        return np.asarray(calibration.command_for(desired, **more), dtype=np.float64)
    except ValueError as error:
        if config.model is None:
            raise
        raise Refused(f"goto: no command gives {desired.tolist()}: {error}") from None


def unchecked(
    config: RigConfig, frame: Frame | None, told: Sequence[str] = ()
) -> list[str]:
    """Axes of which neither drive nor phone tells that they were moved when off.

    A drive without homed bit and absolute encoder counts from 0 when it is switched on:
    where it was left there, its count says nothing. That of ``told`` axes does, whose
    home is at a count of its own.
    """
    unseen = [] if frame is None else geometry_of(config).unseen(frame.zero)
    return [
        axis.name
        for axis in config.axes
        if axis.name in unseen
        and not (
            axis.map.has("homed") or axis.map.absolute_encoder or axis.name in told
        )
    ]
