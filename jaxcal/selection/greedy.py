"""Greedy selection: one candidate at a time, the largest gain first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.problem import Problem
from jaxcal.selection.solver import Found

__all__ = ["greedy_indices", "solve", "solve_many"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_RIDGE = 1e-9  # of the mean leverage: the limit of no ridge, to eight digits


def solve(problem: Problem) -> Found:
    """The solver "greedy"."""
    return Found(greedy_indices(problem))


def solve_many(problems: list[Problem]) -> list[Found]:
    """All problems of a batch at once; they share their shapes."""
    if not problems[0].rank_one:
        return [solve(problem) for problem in problems]
    picks = _greedy(
        np.stack([problem.rows for problem in problems]),
        np.stack([problem.prior for problem in problems]),
        np.stack([problem.upper for problem in problems]),
        problems[0].k,
        np.stack([problem.required for problem in problems]),
    )
    return [Found(indices) for indices in picks]


def greedy_indices(problem: Problem) -> Indices:
    """(k,) candidates in the order picked, the required ones first.

    On blocks, gains count a share of what the candidates not chosen yet will give, and
    swaps mend a singular selection. For E the gain is that in the sum of the variances,
    which is at most p times and at least once the largest: an incomplete selection has
    no least eigenvalue to raise.
    """
    if problem.rank_one:
        return solve_many([problem])[0].indices
    from jaxcal.selection.exchange.blocks import Blocks

    return Blocks(problem).greedy()


def _greedy(
    rows: Array, prior: Array, upper: Indices, k: int, required: Indices
) -> Indices:
    """Complete partial selections greedily, a batch at a time.

    The gain of candidate i is ``x_i.T V x_i``, V the inverse of ridge, prior and what
    is chosen. As the ridge goes to zero the first gains are the lengths that rows add
    outside the span of the chosen, the later ones those without a ridge. Whitened rows
    leave 1/M of some row outside every incomplete span, so the result is never
    singular.

    Args:
        rows: (B, M, p) whitened.
        prior: (B, p, p).
        upper: (B, M) how often each candidate may be chosen.
        k: candidates per set.
        required: (B, r) partial selections to start from, possibly r = 0.

    Returns:
        (B, k), the required first, then in the order picked.
    """
    num_sets, num_candidates, p = rows.shape
    each = np.arange(num_sets)
    room = upper.copy()
    np.subtract.at(room, (each[:, None], required), 1)
    kept = np.take_along_axis(rows, required[..., None], axis=1)
    gram = np.matrix_transpose(kept) @ kept + prior
    gram = gram + (_RIDGE * p / num_candidates) * np.eye(p)
    picks = np.zeros((num_sets, k), dtype=np.int64)
    picks[:, : required.shape[1]] = required
    for step in range(required.shape[1], k):
        gain = np.einsum("bmp,bmp->bm", rows @ np.linalg.inv(gram), rows)
        pick = np.where(room > 0, gain, -np.inf).argmax(axis=1)
        row = rows[each, pick]
        gram = gram + row[:, :, None] * row[:, None]
        room[each, pick] -= 1
        picks[:, step] = pick
    return picks
