"""Local search: swaps of one posture that keep the determinant and shorten the tour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.fastest.task import SAME_TIME, Search, Task
from jaxcal.selection.solver import Found

__all__ = ["local_search", "search"]

Indices = NDArray[np.int64]

_STARTS = 12  # the D-optimum and local optima of the exchange
_KICKS = 20  # random changes of the best run found, from which to search again
_KICK_TRIES = 50  # swaps drawn until one keeps the determinant
_RIDGE = 1e-8  # of the whitened information of fewer postures than identify
_TRIED = 8  # most promising swaps that are put in their best order


def search(task: Task, seed: int) -> Search:
    """Local search from several subsets, then from random changes of the best."""

    def solve(wanted: float) -> Found | None:
        rng = np.random.default_rng(seed)
        best, least = local_search(task, wanted, rng)
        if best is None:
            return None
        for _ in range(_KICKS):
            chosen, seconds = _shortened(task, _kicked(task, best, wanted, rng), wanted)
            if seconds < least - SAME_TIME:
                best, least = chosen, seconds
        return Found(best, method="heuristic")

    return solve


def local_search(
    task: Task, wanted: float, rng: np.random.Generator
) -> tuple[Indices | None, float]:
    """The fastest subset (k,) found from near-optimal ones, and its seconds of travel.

    None and infinity where no start has the log det ``wanted``.
    """
    starts = [task.optimum] + [
        task.positions(exchange_indices(task.problem, 1, int(rng.integers(2**31))))
        for _ in range(_STARTS - 1)
    ]
    best, least = None, np.inf
    for start in starts:
        if task.log_det(start) >= wanted:
            chosen, seconds = _shortened(task, start, wanted)
            if seconds < least - SAME_TIME:
                best, least = chosen, seconds
    return best, least


def _kicked(
    task: Task, chosen: Indices, wanted: float, rng: np.random.Generator
) -> Indices:
    """Up to two random swaps that keep the determinant, to leave a local optimum."""
    for _ in range(2):
        free = np.flatnonzero(chosen >= task.fixed)
        others = np.setdiff1d(np.arange(len(task.blocks)), chosen)
        for _ in range(_KICK_TRIES if len(free) and len(others) else 0):
            tried = chosen.copy()
            tried[rng.choice(free)] = rng.choice(others)
            if task.log_det(tried) >= wanted:
                chosen = tried
                break
    return chosen


def _shortened(task: Task, start: Indices, wanted: float) -> tuple[Indices, float]:
    """Swap until none of the most promising swaps shortens the tour."""
    tour, seconds = task.tour(start)
    for _ in range(10 * task.k):
        swaps = [
            swap
            for i in np.flatnonzero(tour >= task.fixed)
            for swap in _refills(task, np.delete(tour, i), wanted, _TRIED + 1)
        ]
        for _, tried in sorted(swaps, key=lambda swap: swap[0])[:_TRIED]:
            if task.log_det(tried) >= wanted:
                shorter, reached = task.tour(tried)
                if reached < seconds - SAME_TIME:
                    tour, seconds = shorter, reached
                    break
        else:
            break
    return tour, seconds


def _refills(
    task: Task, kept: Indices, wanted: float, most: int
) -> list[tuple[float, Indices]]:
    """Ways to complete k - 1 postures to k, by their estimated seconds of travel.

    The estimate inserts the new posture where it adds least to the tour kept.

    Args:
        task: the postures and the times between them.
        kept: (k - 1,) postures in the order visited.
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
    value = np.log(np.maximum(factor, 1e-300)) + 2.0 * np.log(np.diag(lower)).sum()
    seconds = np.where(value >= wanted - 1e-6, seconds + legs.sum(), np.inf)
    best = np.argsort(seconds, kind="stable")[:most]
    return [
        (float(seconds[i]), np.append(kept, others[i]))
        for i in best[np.isfinite(seconds[best])]
    ]
