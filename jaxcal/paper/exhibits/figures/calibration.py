"""Boxes of errors before and after calibration; bars of what the model leaves."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.paper.datasets import AXES
from jaxcal.paper.exhibits.figures.parts import boxes, legend_right, panels
from jaxcal.plots import BLACK, COLOURS

__all__ = ["error_boxes", "order_bars"]

Array = NDArray[np.float64]


def error_boxes(before: Array, after: Array, title: str) -> Figure:
    """Box plots by axis; what is left after calibration again on its own scale.

    Args:
        before: (..., 3) degrees.
        after: (..., 3) degrees.
        title: of the figure.
    """
    figure, (left, right) = panels(
        (8.0, 3.8), f"Input-output error by axis: {title}", 1, 2, width_ratios=(2, 1)
    )
    first, second = before.reshape(-1, 3), after.reshape(-1, 3)
    places = np.arange(3.0)
    for axes, errors, positions, colour in (
        (left, first, places, COLOURS[1]),
        (left, second, places + 3.5, COLOURS[0]),
        (right, second, places, COLOURS[0]),
    ):
        boxes(axes, errors, [colour] * 3, (1, 99), positions=positions)
    labels = [f"{axis}\n{when}" for when in ("before", "after") for axis in AXES]
    left.set_xticks([*places, *(places + 3.5)], labels, fontsize=8)
    right.set_xticks(places, labels[3:], fontsize=8)
    for axes, name in ((left, "before and after"), (right, "after, enlarged")):
        axes.set_title(name, fontsize=9)
        axes.axhline(0.0, color=BLACK, linewidth=0.6)
        axes.set_ylabel("input-output error (°)")
    left.set_xlabel("box: quartiles and median, whiskers: 1 to 99 % of the postures")
    return figure


def order_bars(columns: dict[str, Any], noise_std_deg: float) -> Figure:
    """Root mean square left by the linear model, by read-out order and axis."""
    figure, axes = panels(
        (8.0, 3.4), "What the linear model leaves under each Euler order"
    )
    places = np.arange(len(columns["read_out_order"]))
    heights = np.array([columns[f"rms_{axis}_deg"] for axis in AXES])
    for number, label in enumerate(AXES):
        axes.bar(
            places + 0.27 * (number - 1),
            heights[number],
            width=0.25,
            color=COLOURS[number],
            label=label,
            hatch=("", "//", "..")[number],
            edgecolor="white",
        )
    line = f"noise of one\nreading, {noise_std_deg}°"
    axes.axhline(noise_std_deg, color=BLACK, linestyle="--", linewidth=0.9, label=line)
    for place in places[heights.sum(axis=0) < 1e-9]:
        axes.annotate(
            "exact",
            (place, noise_std_deg),
            xytext=(0, 4),
            ha="center",
            textcoords="offset points",
            fontsize=8,
        )
    axes.set_xticks(places, columns["read_out_order"])
    axes.set_xlabel("order in which the angles are read (mechanism: XYZ)")
    axes.set_ylabel("residual of y = A u + b (° rms)")
    legend_right(axes)
    return figure
