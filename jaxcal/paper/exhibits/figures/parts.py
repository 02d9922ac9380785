"""Pieces of figures: panels with a title, bands, boxes, legends, log axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import ArrayLike, NDArray

from jaxcal.plots import BLACK, COLOURS, MARKERS, STYLES, plain_axes

__all__ = [
    "band",
    "boxes",
    "legend_below",
    "legend_right",
    "numbered",
    "panels",
    "plain_log",
]

Array = NDArray[np.float64]


def panels(
    size: tuple[float, float], title: str, rows: int = 1, columns: int = 1, **rest: Any
) -> tuple[Figure, Any]:
    """A figure of that many inches with a title, and its axes, (rows, columns).

    ``rest`` goes to ``Figure.subplots``; of one row or column that axis is dropped.
    """
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, **rest)
    for each in np.ravel(axes):
        plain_axes(each)
    figure.suptitle(title, fontsize=10)
    return figure, axes


def numbered(index: int) -> dict[str, Any]:
    """Colour, line and marker of a curve by its number."""
    return {
        "color": COLOURS[index],
        "linestyle": STYLES[index],
        "marker": MARKERS[index],
        "markersize": 4,
    }


def band(
    axes: Any,
    x: ArrayLike,
    value: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    **look: Any,
) -> None:
    """A curve (N,) with its interval shaded; ``look`` is that of the curve."""
    axes.fill_between(x, low, high, color=look["color"], alpha=0.25, linewidth=0)
    axes.plot(x, value, **look)


def boxes(
    axes: Any, samples: Any, colours: Sequence[str], ends: tuple[int, int], **rest: Any
) -> None:
    """A box plot: quartiles, median, whiskers at the two percentiles ``ends``."""
    drawn = axes.boxplot(
        samples,
        widths=0.6,
        whis=ends,
        showfliers=False,
        patch_artist=True,
        medianprops={"color": BLACK},
        **rest,
    )
    for patch, colour in zip(drawn["boxes"], colours, strict=True):
        patch.set(facecolor=colour, alpha=0.6)


def legend_right(axes: Any) -> None:
    """A legend outside the axes, on the right."""
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def legend_below(figure: Figure, axes: Any) -> None:
    """One legend for the whole figure, of the curves of these axes."""
    handles, labels = axes.get_legend_handles_labels()
    place = "outside lower center"
    figure.legend(handles, labels, loc=place, ncols=4, fontsize=8, frameon=False)


def plain_log(axis: Any) -> None:
    """1, 2, 5 of each decade, written out."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
