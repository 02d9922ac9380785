"""Which few of many candidate postures to measure: one signature for every solver."""

from jaxcal.selection.api import METHODS, score, select
from jaxcal.selection.batch import (
    exact_batch,
    exchange_batch,
    greedy_batch,
    random_batch,
)
from jaxcal.selection.problem import Problem, make_problem, make_problems
from jaxcal.selection.result import BatchSelection, Selection, Subset

__all__ = [
    "METHODS",
    "BatchSelection",
    "Problem",
    "Selection",
    "Subset",
    "exact_batch",
    "exchange_batch",
    "greedy_batch",
    "make_problem",
    "make_problems",
    "random_batch",
    "score",
    "select",
]
