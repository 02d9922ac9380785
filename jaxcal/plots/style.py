"""What every figure shares: colours, axes, and how it becomes a file.

Colours are those of Okabe and Ito, which stay apart under colour blindness; line styles
and markers repeat the distinction.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

__all__ = ["BLACK", "COLOURS", "GREY", "MARKERS", "STYLES", "as_bytes", "plain_axes"]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P")
GREY = "#7F7F7F"
BLACK = "#000000"


def as_bytes(figure: Figure, suffix: str) -> bytes:
    """The figure as a file of the given kind, "png" or "svg"; the same every time.

    The constrained layout makes room for the tick labels of the drawing before, so the
    first drawing of a figure can cut a label off: the figure is drawn twice.
    """
    buffer = io.BytesIO()
    metadata: dict[str, Any] = {"Date": None} if suffix == "svg" else {}
    with rc_context({"svg.hashsalt": "jaxcal"}):
        figure.draw_without_rendering()
        figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
    return buffer.getvalue()


def plain_axes(axes: Any) -> None:
    axes.grid(True, color="#E6E6E6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top"]].set_visible(False)
