"""Calibrations of a device over time: what moved, and whether the last one holds."""

from __future__ import annotations

import dataclasses
import datetime
import json
import pathlib

import numpy as np

from jaxcal.pages import Badge, Block, Page, Section, Table, Text, write_page
from rig.config import AXIS_NAMES
from rig.core.attitude import Array
from rig.journal import JournalError, Record, read_journal
from rig.workbench.outputs.console import recalibrate
from rig.workbench.outputs.report import draw_parameters, drawn

NAMES = [f"A[{y}, {u}]" for y in AXIS_NAMES for u in AXIS_NAMES]
NAMES = [*NAMES, *(f"b[{y}]" for y in AXIS_NAMES)]  # of the twelve parameters
HEAD = ["measured", "run", "mode", "held-out error [deg]", "moved since the one before"]


@dataclasses.dataclass(frozen=True)
class Device:
    """The runs of one device fingerprint, oldest first, and their rows of a table."""

    fingerprint: Record
    runs: list[Record]  # time, name, mode, summary, limit_deg
    rows: list[list[str]]
    reasons: list[str]  # to calibrate again; none where the last calibration holds

    @property
    def calibrations(self) -> list[Record]:
        """Summaries of those that identified, with their time."""
        return [r["summary"] | {"time": r["time"]} for r in self.runs if _fitted(r)]

    @property
    def verdict(self) -> str:
        """In words."""
        if self.reasons:
            return f"RECALIBRATE: {'; '.join(self.reasons)}"
        return "the last calibration still holds"


def _fitted(run: Record) -> bool:
    return "A" in run["summary"]


def read_runs(folder: pathlib.Path) -> tuple[list[Device], list[str]]:
    """The devices with finished calibrations and verifications under a folder.

    Runs of different device fingerprints are never compared. A refit stands at the time
    at which its run was measured.

    Returns:
        The devices, and a line for each journal that could not be read.
    """
    found: dict[str, list[Record]] = {}
    skipped = []
    for path in sorted(folder.rglob("journal.jsonl")):
        try:
            start = read_journal(path)[0]
            text = (path.parent / "summary.json").read_text(encoding="utf-8")
            summary = json.loads(text)
            device = start["device"]
            if start.get("simulated"):  # never compared with a real one
                device = {"simulated": True, **device}
            limit = start["config"]["session"]["verify_limit_deg"]
        except FileNotFoundError:
            continue  # not finished, or of a kind without a summary
        except (OSError, JournalError, ValueError, KeyError, IndexError) as error:
            skipped.append(f"{path.parent}: {error}")
            continue
        run = {
            "time": summary.get("measured_at", start["time"]),
            "name": path.parent.name, "mode": start["mode"], "summary": summary,
            "limit_deg": limit, "fingerprint": device,
        }  # fmt: skip
        found.setdefault(json.dumps(device, sort_keys=True), []).append(run)
    return [_device(runs) for runs in found.values()], skipped


def _device(runs: list[Record]) -> Device:
    runs = sorted(runs, key=lambda run: run["time"])
    rows, last, reasons = [], None, []
    for run in runs:
        summary, moved = run["summary"], ""
        if _fitted(run):
            moved = "first" if last is None else ", ".join(_moved(last, summary))
            moved, last = moved or "nothing", summary
        when = datetime.datetime.fromtimestamp(run["time"])
        error = "not measured"
        if (worst := _worst(summary)) is not None:
            error = f"{worst:.4f} (limit {run['limit_deg']:g})"
            reasons = [
                f"{run['name']}: {text}"
                for text in recalibrate(summary, run["limit_deg"])
            ]
        rows.append([f"{when:%Y-%m-%d %H:%M}", run["name"], run["mode"], error, moved])
    return Device(runs[0]["fingerprint"], runs, rows, reasons)


def _worst(summary: Record) -> float | None:
    """Largest error at held-out postures; compensated, or of a refit predicted."""
    if "after" in summary:
        return float(summary["after"]["max"])
    return summary.get("prediction_max")


def _moved(before: Record, now: Record) -> list[str]:
    """Parameters that differ by more than their intervals allow."""
    change = _flat(np.column_stack([now["A"], now["b"]])) - _flat(
        np.column_stack([before["A"], before["b"]])
    )
    allowed = np.hypot(_flat(np.array(now["ci95"])), _flat(np.array(before["ci95"])))
    return [
        f"{name} {value:+.4f} (interval {width:.4f})"
        for name, value, width in zip(NAMES, change, allowed, strict=True)
        if abs(value) > width
    ]


def _flat(values: Array) -> Array:
    """(3, 4) to twelve in the order of NAMES."""
    return np.concatenate([values[:, :3].ravel(), values[:, 3]])


def trend_lines(device: Device) -> list[str]:
    """The table and the verdict for the console."""
    wide = [max(map(len, column)) for column in zip(HEAD, *device.rows, strict=True)]
    table = [
        "  " + "  ".join(c.ljust(w) for c, w in zip(row, wide, strict=True)).rstrip()
        for row in [HEAD, *device.rows]
    ]
    return [f"device {_label(device.fingerprint)}", *table, f"  {device.verdict}"]


def _label(fingerprint: Record) -> str:
    """What tells devices apart at a glance."""
    keys = ("map", "unit", "pulses_per_rev", "reduction", "direction")
    axes = (
        f"{name} "
        + " ".join(str(fingerprint.get(f"axes.{name}.{k}", "?")) for k in keys)
        for name in AXIS_NAMES
    )
    simulated = "simulated: " if fingerprint.get("simulated") else ""
    return f"{simulated}{'; '.join(axes)}; order {fingerprint['mechanism.order']}"


def write_trend(folder: pathlib.Path, devices: list[Device]) -> pathlib.Path:
    """Write ``trend.html``; returns its path."""
    sections = []
    for number, device in enumerate(devices):
        badge = (
            Badge("recalibrate", "bad") if device.reasons else Badge("holds", "good")
        )
        blocks: list[Block] = [
            Text(device.verdict, "warning" if device.reasons else ""),
            Table(HEAD, device.rows, numeric=False),
        ]
        if device.calibrations:
            alt = "A and b over time, with their 95 % intervals"
            blocks.append(drawn(draw_parameters, device.calibrations, (11, 7), alt))
        rows = [[key, json.dumps(v)] for key, v in device.fingerprint.items()]
        blocks.append(Table(["fingerprint", ""], rows, numeric=False))
        sections.append(Section(f"Device {number + 1}", blocks, badge=badge))
    path = folder / "trend.html"
    write_page(path, Page(f"Calibrations in {folder.resolve().name}", sections))
    return path
