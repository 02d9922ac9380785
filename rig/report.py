"""One HTML file with all numbers and figures: no other file, no network."""

from __future__ import annotations

import base64
import html
import io
import pathlib
from typing import Any

import numpy as np

from jaxcal.files import write_text
from rig.settings import AXIS_NAMES

__all__ = ["write_report"]

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60em; margin: 2em auto;
       padding: 0 1em; color: #1c2430; }
table { border-collapse: collapse; margin: 1em 0; }
th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #d5dbe3; }
th:first-child, td:first-child { text-align: left; }
.warn { background: #fff3d6; border-left: 4px solid #d08700; padding: .6em 1em; }
img { max-width: 100%; } small { color: #5b6778; }
"""


def _figure(draw: Any, size: tuple[float, float], text: str) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    draw(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="{text}" src="data:image/png;base64,{data}">'


def _table(head: list[str], rows: list[list[str]]) -> str:
    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"

    return (
        "<table>"
        + line(head, "th")
        + "".join(line(row, "td") for row in rows)
        + "</table>"
    )


def _errors_figure(summary: dict[str, Any]) -> str:
    def draw(figure: Any) -> None:
        axes = figure.subplots(1, 2, sharex=True)
        for axis, key, title in zip(
            axes, ("before", "after"), ("raw", "compensated"), strict=True
        ):
            each = np.array(summary[key]["each"])
            axis.axhline(0.0, color="#9aa5b1", linewidth=0.8)
            for column, name in enumerate(AXIS_NAMES):
                x = np.full(len(each), column) + np.linspace(-0.15, 0.15, len(each))
                axis.plot(x, each[:, column], "o", label=name)
            axis.set_xticks(range(3), AXIS_NAMES)
            axis.set_ylabel("measured - desired [deg]")
            axis.set_title(f"{title}: {summary[key]['rms']:.4f} deg rms")

    return _figure(draw, (9, 3.4), "held-out errors, raw and compensated")


def _postures_figure(records: list[dict[str, Any]]) -> str:
    def draw(figure: Any) -> None:
        axes = figure.subplots(1, 3)
        planes = ((0, 1), (0, 2), (1, 2))
        styles = {"select": "o", "before": "^", "after": "v", "reference": "s"}
        for axis, (a, b) in zip(axes, planes, strict=True):
            for role, marker in styles.items():
                points = [r["commanded_deg"] for r in records if r.get("role") == role]
                if points:
                    u = np.array(points)
                    axis.plot(u[:, a], u[:, b], marker, label=role)
            axis.set_xlabel(f"{AXIS_NAMES[a]} [deg]")
            axis.set_ylabel(f"{AXIS_NAMES[b]} [deg]")
        axes[0].legend(fontsize=8)

    return _figure(draw, (10, 3.2), "commanded postures in three planes")


def _readings_figure(records: list[dict[str, Any]]) -> str:
    def draw(figure: Any) -> None:
        axes = figure.subplots(3, 1, sharex=True)
        begin = 0
        for record in records:
            raw = np.array(record["raw_deg"])
            raw = raw - np.array(record["measured_deg"])
            x = np.arange(begin, begin + len(raw))
            for column, axis in enumerate(axes):
                axis.plot(x, raw[:, column], ".", markersize=2)
            begin += len(raw)
        for axis, name in zip(axes, AXIS_NAMES, strict=True):
            axis.set_ylabel(f"{name} [deg]")
        axes[-1].set_xlabel("reading, posture by posture, less the posture's mean")

    return _figure(draw, (9, 4), "readings of every posture about their mean")


def write_report(
    folder: pathlib.Path,
    summary: dict[str, Any],
    start: dict[str, Any],
    postures: dict[str, dict[str, Any]],
) -> pathlib.Path:
    """Write ``report.html`` of a calibration run; returns its path."""
    records, choice = list(postures.values()), summary["choice"]
    rank = "the proven optimum" if choice["proven"] else "the best known subset"
    efficiency = np.exp((choice["log_det"] - choice["best_log_det"]) / 12.0)
    parts = [
        f"<h1>Calibration {html.escape(folder.name)}</h1>",
        f"<p>{html.escape(str(start['started']))} on {html.escape(str(start['host']))}"
        f", jaxcal {html.escape(str(start['jaxcal']))}"
        + (", <b>simulated rig</b>" if summary.get("simulated") else "")
        + ".</p>",
    ]
    if summary["orders"]["warning"]:
        parts.append(f'<p class="warn">{html.escape(summary["orders"]["warning"])}</p>')
    rows = [
        [
            name,
            *(
                f"{summary['A'][i][j]:.5f} ± {summary['ci95'][i][j]:.5f}"
                for j in range(3)
            ),
            f"{summary['b'][i]:.4f} ± {summary['ci95'][i][3]:.4f}",
        ]
        for i, name in enumerate(AXIS_NAMES)
    ]
    parts += [
        "<h2>y = A u + b, degrees, ± 95 % for all twelve at once</h2>",
        _table(["", *(f"u {name}" for name in AXIS_NAMES), "b"], rows),
        f"<p>Noise of one posture {summary['noise_std_deg'][0]:.4f} deg, from "
        f"{html.escape(summary['basis'])} ({summary['dof']} degrees of freedom). "
        "Measured postures: "
        f"{html.escape(', '.join(summary['postures']))}.</p>",
        "<h2>Choice</h2>",
        f"<p>{html.escape(choice['method'])}: log det {choice['log_det']:.4f} with "
        f"commands in degrees; {rank} {choice['best_log_det']:.4f}; D-efficiency "
        f"{efficiency:.4f}. {html.escape(choice['note'])}</p>",
        _postures_figure(records),
    ]
    if "before" in summary:
        rows = [
            [
                title,
                *(f"{v:.4f}" for v in summary[key]["rms_axis"]),
                f"{summary[key]['rms']:.4f}",
                f"{summary[key]['max']:.4f}",
            ]
            for key, title in (("before", "raw"), ("after", "compensated"))
        ]
        parts += [
            "<h2>Held-out error, degrees</h2>",
            _table(["", *AXIS_NAMES, "rms", "max"], rows),
            _errors_figure(summary),
        ]
    configured = " (configured)"
    if summary["orders"]["rms"]:
        rows = [
            [
                order + configured * (order == summary["orders"]["configured"]),
                f"{v:.4f}",
            ]
            for order, v in summary["orders"]["rms"].items()
        ]
        parts += [
            "<h2>Residual under each Euler order, degrees rms</h2>",
            _table(["order", "residual"], rows),
        ]
    drift = summary["drift_deg"]
    parts += [
        "<h2>Readings</h2>",
        _readings_figure(records),
        ""
        if drift is None
        else f"<p>The zero posture read {drift:.4f} deg from zero at the end.</p>",
        "<p><small>Research software, not a medical device. Calibrate with no patient "
        "attached; a hardware emergency stop is required.</small></p>",
    ]
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>Calibration {html.escape(folder.name)}</title><style>{_STYLE}</style>"
        + "\n".join(parts)
        + "</html>\n"
    )
    path = folder / "report.html"
    write_text(path, page)
    return path
