"""Which postures, in which order, so that a run takes least time; the trade-off."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import one_of, share, whole_number
from jaxcal.selection.fastest import exact, heuristic
from jaxcal.selection.fastest.motion import Motion
from jaxcal.selection.fastest.task import SAME_TIME, Search, Task, make_task
from jaxcal.selection.problem import Asked
from jaxcal.selection.solvers import checked_seed

__all__ = ["FastSelection", "ParetoFront", "pareto_front", "select_fastest"]

_METHODS = {"exact": exact.search, "heuristic": heuristic.search}
_MOST_EXACT = 12  # postures that the exact search accepts
_EXACT_BY_DEFAULT = 8


@dataclasses.dataclass(frozen=True, eq=False)
class FastSelection:
    """The postures in the order to visit, what the run takes, and what is proven."""

    indices: NDArray[np.int64]  # (k,) in the order to visit
    seconds: float  # of travel and settling
    travel_seconds: float
    log_det: float  # natural log det S, in the candidates' unit
    efficiency: float  # D-efficiency against ``bound``
    least_efficiency: float  # that was asked for
    proven: bool  # no subset and order with that efficiency takes less time
    method: str  # as asked for; "exact" where only the D-optimum was efficient enough
    bound: float  # log det S of the D-optimum, an upper bound on it where not proven
    bound_proven: bool  # ``bound`` is the optimum
    nodes: int  # of the exact search
    search_seconds: float  # that finding it took


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Runs none of which is both faster and more efficient than another."""

    points: tuple[FastSelection, ...]  # ascending in time and in efficiency
    least_efficiency: float  # where the front was cut off
    proven: bool  # every point is, and none is missing


def select_fastest(
    asked: Asked,
    k: int | None,
    motion: Motion,
    least_efficiency: float,
    start: ArrayLike | None,
    method: str | None,
    time_limit: float,
    seed: int | np.random.Generator,
) -> FastSelection:
    """See :meth:`jaxcal.Design.fastest`."""
    least = share("least_efficiency", least_efficiency)
    task = make_task(asked, k, motion, start, time_limit)
    found = _answer(task, _search(task, method, seed), least)
    if found is None:
        raise ValueError(
            f"least_efficiency must be reachable, got {least:g}; the optimum is only "
            "bounded within the time limit: give more time, or ask for less"
        )
    return found


def pareto_front(
    asked: Asked,
    k: int | None,
    motion: Motion,
    least_efficiency: float,
    start: ArrayLike | None,
    method: str | None,
    max_points: int,
    time_limit: float,
    seed: int | np.random.Generator,
) -> ParetoFront:
    """See :meth:`jaxcal.Design.pareto`."""
    least_efficiency = share("least_efficiency", least_efficiency)
    max_points = whole_number("max_points", max_points, 1)
    task = make_task(asked, k, motion, start, time_limit)
    search = _search(task, method, seed)
    points: list[FastSelection] = []
    complete = False
    while len(points) < max_points and not complete:
        above = points[-1].log_det if points else None
        point = _answer(task, search, least_efficiency, above)
        if point is None:
            complete = True
        else:
            points.append(point)
    kept = tuple(
        p
        for p in points
        if not any(
            q.seconds <= p.seconds + SAME_TIME and q.log_det > p.log_det for q in points
        )
    )
    proven = complete and all(point.proven for point in points)
    return ParetoFront(kept, least_efficiency, proven)


def _search(task: Task, method: str | None, seed: int | np.random.Generator) -> Search:
    """The search of ``method``, or of the one that suits k."""
    if method is None:
        method = "exact" if task.k <= _EXACT_BY_DEFAULT else "heuristic"
    one_of("method", method, tuple(_METHODS))
    if method == "exact" and task.k > _MOST_EXACT:
        raise ValueError(f"k must be at most {_MOST_EXACT} with exact, got {task.k}")
    return _METHODS[method](task, checked_seed(seed))


def _answer(
    task: Task, search: Search, least: float, above: float | None = None
) -> FastSelection | None:
    """The fastest run with efficiency ``least``, and log det S over ``above``.

    None where the search finds no subset with that determinant.
    """
    begun = time.perf_counter()
    found = search(task.wanted(least, above))
    if found is None:
        return None
    problem = task.problem
    tour, travel = task.tour(found.indices)
    indices = task.pool[tour]
    log_det = problem.log_det(indices)
    bound = max(task.exact.bound, log_det)
    return FastSelection(
        indices=indices,
        seconds=travel + task.settle,
        travel_seconds=travel,
        log_det=log_det,
        efficiency=problem.criterion.efficiency(log_det, bound),
        least_efficiency=least,
        proven=found.proven and task.exact.proven,
        method=str(found.method),
        bound=bound,
        bound_proven=task.exact.proven,
        nodes=found.nodes or 0,
        search_seconds=time.perf_counter() - begun,
    )
