"""Designs beyond a choice of rows: between the candidates, with travel between rows."""

from jaxcal.designs.continuous import Refinement, optimise
from jaxcal.designs.travel import Motion

__all__ = ["Motion", "Refinement", "optimise"]
