"""Which postures to measure, and in which order, so that the run takes least time.

Loads neither numba nor JAX: the searches do, when they are called.
"""

from jaxcal.selection.fastest.api import FastSelection, select_fastest
from jaxcal.selection.fastest.motion import Motion, travel_times
from jaxcal.selection.fastest.pareto import ParetoFront, pareto_front
from jaxcal.selection.fastest.tour import fastest_tour

__all__ = [
    "FastSelection",
    "Motion",
    "ParetoFront",
    "fastest_tour",
    "pareto_front",
    "select_fastest",
    "travel_times",
]
