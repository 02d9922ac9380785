"""A recorded calibration identified anew: same readings, other orders or mounting.

The phone's angles are what was recorded, whatever was made of them: the attitude of a
reading is taken apart under the order and signs of then and put together under those of
now.
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
from rig.config.settings import ImuSettings
from rig.core.attitude import (
    DIGITS,
    Array,
    Frame,
    euler_to_matrix,
    frame_at,
    matrix_to_euler,
    mean_rotation,
)
from rig.core.faults import EXIT_OK, EXIT_RECALIBRATE, MotionFault, Refused
from rig.journal import Record, RunFolder, measured_postures, new_run_folder
from rig.workbench.identification.conclusion import Evidence, check_matrix, conclude
from rig.workbench.outputs.console import recalibrate, summary_lines
from rig.workbench.outputs.report import write_report
from rig.workbench.readings import attitudes
from rig.workbench.toml import set_values


def require_angles(imu: ImuSettings, changes: dict[str, Any]) -> None:
    """Refused where the phone sent quaternions, which have neither order nor signs."""
    for name in changes.keys() & {"imu.order", "imu.signs"}:
        if _quaternions(imu):
            raise Refused(
                f"{name} cannot be changed to {changes[name]}: this phone sent "
                "quaternions, which have neither order nor signs. Look at "
                "mechanism.order and imu.mounting_deg"
            )


def _quaternions(imu: ImuSettings) -> bool:
    return imu.format == "sensorlogger" or imu.quaternion_columns is not None


def reread(
    records: list[Record], then: RigConfig, now: RigConfig
) -> tuple[list[Record], Evidence]:
    """Zero, postures and held-out pairs as another configuration reads them.

    Args:
        records: of the journal of a calibration, of any version.
        then: its configuration.
        now: the same but for orders, signs and mounting.

    Returns:
        The records for a new journal, and the evidence to conclude from.

    Raises:
        Refused: not enough was measured to identify from.
    """
    kept = {"zero": [], "held_out": []}  # type: dict[str, list[Record]]
    for record in records:
        kept.get(record["event"], []).append(record)
    postures = measured_postures(records)
    chosen = [r for r in postures.values() if r.get("role") == "select"]
    if not kept["zero"] or len(chosen) < then.session.k:
        raise Refused(
            f"the run holds {len(chosen)} of the {then.session.k} chosen postures that "
            "a calibration takes. Resume it first"
        )
    zero = kept["zero"][-1]
    turned = _turned(attitudes(zero), then.imu, now.imu)
    new = frame_at(now, mean_rotation(turned))
    zero = _remeasured(zero, turned, new)
    zero["measured_deg"] = [0.0, 0.0, 0.0]
    read = {
        name: _remeasured(r, _turned(attitudes(r), then.imu, now.imu), new)
        for name, r in postures.items()
    }
    of_role: dict[str, list[Record]] = {}
    for record in read.values():
        of_role.setdefault(record.get("role", ""), []).append(record)
    held = kept["held_out"][-1:]
    evidence = Evidence(
        zero=zero,
        chosen=of_role["select"],
        held=held[0]["pairs"] if held else [],
        held_out=of_role.get("before", []) + of_role.get("after", []),
        references=sorted(of_role.get("reference", []), key=lambda r: r["time"]),
    )
    return [zero, *held, *read.values()], evidence


def _turned(matrices: Array, then: ImuSettings, now: ImuSettings) -> Array:
    """(N, 3, 3) attitudes from the same phone angles under other order and signs."""
    if (then.order, then.signs) == (now.order, now.signs) or _quaternions(then):
        return matrices
    sent = matrix_to_euler(matrices, str(then.order)) * np.array(then.signs)
    return euler_to_matrix(sent * np.array(now.signs), str(now.order))


def _remeasured(record: Record, matrices: Array, frame: Frame) -> Record:
    attitude = mean_rotation(matrices)
    spread = frame.angles(matrices)
    std = spread.std(axis=0, ddof=1) if len(spread) > 1 else np.zeros(3)
    quaternions = Rotation.from_matrix(matrices).as_quat(canonical=True)
    return record | {
        "measured_deg": frame.angles(attitude).round(9).tolist(),
        "std_deg": std.round(6).tolist(),
        "attitude": attitude.round(12).tolist(),
        "quaternions": quaternions.round(DIGITS).tolist(),
    }


def refit(
    folder: pathlib.Path,
    held: list[Record],
    then: RigConfig,
    wanted: dict[str, Any],
    say: Callable[[str], object],
) -> int:
    """Identify a recorded calibration anew, into a folder beside it.

    Args:
        folder: of the run.
        held: the records of its journal.
        then: its configuration.
        wanted: keys of rig.toml to values; None leaves one as it was.
        say: is told what came of it.

    Returns:
        The exit code.

    Raises:
        Refused: the run does not allow it; nothing was written.
    """
    start = held[0]
    old = {
        "mechanism.order": then.mechanism.order,
        "imu.order": then.imu.order,
        "imu.signs": [*then.imu.signs],
        "imu.mounting_deg": [*then.imu.mounting_deg],
    }
    new = {k: v for k, v in wanted.items() if v is not None and v != old[k]}
    require_angles(then.imu, new)
    text = set_values(then.text, new)
    now = parse_config(text, pathlib.Path(start["maps_from"]), str(folder))
    changed = {key: [old[key], value] for key, value in new.items()}
    records, evidence = reread(held, then, now)
    notes = {"refit_of": folder.name, "simulated": start["simulated"] is not None}
    calibration, summary = conclude(now, evidence, notes)
    try:
        warnings = check_matrix(calibration.matrix)
    except MotionFault as fault:
        raise Refused(f"nothing was written: read like this, {fault}") from None
    if changed:
        summary.pop("after", None)  # compensated by another calibration than this
    summary |= {
        "mode": "refit",
        "refit_of": folder.name,
        "changed": changed,
        "was": _saved(folder / "summary.json", "A", "b"),
        "simulated": start["simulated"],
    }
    into = new_run_folder(folder.resolve().parent, "refit")
    write_text(into / "rig.toml", text)
    begun = {key: start[key] for key in ("simulated", "maps_from")}
    run = RunFolder(now, into, "refit", {**begun, "inputs": {"run": folder.name}})
    try:
        for record in records:
            fields = {k: v for k, v in record.items() if k not in ("seq", "event")}
            run.emit(record["event"], **fields)
        calibration.save(into / "calibration.json")
        run.save_pairs()
        run.save_summary(summary)
        run.emit("end", sync=True, code=EXIT_OK, reason="")
        write_report(into, run.journal.records)
    finally:
        run.journal.close()
    say(f"{folder.name} identified anew from {len(evidence.chosen)} postures:")
    for key, (was, value) in changed.items():
        say(f"  {key} = {json.dumps(value)}  # was {json.dumps(was)}")
    say("  no key was changed" if not changed else "  Set these in your rig.toml too")
    limit = now.session.verify_limit_deg
    for line in summary_lines(summary, limit):
        say(line)
    for text in warnings:
        say(f"WARNING: {text}")
    say(f"saved: {into}/calibration.json, pairs.csv, summary.json, report.html")
    return EXIT_RECALIBRATE if recalibrate(summary, limit) else EXIT_OK


def _saved(path: pathlib.Path, *keys: str) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    summary = json.loads(path.read_text(encoding="utf-8"))
    return {key: summary[key] for key in keys}
