"""Which few of many candidate postures to measure: one signature for every solver."""

from jaxcal.selection.api import score, select
from jaxcal.selection.batch import (
    exact_batch,
    exchange_batch,
    greedy_batch,
    random_batch,
)
from jaxcal.selection.problem import (
    Problem,
    make_block_problem,
    make_problem,
    make_problems,
)
from jaxcal.selection.result import BatchSelection, Selection, Subset
from jaxcal.selection.solvers import METHODS

__all__ = [
    "METHODS",
    "BatchSelection",
    "Problem",
    "Selection",
    "Subset",
    "exact_batch",
    "exchange_batch",
    "greedy_batch",
    "make_block_problem",
    "make_problem",
    "make_problems",
    "random_batch",
    "score",
    "select",
]
