"""A recorded calibration identified anew, the joints in another order."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.files import write_text
from rig.config import RigConfig, parse_config
from rig.faults import EXIT_OK, MotionFault, Refused
from rig.identification.conclusion import check_matrix, conclude
from rig.journal.run_folder import Record, RunFolder, measured_postures, new_run_folder
from rig.outputs.messages import save_result
from rig.prove.steps import set_values
from rig.readings.geometry import Array, geometry_of


def attitudes(record: Record) -> Array:
    """(samples, 3, 3) of the phone in its world, of a posture's or zero's readings."""
    return Rotation.from_quat(record["quaternions"]).as_matrix()


def reread(records: list[Record], now: RigConfig) -> list[Record]:
    """Zero, postures and held-out pairs of a journal, as the configuration ``now``
    reads them; Refused where not enough was measured."""
    postures = measured_postures(records)
    chosen = [r for r in postures.values() if r["role"] == "select"]
    zeros = [r for r in records if r["event"] == "zero"]
    if not zeros or len(chosen) < now.k:
        raise Refused(
            f"the run has {len(chosen)} of the {now.k} chosen postures that a "
            "calibration needs. Finish it first with `jaxcal-rig resume`"
        )
    geometry, frame, by_phone = geometry_of(now), None, now.imu is not None

    def read(record: Record) -> Record:
        nonlocal frame
        values: Any = attitudes(record) if by_phone else np.array(record["readings"])
        attitude = geometry.mean(values)
        frame = frame or geometry.frame(attitude)  # of the zero, which comes first
        spread = frame.angles(values)
        std = spread.std(axis=0, ddof=1) if len(spread) > 1 else 0.0 * spread[0]
        return record | {
            "measured_deg": frame.angles(attitude).round(9).tolist(),
            "std_deg": std.round(6).tolist(),
            "attitude": attitude.round(12).tolist(),
        }

    held = [r for r in records if r["event"] == "held_out"][-1:]
    return [read(zeros[-1]), *held, *map(read, postures.values())]


def refit(
    folder: pathlib.Path,
    held: list[Record],
    then: RigConfig,
    order: str | None,
    say: Callable[[str], object],
) -> int:
    """Identify a recorded calibration anew, into a folder beside it; the exit code.

    ``held`` are the records of its journal, ``then`` its configuration; ``order`` is a
    mechanism.order, None what it was. Refused where the run does not allow it.
    """
    start, changed = held[0], dict[str, list[Any]]()
    if order is not None:
        if then.imu is None or then.is_arm:
            raise Refused("--order needs a phone on three joints: not this device")
        if order != then.mechanism.order:
            changed["mechanism.order"] = [then.mechanism.order, order]
    text = set_values(then.text, {key: value for key, (_, value) in changed.items()})
    now = parse_config(text, pathlib.Path(start["maps_from"]), str(folder))
    records = reread(held, now)
    notes = {"refit_of": folder.name, "simulated": start["simulated"] is not None}
    calibration, summary = conclude(now, records, notes, compensated=not changed)
    warnings = []
    if now.model is None:
        try:
            warnings = check_matrix(now, calibration.matrix)
        except MotionFault as fault:
            raise Refused(f"nothing was written: with these keys, {fault}") from None
    summary |= {"mode": "refit", "refit_of": folder.name, "changed": changed}
    summary["simulated"] = start["simulated"]
    into = new_run_folder(folder.resolve().parent, "refit")
    write_text(into / "rig.toml", text)
    begun = {key: start[key] for key in ("simulated", "maps_from")}
    run = RunFolder(now, into, "refit", {**begun, "inputs": {"run": folder.name}})
    try:
        for record in records:
            fields = {k: v for k, v in record.items() if k not in ("seq", "event")}
            run.emit(record["event"], **fields)
        run.emit("end", sync=True, code=EXIT_OK, reason="")
        chosen = len(summary["postures"])
        say(f"{folder.name} identified again from {chosen} postures:")
        for key, (before, value) in changed.items():
            say(f"  {key} = {json.dumps(value)}  # was {json.dumps(before)}")
        say("  Set these in your rig.toml too" if changed else "  no key was changed")
        for warning in warnings:
            say(f"WARNING: {warning}")
        return save_result(run, calibration, summary, say)
    finally:
        run.journal.close()
