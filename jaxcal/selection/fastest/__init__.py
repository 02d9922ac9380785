"""Which postures to measure, and in which order, so that the run takes least time.

Names load on first use: ``Motion`` and ``travel_times`` need numpy alone, the searches
load numba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxcal.plots.selection import pareto_figure
    from jaxcal.selection.fastest.api import FastSelection, select_fastest
    from jaxcal.selection.fastest.motion import Motion, travel_times
    from jaxcal.selection.fastest.pareto import ParetoFront, pareto_front
    from jaxcal.selection.fastest.tour import fastest_tour

_HOME = {
    "FastSelection": "jaxcal.selection.fastest.api",
    "Motion": "jaxcal.selection.fastest.motion",
    "ParetoFront": "jaxcal.selection.fastest.pareto",
    "fastest_tour": "jaxcal.selection.fastest.tour",
    "pareto_figure": "jaxcal.plots.selection",
    "pareto_front": "jaxcal.selection.fastest.pareto",
    "select_fastest": "jaxcal.selection.fastest.api",
    "travel_times": "jaxcal.selection.fastest.motion",
}

__all__ = [
    "FastSelection",
    "Motion",
    "ParetoFront",
    "fastest_tour",
    "pareto_figure",
    "pareto_front",
    "select_fastest",
    "travel_times",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)
