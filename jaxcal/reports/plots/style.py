"""What every figure shares: colours, panels, bands, boxes, legends, and its file.

Colours are those of Okabe and Ito, which stay apart under colour blindness; line styles
and markers repeat the distinction.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

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


def band(axes: Any, x: Any, value: Any, low: Any, high: Any, **look: Any) -> None:
    """A curve (N,) with its interval shaded; ``look`` is that of the curve."""
    axes.fill_between(x, low, high, color=look["color"], alpha=0.25, linewidth=0)
    axes.plot(x, value, **look)


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
