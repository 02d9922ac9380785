"""Predicted postures one by one: the angles, and what each calibration is off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.evaluation.parameters import predict
from jaxcal.paper.constants import AXES
from jaxcal.plots.style import BLACK, COLOURS, GREY, legend_below, panels
from studies.paper.exhibits.exhibit import by_axis

__all__ = ["POINTS", "TRACED", "trace_columns", "traces"]

Array = NDArray[np.float64]

POINTS = 8  # postures predicted in a session
TRACED = 6  # sessions drawn point by point
_LOOKS = {
    "measured": ("measured", BLACK, "-", ""),
    "x0_random": ("X$_0$, random postures", GREY, ":", "x"),
    "x0_policy": ("X$_0$, policy's postures", COLOURS[1], "--", "s"),
    "x_star": ("X$_*$", COLOURS[0], "-", "o"),
}


def trace_columns(
    sessions: NDArray[np.int64],
    commands: Array,
    measured: Array,
    parameters: Mapping[str, Array],
) -> dict[str, Any]:
    """Measured and predicted angles, a row per posture.

    Of (S,) sessions, (S, POINTS, 3) commands and readings in degrees, and the (12,)
    parameters of each calibration.
    """
    u = commands.reshape(-1, 3)
    shown = {name: predict(found, u) for name, found in parameters.items()}
    return {
        "session": np.repeat(sessions, POINTS),
        "point": np.tile(np.arange(1, POINTS + 1), len(sessions)),
        **by_axis({"measured": measured.reshape(-1, 3)} | shown),
    }


def traces(columns: Mapping[str, Any], title: str) -> Figure:
    """The angles and the errors of each calibration, axis by axis."""
    title = f"Predicted postures: {title}"
    figure, axes = panels((11.0, 6.6), title, (3, 2), sharex=True)
    x = np.arange(len(columns["session"])) + 1
    edges = x[1:][np.diff(columns["session"]) != 0] - 0.5
    for (left, right), name in zip(axes, AXES, strict=True):
        measured = columns[f"measured_{name}_deg"]
        for key, (label, colour, line, marker) in _LOOKS.items():
            values = columns[f"{key}_{name}_deg"]
            look: dict[str, Any] = {"color": colour, "linestyle": line}
            look |= {"marker": marker, "linewidth": 1.0, "markersize": 3}
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
