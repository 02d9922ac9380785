"""Calibrations of a device over time: what moved, and whether the last one holds."""

from __future__ import annotations

import datetime
import json
import math
import pathlib

import numpy as np

from jaxcal.checks import aligned
from rig.faults import JournalError
from rig.journal.run_folder import Record, read_journal
from rig.outputs.messages import held_out, recalibrate

HEAD = ["measured", "run", "mode", "held-out error", "moved since the previous one"]


def read_runs(folder: pathlib.Path) -> tuple[list[list[Record]], list[str]]:
    """Finished calibrations and verifications under a folder, a list for each device,
    the oldest first; and a line for each journal that could not be read.

    Runs of different device fingerprints are never compared. A refit stands at the time
    at which its run was measured.
    """
    runs_of_device: dict[str, list[Record]] = {}
    skipped = []
    for path in sorted(folder.rglob("journal.jsonl")):
        try:
            start = read_journal(path)[0]
            text = (path.parent / "summary.json").read_text(encoding="utf-8")
            device = start["device"]
            if start.get("simulated"):  # never compared with a real one
                device = {"simulated": True, **device}
            run = json.loads(text) | {
                "limit": start["config"]["session"]["verify_limit_deg"],
                "name": path.parent.name, "mode": start["mode"], "device": device,
            }  # fmt: skip
            run["time"] = run.get("measured_at", start["time"])
        except FileNotFoundError:
            continue  # not finished, or of a kind without a summary
        except (OSError, JournalError, ValueError, KeyError, IndexError) as error:
            skipped.append(f"{path.parent}: {error}")
            continue
        runs_of_device.setdefault(json.dumps(device, sort_keys=True), []).append(run)
    devices = runs_of_device.values()
    return [sorted(runs, key=lambda run: run["time"]) for runs in devices], skipped


def trend_lines(runs: list[Record]) -> tuple[list[str], bool]:
    """A device's runs and the verdict for the console; whether to calibrate again."""
    rows, before, reasons = [HEAD], None, list[str]()
    for run in runs:
        moved, error = "", "not measured"
        if "A" in run or "parameters" in run:
            moved = "first"
            if before is not None:
                moved = ", ".join(_moved(before, run)) or "nothing"
            before = run
        if "prediction" in run:
            _, worst = held_out(run)
            error = f"{worst:.4f} {run.get('unit', 'deg')} (limit {run['limit']:g})"
        if moved or "prediction" in run:
            reasons = [f"{run['name']}: {x}" for x in recalibrate(run, run["limit"])]
        when = f"{datetime.datetime.fromtimestamp(run['time']):%Y-%m-%d %H:%M}"
        rows.append([when, run["name"], run["mode"], error, moved])
    told, keys = runs[0]["device"], ("map", "unit", "pulses_per_rev", "reduction")
    parts = [key.split(".") for key in told]
    names = dict.fromkeys(part[1] for part in parts if part[0] == "axes")
    axes = (
        " ".join([name, *(str(told.get(f"axes.{name}.{k}", "?")) for k in keys)])
        for name in names
    )
    label = f"{'; '.join(axes)}; order {told.get('mechanism.order', '-')}"
    simulated = "simulated: " if told.get("simulated") else ""
    verdict = "the last calibration still holds"
    if reasons:
        verdict = f"RECALIBRATE: {'; '.join(reasons)}"
    table = [f"  {line}" for line in aligned(rows, "<")]
    return [f"device {simulated}{label}", *table, f"  {verdict}"], bool(reasons)


def _moved(before: Record, now: Record) -> list[str]:
    """Parameters that differ by more than their intervals allow, A before b."""
    then, moved, form = _values(before), [], "g" if "parameters" in now else "f"
    for name, (value, wide) in _values(now).items():
        if name not in then or wide is None:
            continue
        change, allowed = value - then[name][0], math.hypot(wide, then[name][1] or 0.0)
        if abs(change) > allowed:
            moved.append(f"{name} {change:+.4{form}} (interval {allowed:.4{form}})")
    return moved


def _values(run: Record) -> dict[str, tuple[float, float | None]]:
    """What a run identified by its name, with its half-width."""
    if "parameters" in run:
        fitted = run["parameters"].items()
        return {name: (p["value"], p["half_width"]) for name, p in fitted}
    axes = run["axes"]
    outputs = run.get("outputs") or axes
    names = [f"A[{y}, {u}]" for y in outputs for u in axes]
    names += [f"b[{y}]" for y in outputs]
    wide = np.array(run["ci95"])
    values = np.concatenate([np.ravel(run["A"]), run["b"]]).tolist()
    widths = np.concatenate([wide[:, :-1].ravel(), wide[:, -1]]).tolist()
    return dict(zip(names, zip(values, widths, strict=True), strict=True))
