"""The best design of one size by G or I: exchange on the criterion itself.

It starts from the D-optimal selection (exact where time allows), the greedy one, the
design of one measurement less plus its best addition, and random ones. It proves
nothing; ``bound`` says what no design beats.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.greedy import greedy_indices
from jaxcal.selection.problem import Problem

__all__ = ["CRITERIA", "Design", "best_design", "criterion_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Over the variances of the region, for unit noise.
CRITERIA: dict[str, Callable[..., Any]] = {"G": np.max, "I": np.mean}

_RANDOM_STARTS = 4
_D_RESTARTS = 50  # of the exchange that looks for the D-optimal selection


@dataclasses.dataclass(frozen=True)
class Design:
    """The best design of one K that was found."""

    indices: Indices  # (k,) sorted
    variance: float  # the criterion for unit noise
    d_optimal: float  # the criterion of the D-optimal selection
    method: str  # "exact": a D-optimal selection of exact; else "exchange"
    proven: bool  # the design is a proven D-optimum


def criterion_of(rows: Array, indices: Indices, points: Array, criterion: str) -> float:
    """The criterion of a design for unit noise; inf where it is singular.

    Args:
        rows: (M, p) whitened regressors of the candidates.
        indices: (k,) into rows.
        points: (R, p) whitened regressors of the region.
        criterion: "G" or "I".
    """
    singular, right = np.linalg.svd(rows[indices])[1:]
    if len(singular) < rows.shape[1] or singular[-1] <= 1e-7 * singular[0]:
        return np.inf
    return float(CRITERIA[criterion](((points @ (right.T / singular)) ** 2).sum(1)))


def best_design(
    problem: Problem,
    points: Array,
    criterion: str,
    design: str,
    time_limit: float,
    previous: Indices | None,
    seed: int,
) -> Design:
    """The best design of ``problem.k`` found.

    Args:
        problem: candidates, limits and k.
        points: (R, p) whitened regressors of the region.
        criterion: "G" or "I".
        design: of the D-optimal selection: "exact" or "exchange".
        time_limit: seconds of exact.
        previous: (k - 1,) the design of one measurement less.
        seed: of exchange and of the random starts.
    """
    proven = False
    if design == "exact":
        found = solve_exact(problem, deadline=time.perf_counter() + time_limit)
        optimal, proven = found.subsets[0], found.proven
    else:
        optimal = exchange_indices(problem, _D_RESTARTS, seed)
    starts = [optimal, greedy_indices(problem)]
    if previous is not None:
        starts.append(_with_best_addition(problem, previous, points, criterion))
    rng = np.random.default_rng([seed, problem.k])
    room = np.repeat(np.arange(len(problem.rows)), problem.upper - problem.lower)
    for _ in range(_RANDOM_STARTS):
        some = rng.permutation(room)[: problem.k - len(problem.required)]
        starts.append(np.concatenate([problem.required, some]))
    base = criterion_of(problem.rows, optimal, points, criterion)
    best, value = optimal, base
    for start in starts:
        indices, reached = _exchange(problem, start, points, criterion)
        if reached < value * (1.0 - 1e-12):
            best, value = indices, reached
    best = np.sort(best)
    same = np.array_equal(best, np.sort(optimal))
    method = "exact" if same and design == "exact" else "exchange"
    return Design(best, value, base, method, same and proven)


def _exchange(
    problem: Problem, start: Indices, points: Array, criterion: str
) -> tuple[Indices, float]:
    """Swap one posture at a time, the best swap first, until none lowers the criterion.

    The required candidates stay, one measurement of each. A singular start stays too.
    """
    rows = problem.rows
    chosen = np.array(start)
    value = criterion_of(rows, chosen, points, criterion)
    while np.isfinite(value):
        fixed = [int(np.flatnonzero(chosen == i)[0]) for i in problem.required]
        free = np.setdiff1d(np.arange(len(chosen)), fixed)
        free = free[np.unique(chosen[free], return_index=True)[1]]
        more = _room(problem, chosen)
        if not len(free) or not len(more):
            break
        values = _after_swaps(
            rows[chosen], rows[chosen[free]], rows[more], points, criterion
        )
        i, j = divmod(int(values.argmin()), len(more))
        tried = chosen.copy()
        tried[free[i]] = more[j]
        reached = criterion_of(rows, tried, points, criterion)
        if not reached < value * (1.0 - 1e-9):
            break
        chosen, value = tried, reached
    return chosen, value


def _after_swaps(
    design: Array, out: Array, new: Array, points: Array, criterion: str
) -> Array:
    """(free, more) criterion after each swap, by the Woodbury identity.

    Taking x_i out and x_j in changes the variance v at z by ``-((1 - d_i) a_j^2 +
    2 d_ij a_i a_j - (1 + d_j) a_i^2) / D`` with a = z.T M^-1 x, d likewise between the
    two, and ``D = (1 - d_i)(1 + d_j) + d_ij^2`` the factor of the determinant.

    Args:
        design: (k, p) rows measured.
        out: (free, p) those of them that may be swapped.
        new: (more, p) rows that may come in.
        points: (R, p) the region.
        criterion: "G" or "I".
    """
    inverse = np.linalg.inv(design.T @ design)
    v = _variances(points, inverse)
    a_out, a_new = points @ inverse @ out.T, points @ inverse @ new.T
    d_out, d_new, d_both = (
        _variances(out, inverse),
        _variances(new, inverse),
        out @ inverse @ new.T,
    )
    values = np.full(d_both.shape, np.inf)
    for i in range(len(out)):
        factor = (1.0 - d_out[i]) * (1.0 + d_new) + d_both[i] ** 2
        sound = factor > 1e-9
        a_i, a_j = a_out[:, i : i + 1], a_new[:, sound]
        less = (
            (1.0 - d_out[i]) * a_j**2
            + 2.0 * d_both[i, sound] * a_i * a_j
            - (1.0 + d_new[sound]) * a_i**2
        )
        values[i, sound] = CRITERIA[criterion](
            v[:, None] - less / factor[sound], axis=0
        )
    return values


def _with_best_addition(
    problem: Problem, previous: Indices, points: Array, criterion: str
) -> Indices:
    """One more measurement: ``v - a_j^2 / (1 + d_j)`` is the variance after j."""
    design, more = problem.rows[previous], _room(problem, previous)
    new, inverse = problem.rows[more], np.linalg.inv(design.T @ design)
    less = (points @ inverse @ new.T) ** 2 / (1.0 + _variances(new, inverse))
    value = CRITERIA[criterion](_variances(points, inverse)[:, None] - less, axis=0)
    return np.append(previous, more[int(value.argmin())])


def _variances(rows: Array, inverse: NDArray[np.floating]) -> Array:
    """(N,) ``x.T M^-1 x`` of rows (N, p)."""
    return np.asarray(np.einsum("ip,pq,iq->i", rows, inverse, rows))


def _room(problem: Problem, indices: Indices) -> Indices:
    """Candidates that may be chosen once more."""
    counts = np.bincount(indices, minlength=len(problem.rows))
    return np.flatnonzero(counts < problem.upper)
