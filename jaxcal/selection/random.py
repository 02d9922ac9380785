"""Random selection: the baseline of the paper, never singular."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.exchange.exchange import greedy_indices
from jaxcal.selection.problem import Problem, log_dets
from jaxcal.selection.solver import Found

__all__ = ["solve", "solve_many"]

Indices = NDArray[np.int64]

_TRIES = 200


def solve(problem: Problem, *, seed: int) -> Found:
    """The solver "random"."""
    found = solve_many([problem], seed=seed)[0]
    return Found(found.indices, found.value, seed=seed)


def solve_many(problems: list[Problem], *, seed: int) -> list[Found]:
    """A selection of each problem drawn uniformly, the required candidates first.

    A singular draw is drawn again; where all are (a table that is nearly all
    duplicates), the answer is the greedy selection. One seed draws the whole batch.
    """
    rng = np.random.default_rng(seed)
    indices = np.stack([_drawn(problem, rng) for problem in problems])
    values = log_dets(problems, indices[:, None])[:, 0]
    for b in np.flatnonzero(np.isneginf(values)):
        for attempt in range(_TRIES):
            last = attempt == _TRIES - 1
            drawn = greedy_indices(problems[b]) if last else _drawn(problems[b], rng)
            indices[b], values[b] = drawn, problems[b].log_det(drawn)
            if values[b] > -np.inf:
                break
    return [Found(i, float(v)) for i, v in zip(indices, values, strict=True)]


def _pool(problem: Problem, rng: np.random.Generator) -> Indices:
    """What may be chosen beside the required, replicates repeated, in random order."""
    room = problem.upper - problem.lower
    return rng.permutation(np.repeat(np.arange(len(room)), room))


def _drawn(problem: Problem, rng: np.random.Generator) -> Indices:
    free = problem.k - len(problem.required)
    return np.concatenate([problem.required, _pool(problem, rng)[:free]])
