"""Fast runs by look-ahead, for many prices of a second at once.

The next posture is the one from which greedy choices to the end of the run gain most
log det(Z.T Z), less price times the travel time of those choices. Each price gives runs
from its best few first postures. No price reaches a run inside the convex hull of time
against efficiency; so for a wanted efficiency the last two postures of every run are
chosen again: of all pairs that meet it, the one that makes the run shortest.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.fastest.refill import refills
from jaxcal.selection.fastest.task import Search, Task
from jaxcal.selection.policy.kernel import conditional, look_ahead
from jaxcal.selection.solver import Found

__all__ = ["PRICES", "complete", "lookahead_runs", "search"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Prices in log det(Z.T Z) a mean move: none, and from where time hardly matters to
# where the device stays as near as it can.
PRICES = np.concatenate([[0.0], np.geomspace(0.02, 6.0, 31)])

_DEPTH = 12  # most choices to look ahead
_LARGEST_TOLL = 600.0  # exp(-600) is still a normal number
_ENDINGS = 30  # endings of a run that are put in their best order,
_SUBSETS = 100  # and of all runs together


def search(task: Task, num: int, weight: float | None = None) -> Search:
    """The look-ahead runs of a task, completed at each determinant asked for.

    With ``weight`` the run of most worth, at any determinant.
    """
    if task.blocks.shape[1] > 1 or task.problem.prior.any():
        raise ValueError(
            'method must be "exact" or "heuristic" with blocks of several rows, a '
            'prior or measurements, got "lookahead"'
        )

    @functools.cache
    def runs() -> Indices:
        return lookahead_runs(task, PRICES, num)

    def solve(wanted: float) -> Found | None:
        if weight is not None:
            return Found(_most_worth(task, weight, num), method="lookahead")
        chosen = complete(task, runs(), wanted)
        if chosen is not None:
            return Found(chosen, method="lookahead")
        if task.log_det(task.optimum) >= wanted:
            return Found(task.optimum, method="exact")
        return None

    return solve


def _most_worth(task: Task, weight: float, num: int) -> Indices:
    """(k,) the run found of largest log D-efficiency less ``weight`` a second."""
    p = task.problem.num_regressors
    prices = np.append(PRICES[1:], weight * p * task.times.mean())
    runs = lookahead_runs(task, prices, num)
    subsets = np.unique(np.sort(runs, axis=1), axis=0)
    worth = [
        task.log_det(chosen) / p - weight * task.tour(chosen)[1] for chosen in subsets
    ]
    return subsets[int(np.argmax(worth))]


def lookahead_runs(task: Task, prices: Array, num: int) -> Indices:
    """Distinct runs in the order of choice, the required postures first.

    Args:
        task: the postures and the times between them.
        prices: (W,) of a second, in log det(Z.T Z) a mean move.
        num: first postures tried at each price.

    Returns:
        (R, k) into the pool.
    """
    mean = task.times.mean() or 1.0
    longest = max(task.times.max(), task.start.max()) or 1.0
    each = np.minimum(prices / mean, _LARGEST_TOLL / longest)
    # Rows of unit mean square, as [u, 1] has them in whitened coordinates.
    x = np.ascontiguousarray(task.problem.rows[task.pool].T) * np.sqrt(len(task.pool))
    runs = _runs(x, task.times, task.start, each, task.fixed, task.k, num)
    return np.unique(runs, axis=0)


def complete(task: Task, runs: Indices, wanted: float) -> Indices | None:
    """The fastest subset that the runs reach with the determinant wanted.

    Args:
        task: the postures and the times between them.
        runs: (R, k) in the order of choice, required postures first.
        wanted: least whitened log det.

    Returns:
        (k,) subset; None where no run gets there.
    """
    soonest: dict[tuple[int, ...], float] = {}
    for front in np.unique(runs[:, : max(task.k - 2, task.fixed)], axis=0):
        for seconds, chosen in refills(task, front, wanted, _ENDINGS):
            subset = tuple(sorted(chosen.tolist()))
            soonest[subset] = min(seconds, soonest.get(subset, np.inf))
    best, least = None, np.inf
    for subset in sorted(soonest, key=lambda s: soonest[s])[:_SUBSETS]:
        chosen = np.array(subset)
        if task.log_det(chosen) >= wanted:
            seconds = task.tour(chosen)[1]
            if seconds < least:
                best, least = chosen, seconds
    return best


def _runs(x, times, start, prices, fixed, k, num):
    """(W num, k) int64 runs: for each price the best ``num`` first postures, completed.

    Args:
        x: (p, M) float64 whitened regressors of unit mean square.
        times: (M, M) float64 seconds.
        start: (M,) float64 seconds from the start.
        prices: (W,) float64 log det(Z.T Z) a second.
        fixed: postures chosen already, the first of ``x``, visited in that order;
            fewer than k.
        k: postures in all.
        num: first postures.
    """
    m = len(start)
    runs = np.empty((len(prices) * num, k), np.int64)
    chosen = np.arange(k)
    free = np.ones(m, np.bool_)
    for w in range(len(prices)):
        tolls = prices[w] * times
        factors = np.exp(-tolls)
        entry = prices[w] * start
        free[:] = True
        free[:fixed] = False
        chosen[:fixed] = np.arange(fixed)
        ends = _ends(x, tolls, factors, entry, free, chosen[:fixed], k)
        firsts = np.argsort(-ends, kind="mergesort")
        for turn in range(num):
            chosen[fixed] = firsts[turn] if turn < m - fixed else firsts[0]
            for count in range(fixed + 1, k):
                free[:] = True
                free[chosen[:count]] = False
                ends = _ends(x, tolls, factors, entry, free, chosen[:count], k)
                chosen[count] = ends.argmax()
            runs[w * num + turn] = chosen
    return runs


def _ends(x, tolls, factors, start, free, chosen, k):
    """(M,) log gain less tolls to the end of the run, by the candidate chosen next."""
    values = np.empty((4, len(free)))
    depth = min(_DEPTH, k - len(chosen))
    y = conditional(x, chosen, free, k)
    look_ahead(y, free, k > len(x), depth, False, factors, values)
    return values[3] - (tolls[chosen[-1]] if len(chosen) else start)
