"""report.html of a run of any kind, also of one that is not finished.

Made from the journal and, where there is one, the summary; loaded after the last move.
Figures need matplotlib; without it the page says so.
"""

from __future__ import annotations

import datetime
import json
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.pages import Figure, Page, Section, Strong, Table, Text, write_page
from rig.config import AXIS_NAMES
from rig.core.attitude import Array
from rig.journal import Record, measured_postures
from rig.workbench.outputs.console import (
    choice_text,
    drift_text,
    event_lines,
    noise_text,
    numbers,
    recalibrate,
)
from rig.workbench.readings import angles, recorded_frame

FOOTER = (
    "Research software, not a medical device. Calibrate with no patient attached; a "
    "hardware emergency stop is required."
)
ENDS = ("end", "paused", "fault", "stopped", "refused")
TOLD = (*ENDS, "resume", "stop", "void", "unreachable", "replan", "sender_refused")
MOST_ROWS = 60  # of the table of postures; more are in pairs.csv
MARKERS = {
    "select": "o", "before": "^", "after": "v", "reference": "s", "collect": ".",
    "goto": "*",
}  # fmt: skip
PLANES = ((0, 1), (0, 2), (1, 2))


def write_report(folder: pathlib.Path, records: list[Record]) -> pathlib.Path:
    """Write ``report.html`` of a run, from the records of its journal."""
    start, summary = records[0], {}
    if (folder / "summary.json").is_file():
        text = (folder / "summary.json").read_text(encoding="utf-8")
        summary = json.loads(text)
    made = f"{start['started']} on {start['host']}, jaxcal {start['jaxcal']}"
    intro = [Text([made, "."])]
    if start.get("simulated"):
        intro = [Text([made, ", ", Strong("simulated rig"), "."])]
    intro += [_ending(records), *_warnings(summary, start)]
    blocks: dict[str, list[Any]] = {
        **(_calibrated(summary) if "A" in summary else {}),
        **_checked(summary),
        **_measured(start, records),
        **_told(records),
    }
    sections = [Section(title, parts) for title, parts in blocks.items()]
    path, kind = folder / "report.html", str(start["mode"])
    kind = {"calibrate": "Calibration"}.get(kind, kind.capitalize())
    title = f"{kind} {folder.name}"
    write_page(path, Page(title, sections, intro=intro, footer=(FOOTER,)))
    return path


def _ending(records: list[Record]) -> Text:
    """How the run ended, or that it did not."""
    last = next(
        r
        for r in reversed(records)
        if r["event"] in (*ENDS, "start", "resume") or r.get("phase") == "finishing"
    )
    if last["event"] == "phase":  # a calibration writes its report before its end
        return Text("All was measured, and every drive was stopped.")
    if last["event"] in ("start", "resume"):
        return Text("This run has no end: it still runs, or it was killed.", "warning")
    if last["event"] == "end":
        return Text(f"Ended with exit code {last['code']}.")
    return Text(f"Ended: {last['event']}. {last['reason']}", "warning")


def _warnings(summary: Record, start: Record) -> list[Text]:
    found = []
    if text := summary.get("orders", {}).get("warning"):
        found.append(Text(text, "warning"))
    limit = start["config"]["session"]["verify_limit_deg"]
    if reasons := recalibrate(summary, summary.get("limit_deg", limit)):
        found.append(Text(f"RECALIBRATE: {' and '.join(reasons)}.", "warning"))
    return found


def _calibrated(summary: Record) -> dict[str, list[Any]]:
    """A and b, how they were found, and what was changed by a refit."""
    blocks: dict[str, list[Any]] = {
        "y = A u + b, degrees, ± 95 % for all twelve at once": [
            _fitted(summary),
            f"{noise_text(summary).capitalize()}. Measured postures: "
            f"{', '.join(summary['postures'])}.",
        ]
    }
    if changes := summary.get("changed"):
        rows = [[key, str(old), str(new)] for key, (old, new) in changes.items()]
        head = ["key of rig.toml", "as recorded", "here"]
        blocks[f"Identified anew from {summary['refit_of']}"] = [
            Table(head, rows, numeric=False), _moved(summary)
        ]  # fmt: skip
    if choice := summary.get("choice"):
        blocks["Choice"] = [f"{choice_text(choice)}. {choice['note']}"]
    if summary.get("drift"):
        blocks["Drift"] = [f"{drift_text(summary['drift']).capitalize()}."]
    if (orders := summary["orders"])["rms"]:
        rows = [
            [order + " (configured)" * (order == orders["configured"]), f"{rms:.4f}"]
            for order, rms in orders["rms"].items()
        ]
        title = "Residual under each Euler order, degrees rms"
        blocks[title] = [Table(["order", "residual"], rows)]
    return blocks


def _checked(summary: Record) -> dict[str, list[Any]]:
    """Errors at held-out targets."""
    if "before" not in summary:
        return {}
    alt = "held-out errors, raw and compensated"
    rows = []
    for title, key in (("raw", "before"), ("compensated", "after")):
        if key in summary:
            found = summary[key]
            values = (*found["rms_axis"], found["rms"], found["max"])
            rows.append([title, *(f"{value:.4f}" for value in values)])
    parts: list[Any] = [Table(["", *AXIS_NAMES, "rms", "max"], rows)]
    if "after" in summary:
        parts.append(drawn(draw_errors, summary, (9, 3.4), alt))
    if "prediction_rms" in summary:
        rms = summary["prediction_rms"]
        parts.append(f"Predicted by the calibration to {rms:.4f} deg rms.")
    return {"Held-out error, degrees": parts}


def _measured(start: Record, records: list[Record]) -> dict[str, list[Any]]:
    """Every posture measured so far, and its readings."""
    postures = list(measured_postures(records).values())
    planned = next((r for r in records if r["event"] in ("plan", "collection")), None)
    if not postures:
        what = "planned" if planned else "planned or measured"
        return {"Postures": [f"Nothing was {what if planned is None else 'measured'}."]}
    shown = [
        [r["name"], *(numbers(r[f"{what}_deg"], 0, 3) for what in ("commanded",
         "measured")), numbers(r["std_deg"], 0, 4)]
        for r in postures[:MOST_ROWS]
    ]  # fmt: skip
    head = ["posture", "commanded [deg]", "measured [deg]", "scatter [deg]"]
    more = f", the first {MOST_ROWS} of them" if len(postures) > MOST_ROWS else ""
    table = Table(head, shown, f"{len(postures)} measured{more}")
    alt = "commanded postures, three planes"
    parts = [drawn(draw_postures, postures, (10, 3.2), alt), table]
    blocks = {"Postures": parts}
    if zeros := [record for record in records if record["event"] == "zero"]:
        frame = recorded_frame(start["config"], zeros[-1])
        off = [angles(r, frame) - np.array(r["measured_deg"]) for r in postures]
        alt = "readings of every posture about their mean"
        blocks["Readings"] = [drawn(draw_readings, off, (9, 4), alt)]
    return blocks


def _told(records: list[Record]) -> dict[str, list[Any]]:
    """Faults, stops, and whatever else happened on the way."""
    rows = []
    for record in records:
        if record["event"] in TOLD:
            when = datetime.datetime.fromtimestamp(record["time"])
            words = " ".join(event_lines(record)) or record.get("reason", "")
            rows.append([f"{when:%H:%M:%S}", record["event"], words])
    if not rows:
        return {}
    return {"What happened": [Table(["", "event", ""], rows, numeric=False)]}


def _fitted(summary: Record) -> Table:
    values = np.column_stack([summary["A"], summary["b"]])
    rows = [
        [name, *(f"{v:.5f} ± {w:.5f}" for v, w in zip(row, wide, strict=True))]
        for name, row, wide in zip(AXIS_NAMES, values, summary["ci95"], strict=True)
    ]
    return Table(["", *(f"u {name}" for name in AXIS_NAMES), "b"], rows)


def _moved(summary: Record) -> Table:
    then = np.column_stack([summary["was"]["A"], summary["was"]["b"]])
    moved = np.column_stack([summary["A"], summary["b"]]) - then
    rows = [
        [name, *(f"{value:+.5f}" for value in row)]
        for name, row in zip(AXIS_NAMES, moved, strict=True)
    ]
    head = ["changed by", *(f"u {name}" for name in AXIS_NAMES), "b"]
    return Table(head, rows)


# Figures


def drawn(
    draw: Callable[[Any, Any], None], data: Any, size: tuple[float, float], alt: str
) -> Any:
    """A block of a page: the figure, or words where matplotlib is not installed."""
    try:
        import matplotlib.figure

        from jaxcal.plots import as_bytes
    except ModuleNotFoundError:
        missing = "no figure: matplotlib is not installed (pip install 'jaxcal[study]')"
        return Text(f"{alt}: {missing}", "note")
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
    draw(figure, data)
    return Figure(as_bytes(figure, "png"), alt)


def draw_errors(figure: Any, summary: Record) -> None:
    """Errors at held-out targets, raw beside compensated."""
    from jaxcal import plots

    axes = figure.subplots(1, 2)
    shown = (("raw", "before", "#D55E00"), ("compensated", "after", "#0072B2"))
    for axis, (title, key, colour) in zip(axes, shown, strict=True):
        each = {title: summary[key]["each"]}
        plots.before_after(axis, each, AXIS_NAMES, "deg", color=colour)


def draw_postures(figure: Any, records: list[Record]) -> None:
    """Commands in the three planes, by role."""
    axes = figure.subplots(1, 3)
    for axis, (a, b) in zip(axes, PLANES, strict=True):
        for role, marker in MARKERS.items():
            points = [r["commanded_deg"] for r in records if r.get("role") == role]
            if points:
                u = np.array(points)
                axis.plot(u[:, a], u[:, b], marker, label=role)
        axis.set_xlabel(f"{AXIS_NAMES[a]} [deg]")
        axis.set_ylabel(f"{AXIS_NAMES[b]} [deg]")
    axes[0].legend(fontsize=8)


def draw_readings(figure: Any, off: list[Array]) -> None:
    """(samples, 3) of each posture about its mean, one after another."""
    from jaxcal import plots

    axes = figure.subplots(3, 1, sharex=True)
    for axis, name, column in zip(axes, AXIS_NAMES, np.vstack(off).T, strict=True):
        plots.residuals(axis, column, markersize=2)
        axis.set(ylabel=f"{name} [deg]", xlabel="")
        for end in np.cumsum([len(values) for values in off])[:-1]:
            axis.axvline(end + 0.5, color="#E6E6E6", linewidth=0.8)
    axes[-1].set_xlabel("reading, posture by posture, less the posture's mean")


def draw_parameters(figure: Any, runs: list[Record]) -> None:
    """A and b with their intervals, calibration after calibration."""
    axes = figure.subplots(3, 4, sharex=True)
    values = np.array([np.column_stack([r["A"], r["b"]]) for r in runs])
    wide = np.array([r["ci95"] for r in runs])
    days = np.array([r["time"] for r in runs]) / 86400.0
    for row, name in enumerate(AXIS_NAMES):
        for column, source in enumerate((*(f"u {each}" for each in AXIS_NAMES), "b")):
            axis = axes[row, column]
            y, e = values[:, row, column], wide[:, row, column]
            axis.errorbar(days - days[0], y, e, fmt="o-", capsize=3, markersize=4)
            axis.set_title(f"{name}: {source}", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("days")
