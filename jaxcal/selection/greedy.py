"""Greedy selection: one posture at a time, the largest gain in log det first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.problem import Problem

__all__ = ["greedy_indices", "greedy_rows"]

_RIDGE = 1e-9  # of the mean leverage: the limit of no ridge, to eight digits


def greedy_rows(
    rows: NDArray[np.float64],
    upper: NDArray[np.int64],
    k: int,
    required: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Complete partial selections greedily, a batch at a time.

    The gain of candidate i is ``x_i.T (ridge I + sum of chosen x x.T)^-1 x_i``. As the
    ridge goes to zero the first n + 1 gains are the diagonal of the Schur-complement
    kernel (the squared part of x_i outside the span of the chosen), the later ones
    ``x_i.T M^-1 x_i``. Whitened rows leave 1/M of some row outside every incomplete
    span, so the result is never singular.

    Args:
        rows: (B, M, p) whitened regressors.
        upper: (B, M) how often each candidate may be chosen.
        k: postures a set.
        required: (B, r) partial selections to start from, possibly r = 0.

    Returns:
        (B, k), the required first, then in the order picked.
    """
    num_sets, num_candidates, p = rows.shape
    each = np.arange(num_sets)
    room = upper.copy()
    np.subtract.at(room, (each[:, None], required), 1)
    chosen = np.take_along_axis(rows, required[..., None], axis=1)
    gram = np.matrix_transpose(chosen) @ chosen
    gram = gram + (_RIDGE * p / num_candidates) * np.eye(p)
    picks = np.zeros((num_sets, k), dtype=np.int64)
    picks[:, : required.shape[1]] = required
    for step in range(required.shape[1], k):
        gain = np.einsum("bmp,bmp->bm", rows @ np.linalg.inv(gram), rows)
        pick = np.where(room > 0, gain, -np.inf).argmax(axis=1)
        x = rows[each, pick]
        gram = gram + x[:, :, None] * x[:, None, :]
        room[each, pick] -= 1
        picks[:, step] = pick
    return picks


def greedy_indices(problem: Problem) -> NDArray[np.int64]:
    """(k,) candidates in the order picked, the required ones first."""
    return greedy_rows(
        problem.rows[None], problem.upper[None], problem.k, problem.required[None]
    )[0]
