"""A recorded calibration identified anew: same readings, read in another way.

The phone's angles are what was recorded, whatever was made of them: the attitude of a
reading is taken apart under the order and signs of then and put together under those of
now. Numbers of a sensor stay as they are.
"""

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
from rig.readings.attitude import DIGITS, Array, euler_to_matrix, matrix_to_euler
from rig.readings.geometry import geometry_of


def attitudes(record: Record) -> Array:
    """(samples, 3, 3) of the phone in its world, of a posture's or zero's readings."""
    return Rotation.from_quat(record["quaternions"]).as_matrix()


def reread(records: list[Record], then: RigConfig, now: RigConfig) -> list[Record]:
    """Zero, postures and held-out pairs of a journal, made with the configuration
    ``then``, as ``now`` reads them; Refused where not enough was measured."""
    postures = measured_postures(records)
    chosen = [r for r in postures.values() if r["role"] == "select"]
    zeros = [r for r in records if r["event"] == "zero"]
    if not zeros or len(chosen) < then.k:
        raise Refused(
            f"the run has {len(chosen)} of the {then.k} chosen postures that a "
            "calibration needs. Finish it first with `jaxcal-rig resume`"
        )
    geometry, frame = geometry_of(now), None
    values_of: Callable[[Record], Any] = _numbers
    if then.imu is not None:
        values_of = _attitudes(then, now)

    def read(record: Record) -> Record:
        nonlocal frame
        values, raw = values_of(record)
        attitude = geometry.mean(values)
        frame = frame or geometry.frame(attitude)  # of the zero, which comes first
        spread = frame.angles(values)
        std = spread.std(axis=0, ddof=1) if len(spread) > 1 else 0.0 * spread[0]
        return record | {
            "measured_deg": frame.angles(attitude).round(9).tolist(),
            "std_deg": std.round(6).tolist(),
            "attitude": attitude.round(12).tolist(),
            **raw,
        }

    held = [r for r in records if r["event"] == "held_out"][-1:]
    return [read(zeros[-1]), *held, *map(read, postures.values())]


def _attitudes(then: RigConfig, now: RigConfig) -> Callable[[Record], Any]:
    """What reads the phone's attitudes of a record, and the fields that hold them."""
    phone, new = then.phone, now.phone
    same = (phone.order, phone.signs) == (new.order, new.signs)
    signs = np.array(phone.signs) * np.array(new.signs)

    def read(record: Record) -> tuple[Array, Record]:
        turned = attitudes(record)
        if not same:
            sent = matrix_to_euler(turned, str(phone.order))
            turned = euler_to_matrix(sent * signs, str(new.order))
        quaternions = Rotation.from_matrix(turned).as_quat(canonical=True)
        return turned, {"quaternions": quaternions.round(DIGITS).tolist()}

    return read


def _numbers(record: Record) -> tuple[Array, Record]:
    return np.array(record["readings"]), {}


def _changed(then: RigConfig, wanted: dict[str, Any]) -> dict[str, list[Any]]:
    """Keys that are to be read otherwise, as they were and as they will be; Refused
    where one is not of what the run was measured with."""
    imu, described = then.imu, json.loads(json.dumps(then.described()))
    changed = {}
    for name, value in wanted.items():
        if value is None:
            continue
        table, _, key = name.partition(".")
        if table == "imu" and imu is None:
            raise Refused(f"{name} needs a phone; this run was measured by a sensor")
        if table == "mechanism" and (imu is None or then.is_arm):
            raise Refused(f"{name} needs a phone on three joints: not this device")
        old, new = described[table][key], json.loads(json.dumps(value))
        if old != new:
            changed[name] = [old, value]
    quaternions = imu and imu.by_quaternion
    for name in changed.keys() & {"imu.order", "imu.signs"} if quaternions else ():
        raise Refused(
            f"{name} cannot be changed to {changed[name][1]}: this phone sent "
            "quaternions, which have neither order nor signs. Check mechanism.order "
            "and imu.mounting_deg"
        )
    return changed


def refit(
    folder: pathlib.Path,
    held: list[Record],
    then: RigConfig,
    wanted: dict[str, Any],
    say: Callable[[str], object],
) -> int:
    """Identify a recorded calibration anew, into a folder beside it; the exit code.

    Args:
        folder, held, then: of the run, the records of its journal, its configuration.
        wanted: keys of rig.toml to values; None leaves one as it was. Refused, and
            nothing written, where the run does not allow it.
        say: is told what came of it.
    """
    start, changed = held[0], _changed(then, wanted)
    text = set_values(then.text, {key: value for key, (_, value) in changed.items()})
    now = parse_config(text, pathlib.Path(start["maps_from"]), str(folder))
    records = reread(held, then, now)
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
