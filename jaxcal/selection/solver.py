"""What a solver is: functions from a checked problem to what it found.

``solve(problem, *, option, ...) -> Found`` solves one problem; its keyword arguments
are the options it reads, checked and complete. ``solve_many(problems, *, option, ...)``
solves a batch. :mod:`jaxcal.selection.solvers` is the table of all of them.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.problem import Problem

__all__ = ["Found", "in_threads"]


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """A solver's answer; what it leaves out is judged by the caller."""

    indices: NDArray[np.int64]  # (k,) in the order picked
    value: float | None = None  # of the criterion, as reported to the caller
    bound: float | None = None  # no selection allowed has a better value
    proven: bool = False  # no selection is better by more than 1e-9
    nodes: int | None = None  # nodes of branch and bound or of the search
    alternatives: tuple[tuple[NDArray[np.int64], float], ...] = ()  # best first
    method: str | None = None  # the solver that answered, where another was asked
    reason: str = ""  # one sentence
    seed: int | None = None  # where it draws at random
    restarts: int | None = None  # random starts of the exchange


def in_threads(
    problems: list[Problem], solve: Callable[[Problem], Found]
) -> list[Found]:
    """Solve every problem, in threads: compiled solvers release the interpreter."""
    if len(problems) == 1:
        return [solve(problem) for problem in problems]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return list(pool.map(solve, problems))
