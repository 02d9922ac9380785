"""Random selection: the baseline of the paper, never singular."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.blocks import significant
from jaxcal.selection.problem import Problem, log_dets
from jaxcal.selection.solver import Found

__all__ = ["solve", "solve_many"]

Indices = NDArray[np.int64]

_TRIES = 20


def solve(problem: Problem, *, seed: int) -> Found:
    """The solver "random"."""
    found = solve_many([problem], seed=seed)[0]
    return Found(found.indices, found.value, seed=seed)


def solve_many(problems: list[Problem], *, seed: int) -> list[Found]:
    """A selection of each problem drawn uniformly, the required candidates first.

    A singular draw is drawn again; after a few in a row (grids, duplicates) the next
    one skips the candidates that add no new direction until the span is complete. One
    seed draws the whole batch.
    """
    rng = np.random.default_rng(seed)
    indices = np.stack([_drawn(problem, rng) for problem in problems])
    values = log_dets(problems, indices[:, None])[:, 0]
    for b in np.flatnonzero(np.isneginf(values)):
        problem = problems[b]
        for attempt in range(_TRIES):
            last = attempt == _TRIES - 1
            indices[b] = (_independent_first if last else _drawn)(problem, rng)
            values[b] = problem.log_det(indices[b])
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


def _independent_first(problem: Problem, rng: np.random.Generator) -> Indices:
    """The required, then in random order what extends the span, then the rest."""
    p, rank = problem.num_regressors, problem.held_rank
    chosen: list[int] = problem.required.tolist()
    later: list[int] = []
    rows = problem.blocks[problem.required].reshape(-1, p)
    rows = np.concatenate([problem.root @ problem.basis, rows])
    for i in _pool(problem, rng).tolist():
        more, found = np.concatenate([rows, problem.blocks[i]]), 0
        if rank < p and len(chosen) < problem.k:
            found = int(significant(np.linalg.svd(more, compute_uv=False)).sum())
        if found > rank:
            rows, rank = more, found
        (chosen if rows is more else later).append(i)
    return np.array([*chosen, *later][: problem.k], dtype=np.int64)
