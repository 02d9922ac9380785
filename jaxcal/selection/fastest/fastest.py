"""Which postures to measure, and in which order, so that the run takes least time.

A move is a trapezoid profile on every axis (accelerate, cruise, brake), all axes start
together and the slowest sets the time; after it the device settles. The fastest run is
the subset **and** order of least total time among those with at least a given
D-efficiency. Each axis' time is a concave function of its distance that is zero at
zero, so the travel time is a metric, which the exact search uses to cut branches.

``exact`` proves the answer, for few postures (K up to about 8 of 50; it stops at a time
limit and says so). ``heuristic`` is local search from near-optimal subsets, for any K,
and proves nothing. ``policy`` is a network that was trained on every weight of time
against log det S, asked for 32 of them at once; ``lookahead`` is the rule that it
started from, without learning.
"""

from __future__ import annotations

import dataclasses
import pathlib
import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers
from jaxcal.information.criteria import d_efficiency
from jaxcal.selection.auto import check_least_efficiency
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.fastest import travel_policy
from jaxcal.selection.fastest.travel import (
    MOST_EXACT,
    Motion,
    fastest_tour,
    improved_tour,
    tour_seconds,
    travel_times,
)
from jaxcal.selection.problem import Problem, make_problem, whole_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "FastSelection",
    "Motion",
    "ParetoFront",
    "fastest_tour",
    "pareto_figure",
    "pareto_front",
    "select_fastest",
    "travel_times",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

METHODS = ("exact", "heuristic", *travel_policy.METHODS)

_EXACT_INSIDE = 7  # postures up to which the heuristic orders every trial exactly
_CHUNK = 20_000  # nodes between looks at the clock
_ROUNDING = 1e-12  # of log det(Z.T Z), so that the optimum itself meets its own value
_SAME_TIME = 1e-9  # seconds: two runs this close take as long
_STARTS = 12  # of the heuristic, and then random changes of the best it found:
_KICKS = 20
_KICK_TRIES = 50  # swaps drawn until one keeps the determinant


@dataclasses.dataclass(frozen=True, eq=False)
class FastSelection:
    """The postures in the order to visit, what the run takes, and what is proven."""

    indices: Indices  # (k,) in the order to visit
    seconds: float  # of travel and settling
    travel_seconds: float
    log_det: float  # natural log det S, in the candidates' unit
    efficiency: float  # D-efficiency against ``bound``
    least_efficiency: float  # that was asked for; 0 where a weight was
    proven: bool  # no subset and order with that efficiency takes less time
    method: str  # as asked for; "exact" where only the D-optimum was efficient enough
    bound: float  # log det S of the D-optimum, an upper bound on it where not proven
    bound_proven: bool  # ``bound`` is the optimum
    nodes: int  # of the exact search
    search_seconds: float  # that finding it took


def select_fastest(
    candidates: ArrayLike,
    k: int = 4,
    *,
    motion: Motion,
    least_efficiency: float | None = None,
    weight: float | None = None,
    start: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    num_outputs: int | None = None,
    method: str | None = None,
    time_limit: float = 60.0,
    num: int = 8,
    checkpoint: str | pathlib.Path | None = None,
    seed: int = 0,
) -> FastSelection:
    """Subset and order of least time with a D-efficiency of ``least_efficiency``.

    Args:
        candidates: (M, n) commands that could be measured, in any unit.
        k: postures to choose, distinct.
        motion: speeds and accelerations in the candidates' unit, settle time.
        least_efficiency: in (0, 1], against the proven D-optimum; 0.95 when neither
            this nor a weight is given.
        weight: instead of it, what a second is worth: the run with the largest
            ``log(efficiency) - weight * seconds`` among those found ("policy" and
            "lookahead" only).
        start: (n,) where the device stands; it begins at any posture when not given.
        available: (M,) bool, True where a candidate may be chosen.
        required: (r,) candidates that must be among the chosen.
        num_outputs: m; changes log det S, not the answer.
        method: "exact" (k up to 12, with a proof unless the time runs out),
            "heuristic", "policy" or "lookahead"; exact up to k = 8 when not given, the
            heuristic above, the policy where a weight is given.
        time_limit: seconds of the exact search and of the D-optimum behind it.
        num: first postures that policy and lookahead try for each of 32 weights.
        checkpoint: folder of the travel policy; the one that ships when not given.
        seed: of the starts of the heuristic, which also starts exact.

    Returns:
        The selection; among runs of equal time the one with the largest determinant.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    if weight is not None:
        if least_efficiency is not None:
            raise ValueError(
                "weight and least_efficiency must not both be given, got "
                f"{weight!r} and {least_efficiency!r}"
            )
        weight = _check_weight(weight)
        method = "policy" if method is None else method
        if method not in travel_policy.METHODS:
            raise ValueError(
                "method must be one of "
                f"{', '.join(travel_policy.METHODS)} with a weight, got {method!r}"
            )
    least = check_least_efficiency(
        0.95 if least_efficiency is None else least_efficiency
    )
    problem = make_problem(
        candidates,
        k,
        available=available,
        required=required,
        num_outputs=num_outputs,
    )
    method = _method(method, problem.k)
    task = _task(
        problem, motion, start, method, time_limit, seed, num, checkpoint, weight
    )
    return _fastest(task, least, None) if weight is None else _weighted(task, weight)


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Runs none of which is both faster and more efficient than another."""

    points: tuple[FastSelection, ...]  # ascending in time and in efficiency
    least_efficiency: float  # where the front was cut off
    proven: bool  # every point is, and none is missing


def pareto_front(
    candidates: ArrayLike,
    k: int = 4,
    *,
    motion: Motion,
    least_efficiency: float = 0.7,
    start: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    num_outputs: int | None = None,
    method: str | None = None,
    time_limit: float = 60.0,
    max_points: int = 200,
    num: int = 8,
    checkpoint: str | pathlib.Path | None = None,
    seed: int = 0,
) -> ParetoFront:
    """Time against D-efficiency, from ``least_efficiency`` up to the D-optimum.

    Each point is the fastest run more efficient than the point before it.

    Args:
        candidates, k, motion, start, available, required, num_outputs, method, num,
            checkpoint, seed: as in :func:`select_fastest`.
        least_efficiency: where to cut the front off, in (0, 1].
        time_limit: seconds for each point.
        max_points: points after which to stop; the front is then not proven.
    """
    least_efficiency = check_least_efficiency(least_efficiency)
    max_points = whole_number("max_points", max_points, 1)
    problem = make_problem(
        candidates,
        k,
        available=available,
        required=required,
        num_outputs=num_outputs,
    )
    method = _method(method, problem.k)
    task = _task(problem, motion, start, method, time_limit, seed, num, checkpoint)
    points: list[FastSelection] = []
    share, above = least_efficiency, None
    complete = False
    while len(points) < max_points:
        try:
            point = _fastest(task, share, above)
        except _NothingLeftError:
            complete = True
            break
        points.append(point)
        above = point.log_det
    kept = [
        p
        for p in points
        if not any(
            q.seconds <= p.seconds + _SAME_TIME and q.log_det > p.log_det
            for q in points
        )
    ]
    proven = complete and all(point.proven for point in points)
    return ParetoFront(tuple(kept), least_efficiency, proven)


def pareto_figure(fronts: dict[str, ParetoFront]) -> Figure:
    """Time against efficiency; filled markers are proven, hollow ones are not."""
    from matplotlib.figure import Figure

    from jaxcal.plots import COLOURS, MARKERS, plain_axes

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, front) in enumerate(fronts.items()):
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
        efficiency = [point.efficiency for point in front.points]
        seconds = [point.seconds for point in front.points]
        axes.plot(
            efficiency,
            seconds,
            drawstyle="steps-pre",
            color=colour,
            linewidth=1.0,
            marker=marker,
            markersize=5,
            markerfacecolor=colour if front.proven else "white",
            label=name + ("" if front.proven else " (not proven)"),
        )
    axes.set_xlabel("D-efficiency against the optimum")
    axes.set_ylabel("time of the run (s): travel and settling")
    axes.legend(frameon=False)
    plain_axes(axes)
    return figure


# -- inside ----------------------------------------------------------------------------


class _NothingLeftError(ValueError):
    """No subset has the determinant asked for."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Task:
    problem: Problem
    pool: Indices  # (P,) available candidates, the required first
    times: Array  # (P, P)
    start: Array  # (P,)
    settle: float
    method: str
    time_limit: float
    seed: int
    optimum: Indices  # (k,) the D-optimal subset, into the pool
    bound: float  # log det S
    bound_proven: bool
    runs: Indices | None  # (R, k) of the policy or the look-ahead, into the pool

    @property
    def rows(self) -> Array:
        return self.problem.rows[self.pool]


def _method(method: str | None, k: int) -> str:
    if method is None:
        return "exact" if k <= 8 else "heuristic"
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    if method == "exact" and k > MOST_EXACT:
        raise ValueError(f"k must be at most {MOST_EXACT} with exact, got {k}")
    return method


def _task(
    problem: Problem,
    motion: Motion,
    start: ArrayLike | None,
    method: str,
    time_limit: float,
    seed: int,
    num: int,
    checkpoint: str | pathlib.Path | None,
    weight: float | None = None,
) -> _Task:
    num = whole_number("num", num, 1)
    if not isinstance(motion, Motion):
        raise ValueError(f"motion must be a Motion, got {motion!r}")
    limit = numbers("time_limit", time_limit, finite=False)
    if limit.ndim or not limit > 0.0:
        raise ValueError(f"time_limit must be above 0 seconds, got {time_limit!r}")
    n = problem.num_regressors - 1
    free = np.setdiff1d(np.flatnonzero(problem.available), problem.required)
    leverage = (problem.rows[free] ** 2).sum(axis=1)
    pool = np.concatenate([problem.required, free[np.argsort(-leverage)]])
    points = problem.candidates[pool]
    begin = np.zeros(len(pool))
    if start is not None:
        where = numbers("start", start)
        if where.shape != (n,):
            raise ValueError(f"start must have shape ({n},), got {where.shape}")
        begin = travel_times(where[None], points, motion)[0]
    found = solve_exact(problem, deadline=time.perf_counter() + time_limit)
    position = np.full(len(problem.rows), -1)
    position[pool] = np.arange(len(pool))
    times = travel_times(points, points, motion)
    runs = None
    if method in travel_policy.METHODS:
        m = len(problem.rows)
        between, first = np.zeros((m, m)), np.zeros(m)
        between[np.ix_(pool, pool)], first[pool] = times, begin
        weights = travel_policy.WEIGHTS
        if weight is not None:
            asked = weight * problem.num_regressors * times.mean()
            weights = np.append(weights[1:], asked)
        runs = position[
            travel_policy.runs(
                problem, between, first, method, num, checkpoint, weights
            )
        ]
    return _Task(
        problem=problem,
        pool=pool,
        times=times,
        start=begin,
        settle=float(motion.settle) * problem.k,
        method=method,
        time_limit=float(time_limit),
        seed=whole_number("seed", seed, 0),
        optimum=position[found.subsets[0]],
        bound=found.bound,
        bound_proven=found.proven,
        runs=runs,
    )


def _check_weight(weight: float) -> float:
    value = numbers("weight", weight)
    if value.ndim or value < 0.0:
        raise ValueError(f"weight must be a number of at least 0, got {weight!r}")
    return float(value)


def _log_det(rows: Array, chosen: Indices) -> float:
    x = rows[chosen]
    sign, value = np.linalg.slogdet(x.T @ x)
    return float(value) if sign > 0 else -np.inf


def _fastest(task: _Task, least: float, above: float | None) -> FastSelection:
    """The fastest run with efficiency ``least``, and log det S over ``above``."""
    begun = time.perf_counter()
    problem, rows = task.problem, task.rows
    m, p = problem.num_outputs, problem.num_regressors
    scale = problem.log_scale
    # log det(X.T X) wanted; a bound that is not the optimum asks too much of a subset,
    # never too little.
    wanted = task.bound / m - scale + p * np.log(least) - _ROUNDING
    if above is not None:
        wanted = max(wanted, above / m - scale + 1e-9)
    nodes, proven, method = 0, False, task.method
    if task.runs is not None:
        fixed = len(problem.required)
        chosen, _ = travel_policy.completed(
            task.runs, rows, task.times, task.start, wanted, fixed
        )
        if chosen is None and _log_det(rows, task.optimum) >= wanted:
            chosen, method = task.optimum, "exact"
    else:
        chosen, seconds = _local_search(task, wanted)
        if method == "exact":
            value = -np.inf if chosen is None else _log_det(rows, chosen)
            chosen, nodes, proven = _exact_search(task, wanted, chosen, seconds, value)
    if chosen is None:
        if above is not None:
            raise _NothingLeftError
        raise ValueError(
            f"least_efficiency must be reachable, got {least:g}; the optimum is only "
            "bounded within the time limit: give more time, or ask for less"
        )
    return _selection(task, chosen, least, method, proven, nodes, begun)


def _weighted(task: _Task, weight: float) -> FastSelection:
    """The run of largest log efficiency less ``weight`` a second."""
    begun = time.perf_counter()
    p = task.problem.num_regressors
    assert task.runs is not None
    subsets = np.unique(np.sort(task.runs, axis=1), axis=0)
    worth = []
    for chosen in subsets:
        _, travel = fastest_tour(task.times[np.ix_(chosen, chosen)], task.start[chosen])
        worth.append(_log_det(task.rows, chosen) / p - weight * travel)
    chosen = subsets[int(np.argmax(worth))]
    return _selection(task, chosen, 0.0, task.method, False, 0, begun)


def _selection(
    task: _Task,
    chosen: Indices,
    least: float,
    method: str,
    proven: bool,
    nodes: int,
    begun: float,
) -> FastSelection:
    """A subset of the pool, in its best order and with everything to be said of it."""
    problem = task.problem
    order, travel = fastest_tour(task.times[np.ix_(chosen, chosen)], task.start[chosen])
    indices = task.pool[chosen[order]]
    log_det = problem.log_det(indices)
    weight = problem.num_outputs * problem.num_regressors
    return FastSelection(
        indices=indices,
        seconds=travel + task.settle,
        travel_seconds=travel,
        log_det=log_det,
        efficiency=d_efficiency(log_det, max(task.bound, log_det), weight),
        least_efficiency=least,
        proven=proven and task.bound_proven,
        method=method,
        bound=max(task.bound, log_det),
        bound_proven=task.bound_proven,
        nodes=nodes,
        search_seconds=time.perf_counter() - begun,
    )


def _exact_search(
    task: _Task, wanted: float, chosen: Indices | None, seconds: float, value: float
) -> tuple[Indices | None, int, bool]:
    """Drive the compiled search, watching the clock."""
    from jaxcal.selection.fastest.kernel import search

    k = task.problem.k
    best = np.array([seconds, value])
    best_chosen = np.zeros(k, dtype=np.int64) if chosen is None else np.sort(chosen)
    state, stack = np.zeros(3, dtype=np.int64), np.zeros(k + 1, dtype=np.int64)
    relaxed = task.rows[task.optimum].T @ task.rows[task.optimum]
    deadline = time.perf_counter() + task.time_limit
    complete = False
    tours = np.full((1 << k, k), np.inf)
    while not complete and time.perf_counter() < deadline:
        complete = search(
            np.ascontiguousarray(task.rows), task.times, task.start,
            len(task.problem.required), k, relaxed, wanted, _SAME_TIME, tours,
            stack, state, best, best_chosen, _CHUNK,
        )  # fmt: skip
    found = best_chosen if np.isfinite(best[0]) else None
    return found, int(state[2]), bool(complete)


def _local_search(task: _Task, wanted: float) -> tuple[Indices | None, float]:
    """Swaps that keep the determinant and shorten the tour, from several subsets."""
    rng = np.random.default_rng(task.seed)
    starts = [task.optimum]
    position = np.full(len(task.problem.rows), -1)
    position[task.pool] = np.arange(len(task.pool))
    for _ in range(_STARTS - 1):
        indices = exchange_indices(task.problem, 1, int(rng.integers(2**31)))
        starts.append(position[indices])
    best: Indices | None = None
    least = np.inf
    for start in starts:
        if _log_det(task.rows, start) < wanted:
            continue
        chosen, seconds = _shortened(task, start, wanted)
        if seconds < least - _SAME_TIME:
            best, least = chosen, seconds
    for _ in range(_KICKS if task.method == "heuristic" else 0):
        if best is None:
            break
        kicked = _kicked(task, best, wanted, rng)
        chosen, seconds = _shortened(task, kicked, wanted)
        if seconds < least - _SAME_TIME:
            best, least = chosen, seconds
    return best, least


def _kicked(
    task: _Task, chosen: Indices, wanted: float, rng: np.random.Generator
) -> Indices:
    """Up to two random swaps that keep the determinant, to leave a local optimum."""
    fixed = len(task.problem.required)
    for _ in range(2):
        free = np.flatnonzero(chosen >= fixed)
        others = np.setdiff1d(np.arange(len(task.rows)), chosen)
        for _ in range(_KICK_TRIES if len(free) and len(others) else 0):
            tried = chosen.copy()
            tried[rng.choice(free)] = rng.choice(others)
            if _log_det(task.rows, tried) >= wanted:
                chosen = tried
                break
    return chosen


def _shortened(task: _Task, start: Indices, wanted: float) -> tuple[Indices, float]:
    rows, times, begin = task.rows, task.times, task.start
    fixed = len(task.problem.required)
    order, seconds = fastest_tour(times[np.ix_(start, start)], begin[start])
    tour = start[order]
    for _ in range(10 * len(tour)):
        gram = rows[tour].T @ rows[tour]
        value = np.linalg.slogdet(gram)[1]
        inverse = np.linalg.inv(gram)
        leverage = np.einsum("mp,pq,mq->m", rows, inverse, rows)
        others = np.setdiff1d(np.arange(len(rows)), tour)
        moves: list[tuple[float, int, int]] = []
        for i in np.flatnonzero(tour >= fixed):
            cross = rows[others] @ inverse @ rows[tour[i]]
            with np.errstate(divide="ignore", invalid="ignore"):
                after = value + np.log(
                    (1 + leverage[others]) * (1 - leverage[tour[i]]) + cross**2
                )
            enough = others[after >= wanted]
            if not len(enough):
                continue
            rest = np.delete(tour, i)
            base = tour_seconds(
                np.arange(len(rest)), times[np.ix_(rest, rest)], begin[rest]
            )
            estimate = base + _insertions(rest, enough, times, begin)
            moves += [
                (float(t), int(i), int(j))
                for t, j in zip(estimate, enough, strict=True)
            ]
        improved = False
        for _, out, new in sorted(moves)[:8]:
            tried = tour.copy()
            tried[out] = new
            if _log_det(rows, tried) < wanted:
                continue
            if len(tried) <= _EXACT_INSIDE:
                order, length = fastest_tour(times[np.ix_(tried, tried)], begin[tried])
            else:
                order = improved_tour(
                    np.arange(len(tried)), times[np.ix_(tried, tried)], begin[tried]
                )
                length = tour_seconds(order, times[np.ix_(tried, tried)], begin[tried])
            if length < seconds - _SAME_TIME:
                tour, seconds, improved = tried[order], length, True
                break
        if not improved:
            break
    return tour, seconds


def _insertions(tour: Indices, new: Indices, times: Array, begin: Array) -> Array:
    """(new,) least time that putting each of ``new`` anywhere in the tour adds."""
    first = begin[new] + times[new, tour[0]] - begin[tour[0]]
    last = times[tour[-1], new]
    between = (
        times[np.ix_(tour[:-1], new)]
        + times[np.ix_(tour[1:], new)]
        - times[tour[:-1], tour[1:]][:, None]
    )
    return np.vstack([first, last, between]).min(axis=0)
