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
from numba import njit
from numpy.typing import NDArray

from jaxcal.selection.fastest.refill import refills
from jaxcal.selection.fastest.task import Found, Solver, Task, log_det_of_rows

__all__ = ["complete", "lookahead_runs", "most_worth", "solver"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Prices in log det(Z.T Z) a mean move: none, and from where time hardly matters to
# where the device stays as near as it can.
PRICES = np.concatenate([[0.0], np.geomspace(0.02, 6.0, 31)])

_DEPTH = 12  # most choices to look ahead
_ALL_START = 1024  # candidates up to which every one is looked ahead from;
_STARTS = 512  # of more candidates, those of largest gain
_LEAST_GAIN = 1e-5  # of a whitened row; anything below counts as this much
_LARGEST_TOLL = 600.0  # exp(-600) is still a normal number
_ENDINGS = 30  # endings of a run that are put in their best order,
_SUBSETS = 100  # and of all runs together


def solver(task: Task, num: int) -> Solver:
    """The look-ahead runs of a task, completed at each determinant asked for."""

    @functools.cache
    def runs() -> Indices:
        return lookahead_runs(task, PRICES, num)

    def solve(wanted: float) -> Found | None:
        chosen = complete(task, runs(), wanted)
        if chosen is not None:
            return Found(chosen, "lookahead")
        if log_det_of_rows(task.rows[task.optimum]) >= wanted:
            return Found(task.optimum, "exact")
        return None

    return solve


def most_worth(task: Task, weight: float, num: int) -> Indices:
    """(k,) the run found of largest log D-efficiency less ``weight`` a second."""
    p = task.rows.shape[1]
    prices = np.append(PRICES[1:], weight * p * task.times.mean())
    runs = lookahead_runs(task, prices, num)
    subsets = np.unique(np.sort(runs, axis=1), axis=0)
    worth = [
        log_det_of_rows(task.rows[chosen]) / p - weight * task.tour(chosen)[1]
        for chosen in subsets
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
    rows = task.rows * np.sqrt(len(task.rows))
    runs = _runs(rows, task.times, task.start, each, task.fixed, task.k, num)
    return np.unique(runs, axis=0)


def complete(task: Task, runs: Indices, wanted: float) -> Indices | None:
    """The fastest subset that the runs reach with the determinant wanted.

    Args:
        task: the postures and the times between them.
        runs: (R, k) in the order of choice, required postures first.
        wanted: least log det(X_s.T X_s).

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
        if log_det_of_rows(task.rows[chosen]) >= wanted:
            seconds = task.tour(chosen)[1]
            if seconds < least:
                best, least = chosen, seconds
    return best


@njit(cache=True, nogil=True)
def _runs(rows, times, start, prices, fixed, k, num):
    """(W num, k) int64 runs: for each price the best ``num`` first postures, completed.

    Args:
        rows: (M, p) float64 whitened regressors of unit mean square.
        times: (M, M) float64 seconds.
        start: (M,) float64 seconds from the start.
        prices: (W,) float64 log det(Z.T Z) a second.
        fixed: postures chosen already, the first of ``rows``, visited in that order;
            fewer than k.
        k: postures in all.
        num: first postures.
    """
    m = len(rows)
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
        values = _values(rows, tolls, factors, entry, free, chosen, fixed, k)
        firsts = np.argsort(-values, kind="mergesort")
        for turn in range(num):
            chosen[fixed] = firsts[turn] if turn < m - fixed else firsts[0]
            for count in range(fixed + 1, k):
                free[:] = True
                free[chosen[:count]] = False
                values = _values(rows, tolls, factors, entry, free, chosen, count, k)
                chosen[count] = values.argmax()
            runs[w * num + turn] = chosen
    return runs


@njit(cache=True, nogil=True)
def _values(rows, tolls, factors, entry, free, chosen, count, k):
    """(M,) log gain less tolls to the end of the run, by the candidate chosen next.

    Args:
        rows: (M, p) float64.
        tolls: (M, M) float64 price times seconds.
        factors: (M, M) float64 ``exp(-tolls)``.
        entry: (M,) float64 tolls from the start.
        free: (M,) bool, may be chosen.
        chosen: (k,) int64, of which the first ``count`` are chosen.
        count: choices made.
        k: choices in all.
    """
    m, p = rows.shape
    # With k = p a choice multiplies det by what is left of its row outside the span of
    # the others. With more it multiplies the ridged det by 1 + its squared length in
    # the metric of the chosen.
    spanned = k > p
    rest = rows.copy()
    if spanned:
        rest /= np.sqrt(0.01 if count < p else 1e-6)
    for c in range(count):
        _take(rest, chosen[c], spanned)
    gains = (rest * rest).sum(axis=1)
    least = np.sort(gains)[m - _STARTS] if m > _ALL_START else 0.0
    values = np.full(m, -np.inf)
    depth = min(_DEPTH, k - count)
    base = 1.0 if spanned else 0.0
    open_ = free.copy()
    for first in range(m):
        if not free[first] or gains[first] < least:
            continue
        value = np.log(max(base + gains[first], _LEAST_GAIN))
        value -= tolls[chosen[count - 1], first] if count else entry[first]
        z = rest.copy()
        open_[:] = free
        here = first
        for _ in range(1, depth):
            open_[here] = False
            _take(z, here, spanned)
            best, most = -1, -1.0
            for j in range(m):
                if open_[j]:
                    gain = base
                    for a in range(p):
                        gain += z[j, a] * z[j, a]
                    gain = max(gain, _LEAST_GAIN) * factors[here, j]
                    if gain > most:
                        best, most = j, gain
            value += np.log(most)
            here = best
        values[first] = value
    return values


@njit(cache=True, nogil=True)
def _take(rest, i, spanned):
    """Shorten all of ``rest`` (M, p) along row i, which is chosen, in place."""
    m, p = rest.shape
    along = rest[i].copy()
    size = (along * along).sum()
    if size < 1e-12:
        return
    share = (1.0 - 1.0 / np.sqrt(1.0 + size)) / size if spanned else 1.0 / size
    for j in range(m):
        inner = 0.0
        for a in range(p):
            inner += rest[j, a] * along[a]
        for a in range(p):
            rest[j, a] -= share * inner * along[a]
