"""What every search for a fast run reads: rows, times between postures, the optimum."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, seconds
from jaxcal.selection.exact.exact import ExactResult, solve_exact
from jaxcal.selection.fastest.motion import Motion, travel_times
from jaxcal.selection.problem import Problem, make_problem

__all__ = ["SAME_TIME", "Found", "Solver", "Task", "log_det_of_rows", "make_task"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SAME_TIME = 1e-9  # seconds: two runs this close take as long


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """One problem, cut down to the candidates that may be chosen: the pool."""

    problem: Problem
    pool: Indices  # (P,) candidates, the required first, then by falling leverage
    rows: Array  # (P, p) whitened regressors
    times: Array  # (P, P) seconds from each to each
    start: Array  # (P,) seconds to each from the start; 0 where there is none
    settle: float  # seconds at all k postures together
    time_limit: float  # seconds

    @property
    def k(self) -> int:
        """Postures to choose."""
        return self.problem.k

    @property
    def fixed(self) -> int:
        """Postures of the pool that every search holds fixed, the first ones.

        One is always left to choose: where all k are required the pool is just those.
        """
        return min(len(self.problem.required), self.k - 1)

    @functools.cached_property
    def exact(self) -> ExactResult:
        """The D-optimum, or the best found within the time limit with a bound."""
        return solve_exact(self.problem, deadline=time.perf_counter() + self.time_limit)

    @property
    def optimum(self) -> Indices:
        """(k,) the D-optimal subset, into the pool."""
        return self.positions(self.exact.subsets[0])

    def positions(self, indices: Indices) -> Indices:
        """Candidates as positions in the pool."""
        place = np.argsort(self.pool)
        return place[np.searchsorted(self.pool, indices, sorter=place)]

    def wanted(self, least: float, above: float | None) -> float:
        """log det(X_s.T X_s) of an efficiency ``least``, and of log det S > ``above``.

        A bound that is not the optimum asks too much of a subset, never too little.
        """
        m, scale = self.problem.num_outputs, self.problem.log_scale
        # The optimum itself must meet its own value.
        value = (
            self.exact.bound / m - scale + self.rows.shape[1] * np.log(least) - 1e-12
        )
        return float(
            value if above is None else max(value, above / m - scale + SAME_TIME)
        )

    def tour(self, chosen: Indices) -> tuple[Indices, float]:
        """``chosen`` (k,) in the best order found, and its seconds of travel."""
        from jaxcal.selection.fastest.tour_kernel import best_order

        order, seconds = best_order(
            self.times[np.ix_(chosen, chosen)], self.start[chosen]
        )
        return chosen[order], float(seconds)


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """A subset that one search returns."""

    chosen: Indices  # (k,) into the pool
    method: str
    proven: bool = False  # against the determinant asked for
    nodes: int = 0


# A search: from the log det(X_s.T X_s) wanted to the fastest subset found.
Solver = Callable[[float], Found | None]


def log_det_of_rows(rows: Array) -> float:
    """log det(X.T X) of whitened rows (k, p); -inf where singular."""
    sign, value = np.linalg.slogdet(rows.T @ rows)
    return float(value) if sign > 0 else -np.inf


def make_task(
    candidates: ArrayLike,
    k: int | None,
    motion: Motion,
    start: ArrayLike | None,
    available: ArrayLike | None,
    required: ArrayLike | None,
    num_outputs: int | None,
    time_limit: float,
) -> Task:
    """Check the arguments of ``select_fastest`` and find the D-optimum."""
    problem = make_problem(
        candidates, k, available=available, required=required, num_outputs=num_outputs
    )
    if not isinstance(motion, Motion):
        raise ValueError(f"motion must be a Motion, got {motion!r}")
    limit = seconds("time_limit", time_limit)
    free = np.setdiff1d(np.flatnonzero(problem.available), problem.required)
    leverage = (problem.rows[free] ** 2).sum(axis=1)
    pool = np.concatenate([problem.required, free[np.argsort(-leverage)]])
    if len(problem.required) == problem.k:
        pool = problem.required
    assert problem.candidates is not None
    points = problem.candidates[pool]
    begin = np.zeros(len(pool))
    if start is not None:
        where = numbers("start", start)
        if where.shape != points.shape[1:]:
            raise ValueError(
                f"start must have shape {points.shape[1:]}, got {where.shape}"
            )
        begin = travel_times(where[None], points, motion)[0]
    times = travel_times(points, points, motion)
    return Task(
        problem=problem,
        pool=pool,
        rows=np.ascontiguousarray(problem.rows[pool]),
        times=times,
        start=begin,
        settle=float(motion.settle) * problem.k,
        time_limit=limit,
    )
