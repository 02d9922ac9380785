"""Greedy selection: one candidate at a time, the largest gain first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.exchange.exchange import Climbs
from jaxcal.selection.problem import Problem
from jaxcal.selection.solver import Found

__all__ = ["greedy_indices", "solve", "solve_many"]


def solve(problem: Problem) -> Found:
    """The solver "greedy"."""
    return Found(greedy_indices(problem))


def solve_many(problems: list[Problem]) -> list[Found]:
    """One by one."""
    return [solve(problem) for problem in problems]


def greedy_indices(problem: Problem) -> NDArray[np.int64]:
    """(k,) candidates in the order picked, the required ones first.

    Gains count a share of what the candidates not chosen yet will give, and swaps mend
    a singular selection. For E the gain is that in the sum of the variances, which is
    at most p times and at least once the largest: an incomplete selection has no least
    eigenvalue to raise.
    """
    return Climbs(problem, 0, None).greedy()
