"""Local search: swaps of one posture that keep the determinant and shorten the tour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.fastest.refill import refills
from jaxcal.selection.fastest.task import SAME_TIME, Search, Task
from jaxcal.selection.solver import Found

__all__ = ["local_search", "search"]

Indices = NDArray[np.int64]

_STARTS = 12  # the D-optimum and local optima of the exchange
_KICKS = 20  # random changes of the best run found, from which to search again
_KICK_TRIES = 50  # swaps drawn until one keeps the determinant
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
            for swap in refills(task, np.delete(tour, i), wanted, _TRIED + 1)
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
