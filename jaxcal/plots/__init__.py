"""Figures: the style that all share, and those of a selection (``plots.selection``)."""

from jaxcal.plots.style import (
    BLACK,
    COLOURS,
    GREY,
    MARKERS,
    STYLES,
    as_bytes,
    plain_axes,
)

__all__ = ["BLACK", "COLOURS", "GREY", "MARKERS", "STYLES", "as_bytes", "plain_axes"]
