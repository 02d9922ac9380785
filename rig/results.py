"""refit, report, export and trend: what is made of runs that were recorded."""

from __future__ import annotations

import argparse
import json
import pathlib
import sys
from typing import Any

from jaxcal.files import write_text
from rig.config import parse_config
from rig.core.faults import EXIT_OK, EXIT_RECALIBRATE, MotionFault, Refused
from rig.sessions import recorded, records_of


def refit(args: argparse.Namespace) -> int:
    """Identify a recorded calibration anew, into a folder of its own."""
    from rig.core.record import check_matrix
    from rig.journal import RunFolder, new_run_folder
    from rig.workbench.commission.toml import set_values
    from rig.workbench.identification.conclusion import conclude
    from rig.workbench.identification.refit import require_angles, reread
    from rig.workbench.outputs.console import recalibrate, summary_lines
    from rig.workbench.outputs.report import write_report

    held = records_of(args.run)
    then, start = recorded(args)
    if start["mode"] != "calibrate":
        raise Refused(f"{args.run} is a {start['mode']} run; refit takes a calibration")
    wanted = {
        "mechanism.order": args.order,
        "imu.order": args.imu_order,
        "imu.signs": args.signs,
        "imu.mounting_deg": args.mounting,
    }
    old = {
        "mechanism.order": then.mechanism.order,
        "imu.order": then.imu.order,
        "imu.signs": [*then.imu.signs],
        "imu.mounting_deg": [*then.imu.mounting_deg],
    }
    new = {k: v for k, v in wanted.items() if v is not None and v != old[k]}
    require_angles(then.imu, new)
    text = set_values(then.text, new)
    now = parse_config(text, pathlib.Path(start["maps_from"]), str(args.run))
    changed = {key: [old[key], value] for key, value in new.items()}
    records, evidence = reread(held, then, now)
    calibration, summary = conclude(
        now,
        evidence,
        {"refit_of": args.run.name, "simulated": start["simulated"] is not None},
    )
    try:
        warnings = check_matrix(calibration.matrix)
    except MotionFault as fault:
        raise Refused(f"nothing was written: read like this, {fault}") from None
    if changed:
        summary.pop("after", None)  # compensated by another calibration than this
    summary |= {
        "mode": "refit",
        "refit_of": args.run.name,
        "changed": changed,
        "was": _saved(args.run / "summary.json", "A", "b"),
        "simulated": start["simulated"],
    }
    folder = new_run_folder(args.run.resolve().parent, "refit")
    write_text(folder / "rig.toml", text)
    begun = {key: start[key] for key in ("simulated", "maps_from")}
    run = RunFolder(now, folder, "refit", {**begun, "inputs": {"run": args.run.name}})
    try:
        for record in records:
            fields = {k: v for k, v in record.items() if k not in ("seq", "event")}
            run.emit(record["event"], **fields)
        calibration.save(folder / "calibration.json")
        run.save_pairs()
        run.save_summary(summary)
        run.emit("end", sync=True, code=EXIT_OK, reason="")
        write_report(folder, run.journal.records)
    finally:
        run.journal.close()
    print(f"{args.run.name} identified anew from {len(evidence.chosen)} postures:")
    for key, (was, value) in changed.items():
        print(f"  {key} = {json.dumps(value)}  # was {json.dumps(was)}")
    print("  no key was changed" if not changed else "  Set these in your rig.toml too")
    limit = now.session.verify_limit_deg
    print(*summary_lines(summary, limit), sep="\n")
    print(*(f"WARNING: {text}\n" for text in warnings), sep="", end="")
    print(f"saved: {folder}/calibration.json, pairs.csv, summary.json, report.html")
    return EXIT_RECALIBRATE if recalibrate(summary, limit) else EXIT_OK


def _saved(path: pathlib.Path, *keys: str) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    summary = json.loads(path.read_text(encoding="utf-8"))
    return {key: summary[key] for key in keys}


def report(args: argparse.Namespace) -> int:
    """Write report.html of a run of any kind, also of an unfinished one."""
    from rig.workbench.outputs.report import write_report

    print(write_report(args.run, records_of(args.run)))
    return EXIT_OK


def export(args: argparse.Namespace) -> int:
    """Print or write the inverse map of a run's calibration."""
    from rig.workbench.outputs.export import LANGUAGES, load_inverse

    inverse = load_inverse(args.run, records_of(args.run))
    for text in inverse.warnings:
        print(f"WARNING: {text}", file=sys.stderr)
    text = LANGUAGES[args.to](inverse)
    if args.out is None:
        print(text, end="")
    else:
        write_text(args.out, text)
        print(f"{args.out}: SHA-256 of the numbers {inverse.checksum}")
    return EXIT_OK


def trend(args: argparse.Namespace) -> int:
    """Compare the calibrations in a folder, device by device; also as trend.html."""
    from rig.workbench.outputs.trend import read_runs, trend_lines, write_trend

    if not args.folder.is_dir():
        raise Refused(f"{args.folder} is no folder")
    devices, skipped = read_runs(args.folder)
    for text in skipped:
        print(f"left out: {text}", file=sys.stderr)
    if not devices:
        raise Refused(f"{args.folder} holds no finished calibration or verification")
    for device in devices:
        print(*trend_lines(device), sep="\n")
    print(f"saved: {write_trend(args.folder, devices)}")
    again = any(device.reasons for device in devices)
    return EXIT_RECALIBRATE if again else EXIT_OK
