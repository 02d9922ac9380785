"""What every search for a fast run reads: blocks, times between postures, optimum."""

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
from jaxcal.selection.problem import Asked, Problem
from jaxcal.selection.solver import Found

__all__ = ["SAME_TIME", "Search", "Task", "make_task"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SAME_TIME = 1e-9  # seconds: two runs this close take as long

# From the whitened log det wanted to the fastest subset (into the pool) found.
Search = Callable[[float], Found | None]


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """One problem, cut down to the candidates that may be chosen: the pool."""

    problem: Problem
    pool: Indices  # (P,) candidates, the required first, then by falling leverage
    blocks: Array  # (P, q, p) whitened
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

    def information(self, chosen: Indices) -> Array:
        """(p, p) whitened information of postures of the pool, with the prior."""
        rows = self.blocks[chosen].reshape(-1, self.blocks.shape[2])
        return rows.T @ rows + self.problem.prior

    def log_det(self, chosen: Indices) -> float:
        """log det of it; -inf where singular."""
        sign, value = np.linalg.slogdet(self.information(chosen))
        return float(value) if sign > 0 else -np.inf

    def wanted(self, least: float, above: float | None) -> float:
        """``log_det`` of an efficiency ``least``, and of log det S > ``above``.

        A bound that is not the optimum asks too much of a subset, never too little.
        """
        m, scale = self.problem.multiplicity, self.problem.log_scale
        p = self.problem.num_regressors
        # The optimum itself must meet its own value.
        value = self.exact.bound / m - scale + p * np.log(least) - 1e-12
        more = -np.inf if above is None else above / m - scale + SAME_TIME
        return float(max(value, more))

    def tour(self, chosen: Indices) -> tuple[Indices, float]:
        """``chosen`` (k,) in the best order found, and its seconds of travel."""
        from jaxcal.selection.fastest.kernel import best_order

        order, seconds = best_order(
            self.times[np.ix_(chosen, chosen)], self.start[chosen]
        )
        return chosen[order], float(seconds)


def make_task(
    asked: Asked,
    k: int | None,
    motion: Motion,
    start: ArrayLike | None,
    time_limit: float,
) -> Task:
    """The task of visiting k of the candidates, by their D-efficiency."""
    problem, points = asked.problem(k, "D"), asked.candidates
    if points is None:
        raise ValueError(
            "commands must be given with blocks, Design.from_blocks(..., commands=), "
            "for travel between them"
        )
    if not isinstance(motion, Motion):
        raise ValueError(f"motion must be a Motion, got {motion!r}")
    pool = problem.required
    if len(pool) < problem.k:
        free = np.setdiff1d(np.flatnonzero(problem.available), pool)
        leverage = (problem.blocks[free] ** 2).sum(axis=(1, 2))
        pool = np.concatenate([pool, free[np.argsort(-leverage)]])
    points = points[pool]
    begin = np.zeros(len(pool))
    if start is not None:
        where = numbers("start", start)
        if where.shape != points.shape[1:]:
            raise ValueError(
                f"start must have shape {points.shape[1:]}, got {where.shape}"
            )
        begin = travel_times(where[None], points, motion)[0]
    return Task(
        problem=problem,
        pool=pool,
        blocks=np.ascontiguousarray(problem.blocks[pool]),
        times=travel_times(points, points, motion),
        start=begin,
        settle=float(motion.settle) * problem.k,
        time_limit=seconds("time_limit", time_limit),
    )
