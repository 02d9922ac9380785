"""Calibrations of a device over time: what moved, and whether the last one holds."""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import pathlib

import numpy as np

from jaxcal.checks import aligned
from jaxcal.reports.page import Badge, Block, Page, Section, Table, Text, write_page
from rig.faults import JournalError
from rig.journal.run_folder import Record, read_journal
from rig.outputs.messages import held_out, recalibrate
from rig_workbench.outputs.report import draw_parameters, drawn

HEAD = ["measured", "run", "mode", "held-out error", "moved since the previous one"]
HOLDS = "the last calibration still holds"


@dataclasses.dataclass
class DeviceHistory:
    """What was found of one device fingerprint, the oldest first."""

    fingerprint: Record
    rows: list[list[str]]  # of a table under HEAD
    calibrations: list[Record]  # summaries of those that identified, with their time
    reasons: list[str]  # to calibrate again; none where the last calibration holds

    @property
    def verdict(self) -> str:
        return f"RECALIBRATE: {'; '.join(self.reasons)}" if self.reasons else HOLDS


def read_runs(folder: pathlib.Path) -> tuple[list[DeviceHistory], list[str]]:
    """The devices with finished calibrations and verifications under a folder, and a
    line for each journal that could not be read.

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
    return [_device(runs) for runs in runs_of_device.values()], skipped


def _device(runs: list[Record]) -> DeviceHistory:
    device = DeviceHistory(runs[0]["device"], [], [], [])
    for run in sorted(runs, key=lambda run: run["time"]):
        moved, error = "", "not measured"
        if "A" in run or "parameters" in run:
            moved = "first"
            if device.calibrations:
                moved = ", ".join(_moved(device.calibrations[-1], run)) or "nothing"
            device.calibrations.append(run)
        if "prediction" in run:
            _, worst = held_out(run)
            error = f"{worst:.4f} {run.get('unit', 'deg')} (limit {run['limit']:g})"
            reasons = recalibrate(run, run["limit"])
            device.reasons = [f"{run['name']}: {reason}" for reason in reasons]
        when = f"{datetime.datetime.fromtimestamp(run['time']):%Y-%m-%d %H:%M}"
        device.rows.append([when, run["name"], run["mode"], error, moved])
    return device


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
    outputs = run["outputs"] if "outputs" in run else axes
    names = [f"A[{y}, {u}]" for y in outputs for u in axes]
    names += [f"b[{y}]" for y in outputs]
    wide = np.array(run["ci95"])
    values = np.concatenate([np.ravel(run["A"]), run["b"]]).tolist()
    widths = np.concatenate([wide[:, :-1].ravel(), wide[:, -1]]).tolist()
    return dict(zip(names, zip(values, widths, strict=True), strict=True))


def trend_lines(device: DeviceHistory) -> list[str]:
    """The table and the verdict for the console."""
    table = [f"  {line}" for line in aligned([HEAD, *device.rows], "<")]
    told, keys = device.fingerprint, ("map", "unit", "pulses_per_rev", "reduction")
    parts = [key.split(".") for key in told]
    names = dict.fromkeys(part[1] for part in parts if part[0] == "axes")
    axes = (
        " ".join([name, *(str(told.get(f"axes.{name}.{k}", "?")) for k in keys)])
        for name in names
    )
    label = f"{'; '.join(axes)}; order {told.get('mechanism.order', '-')}"
    simulated = "simulated: " if told.get("simulated") else ""
    return [f"device {simulated}{label}", *table, f"  {device.verdict}"]


def write_trend(folder: pathlib.Path, devices: list[DeviceHistory]) -> pathlib.Path:
    """Write ``trend.html``; returns its path."""
    sections = []
    for number, device in enumerate(devices):
        bad = bool(device.reasons)
        blocks: list[Block] = [
            Text(device.verdict, "warning" if bad else ""),
            Table(HEAD, device.rows, numeric=False),
        ]
        if device.calibrations and "A" in device.calibrations[-1]:
            alt = "A and b over time, with their 95 % intervals"
            blocks.append(drawn(draw_parameters, device.calibrations, (11, 7), alt))
        rows = [[key, json.dumps(v)] for key, v in device.fingerprint.items()]
        blocks.append(Table(["fingerprint", ""], rows, numeric=False))
        badge = Badge("recalibrate", "bad") if bad else Badge("holds", "good")
        sections.append(Section(f"Device {number + 1}", blocks, badge=badge))
    path = folder / "trend.html"
    write_page(path, Page(f"Calibrations in {folder.resolve().name}", sections))
    return path
