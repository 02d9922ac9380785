"""Subsets that complete some postures and keep the determinant, by estimated time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.fastest.task import Task

__all__ = ["refills"]

Indices = NDArray[np.int64]

_RIDGE = 1e-8  # of the whitened information of fewer postures than identify


def refills(
    task: Task, kept: Indices, wanted: float, most: int
) -> list[tuple[float, Indices]]:
    """Ways to complete postures to k, by their estimated seconds of travel.

    The estimate inserts each new posture where it adds least to the tour kept, or two
    new ones one after the other at its end.

    Args:
        task: the postures and the times between them.
        kept: (k - 1,) postures in the order visited; (k - 2,) with blocks of one row.
        wanted: least whitened log det, met to 1e-6.
        most: completions to return.

    Returns:
        Seconds and (k,) subset of each, ascending.
    """
    times, begin = task.times, task.start
    legs = np.concatenate([begin[kept[:1]], times[kept[:-1], kept[1:]], [0.0]])
    others = np.setdiff1d(np.arange(len(task.blocks)), kept)
    _, q, p = task.blocks.shape
    lower = np.linalg.cholesky(task.information(kept) + _RIDGE * np.eye(p))
    y = np.linalg.solve(lower, task.blocks[others].reshape(-1, p).T).T.reshape(-1, q, p)
    # Factor of the determinant.
    factor = np.linalg.det(np.eye(q) + y @ np.matrix_transpose(y))
    into = np.vstack([begin[others], times[np.ix_(kept, others)]])
    onward = np.vstack([times[np.ix_(kept, others)], np.zeros(len(others))])
    seconds = (into + onward - legs[:, None]).min(axis=0)
    if len(kept) == task.k - 2:
        factor = np.outer(factor, factor) - (y[:, 0] @ y[:, 0].T) ** 2
        last = into[-1][:, None] + times[np.ix_(others, others)]
        seconds = np.minimum(np.minimum(last, last.T), seconds[:, None] + seconds)
        factor[np.tril_indices(len(others))] = 0.0
    value = np.log(np.maximum(factor, 1e-300)) + 2.0 * np.log(np.diag(lower)).sum()
    seconds = np.where(value >= wanted - 1e-6, seconds + legs.sum(), np.inf)
    best = np.argsort(seconds, axis=None, kind="stable")[:most]
    best = best[np.isfinite(seconds.flat[best])]
    new = np.stack(np.unravel_index(best, seconds.shape), axis=-1)
    return [
        (float(seconds.flat[place]), np.concatenate([kept, others[some]]))
        for place, some in zip(best, new, strict=True)
    ]
