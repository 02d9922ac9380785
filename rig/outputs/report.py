"""report.html of a calibration: all numbers and figures in one file.

Loaded after the last move. Figures need matplotlib; without it the page says so.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.pages import Figure, Page, Section, Strong, Table, Text, write_page
from rig.config.axis import AXIS_NAMES


def write_report(
    folder: pathlib.Path,
    summary: dict[str, Any],
    start: dict[str, Any],
    postures: dict[str, dict[str, Any]],
) -> pathlib.Path:
    """Write ``report.html``.

    Args:
        folder: of the run.
        summary: what summary.json holds.
        start: first record of the journal.
        postures: records by name, in order.

    Returns:
        The path of the page.
    """
    records, choice, orders = (
        list(postures.values()),
        summary["choice"],
        summary["orders"],
    )
    made = f"{start['started']} on {start['host']}, jaxcal {start['jaxcal']}"
    intro: list[Any] = [Text([made, ", ", Strong("simulated rig"), "."])]
    if not summary.get("simulated"):
        intro = [f"{made}."]
    if orders["warning"]:
        intro.append(Text(orders["warning"], "warning"))
    rank = "the proven optimum" if choice["proven"] else "the best known subset"
    efficiency = np.exp((choice["log_det"] - choice["best_log_det"]) / 12.0)
    sections = [
        Section(
            "y = A u + b, degrees, ± 95 % for all twelve at once",
            [
                Table(
                    ["", *(f"u {name}" for name in AXIS_NAMES), "b"], _fitted(summary)
                ),
                f"Noise of one posture {summary['noise_std_deg'][0]:.4f} deg, from "
                f"{summary['basis']} ({summary['dof']} degrees of freedom). Measured "
                f"postures: {', '.join(summary['postures'])}.",
            ],
        ),
        Section(
            "Choice",
            [
                f"{choice['method']}: log det {choice['log_det']:.4f} with commands in "
                f"degrees; {rank} {choice['best_log_det']:.4f}; D-efficiency "
                f"{efficiency:.4f}. {choice['note']}",
                _drawn(
                    _postures, records, (10, 3.2), "commanded postures, three planes"
                ),
            ],
        ),
    ]
    if "before" in summary:
        rows = [
            [
                title,
                *(f"{v:.4f}" for v in (*found["rms_axis"], found["rms"], found["max"])),
            ]
            for title, found in (
                ("raw", summary["before"]),
                ("compensated", summary["after"]),
            )
        ]
        figure = _drawn(
            _errors, summary, (9, 3.4), "held-out errors, raw and compensated"
        )
        table = Table(["", *AXIS_NAMES, "rms", "max"], rows)
        sections.append(Section("Held-out error, degrees", [table, figure]))
    if orders["rms"]:
        rows = [
            [order + " (configured)" * (order == orders["configured"]), f"{rms:.4f}"]
            for order, rms in orders["rms"].items()
        ]
        table = Table(["order", "residual"], rows)
        sections.append(
            Section("Residual under each Euler order, degrees rms", [table])
        )
    blocks: list[Any] = [
        _drawn(_readings, records, (9, 4), "readings of every posture about their mean")
    ]
    if summary["drift_deg"] is not None:
        drift = summary["drift_deg"]
        blocks.append(f"The zero posture read {drift:.4f} deg from zero at the end.")
    sections.append(Section("Readings", blocks))
    footer = (
        "Research software, not a medical device. Calibrate with no patient attached; "
        "a hardware emergency stop is required.",
    )
    path = folder / "report.html"
    page = Page(f"Calibration {folder.name}", sections, intro=intro, footer=footer)
    write_page(path, page)
    return path


def _fitted(summary: dict[str, Any]) -> list[list[str]]:
    rows = []
    for name, a, b, wide in zip(
        AXIS_NAMES, summary["A"], summary["b"], summary["ci95"], strict=True
    ):
        cells = [f"{v:.5f} ± {w:.5f}" for v, w in zip(a, wide[:3], strict=True)]
        rows.append([name, *cells, f"{b:.4f} ± {wide[3]:.4f}"])
    return rows


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
        spread = np.linspace(-0.15, 0.15, len(each))
        for column in range(3):
            axis.plot(column + spread, each[:, column], "o")
        axis.set_xticks(range(3), AXIS_NAMES)
        axis.set_ylabel("measured - desired [deg]")
        axis.set_title(f"{title}: {summary[key]['rms']:.4f} deg rms")


def _postures(figure: Any, records: list[dict[str, Any]]) -> None:
    axes = figure.subplots(1, 3)
    styles = {"select": "o", "before": "^", "after": "v", "reference": "s"}
    for axis, (a, b) in zip(axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        for role, marker in styles.items():
            points = [r["commanded_deg"] for r in records if r.get("role") == role]
            if points:
                u = np.array(points)
                axis.plot(u[:, a], u[:, b], marker, label=role)
        axis.set_xlabel(f"{AXIS_NAMES[a]} [deg]")
        axis.set_ylabel(f"{AXIS_NAMES[b]} [deg]")
    axes[0].legend(fontsize=8)


def _readings(figure: Any, records: list[dict[str, Any]]) -> None:
    axes = figure.subplots(3, 1, sharex=True)
    begin = 0
    for record in records:
        off = np.array(record["raw_deg"]) - np.array(record["measured_deg"])
        for column, axis in enumerate(axes):
            axis.plot(begin + np.arange(len(off)), off[:, column], ".", markersize=2)
        begin += len(off)
    for axis, name in zip(axes, AXIS_NAMES, strict=True):
        axis.set_ylabel(f"{name} [deg]")
    axes[-1].set_xlabel("reading, posture by posture, less the posture's mean")
