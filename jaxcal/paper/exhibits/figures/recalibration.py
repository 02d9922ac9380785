"""Measured and predicted angles, and error by session."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxcal.paper.datasets import AXES
from jaxcal.paper.exhibits.figures.parts import (
    band,
    legend_below,
    legend_right,
    panels,
)
from jaxcal.plots import BLACK, COLOURS, GREY, MARKERS

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
        columns: ``session``, and angles in degrees by name and axis, (N,) each.
        title: what is shown.
    """
    figure, axes = panels(
        (11.0, 6.6), f"Predicted postures: {title}", 3, 2, sharex=True
    )
    session = np.asarray(columns["session"])
    x = np.arange(len(session)) + 1
    edges = x[1:][np.diff(session) != 0] - 0.5
    for (left, right), name in zip(axes, AXES, strict=True):
        measured = columns[f"measured_{name}_deg"]
        for key, (label, colour, line, marker) in _LOOKS.items():
            values = columns[f"{key}_{name}_deg"]
            look: dict[str, Any] = {
                "color": colour,
                "linestyle": line,
                "marker": marker,
            }
            look |= {"linewidth": 1.0, "markersize": 3}
            left.plot(x, values, label=label, **look)
            right.plot(x, values - measured, **look)
        left.set_ylabel(f"{name} (°)")
        right.set_ylabel("error (°)")
    for each in axes.flat:
        for edge in edges:
            each.axvline(edge, color="#BBBBBB", linewidth=0.8, zorder=0)
        each.grid(False, axis="x")
        each.margins(x=0.01)
    axes[0, 0].set_title("angle", fontsize=9)
    axes[0, 1].set_title("predicted less measured", fontsize=9)
    for each in axes[-1]:
        each.set_xlabel("posture (grey lines: next session)")
    legend_below(figure, axes[0, 0])
    return figure


def by_age(columns: Mapping[str, Any], later: int, drift_deg: float) -> Figure:
    """Error of prediction in each session, by choice and session of the calibration."""
    title = f"Old and recent calibration, bias drifting {drift_deg}° per session"
    figure, axes = panels((8.0, 4.0), title)
    for calibrated, name, line in ((1, "X$_0$", "--"), (later, "X$_*$", "-")):
        for i, (choice, colour) in enumerate(
            (("random", GREY), ("policy", COLOURS[0]), ("det-maximal", COLOURS[1]))
        ):
            keep = (columns["choice"] == choice) & (
                columns["calibrated_in"] == calibrated
            )
            x, value, low, high = (
                columns[c][keep] for c in ("session", "median_rms_deg", "low", "high")
            )
            look: dict[str, Any] = {"color": colour, "marker": MARKERS[i]}
            look["label"] = f"{name} of session {calibrated}, {choice}"
            if choice == "det-maximal":  # lies on the policy's curve: markers alone
                look |= {"linestyle": "none", "markersize": 7}
                axes.plot(x, value, markerfacecolor="none", **look)
            else:
                band(axes, x, value, low, high, linestyle=line, markersize=3.5, **look)
    axes.set_xlabel("session predicted")
    axes.set_ylabel("error of prediction\n(° rms, median; band: its 95 % interval)")
    axes.set_ylim(bottom=0.0)
    axes.set_xticks(np.unique(columns["session"])[:: (later - 1) // 2])
    legend_right(axes)
    return figure
