"""What uses a saved calibration: verify, whether it still holds, and goto."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from rig.command_run import Run
from rig.config import RigConfig
from rig.config.config import differences
from rig.core.device import Posture
from rig.core.record_check import ZeroRecord
from rig.core.session import visit
from rig.faults import EXIT_OK, EXIT_RECALIBRATE, LimitError, Refused
from rig.identification.conclusion import held_out_errors
from rig.outputs.messages import error_text, held_out
from rig.parts import model_of
from rig.procedures.calibrate import pair_targets, visit_pairs
from rig.procedures.plan import draw_held_out
from rig.readings.geometry import Array, Frame, geometry_of


def load_calibration(
    path: pathlib.Path, config: RigConfig, simulated: bool = False
) -> tuple[Any, ZeroRecord]:
    """A calibration made with a device configured as this one, and its zero posture.

    Raises Refused: not a calibration's file or run, or of another device (names the
    keys), or made with a simulated one, and that to be moved is not ``simulated``.
    """
    import jaxcal

    path = path / "calibration.json" if path.is_dir() else path
    try:
        made = None if config.is_arm else model_of(config)  # a file holds an arm
        model = None if made is None else made.model
        calibration = jaxcal.Calibration.load(path, model=model)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise Refused(f"{path}: not a calibration: {reason}") from None
    notes = calibration.provenance.get("notes", {})
    if notes.get("simulated") and not simulated:
        raise Refused(
            f"{path}: made with a simulated device, so it is not valid for the real "
            "one. Calibrate the device, or use it with --simulate"
        )
    if lack := {"device", "zero_pulses", "zero_attitude"} - notes.keys():
        raise Refused(
            f"{path}: the device and zero posture are not recorded (no "
            f"{', '.join(sorted(lack))}). Calibrate the device: jaxcal-rig calibrate"
        )
    if changed := differences(notes["device"], config.device_fingerprint()):
        raise Refused(
            f"{path}: made with another device: {'; '.join(changed)}. Correct "
            "rig.toml, or calibrate this device"
        )
    kept = ZeroRecord(
        f"calibration {notes.get('run', path)}",
        tuple(map(int, notes["zero_pulses"])),
        np.array(notes["zero_attitude"], dtype=np.float64),
    )
    return calibration, kept


def verify(run: Run, calibration: Any, count: int) -> int:
    """Fresh held-out postures against a saved calibration: is it still true?"""
    config = run.config
    held = run.remember(
        "held_out", lambda: {"pairs": draw_held_out(config, calibration, count)}
    )["pairs"]
    if not held:
        raise Refused(
            "no target in session.*_range_deg can be reached with this calibration. "
            "Widen the ranges, or calibrate again"
        )
    if run.lacks(pair_targets(held)):
        with run.device() as device:
            visit_pairs(run, device, held)
            run.emit("phase", phase="saving")
    if run.model is not None:
        records = [r for r in run.postures().values() if r["role"] == "held"]
        errors = run.model.held_out_errors(config, calibration, records)
    else:
        _, errors = held_out_errors(config, held, run.postures(), calibration)
    if not errors:
        raise Refused(
            "no held-out posture could be reached. Narrow session.*_range_deg to what "
            "the device reaches"
        )
    limit = config.session.verify_limit_deg
    again = held_out(errors)[1] > limit
    run.save_pairs()
    run.save_summary({**errors, "limit_deg": limit, "recalibrate": again})
    run.say(f"{error_text(errors, config.output_unit)}, limit {limit:g}")
    over = "RECALIBRATE: over session.verify_limit_deg. Run `jaxcal-rig calibrate`"
    run.say(over if again else "the calibration still holds")
    return EXIT_RECALIBRATE if again else EXIT_OK


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
    if config.model is not None:
        limits = [(axis.min_deg, axis.max_deg) for axis in config.axes]
        try:
            commands = calibration.command_for(desired, limits=limits)
            return np.asarray(commands, dtype=np.float64)
        except ValueError as error:
            text = f"goto: no command gives {desired.tolist()}: {error}"
            raise Refused(text) from None
    if len(desired) > len(config.axes):  # as near as they can
        matrix = np.asarray(calibration.matrix)
        return np.linalg.lstsq(matrix, desired - calibration.bias)[0]
    return np.asarray(calibration.command_for(desired), dtype=np.float64)


def unchecked(
    config: RigConfig, frame: Frame | None, told: Sequence[str] = ()
) -> list[str]:
    """Axes of which neither drive nor phone tells that they were moved when off.

    A drive without homed bit and absolute encoder counts from 0 when it is switched on,
    but for ``told`` axes, whose home is at a count of its own.
    """
    unseen = [] if frame is None else geometry_of(config).unseen(frame.zero)
    telling = [a.name for a in config.axes if a.map.has("homed")]
    telling += [a.name for a in config.axes if a.map.absolute_encoder]
    names = [name for name in config.axis_names if name in unseen]
    return [name for name in names if name not in (*telling, *told)]
