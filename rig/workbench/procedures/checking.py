"""collect; and what uses a calibration: verify, goto."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcal.files import atomic_write
from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.config.config import differences
from rig.core.attitude import Frame
from rig.core.device import Posture
from rig.core.faults import EXIT_OK, EXIT_RECALIBRATE, LimitError, Refused
from rig.core.known import KeptZero, unseen
from rig.core.session import visit
from rig.workbench.identification.fit import held_out_errors, pairs
from rig.workbench.outputs.words import error_text, numbers
from rig.workbench.procedures.calibrate import END, pair_names, visit_pairs
from rig.workbench.procedures.plan import draw, draw_held_out
from rig.workbench.run import Run

_OFFERED = 10  # targets to choose each posture of a check from


def collect(run: Run, count: int) -> int:
    """Record ``count`` random postures: the paper's Datasets 4 and 5.

    Writes pairs.csv and dataset.npz with ``candidates`` and ``measured`` of shape
    (episodes, M, 3), M as configured; the last, unfinished episode is in the CSV only.
    """
    config = run.config
    targets = run.remember(
        "collection", lambda: {"pulses": draw(config, count, 2).tolist()}
    )["pulses"]
    if run.dry_run:
        for number, target in enumerate(targets):
            run.say(f"  {number:>5}   {numbers(config.to_deg(target))}   {target}")
    names = [f"collect:{number}" for number in range(len(targets))]
    if run.lacks([*names, END]):
        with run.device() as device:
            for name, target in zip(names, targets, strict=True):
                visit(device, Posture(name, tuple(target)), role="collect")
            visit(device, Posture(END, run.zero_pulses), role="reference")
            run.emit("phase", phase="saving")
    closing = run.postures().get(END)
    collected = [r for r in run.postures().values() if r["role"] == "collect"]
    commands, measured = pairs(collected)
    size = min(config.session.candidates, len(commands))
    episodes = len(commands) // max(1, size)
    run.save_pairs()
    with atomic_write(run.folder / "dataset.npz") as file:
        np.savez(
            file,
            candidates=commands[: episodes * size].reshape(episodes, size, 3),
            measured=measured[: episodes * size].reshape(episodes, size, 3),
        )
    run.say(
        f"saved: {run.folder}/pairs.csv ({len(commands)} postures), dataset.npz "
        f"({episodes} x {size})"
    )
    drift = np.abs(closing["measured_deg"]).max() if closing else 0.0
    limit = config.session.drift_limit_deg
    if drift > limit:
        run.say(
            f"RECALIBRATE: the zero posture reads {drift:.3f} deg at the end (limit "
            f"session.drift_limit_deg = {limit:g}). Fix the phone, and collect again"
        )
        return EXIT_RECALIBRATE
    return EXIT_OK


def load_calibration(
    path: pathlib.Path, config: RigConfig, simulated: bool = False
) -> tuple[Any, KeptZero]:
    """A calibration made with a device configured as this one, and its zero posture.

    Args:
        path: of the file, or of its run's folder.
        config: of the device.
        simulated: so is the device that is to be moved.

    Raises:
        Refused: not a calibration, or of another device (names the keys), or made with
            a simulated one, and that to be moved is real.
    """
    import jaxcal

    path = path / "calibration.json" if path.is_dir() else path
    try:
        calibration = jaxcal.Calibration.load(path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Refused(f"{path}: not a calibration: {error}") from None
    notes = calibration.provenance.get("notes", {})
    if notes.get("simulated") and not simulated:
        raise Refused(
            f"{path}: made with a simulated device: it says nothing of the real one. "
            "Calibrate the device, or use it with --simulate"
        )
    if lack := {"device", "zero_pulses", "zero_attitude"} - notes.keys():
        raise Refused(
            f"{path}: does not say with which device and zero posture it was made "
            f"(no {', '.join(sorted(lack))}). Calibrate it: jaxcal-rig calibrate"
        )
    if changed := differences(notes["device"], config.device_fingerprint()):
        raise Refused(
            f"{path}: made with another device: {'; '.join(changed)}. Correct "
            "rig.toml, or calibrate this device"
        )
    kept = KeptZero(
        f"calibration {notes.get('run', path)}",
        tuple(map(int, notes["zero_pulses"])),
        np.array(notes["zero_attitude"], dtype=np.float64),
    )
    return calibration, kept


def doubts(calibration: Any) -> list[str]:
    """Why its session said not to use a calibration; one made before 0.3 says none."""
    verdict = calibration.provenance.get("notes", {}).get("verdict", {})
    return list(verdict.get("reasons", ()))


def verify(run: Run, calibration: Any, count: int) -> int:
    """Fresh held-out postures against a saved calibration: is it still true?"""
    config = run.config
    held = run.remember(
        "held_out", lambda: {"pairs": telling(config, calibration, count)}
    )["pairs"]
    if not held:
        raise Refused(
            "no target in session.*_range_deg can be reached through this calibration. "
            "Widen the ranges, or calibrate again"
        )
    if run.dry_run:
        for raw, command in held:
            run.say(f"  target {numbers(config.to_deg(raw))}  command {list(command)}")
    if run.lacks(pair_names(held)):
        with run.device() as device:
            visit_pairs(run, device, held)
            run.emit("phase", phase="saving")
    records, found = held_out_errors(config, held, run.postures(), calibration)
    if not found:
        raise Refused(
            "no held-out posture could be reached. Narrow session.*_range_deg to what "
            "the device reaches"
        )
    limit = config.session.verify_limit_deg
    again = found["after"]["max"] > limit
    run.save_pairs()
    run.save_summary({**found, "limit_deg": limit, "recalibrate": again})
    run.say(f"{error_text(found)}, limit {limit:g}")
    if calibration.noise_std is not None:
        told = calibration.check(*pairs(records), tolerance=limit)
        run.say(f"a drift that moves it by {limit:g} is seen with {told.power:.0%}")
    over = "RECALIBRATE: over session.verify_limit_deg. Run `jaxcal-rig calibrate`"
    run.say(over if again else "the calibration still holds")
    return EXIT_RECALIBRATE if again else EXIT_OK


def telling(
    config: RigConfig, calibration: Any, count: int
) -> list[tuple[Pulses, Pulses]]:
    """Of many held-out targets those that show best that the calibration is wrong."""
    offered = draw_held_out(config, calibration, _OFFERED * count)
    if calibration.noise_std is None or len(offered) <= count:
        return offered[:count]
    at = np.array([config.to_deg(command) for _, command in offered])
    return [offered[i] for i in calibration.verification(at, count)]


def goto(run: Run, calibration: Any, to: Sequence[float]) -> int:
    """Move the end-effector to (3,) desired degrees through a calibration."""
    config, desired = run.config, np.array(to, dtype=np.float64)
    command = np.asarray(calibration.command_for(desired), dtype=np.float64)
    for axis, value in zip(config.axes, command, strict=True):
        if not axis.min_deg <= value <= axis.max_deg:
            raise LimitError(
                f"{desired.tolist()} deg needs {axis.name} commanded to {value:.3f} "
                f"deg, outside [{axis.min_deg:g}, {axis.max_deg:g}]. Choose a target "
                "further inside"
            )
    pulses = config.to_pulses(command)
    run.say(
        f"desired {desired.tolist()} deg: command {command.round(4).tolist()} deg, "
        f"pulses {list(pulses)}"
    )
    if run.lacks(["goto"]):
        with run.device() as device:
            visit(device, Posture("goto", pulses), role="goto")
            counted = [drive.axis.name for drive in device.drives if drive.origin]
            names = unchecked(config, device.frame, counted)
        if names:
            run.say(
                f"NOT CHECKED: whether {', '.join(names)} was moved while without "
                "power. The drive does not tell, and the phone does not see a turn "
                "about the vertical. If in doubt: jaxcal-rig home"
            )
    record = run.postures().get("goto")
    if record is None:
        return EXIT_RECALIBRATE
    reached = np.array(record["measured_deg"])
    run.say(
        f"reached {reached.round(4).tolist()} deg, off by "
        f"{(reached - desired).round(4).tolist()}"
    )
    return EXIT_OK


def unchecked(
    config: RigConfig, frame: Frame | None, told: Sequence[str] = ()
) -> list[str]:
    """Axes of which neither drive nor phone tells that they were moved when off.

    A drive without homed bit and absolute encoder counts from 0 when it is switched on:
    where it was left there, its count says nothing. That of ``told`` axes does, whose
    home is at a count of its own.
    """
    seen = [] if frame is None else unseen(config, frame.zero)
    return [
        axis.name
        for axis in config.axes
        if axis.name in seen
        and not (axis.map.homed or axis.map.absolute_encoder or axis.name in told)
    ]
