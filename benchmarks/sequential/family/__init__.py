"""A family of tasks drawn at random, to compare deciders on more than one task."""

from benchmarks.sequential.family.draws import BUDGETS, draw
from benchmarks.sequential.family.padded import SHAPE, Padded, batch, pad, stack
from benchmarks.sequential.family.structures import HELD_OUT, TRAINED_ON, Limits

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
