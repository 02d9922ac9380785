"""Figures: the style that all share, and those of a selection (``plots.selection``)."""

from jaxcal.plots.style import as_bytes

__all__ = ["as_bytes"]
