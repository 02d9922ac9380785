"""Postures of an arm, each a small picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.reports.plots.style import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def postures(figure: Figure, arm: Any, commands: ArrayLike, columns: int = 4) -> Figure:
    """A ``SerialChain`` at each row of ``commands`` (N, n), its tip marked, from 1.

    A column of the sensor, such as the socket, stands beside the number.
    """
    rows = np.asarray(commands, dtype=np.float64)
    drawn = arm.skeleton(rows)
    middle = 0.5 * (drawn.min(axis=(0, 1)) + drawn.max(axis=(0, 1)))
    half = 0.5 * float((drawn.max(axis=(0, 1)) - drawn.min(axis=(0, 1))).max())
    lines = -(-len(rows) // columns)
    for i, (points, row) in enumerate(zip(drawn, rows, strict=True)):
        axes = figure.add_subplot(lines, columns, i + 1, projection="3d")
        axes.plot(*points.T, color=COLOURS[0], marker=".", linewidth=2)
        axes.plot(*points[-1:].T, color=COLOURS[1], marker="o")
        axes.plot(*points[:1].T, color="black", marker="s")
        for k, axis in enumerate("xyz"):
            ends = middle[k] - half, middle[k] + half
            axes.set(**{f"{axis}lim": ends, f"{axis}ticks": []})
        which = row[arm.num_joints :]
        label = f", {arm.sensor.inputs[0]} {which[0]:g}" if which.size == 1 else ""
        axes.set_title(f"{i + 1}{label}", fontsize=9)
    return figure
