"""A family of tasks drawn at random, to compare deciders on more than one task."""

from jaxcal.adaptive.family.draws import BUDGETS, draw
from jaxcal.adaptive.family.padded import SHAPE, Padded, batch, pad, stack
from jaxcal.adaptive.family.structures import HELD_OUT, TRAINED_ON, Limits

__all__ = [
    "BUDGETS",
    "HELD_OUT",
    "SHAPE",
    "TRAINED_ON",
    "Limits",
    "Padded",
    "batch",
    "draw",
    "pad",
    "stack",
]
