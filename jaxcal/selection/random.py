"""Random selection: the baseline of the paper, never singular."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.problem import Problem

__all__ = ["random_indices"]

_TRIES = 20


def random_indices(problem: Problem, rng: np.random.Generator) -> NDArray[np.int64]:
    """A selection drawn uniformly, the required candidates first.

    A singular draw is drawn again; after a few in a row (grids, duplicates) the next
    one skips the candidates that add no new direction until the span is complete.

    Args:
        problem: what to choose from.
        rng: source of the draw.

    Returns:
        (k,) candidates in the order drawn.
    """
    room = problem.upper - problem.lower
    pool = np.repeat(np.arange(len(room)), room)
    missing = problem.k - len(problem.required)
    for _ in range(_TRIES):
        drawn = rng.permutation(pool)[:missing]
        chosen = np.concatenate([problem.required, drawn])
        if np.linalg.matrix_rank(problem.rows[chosen]) == problem.num_regressors:
            return chosen
    return _independent_first(problem, rng.permutation(pool))


def _independent_first(problem: Problem, order: NDArray[np.int64]) -> NDArray[np.int64]:
    """The required, then of ``order`` what extends the span, then the rest in order."""
    rows = problem.rows
    residual = rows.copy()
    for i in problem.required:
        residual = _deflate(residual, i)
    chosen = list(problem.required)
    taken: list[int] = []
    # A direction not yet spanned holds 1/M of some row at least: whitened rows have
    # unit sum of squares along every direction.
    least = 1e-3 / len(rows)
    for position, i in enumerate(order):
        if len(chosen) < problem.k and residual[i] @ residual[i] > least:
            residual = _deflate(residual, i)
            chosen.append(i)
            taken.append(position)
    rest = np.delete(order, taken)[: problem.k - len(chosen)]
    return np.concatenate([np.asarray(chosen, dtype=np.int64), rest])


def _deflate(residual: NDArray[np.float64], i: int | np.int64) -> NDArray[np.float64]:
    """Project row i out of all rows; unchanged where row i is already spanned."""
    square = residual[i] @ residual[i]
    if square <= 1e-18:
        return residual
    return residual - np.outer(residual @ residual[i] / square, residual[i])
