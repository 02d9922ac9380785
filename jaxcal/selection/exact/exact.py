"""The proven optimum, by whichever proof is cheaper.

k = n + 1: the absolute determinant is convex in each posture, so only vertices of the
convex hull matter, and :mod:`jaxcal.selection.exact.volume` finds the largest volume.
Everything else (more postures, many runners-up) goes to branch and bound, started from
the exchange. The runner-up need not lie on the hull, so ``best`` > 1 does without it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.regression import log_det_information
from jaxcal.information.relaxation import relaxed_bound
from jaxcal.selection.exact.branch_and_bound import branch_and_bound
from jaxcal.selection.exact.volume import enumeration_cost, largest_volumes
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.greedy import greedy_indices
from jaxcal.selection.problem import Problem

__all__ = ["STARTING_RESTARTS", "ExactResult", "solve_exact", "upper_bound"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STARTING_RESTARTS = (
    30  # of the exchange: enough to start from, the search does the rest
)

_CHEAP = 3e7  # multiplications of an enumeration: about 20 ms
_LARGEST_HULL_DIMENSION = 4  # qhull's facets grow as M^(n // 2)


@dataclasses.dataclass(frozen=True)
class ExactResult:
    """The best selections and the proof."""

    subsets: Indices  # (found, k), each sorted, best first; none of them singular
    log_dets: Array  # (found,) natural log det S
    bound: float  # upper bound on log det S of every selection, log_dets[0] if proven
    nodes: int  # branch-and-bound nodes, or subsets enumerated
    proven: bool


def solve_exact(
    problem: Problem,
    best: int = 1,
    deadline: float | None = None,
    restarts: int = STARTING_RESTARTS,
    seed: int = 0,
) -> ExactResult:
    """The ``best`` selections, or the best found by ``deadline`` and an honest bound.

    Args:
        problem: what to choose from.
        best: how many selections to prove.
        deadline: ``time.perf_counter()`` at which to stop.
        restarts, seed: of the exchange that starts branch and bound.
    """
    if problem.k == problem.num_regressors:
        pool = _pool(problem, hull=best == 1)
        free = problem.k - len(problem.required)
        if best == 1 or enumeration_cost(len(pool), free) <= _CHEAP:
            return _enumerate(problem, pool, best, deadline)
    start = exchange_indices(problem, restarts, seed)
    groups = _groups(problem, merge=best == 1)
    first = np.array([members[0] for members in groups])
    result = branch_and_bound(
        problem.rows[first],
        _sums(problem.lower, groups),
        np.minimum(_sums(problem.upper, groups), problem.k),
        _sums(np.bincount(start, minlength=len(problem.rows)), groups),
        best,
        deadline,
    )
    subsets = [_expand(problem, groups, counts) for counts in result.counts]
    bound = None if result.proven else result.bound
    return _result(problem, subsets, best, bound, result.nodes)


def upper_bound(problem: Problem) -> float:
    """Upper bound on log det S without numba: the optimum where that is cheap."""
    p = problem.num_regressors
    if problem.k == p:
        pool = _pool(problem, hull=True)
        free = problem.k - len(problem.required)
        if enumeration_cost(len(pool), free) <= _CHEAP:
            return _enumerate(problem, pool, 1, None).bound
    keep = np.flatnonzero(problem.available)
    start = np.searchsorted(keep, greedy_indices(problem))
    relaxed = relaxed_bound(
        problem.rows[keep], problem.lower[keep], problem.upper[keep], start
    )
    return problem.num_outputs * (relaxed + problem.log_scale)


def _pool(problem: Problem, hull: bool) -> Indices:
    """Candidates that may join the required ones in an optimum with k = n + 1."""
    usable = problem.available.copy()
    usable[problem.required] = False
    pool = np.flatnonzero(usable)
    n = problem.num_regressors - 1
    if not hull or n > _LARGEST_HULL_DIMENSION or len(pool) <= n + 2:
        return pool
    if n == 1:
        height = problem.rows[pool, 0]
        return pool[np.unique([height.argmin(), height.argmax()])]
    from scipy.spatial import ConvexHull, QhullError

    try:
        return pool[ConvexHull(problem.rows[pool, :n]).vertices]
    except QhullError:  # flat without the required ones: every candidate stays in
        return pool


def _enumerate(
    problem: Problem, pool: Indices, best: int, deadline: float | None
) -> ExactResult:
    """Largest volumes beside the required rows, in the space these leave free."""
    required = problem.rows[problem.required]
    vectors = problem.rows[pool]
    if len(required):
        # The rows outside the span of the required ones keep all the volume there is.
        basis = np.linalg.qr(required.T, mode="complete")[0][:, len(required) :]
        vectors = vectors @ basis
    found = largest_volumes(vectors, best, deadline)
    subsets = [
        np.sort(np.concatenate([problem.required, pool[s]])) for s in found.subsets
    ]
    if found.complete:
        return _result(problem, subsets, best, None, found.examined)
    # Out of time: whatever greedy has, if that is better, and the sharper bound.
    greedy = np.sort(greedy_indices(problem))
    keep = np.flatnonzero(problem.available)
    relaxed = relaxed_bound(
        problem.rows[keep],
        problem.lower[keep],
        problem.upper[keep],
        np.searchsorted(keep, greedy),
    )
    # log det(X_s.T X_s) is twice the log of the volume, beside that of ``required``.
    fixed = np.linalg.slogdet(required @ required.T)[1] if len(required) else 0.0
    bound = min(relaxed, fixed + 2.0 * float(np.log(found.bound)))
    return _result(problem, [*subsets, greedy], best, bound, found.examined)


def _result(
    problem: Problem,
    subsets: list[Indices],
    best: int,
    relaxed: float | None,
    nodes: int,
) -> ExactResult:
    """Values in the caller's unit, singular subsets left out, best first.

    ``relaxed`` is an upper bound on log det(X_s.T X_s), None where the first is proven.
    """
    chosen = np.stack(subsets)
    values = np.atleast_1d(
        log_det_information(problem.candidates[chosen], problem.num_outputs)
    )
    order = np.argsort(-values, kind="stable")[:best]
    order = order[np.isfinite(values[order])]
    if not order.size:
        raise ValueError(
            "candidates must allow an invertible selection, but the best of them, "
            f"{chosen[0].tolist()}, lies in one plane"
        )
    top = float(values[order[0]])
    bound = top
    if relaxed is not None:
        bound = max(top, problem.num_outputs * (relaxed + problem.log_scale))
    return ExactResult(chosen[order], values[order], bound, nodes, relaxed is None)


def _groups(problem: Problem, merge: bool) -> list[Indices]:
    """Available candidates, equal ones together where ``merge``: fewer branches."""
    keep = np.flatnonzero(problem.available)
    if merge:
        _, label = np.unique(problem.candidates[keep], axis=0, return_inverse=True)
        order = np.argsort(label, kind="stable")
        ends = np.flatnonzero(np.diff(label[order])) + 1
        if len(ends) + 1 < len(keep):
            return np.split(keep[order], ends)
    return list(keep[:, None])


def _sums(values: Indices, groups: list[Indices]) -> Indices:
    if all(len(members) == 1 for members in groups):
        return values[[members[0] for members in groups]]
    return np.array([values[members].sum() for members in groups])


def _expand(problem: Problem, groups: list[Indices], counts: Indices) -> Indices:
    """(k,) sorted candidates of group counts, the required ones of a group first."""
    lower, upper = problem.lower, problem.upper
    chosen: list[int] = []
    for group in np.flatnonzero(counts):
        left = int(counts[group])
        members = groups[group]
        take = lower[members].copy()
        left -= int(take.sum())
        for position, member in enumerate(members):
            more = min(left, int(upper[member] - take[position]))
            take[position] += more
            left -= more
        chosen.extend(np.repeat(members, take))
    return np.sort(np.asarray(chosen, dtype=np.int64))
