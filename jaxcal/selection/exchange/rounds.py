"""Selections of which the worst few may fail, losses added as they turn out to matter.

Rounds: the problem where some losses are all there are is solved; what it says is best
is judged by its own losses, which join the others. The optimum of each round bounds the
answer, and where its selection keeps its value the answer is proven.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxcal.deadline import NEVER, Deadline
from jaxcal.selection.problem import LossProblem, Problem, Solution

__all__ = ["in_rounds"]

_ROUNDS = 200
_SAME = 1e-9  # share of a value: the same


def in_rounds(
    problem: LossProblem,
    solve: Callable[[Problem], Solution],
    start: NDArray[np.int64],
    deadline: Deadline = NEVER,
    enough: float | None = None,
) -> Solution:
    """The best selection found over the rounds, with the bound of the last.

    Args:
        problem: what to choose from.
        solve: of the problem where some losses are all there are.
        start: (k,) a selection, whose losses are the first.
        deadline: after which no round begins.
        enough: efficiency in (0, 1] at which to stop.
    """
    criterion, losses = problem.criterion, problem.losses_of(start)
    sign = 1.0 if criterion.larger_is_better else -1.0
    best: Solution | None = None
    value, nodes, bound = -np.inf, 0, np.inf  # larger is better, of both
    proven, tried = False, set[tuple[int, ...]]()
    for _ in range(_ROUNDS):
        solution = solve(problem.among(losses))
        nodes += solution.nodes or 0
        chosen = np.sort(solution.indices)
        reached = sign * float(problem.values(chosen[None])[0][0])
        if best is None or reached > value:
            best, value = dataclasses.replace(solution, indices=chosen), reached
        if solution.bound is not None:
            bound = min(bound, sign * solution.bound)
            near = value >= bound - _SAME * max(1.0, abs(bound))
            proven = solution.proven and near
            share = criterion.efficiency(sign * value, sign * bound)
            if proven or (
                enough is not None and np.isfinite(value) and share >= enough
            ):
                break
        new = problem.losses_of(chosen) - losses
        over = deadline.passed
        if not new or over or (solution.bound is None and tuple(chosen) in tried):
            break
        tried.add(tuple(chosen))
        losses |= new
    assert best is not None
    if not np.isfinite(value):
        raise ValueError(
            f"{problem.subject} must allow a selection that {problem.lost} lost leave "
            f"invertible, but the best found, {best.indices.tolist()}, is not"
        )
    true_bound = None
    if np.isfinite(bound):
        true_bound = sign * max(bound, value)
    return dataclasses.replace(
        best, value=None, log_det=None, bound=true_bound, proven=proven, nodes=nodes,
        alternatives=(),
    )  # fmt: skip
