"""Travel: how long moves take, the order of least time, and which postures to visit so
that a run takes little time, by a heuristic.

A move is a trapezoid profile on every axis (accelerate, cruise, brake), all axes start
together and the slowest sets the time, which is a metric. Local search from the
D-optimum and local optima of the exchange swaps one posture at a time where that keeps
the determinant and shortens the tour; random swaps then lead away from a local optimum.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, Indices, array_of, numbers, seconds, share
from jaxcal.deadline import Deadline
from jaxcal.designs.tour_kernel import best_order
from jaxcal.selection.design import Design
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.problem import CandidateSet, problem_of
from jaxcal.selection.solvers import checked_seed
from jaxcal.tables import require_unnamed

_SAME_TIME = 1e-9  # seconds: two runs this close take as long
_STARTS = 12  # the D-optimum and local optima of the exchange
_KICKS = 20  # random changes of the best run found, from which to search again
_KICK_TRIES = 50  # swaps drawn until one keeps the determinant
_MOST_POINTS = 200  # of a front, which is then not proven
_RIDGE = 1e-8  # of the whitened information of fewer postures than identify
_TRIED = 8  # most promising swaps that are put in their best order


@dataclasses.dataclass(frozen=True)
class Motion:
    """How the device moves; in the unit of the candidates and seconds."""

    speed: tuple[float, ...]  # (n,) or one for all axes, unit/s
    acceleration: tuple[float, ...]  # likewise, unit/s^2; also the deceleration
    settle: float = 0.0  # s at every posture, before and while measuring

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration"):
            require_unnamed(name, getattr(self, name))
            values = numbers(name, getattr(self, name))
            if values.ndim > 1 or not values.size or (values <= 0.0).any():
                raise ValueError(
                    f"{name} must be positive: one number, or one per axis, got "
                    f"{getattr(self, name)!r}"
                )
            object.__setattr__(self, name, tuple(np.atleast_1d(values).tolist()))
        settle = numbers("settle", self.settle)
        if settle.ndim or settle < 0.0:
            raise ValueError(f"settle must be at least 0 seconds, got {self.settle!r}")


def travel_times(points: ArrayLike, others: ArrayLike, motion: Motion) -> Array:
    """(A, B) seconds from each of postures (A, n) to others (B, n), not settling.

    An axis that moves d at speed v and acceleration a takes ``d / v + v / a``, or ``2
    sqrt(d / a)`` where it never reaches v (d < v^2 / a); the slowest axis counts.
    """
    a, b = numbers("points", points), numbers("others", others)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ValueError(
            f"points and others must be (A, n) and (B, n), got {a.shape} and {b.shape}"
        )
    speed, ramp = np.array(motion.speed), np.array(motion.acceleration)
    for name, limit in (("speed", speed), ("acceleration", ramp)):
        if len(limit) not in (1, n := a.shape[1]):
            raise ValueError(f"motion.{name} must hold 1 or {n}, got {len(limit)}")
    way = np.abs(a[:, None] - b[None])
    cruise = way >= speed**2 / ramp
    seconds = np.where(cruise, way / speed + speed / ramp, 2.0 * np.sqrt(way / ramp))
    return seconds.max(axis=2)


def fastest_tour(
    times: ArrayLike, start: ArrayLike | None = None
) -> tuple[Indices, float]:
    """(K,) order of least time through all postures, ending anywhere, and its seconds.

    Optimal up to 12 postures (Held and Karp 1962); beyond, the shortest
    nearest-neighbour tours are improved by 2-opt and moves of single postures.

    Args:
        times: (K, K) seconds from each posture to each, symmetric.
        start: (K,) seconds to each from where the device stands; any when not given.
    """
    between = np.ascontiguousarray(numbers("times", times))
    k = len(between) if between.ndim else 0
    if between.shape != (k, k) or not k:
        raise ValueError(f"times must have shape (K, K), got {between.shape}")
    uneven = np.abs(between - between.T)
    if uneven.max() > 1e-9 * max(float(np.abs(between).max()), 1.0):
        i, j = np.unravel_index(uneven.argmax(), uneven.shape)
        raise ValueError(
            "times must be symmetric, got "
            f"{between[i, j]:g} from {i} to {j} and {between[j, i]:g} back"
        )
    begin = np.zeros(k) if start is None else array_of("start", start, k)
    order, seconds = best_order(between, begin)
    return order, float(seconds)


@dataclasses.dataclass(frozen=True, eq=False)
class FastSelection:
    """The postures in the order to visit, and what the run takes."""

    indices: Indices  # (k,) in the order to visit
    seconds: float  # of travel and settling
    travel_seconds: float
    log_det: float  # natural log det S, in the candidates' unit
    efficiency: float  # D-efficiency against ``bound``
    least_efficiency: float  # that was asked for
    bound: float  # log det S of the D-optimum, an upper bound on it where not proven
    bound_proven: bool  # ``bound`` is the optimum
    search_seconds: float  # that finding it took
    method: str = "heuristic"
    proven: bool = False  # another subset with that efficiency may take less time


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Runs none of which is both faster and more efficient than another."""

    points: tuple[FastSelection, ...]  # ascending in time and in efficiency
    least_efficiency: float  # where the front was cut off
    method: str = "heuristic"
    proven: bool = False  # points may be missing, and others be faster


def fastest(
    design: Design,
    k: int | None,
    motion: Motion,
    *,
    least_efficiency: float = 0.95,
    start: ArrayLike | None = None,
    time_limit: float = 60.0,
    seed: int | np.random.Generator = 0,
) -> FastSelection:
    """The fastest subset and order found with a D-efficiency, by local search.

    Args:
        design: what may be measured; ``design.fastest(k, motion)`` asks the same.
        k: postures to choose, distinct; the fewest that identify when None.
        motion: speeds and accelerations in the candidates' unit, settle time.
        least_efficiency: in (0, 1], against the proven D-optimum.
        start: (n,) where the device stands; it begins at any posture by default.
        time_limit: seconds of the search for the D-optimum.
        seed: of the starts and of the random swaps.

    Raises:
        ValueError: also of scenarios and replicates, which have no such run.
    """
    least = share("least_efficiency", least_efficiency)
    search = _TourSearch(design, k, motion, start, time_limit, seed)
    answer = search.answer(least, None)
    if answer is None:
        raise ValueError(
            f"least_efficiency = {least:g} cannot be reached: the optimum is only "
            "bounded within the time limit. Give more time, or ask for less"
        )
    return answer


def pareto(
    design: Design,
    k: int | None,
    motion: Motion,
    *,
    least_efficiency: float = 0.7,
    **options: Any,
) -> ParetoFront:
    """Time against D-efficiency, from ``least_efficiency`` up to the D-optimum: each
    point is the fastest run found that is more efficient than the one before it.

    ``k``, ``motion`` and the options start, seed and time_limit are as in ``fastest``.
    """
    least = share("least_efficiency", least_efficiency)
    search = _TourSearch(design, k, motion, **options)
    points, front = list[FastSelection](), list[FastSelection]()
    point = search.answer(least, None)
    while point is not None and len(points) < _MOST_POINTS:
        points.append(point)
        point = search.answer(least, point.log_det)
    for point in sorted(points, key=lambda point: -point.log_det):
        if not front or point.seconds < front[-1].seconds - _SAME_TIME:
            front.append(point)
    return ParetoFront(tuple(front[::-1]), least)


def _require_travel(offer: CandidateSet, motion: Motion) -> Array:
    """(M, n) commands between which the device travels; refuses what has no run."""
    if offer.scenarios is not None:
        raise ValueError("scenarios must be left out with fastest and pareto")
    if np.any(offer.max_replicates != 1) or offer.constraints is not None:
        raise ValueError(
            "max_replicates must be 1 with fastest and pareto, which visit a posture "
            f"once and allow no constraints, got {offer.max_replicates}"
        )
    if offer.candidates is None:
        raise ValueError(
            "blocks need the commands for the travel between them: "
            "Design(blocks=..., commands=...)"
        )
    if not isinstance(motion, Motion):
        raise ValueError(f"motion must be a Motion, got {motion!r}")
    return offer.candidates


class _TourSearch:
    """One problem, cut down to the candidates that may be chosen: the pool."""

    def __init__(
        self,
        offer: CandidateSet,
        k: int | None,
        motion: Motion,
        start: ArrayLike | None = None,
        time_limit: float = 60.0,
        seed: int | np.random.Generator = 0,
    ) -> None:
        points = _require_travel(offer, motion)
        self.problem = problem = problem_of(offer, k, "D")
        self.k, self.seed = problem.k, checked_seed(seed)
        self.fixed = len(problem.required)  # the first of the pool
        free = np.setdiff1d(np.flatnonzero(problem.available), problem.required)
        self.pool = np.concatenate([problem.required, free])
        points = points[self.pool]
        self.blocks = np.ascontiguousarray(problem.blocks[self.pool])
        self.times = travel_times(points, points, motion)
        self.start = np.zeros(len(points))
        if start is not None:
            start = offer.by_name("start", start)
            where = array_of("start", start, *points.shape[1:])
            self.start = travel_times(where[None], points, motion)[0]
        self.settle = float(motion.settle) * self.k
        deadline = Deadline(seconds("time_limit", time_limit))
        self.optimum = solve_exact(problem, deadline=deadline)

    def answer(self, least: float, above: float | None) -> FastSelection | None:
        """The fastest run of an efficiency, and log det S over ``above``, if found."""
        begun, problem, optimum = time.perf_counter(), self.problem, self.optimum
        m, scale = problem.multiplicity, problem.white.log_scale
        # Whitened. The optimum itself must meet its own value; a bound that is not the
        # optimum asks too much of a subset, never too little.
        assert optimum.bound is not None
        wanted = optimum.bound / m - scale + problem.num_regressors * np.log(least)
        wanted -= 1e-12
        if above is not None:
            wanted = max(wanted, above / m - scale + _SAME_TIME)
        rng = np.random.default_rng(self.seed)
        chosen, travel = self._local(wanted, rng)
        if chosen is None:
            return None
        for _ in range(_KICKS):
            other, after = self._shortened(self._kicked(chosen, wanted, rng), wanted)
            if after < travel - _SAME_TIME:
                chosen, travel = other, after
        tour, travel = self._tour(chosen)
        log_det = problem.log_det(self.pool[tour])
        bound = max(optimum.bound, log_det)
        share = problem.criterion.efficiency(log_det, bound)
        return FastSelection(
            self.pool[tour], travel + self.settle, travel, log_det, share, least,
            bound, optimum.proven, time.perf_counter() - begun,
        )  # fmt: skip

    def _local(
        self, wanted: float, rng: np.random.Generator
    ) -> tuple[Indices | None, float]:
        """The fastest subset (k,) from near-optimal ones, if any, and its travel."""
        starts = [self.optimum.indices] + [
            exchange_indices(self.problem, 1, int(rng.integers(2**31)))
            for _ in range(_STARTS - 1)
        ]
        best, least = None, np.inf
        place = np.argsort(self.pool)  # of the candidates, in the pool
        for indices in starts:
            start = place[np.searchsorted(self.pool, indices, sorter=place)]
            if self._log_det(start) >= wanted:
                chosen, travel = self._shortened(start, wanted)
                if travel < least - _SAME_TIME:
                    best, least = chosen, travel
        return best, least

    def _kicked(
        self, chosen: Indices, wanted: float, rng: np.random.Generator
    ) -> Indices:
        """Up to two random swaps that keep the determinant, off a local optimum."""
        for _ in range(2):
            free = np.flatnonzero(chosen >= self.fixed)
            others = np.setdiff1d(np.arange(len(self.blocks)), chosen)
            for _ in range(_KICK_TRIES if len(free) and len(others) else 0):
                tried = chosen.copy()
                tried[rng.choice(free)] = rng.choice(others)
                if self._log_det(tried) >= wanted:
                    chosen = tried
                    break
        return chosen

    def _shortened(self, start: Indices, wanted: float) -> tuple[Indices, float]:
        """Swap until none of the most promising swaps shortens the tour."""
        tour, travel = self._tour(start)
        for _ in range(10 * self.k):
            swaps = [
                swap
                for i in np.flatnonzero(tour >= self.fixed)
                for swap in self._refills(np.delete(tour, i), wanted)
            ]
            for _, tried in sorted(swaps, key=lambda swap: swap[0])[:_TRIED]:
                if self._log_det(tried) >= wanted:
                    shorter, reached = self._tour(tried)
                    if reached < travel - _SAME_TIME:
                        tour, travel = shorter, reached
                        break
            else:
                break
        return tour, travel

    def _refills(self, kept: Indices, wanted: float) -> list[tuple[float, Indices]]:
        """Ways to complete a tour (k - 1,), the new posture where it adds least: (k,)
        subsets and their seconds, ascending; ``wanted`` is met to 1e-6."""
        times, begin = self.times, self.start
        others = np.setdiff1d(np.arange(len(self.blocks)), kept)
        legs = np.concatenate([begin[kept[:1]], times[kept[:-1], kept[1:]], [0.0]])
        to_others = times[np.ix_(kept, others)]
        _, q, p = self.blocks.shape
        lower = np.linalg.cholesky(self._information(kept) + _RIDGE * np.eye(p))
        rows = self.blocks[others].reshape(-1, p)
        y = np.linalg.solve(lower, rows.T).T.reshape(-1, q, p)
        factor = np.linalg.det(np.eye(q) + y @ np.matrix_transpose(y))  # of det
        into = np.vstack([begin[others], to_others])
        onward = np.vstack([to_others, np.zeros(len(others))])
        travel = (into + onward - legs[:, None]).min(axis=0)
        value = np.log(np.maximum(factor, 1e-300)) + 2.0 * np.log(np.diag(lower)).sum()
        travel = np.where(value >= wanted - 1e-6, travel + legs.sum(), np.inf)
        best = np.argsort(travel, kind="stable")[: _TRIED + 1]
        return [
            (float(travel[i]), np.append(kept, others[i]))
            for i in best[np.isfinite(travel[best])]
        ]

    def _information(self, chosen: Indices) -> Array:
        """(p, p) whitened information of postures of the pool, with the prior."""
        rows = self.blocks[chosen].reshape(-1, self.blocks.shape[2])
        return rows.T @ rows + self.problem.prior

    def _log_det(self, chosen: Indices) -> float:
        """log det of it; -inf where singular."""
        sign, value = np.linalg.slogdet(self._information(chosen))
        return float(value) if sign > 0 else -np.inf

    def _tour(self, chosen: Indices) -> tuple[Indices, float]:
        """``chosen`` (k,) in the best order found, and its seconds of travel."""
        between = self.times[np.ix_(chosen, chosen)]
        order, travel = best_order(between, self.start[chosen])
        return chosen[order], float(travel)
