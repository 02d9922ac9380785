"""Pictures of selections and calibrations: matplotlib axes in, the same axes out.

``figure, axes = matplotlib.pyplot.subplots()``, then ``plots.selection(axes, ...)``.
Colours are those of Okabe and Ito, which stay apart under colour blindness; line styles
and markers repeat the distinction.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array
from jaxcal.extras import needs

with needs("plots", "jaxcal.reports.plots"):
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

__all__ = [
    "as_bytes",
    "before_after",
    "plan",
    "postures",
    "residuals",
    "selection",
]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P")
GREY = "#7F7F7F"
BLACK = "#000000"


def as_files(figure: Figure, *suffixes: str) -> list[bytes]:
    """The figure as files of these kinds, "png" or "svg"; the same every time.

    The constrained layout makes room for the tick labels of the drawing before, so the
    first drawing of a figure can cut a label off: it is laid out twice, and then stays.
    """
    files = []
    with rc_context({"svg.hashsalt": "jaxcal"}):
        figure.draw_without_rendering()
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for suffix in suffixes:
            buffer = io.BytesIO()
            metadata: dict[str, Any] = {"Date": None} if suffix == "svg" else {}
            figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
            files.append(buffer.getvalue())
    return files


def as_bytes(figure: Figure, suffix: str) -> bytes:
    """The figure as one file, see ``as_files``."""
    return as_files(figure, suffix)[0]


def panels(
    size: tuple[float, float],
    title: str = "",
    shape: tuple[int, int] = (1, 1),
    **rest: Any,
) -> tuple[Figure, Any]:
    """A figure of ``size`` inches and its axes; ``rest`` is for ``Figure.subplots``."""
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(*shape, **rest)
    for axis in np.ravel(axes):
        plain_axes(axis)
    if title:
        figure.suptitle(title, fontsize=10)
    return figure, axes


def plain_axes(axes: Any) -> None:
    axes.grid(True, color="#E6E6E6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top"]].set_visible(False)


def numbered(index: int) -> dict[str, Any]:
    """Colour, line and marker of a curve by its number."""
    looks = {"color": COLOURS, "linestyle": STYLES, "marker": MARKERS}
    return {name: look[index % len(look)] for name, look in looks.items()}


def points(index: int) -> dict[str, Any]:
    """Colour and marker of points that no line joins, by their number."""
    return numbered(index) | {"linestyle": "none", "markersize": 4}


def boxes(
    axes: Any, samples: Any, colours: Sequence[str], ends: tuple[int, int], **rest: Any
) -> None:
    """A box plot: quartiles, median, whiskers at the two percentiles ``ends``."""
    look = {"widths": 0.6, "showfliers": False, "medianprops": {"color": BLACK}}
    drawn = axes.boxplot(samples, whis=ends, patch_artist=True, **look, **rest)
    for patch, colour in zip(drawn["boxes"], colours, strict=True):
        patch.set(facecolor=colour, alpha=0.6)


def legend_right(axes: Any) -> None:
    """A legend outside the axes, on the right."""
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def plain_log(axis: Any) -> None:
    """1, 2, 5 of each decade, written out."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def plan(axes: Any, plan: Any) -> Any:
    """Accuracy against K: the designs, what no design beats, and the target.

    Args:
        plan: a ``Plan``; the output that is furthest from its target is drawn.
    """
    ks = [row.k for row in plan.rows]
    errors = [plan.worst(row.standard_error) for row in plan.rows]
    least = [plan.worst(row.least_error) for row in plan.rows]
    axes.plot(ks, errors, "o-", color=COLOURS[0], label="design found")
    axes.plot(ks, least, ":", color=GREY, label="lower bound")
    target = plan.accuracy[plan.hardest_output]
    axes.axhline(target, color=BLACK, linewidth=0.8, label="target")
    axes.axvline(plan.k, color=BLACK, linewidth=0.8, linestyle=":")
    axes.set_ylabel(f"{plan.summary} standard error of a prediction (measured unit)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("number of measurements K")
    axes.legend(frameon=False)
    plain_axes(axes)
    return axes


def before_after(
    axes: Any, errors: dict[str, ArrayLike], names: Sequence[str] = (), unit: str = ""
) -> Any:
    """Errors of each output side by side, such as raw and calibrated.

    The legend gives each root mean square.

    Args:
        errors: label to (N, q) measured less desired.
        names: q names of the outputs.
        unit: of the errors.
    """
    axes.axhline(0.0, color=BLACK, linewidth=0.8)
    places = np.linspace(-0.2, 0.2, len(errors)) if len(errors) > 1 else [0.0]
    count = 0
    for i, (label, values) in enumerate(errors.items()):
        rows = np.atleast_2d(np.asarray(values, dtype=np.float64))
        count = rows.shape[1]
        spread = np.linspace(-0.07, 0.07, len(rows))[:, None]
        at = np.arange(count) + places[i] + spread
        rms = np.sqrt(np.mean(rows**2))
        shown = f"{rms:.3g}{unit}" if unit == "°" else f"{rms:.3g} {unit}".rstrip()
        axes.plot(at.ravel(), rows.ravel(), label=f"{label}: {shown} rms", **points(i))
    axes.set_xticks(range(count), names or [str(i + 1) for i in range(count)])
    axes.set_ylabel(f"error ({unit})" if unit else "error")
    above = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}  # clear of the points
    axes.legend(frameon=False, **above)
    plain_axes(axes)
    return axes


def residuals(
    axes: Any, values: ArrayLike, names: Sequence[str] = (), unit: str = ""
) -> Any:
    """Measured less fitted, in the order of measurement.

    Args:
        values: (N, q) residuals, such as ``Calibration.residuals``.
        names: q names of the outputs.
        unit: of the residuals.
    """
    table = np.asarray(values, dtype=np.float64)
    table = table[:, None] if table.ndim == 1 else table
    axes.axhline(0.0, color=BLACK, linewidth=0.8)
    for i, column in enumerate(table.T):
        label = names[i] if names else f"output {i + 1}"
        places = np.arange(1, len(column) + 1)
        axes.plot(places, column, label=label, **points(i))
    axes.set_xlabel("measurement")
    axes.set_ylabel(f"measured - fitted ({unit})" if unit else "measured - fitted")
    if table.shape[1] > 1:
        axes.legend(frameon=False)
    plain_axes(axes)
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
    places = np.asarray(candidates, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] < count:
        raise ValueError(
            f"candidates must have at least {count} columns for these axes, "
            f"got shape {places.shape}"
        )
    places = places[:, :count]
    chosen = places[np.asarray(indices)]
    style = {"color": COLOURS[0], "marker": "o", "linestyle": "none"} | look
    if not axes.lines:  # a second selection is drawn over the same candidates
        axes.plot(*places.T, ".", color=GREY, markersize=3, label="candidates")
    axes.plot(*chosen.T, label=label, **style)
    _ellipsoid(axes, chosen, style["color"])
    if names:
        axes.set(xlabel=names[0], ylabel=names[1])
        if solid:
            axes.set_zlabel(names[2])
    if not solid:
        plain_axes(axes)
    return axes


def _ellipsoid(axes: Any, chosen: Array, colour: str) -> None:
    """An ellipse, in 3-D axes a wire net, as far from the mean of points (K, d) as they
    are by their scatter, in root mean square; nothing of points in a plane."""
    d = chosen.shape[1]
    if len(chosen) <= d:
        return
    middle = chosen.mean(axis=0)
    square = d / len(chosen) * (chosen - middle).T @ (chosen - middle)
    if np.linalg.matrix_rank(square) < d:
        return
    root = np.linalg.cholesky(square)
    turn = np.linspace(0.0, 2.0 * np.pi, 200 if d == 2 else 25)
    ring = np.stack([np.cos(turn), np.sin(turn)])
    if d == 2:
        axes.plot(*(middle[:, None] + root @ ring), color=colour)
        return
    tilt = np.linspace(0.0, np.pi, 13)[:, None]
    ball = [*(np.sin(tilt) * ring[:, None]), np.cos(tilt) * np.ones_like(turn)]
    net = middle[:, None, None] + np.tensordot(root, ball, axes=1)
    axes.plot_wireframe(*net, color=colour, linewidth=0.4)


def postures(figure: Figure, arm: Any, commands: ArrayLike, columns: int = 4) -> Figure:
    """A ``SerialChain`` at each row of ``commands`` (N, n), its tip marked, from 1.

    A column of the sensor, such as the socket, stands beside the number.
    """
    rows = np.asarray(commands, dtype=np.float64)
    drawn = arm.skeleton(rows)
    middle = 0.5 * (drawn.min(axis=(0, 1)) + drawn.max(axis=(0, 1)))
    half = 0.5 * float((drawn.max(axis=(0, 1)) - drawn.min(axis=(0, 1))).max())
    lines = -(-len(rows) // columns)
    for i, (joints, row) in enumerate(zip(drawn, rows, strict=True)):
        axes = figure.add_subplot(lines, columns, i + 1, projection="3d")
        axes.plot(*joints.T, color=COLOURS[0], marker=".", linewidth=2)
        axes.plot(*joints[-1:].T, color=COLOURS[1], marker="o")
        axes.plot(*joints[:1].T, color="black", marker="s")
        for k, axis in enumerate("xyz"):
            ends = middle[k] - half, middle[k] + half
            axes.set(**{f"{axis}lim": ends, f"{axis}ticks": []})
        which = row[arm.num_joints :]
        label = f", {arm.sensor.inputs[0]} {which[0]:g}" if which.size == 1 else ""
        axes.set_title(f"{i + 1}{label}", fontsize=9)
    return figure
