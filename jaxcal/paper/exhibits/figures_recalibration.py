"""Measured and predicted angles, and error by session."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxcal.plots import BLACK, COLOURS, GREY, MARKERS, plain_axes

__all__ = ["by_age", "traces"]


_LOOKS = {
    "measured": ("measured", BLACK, "-", ""),
    "x0_random": ("X$_0$, random postures", GREY, ":", "x"),
    "x0_policy": ("X$_0$, policy's postures", COLOURS[1], "--", "s"),
    "x_star": ("X$_*$", COLOURS[0], "-", "o"),
}


def traces(columns: Mapping[str, Any], title: str) -> Figure:
    """Angles measured and predicted with X_0 and X_*, and the errors, axis by axis.

    Args:
        columns: ``session``, and angles in degrees by name and axis.
        title: what is shown.
    """
    figure = Figure(figsize=(11.0, 6.6), layout="constrained")
    panels = figure.subplots(3, 2, sharex=True)
    session = np.asarray(columns["session"])
    x = np.arange(len(session)) + 1
    edges = x[1:][np.diff(session) != 0] - 0.5
    for (left, right), name in zip(panels, ("pitch", "yaw", "roll"), strict=True):
        measured = np.asarray(columns[f"measured_{name}_deg"])
        for key, (label, colour, line, marker) in _LOOKS.items():
            values = np.asarray(columns[f"{key}_{name}_deg"])
            look = {
                "color": colour,
                "linestyle": line,
                "linewidth": 1.0,
                "marker": marker,
                "markersize": 3,
            }
            left.plot(x, values, label=label, **look)
            right.plot(x, values - measured, **look)
        left.set_ylabel(f"{name} (°)")
        right.set_ylabel("error (°)")
        for axes in (left, right):
            plain_axes(axes)
            for edge in edges:
                axes.axvline(edge, color="#BBBBBB", linewidth=0.8, zorder=0)
            axes.grid(False, axis="x")
            axes.margins(x=0.01)
    panels[0, 0].set_title("angle", fontsize=9)
    panels[0, 1].set_title("predicted less measured", fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("posture (grey lines: next session)")
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        fontsize=8,
        frameon=False,
    )
    figure.suptitle(f"Predicted postures: {title}", fontsize=10)
    return figure


def by_age(columns: Mapping[str, Any], later: int, drift_deg: float) -> Figure:
    """Error of prediction in each session, by choice and session of the calibration."""
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.subplots()
    plain_axes(axes)
    looks = {
        "random": (GREY, MARKERS[0], GREY),
        "policy": (COLOURS[0], MARKERS[1], COLOURS[0]),
        "det-maximal": (COLOURS[1], MARKERS[2], "none"),
    }
    for calibrated, name in ((1, "X$_0$"), (later, "X$_*$")):
        for choice, (colour, marker, fill) in looks.items():
            keep = (columns["choice"] == choice) & (
                columns["calibrated_in"] == calibrated
            )
            x = columns["session"][keep]
            lies_on_policy = choice == "det-maximal"
            if not lies_on_policy:
                axes.fill_between(
                    x,
                    columns["low"][keep],
                    columns["high"][keep],
                    color=colour,
                    alpha=0.2,
                    linewidth=0,
                )
            line = "-" if calibrated == later else "--"
            axes.plot(
                x,
                columns["median_rms_deg"][keep],
                color=colour,
                linestyle="none" if lies_on_policy else line,
                marker=marker,
                markersize=7 if lies_on_policy else 3.5,
                markerfacecolor=fill,
                label=f"{name} of session {calibrated}, {choice}",
            )
    axes.set_xlabel("session predicted")
    axes.set_ylabel("error of prediction\n(° rms, median; band: its 95 % interval)")
    axes.set_ylim(bottom=0.0)
    axes.set_xticks(np.unique(columns["session"])[:: (later - 1) // 2])
    axes.set_title(
        f"Old and recent calibration, bias drifting {drift_deg}° a session", fontsize=10
    )
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure
