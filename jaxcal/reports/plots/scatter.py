"""Candidates, the chosen ones and ellipsoids in two or three dimensions; an arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.reports.plots.style import COLOURS, GREY, plain_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def ellipsoid(
    axes: Any, centre: ArrayLike, covariance: ArrayLike, scale: float = 1.0, **look: Any
) -> Any:
    """Points at Mahalanobis distance ``scale``: an ellipse, or a wire net in 3-D axes.

    Args:
        axes: matplotlib axes; of projection "3d" for three dimensions.
        centre: (d,) d = 2 or 3.
        covariance: (d, d) positive definite.
        scale: of the distance; ``sqrt(chi2.ppf(0.95, d))`` holds 95 % of a normal.
        look: passed on to ``plot`` or ``plot_wireframe``.
    """
    middle = np.asarray(centre, dtype=np.float64)
    if middle.shape not in ((2,), (3,)):
        raise ValueError(f"centre must have 2 or 3 numbers, got shape {middle.shape}")
    root = scale * np.linalg.cholesky(np.asarray(covariance, dtype=np.float64))
    turn = np.linspace(0.0, 2.0 * np.pi, 200 if len(middle) == 2 else 25)
    if len(middle) == 2:
        ring = middle[:, None] + root @ np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(*ring, **{"color": COLOURS[0]} | look)
        return axes
    tilt = np.linspace(0.0, np.pi, 13)[:, None]
    across = np.sin(tilt) * np.stack([np.cos(turn), np.sin(turn)])[:, None]
    ball = np.concatenate([across, (np.cos(tilt) * np.ones_like(turn))[None]])
    net = middle[:, None, None] + np.tensordot(root, ball, axes=1)
    axes.plot_wireframe(*net, **{"color": COLOURS[0], "linewidth": 0.4} | look)
    return axes


def selection(
    axes: Any,
    candidates: ArrayLike,
    indices: ArrayLike,
    names: Sequence[str] = (),
    label: str = "selected",
    **look: Any,
) -> Any:
    """Candidates, the chosen ones, and the ellipsoid of their scatter.

    The squared volume of the ellipsoid grows with the determinant that a D-optimal
    selection of the affine model maximises.

    Args:
        axes: matplotlib axes; of projection "3d" to draw three inputs.
        candidates: (M, n) commands; the first two or three columns are drawn.
        indices: (K,) rows chosen, such as ``Selection.indices``.
        names: n names of the inputs, for the axes.
        label: of the chosen ones in the legend.
        look: colour and marker of the chosen ones.
    """
    solid = getattr(axes, "name", "") == "3d"
    count = 3 if solid else 2
    points = np.asarray(candidates, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < count:
        raise ValueError(
            f"candidates must have at least {count} columns for these axes, "
            f"got shape {points.shape}"
        )
    points = points[:, :count]
    chosen = points[np.asarray(indices)]
    style = {"color": COLOURS[0], "marker": "o", "linestyle": "none"} | look
    if not axes.lines:  # a second selection is drawn over the same candidates
        axes.plot(*points.T, ".", color=GREY, markersize=3, label="candidates")
    axes.plot(*chosen.T, label=label, **style)
    scatter = np.atleast_2d(np.cov(chosen.T, bias=True)) if len(chosen) > 1 else None
    if scatter is not None and np.linalg.matrix_rank(scatter) == count:
        middle = chosen.mean(axis=0)
        ellipsoid(axes, middle, scatter, np.sqrt(count), color=style["color"])
    if names:
        axes.set(xlabel=names[0], ylabel=names[1])
        if solid:
            axes.set_zlabel(names[2])
    if not solid:
        plain_axes(axes)
    return axes


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
