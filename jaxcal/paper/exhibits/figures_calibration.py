"""Boxes of errors before and after calibration; bars of what the model leaves."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.plots import BLACK, COLOURS, plain_axes

__all__ = ["error_boxes", "order_bars"]

Array = NDArray[np.float64]
_AXES = ("pitch", "yaw", "roll")


def error_boxes(before: Array, after: Array, title: str) -> Figure:
    """Box plots by axis; what is left after calibration again on its own scale.

    Args:
        before: (..., 3) degrees.
        after: (..., 3) degrees.
        title: of the figure.
    """
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    first, second = before.reshape(-1, 3), after.reshape(-1, 3)
    _boxes(left, first, np.arange(3.0), COLOURS[1])
    _boxes(left, second, np.arange(3.0) + 3.5, COLOURS[0])
    left.set_xticks(
        [0, 1, 2, 3.5, 4.5, 5.5],
        [*(f"{a}\nbefore" for a in _AXES), *(f"{a}\nafter" for a in _AXES)],
        fontsize=8,
    )
    left.set_title("before and after", fontsize=9)
    _boxes(right, second, np.arange(3.0), COLOURS[0])
    right.set_xticks(range(3), [f"{a}\nafter" for a in _AXES], fontsize=8)
    right.set_title("after, enlarged", fontsize=9)
    for axes in (left, right):
        plain_axes(axes)
        axes.axhline(0.0, color=BLACK, linewidth=0.6)
        axes.set_ylabel("input-output error (°)")
    left.set_xlabel("box: quartiles and median, whiskers: 1 to 99 % of the postures")
    figure.suptitle(f"Input-output error by axis: {title}", fontsize=10)
    return figure


def _boxes(axes: Any, errors: Array, positions: Array, colour: str) -> None:
    boxes = axes.boxplot(
        errors,
        positions=positions,
        widths=0.6,
        whis=(1, 99),
        showfliers=False,
        patch_artist=True,
        medianprops={"color": BLACK},
    )
    for patch in boxes["boxes"]:
        patch.set_facecolor(colour)
        patch.set_alpha(0.6)


def order_bars(columns: dict[str, Any], noise_std_deg: float) -> Figure:
    """Root mean square left by the linear model, by read-out order and axis."""
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots()
    plain_axes(axes)
    orders = columns["read_out_order"]
    places = np.arange(len(orders))
    for number, label in enumerate(_AXES):
        axes.bar(
            places + 0.27 * (number - 1),
            columns[f"rms_{label}_deg"],
            width=0.25,
            color=COLOURS[number],
            label=label,
            hatch=("", "//", "..")[number],
            edgecolor="white",
        )
    axes.axhline(
        noise_std_deg,
        color=BLACK,
        linestyle="--",
        linewidth=0.9,
        label=f"noise of one\nreading, {noise_std_deg}°",
    )
    for place in places:
        if sum(columns[f"rms_{label}_deg"][place] for label in _AXES) < 1e-9:
            axes.annotate(
                "exact",
                (place, noise_std_deg),
                xytext=(0, 4),
                ha="center",
                textcoords="offset points",
                fontsize=8,
            )
    axes.set_xticks(places, orders)
    axes.set_xlabel("order in which the angles are read (mechanism: XYZ)")
    axes.set_ylabel("residual of y = A u + b (° rms)")
    axes.set_title("What the linear model leaves under each Euler order", fontsize=10)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure
