"""Random selection: the baseline of the paper, never singular."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.blocks import SINGULAR
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
    order = _pool(problem, rng)
    known = problem.known
    outside = problem.blocks - problem.blocks @ known.T @ known
    for i in problem.required:
        outside = _deflate(outside, i)
    chosen = list(problem.required)
    taken: list[int] = []
    # A direction not yet spanned holds 1/M of some block at least: whitened blocks have
    # unit sum of squares along every direction.
    least = 1e-3 / len(outside)
    for position, i in enumerate(order):
        if len(chosen) < problem.k and (outside[i] ** 2).sum() > least:
            outside = _deflate(outside, i)
            chosen.append(i)
            taken.append(position)
    rest = np.delete(order, taken)[: problem.k - len(chosen)]
    return np.concatenate([np.asarray(chosen, dtype=np.int64), rest])


def _deflate(outside: NDArray[np.float64], i: int | np.int64) -> NDArray[np.float64]:
    """Project the rows of block i (q, p) out of all blocks (M, q, p)."""
    _, size, right = np.linalg.svd(outside[i], full_matrices=False)
    right = right[size > SINGULAR]  # of whitened blocks, whose largest is 1
    return outside - outside @ right.T @ right
