"""report.html of a calibration: all numbers and figures in one file.

Loaded after the last move. Figures need matplotlib; without it the page says so.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.pages import Figure, Page, Section, Strong, Table, Text, write_page
from rig.config import AXIS_NAMES
from rig.outputs.console import choice_text, noise_text

FOOTER = (
    "Research software, not a medical device. Calibrate with no patient attached; a "
    "hardware emergency stop is required."
)
MARKERS = {"select": "o", "before": "^", "after": "v", "reference": "s"}
PLANES = ((0, 1), (0, 2), (1, 2))


def write_report(
    folder: pathlib.Path,
    summary: dict[str, Any],
    start: dict[str, Any],
    postures: dict[str, dict[str, Any]],
) -> pathlib.Path:
    """Write ``report.html`` of a run; returns its path."""
    records, orders = list(postures.values()), summary["orders"]
    made = f"{start['started']} on {start['host']}, jaxcal {start['jaxcal']}"
    intro = [Text([made, "."])]
    if summary.get("simulated"):
        intro = [Text([made, ", ", Strong("simulated rig"), "."])]
    if orders["warning"]:
        intro.append(Text(orders["warning"], "warning"))
    blocks: dict[str, list[Any]] = {
        "y = A u + b, degrees, ± 95 % for all twelve at once": [
            _fitted(summary),
            f"{noise_text(summary).capitalize()}. Measured postures: "
            f"{', '.join(summary['postures'])}.",
        ],
        "Choice": [
            f"{choice_text(summary['choice'])}. {summary['choice']['note']}",
            _drawn(_postures, records, (10, 3.2), "commanded postures, three planes"),
        ],
    }
    if "before" in summary:
        alt = "held-out errors, raw and compensated"
        blocks["Held-out error, degrees"] = [
            _compared(summary), _drawn(_errors, summary, (9, 3.4), alt)
        ]  # fmt: skip
    if orders["rms"]:
        rows = [
            [order + " (configured)" * (order == orders["configured"]), f"{rms:.4f}"]
            for order, rms in orders["rms"].items()
        ]
        title = "Residual under each Euler order, degrees rms"
        blocks[title] = [Table(["order", "residual"], rows)]
    alt = "readings of every posture about their mean"
    blocks["Readings"] = [_drawn(_readings, records, (9, 4), alt)]
    if (drift := summary["drift_deg"]) is not None:
        text = f"The zero posture read {drift:.4f} deg from zero at the end."
        blocks["Readings"].append(text)
    sections = [Section(title, parts) for title, parts in blocks.items()]
    path = folder / "report.html"
    title = f"Calibration {folder.name}"
    write_page(path, Page(title, sections, intro=intro, footer=(FOOTER,)))
    return path


def _fitted(summary: dict[str, Any]) -> Table:
    values = np.column_stack([summary["A"], summary["b"]])
    rows = [
        [name, *(f"{v:.5f} ± {w:.5f}" for v, w in zip(row, wide, strict=True))]
        for name, row, wide in zip(AXIS_NAMES, values, summary["ci95"], strict=True)
    ]
    return Table(["", *(f"u {name}" for name in AXIS_NAMES), "b"], rows)


def _compared(summary: dict[str, Any]) -> Table:
    rows = []
    for title, key in (("raw", "before"), ("compensated", "after")):
        found = summary[key]
        values = (*found["rms_axis"], found["rms"], found["max"])
        rows.append([title, *(f"{value:.4f}" for value in values)])
    return Table(["", *AXIS_NAMES, "rms", "max"], rows)


def _drawn(
    draw: Callable[[Any, Any], None], data: Any, size: tuple[float, float], alt: str
) -> Any:
    try:
        import matplotlib.figure

        from jaxcal.plots import as_bytes
    except ModuleNotFoundError:
        missing = "no figure: matplotlib is not installed (pip install 'jaxcal[study]')"
        return Text(f"{alt}: {missing}", "note")
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
    draw(figure, data)
    return Figure(as_bytes(figure, "png"), alt)


def _errors(figure: Any, summary: dict[str, Any]) -> None:
    axes = figure.subplots(1, 2, sharex=True)
    for axis, key, title in zip(
        axes, ("before", "after"), ("raw", "compensated"), strict=True
    ):
        each = np.array(summary[key]["each"])
        axis.axhline(0.0, color="#9aa5b1", linewidth=0.8)
        places = np.arange(3) + np.linspace(-0.15, 0.15, len(each))[:, None]
        axis.plot(places, each, "o")
        axis.set_xticks(range(3), AXIS_NAMES)
        axis.set_ylabel("measured - desired [deg]")
        axis.set_title(f"{title}: {summary[key]['rms']:.4f} deg rms")


def _postures(figure: Any, records: list[dict[str, Any]]) -> None:
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


def _readings(figure: Any, records: list[dict[str, Any]]) -> None:
    off = [np.array(r["raw_deg"]) - np.array(r["measured_deg"]) for r in records]
    ends = np.cumsum([len(values) for values in off])
    axes = figure.subplots(3, 1, sharex=True)
    for column, (axis, name) in enumerate(zip(axes, AXIS_NAMES, strict=True)):
        for values, end in zip(off, ends, strict=True):
            place = np.arange(end - len(values), end)
            axis.plot(place, values[:, column], ".", markersize=2)
        axis.set_ylabel(f"{name} [deg]")
    axes[-1].set_xlabel("reading, posture by posture, less the posture's mean")
