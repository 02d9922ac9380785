"""collect, verify and goto: the sessions besides calibrate."""

from __future__ import annotations

import json
import pathlib
from typing import Any

import numpy as np

from jaxcal.files import atomic_write, write_text
from rig.attitude import Array
from rig.exits import EXIT_OK, EXIT_RECALIBRATE, Refused
from rig.identification import errors, pairs
from rig.limits import LimitError
from rig.planning import draw_held_out
from rig.session import Run
from rig.settings import RigConfig
from rig.words import pairs_csv

__all__ = ["collect", "goto", "load_calibration", "verify"]


def collect(run: Run, count: int, dry_run: bool = False) -> int:
    """Record ``count`` random postures: the paper's Datasets 4 and 5.

    Writes pairs.csv and dataset.npz with ``candidates`` and ``measured`` of shape
    (episodes, M, 3), M as configured; the last, unfinished episode is in the CSV only.
    """
    config = run.config

    def make() -> dict[str, Any]:
        rng = np.random.default_rng([config.session.seed, 2])
        low, high = np.array(config.session.ranges).T
        angles = rng.uniform(low, high, size=(count, 3))
        return {"pulses": [list(config.to_pulses(angle)) for angle in angles]}

    targets = run.remember("collection", make)["pulses"]
    if dry_run:
        for number, target in enumerate(targets):
            degrees = " ".join(f"{v:9.4f}" for v in config.to_deg(target))
            run.say(f"  {number:>5}   {degrees}   {target}")
        run.say("dry run: nothing was sent to the bus")
        return EXIT_OK
    run.planned = len(targets)
    for number, target in enumerate(targets):
        run.visit(f"collect:{number}", target, role="collect")
    run.phase("saving")
    records = list(run.postures().values())
    size = config.session.candidates
    commands, measured = pairs(records)
    episodes = len(records) // size
    if episodes == 0:
        episodes, size = 1, len(records)
    write_text(run.folder / "pairs.csv", pairs_csv(run))
    shape = (episodes, size, 3)
    with atomic_write(run.folder / "dataset.npz") as file:
        np.savez(
            file,
            candidates=commands[: episodes * size].reshape(shape),
            measured=measured[: episodes * size].reshape(shape),
        )
    run.say(
        f"saved: {run.folder}/pairs.csv ({len(records)} postures), dataset.npz "
        f"({episodes} x {size})"
    )
    return EXIT_OK


def load_calibration(path: pathlib.Path, config: RigConfig) -> tuple[Any, Any]:
    """A saved calibration and the pulses of its zero posture (None where unknown).

    Raises:
        Refused: it cannot be read.
    """
    import jaxcal

    if path.is_dir():
        path = path / "calibration.json"
    try:
        calibration = jaxcal.Calibration.load(path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Refused(f"{path}: not a calibration: {error}") from None
    zero = None
    notes = calibration.provenance.get("notes", {})
    if "zero_pulses" in notes:
        a, b, c = (int(value) for value in notes["zero_pulses"])
        zero = (a, b, c)
    return calibration, zero


def verify(run: Run, calibration: Any, count: int, dry_run: bool = False) -> int:
    """Fresh held-out postures against a saved calibration: is it still true?"""
    config = run.config

    def make() -> dict[str, Any]:
        found = draw_held_out(config, calibration, count)
        return {"pairs": [[list(raw), list(command)] for raw, command in found]}

    held = run.remember("held_out", make)["pairs"]
    if not held:
        raise Refused("no target in the ranges can be reached through this calibration")
    run.planned = 2 * len(held)
    if dry_run:
        for raw, command in held:
            run.say(
                f"  target {config.to_deg(raw).round(4).tolist()}  command {command}"
            )
        run.say("dry run: nothing was sent to the bus")
        return EXIT_OK
    before, after, desired = [], [], []
    for number, (raw, command) in enumerate(held):
        one = run.visit(f"before:{number}", raw, role="before")
        two = run.visit(f"after:{number}", command, role="after")
        if one is not None and two is not None:
            before.append(one)
            after.append(two)
            desired.append(config.to_deg(raw))
    if not desired:
        raise Refused("no held-out posture could be reached")
    targets = np.array(desired)
    found = {"before": errors(before, targets), "after": errors(after, targets)}
    commands, measured = pairs(before + after)
    predicted = measured - calibration.predict(commands)
    limit = config.session.verify_limit_deg
    worst = found["after"]["max"]
    again = bool(worst > limit)
    summary = {
        **found,
        "prediction_rms": float(np.sqrt((predicted**2).mean())),
        "limit_deg": limit,
        "recalibrate": again,
    }
    run.phase("saving")
    write_text(run.folder / "pairs.csv", pairs_csv(run))
    write_text(run.folder / "summary.json", json.dumps(summary, indent=1))
    run.say(
        f"error raw {found['before']['rms']:.4f} deg rms (max "
        f"{found['before']['max']:.4f}), compensated {found['after']['rms']:.4f} (max "
        f"{worst:.4f}), limit {limit:g}"
    )
    run.say("time to RECALIBRATE" if again else "the calibration still holds")
    return EXIT_RECALIBRATE if again else EXIT_OK


def goto(run: Run, calibration: Any, desired: Array, dry_run: bool = False) -> int:
    """Move the end-effector to a desired posture through a calibration."""
    config = run.config
    command = np.asarray(calibration.command_for(desired), dtype=np.float64)
    for axis, value in zip(config.axes, command, strict=True):
        if not axis.min_deg <= value <= axis.max_deg:
            raise LimitError(
                f"{desired.tolist()} deg needs {axis.name} commanded to {value:.3f} "
                f"deg, outside [{axis.min_deg:g}, {axis.max_deg:g}]"
            )
    pulses = config.to_pulses(command)
    run.say(
        f"desired {desired.tolist()} deg: command {command.round(4).tolist()} deg, "
        f"pulses {list(pulses)}"
    )
    if dry_run:
        run.say("dry run: nothing was sent to the bus")
        return EXIT_OK
    run.planned = 1
    record = run.visit("goto", pulses, role="goto")
    if record is None:
        return EXIT_RECALIBRATE
    off = np.array(record["measured_deg"]) - desired
    run.say(
        f"reached {np.round(record['measured_deg'], 4).tolist()} deg, off by "
        f"{off.round(4).tolist()}"
    )
    return EXIT_OK
