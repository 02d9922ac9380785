"""Greedy selection: one posture at a time, the largest gain in log det first."""

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
    picks = _greedy(
        np.stack([problem.blocks for problem in problems]),
        np.stack([problem.prior for problem in problems]),
        np.stack([problem.upper for problem in problems]),
        problems[0].k,
        np.stack([problem.required for problem in problems]),
    )
    return [Found(indices) for indices in picks]


def greedy_indices(problem: Problem) -> Indices:
    """(k,) candidates in the order picked, the required ones first."""
    return solve_many([problem])[0].indices


def _greedy(
    blocks: Array, prior: Array, upper: Indices, k: int, required: Indices
) -> Indices:
    """Complete partial selections greedily, a batch at a time.

    The gain of candidate i is ``det(I + B_i V B_i.T)``, V the inverse of ridge, prior
    and what is chosen. As the ridge goes to zero the first gains are the volumes that
    blocks add outside the span of the chosen, the later ones those without a ridge.
    Whitened blocks leave 1/M of some block outside every incomplete span, so with one
    reading per candidate the result is never singular.

    Args:
        blocks: (B, M, q, p) whitened.
        prior: (B, p, p).
        upper: (B, M) how often each candidate may be chosen.
        k: candidates per set.
        required: (B, r) partial selections to start from, possibly r = 0.

    Returns:
        (B, k), the required first, then in the order picked.
    """
    num_sets, num_candidates, q, p = blocks.shape
    each = np.arange(num_sets)
    room = upper.copy()
    np.subtract.at(room, (each[:, None], required), 1)
    chosen = np.take_along_axis(blocks, required[..., None, None], axis=1)
    rows = blocks.reshape(num_sets, -1, p)
    kept = chosen.reshape(num_sets, -1, p)
    gram = np.matrix_transpose(kept) @ kept + prior
    gram = gram + (_RIDGE * p / num_candidates) * np.eye(p)
    picks = np.zeros((num_sets, k), dtype=np.int64)
    picks[:, : required.shape[1]] = required
    for step in range(required.shape[1], k):
        scaled = rows @ np.linalg.inv(gram)
        if q == 1:
            gain = np.einsum("bmp,bmp->bm", scaled, rows)
        else:
            inner = scaled.reshape(blocks.shape) @ np.matrix_transpose(blocks)
            gain = np.linalg.slogdet(np.eye(q) + inner)[1]
        pick = np.where(room > 0, gain, -np.inf).argmax(axis=1)
        block = blocks[each, pick]
        gram = gram + np.matrix_transpose(block) @ block
        room[each, pick] -= 1
        picks[:, step] = pick
    return picks
