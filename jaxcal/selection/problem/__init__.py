"""What is chosen from, under which rules, and by which criterion."""

from jaxcal.selection.problem.making import (
    make_block_problem,
    make_problem,
    make_problems,
)
from jaxcal.selection.problem.problem import Problem, log_dets, values

__all__ = [
    "Problem",
    "log_dets",
    "make_block_problem",
    "make_problem",
    "make_problems",
    "values",
]
