"""Which few of many candidate postures to measure: one problem, many questions."""

from jaxcal.selection.batch import (
    exact_batch,
    exchange_batch,
    greedy_batch,
    random_batch,
)
from jaxcal.selection.continuous import Refinement, optimise
from jaxcal.selection.criteria import As, Ds, I, Mean, Worst
from jaxcal.selection.design import Design, select
from jaxcal.selection.fastest.motion import Motion
from jaxcal.selection.problem import Problem, make_problems
from jaxcal.selection.result import BatchSelection, Selection, Subset
from jaxcal.selection.solvers import METHODS

__all__ = [
    "METHODS",
    "As",
    "BatchSelection",
    "Design",
    "Ds",
    "I",
    "Mean",
    "Motion",
    "Problem",
    "Refinement",
    "Selection",
    "Subset",
    "Worst",
    "exact_batch",
    "exchange_batch",
    "greedy_batch",
    "make_problems",
    "optimise",
    "random_batch",
    "select",
]
