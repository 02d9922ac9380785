"""The proven optimum, by whichever proof is cheaper.

k = n + 1 affine postures: the absolute determinant is convex in each posture, so only
vertices of the convex hull matter, and ``largest_volume`` finds the best. Everything
else goes to branch and bound, started from the exchange.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from jaxcal import compiled
from jaxcal.checks import Array, Indices
from jaxcal.deadline import NEVER, Deadline
from jaxcal.selection.exact.branch_and_bound import (
    BranchResult,
    JointScenarios,
    Scenario,
    branch_and_bound,
)
from jaxcal.selection.exact.complement import complement
from jaxcal.selection.exact.volume_kernel import descend
from jaxcal.selection.exchange.exchange import (
    default_restarts,
    exchange_indices,
    greedy_indices,
    rules_of,
)
from jaxcal.selection.problem import Problem, Solution

STARTING_RESTARTS = 30  # of the exchange: the search does the rest
_SEARCHED = 0.85  # of the time, before the exchange goes on where nothing is proven
TIME_LIMIT = 10.0  # seconds of one search where none is given
_BLOCKS_LIMIT = 2.0  # of auto: what is not proven by then often takes minutes

_ROUGH = 1e-3  # share of a derivative, by which one that is a difference may be off
TOLERATED = 1e-9  # share by which rounding may change what is called proven

_CHEAP = 5_000_000  # subsets: the largest volume is found within milliseconds
_LARGEST_HULL_DIMENSION = 4  # qhull's facets grow as M^(n // 2)
_PREPARED = 100_000_000  # subsets from which a known volume is worth its time
_STEPS = 5  # towards the D-optimal weights
_STARTS = 4  # random ones of climbs to a known volume, beside a greedy one, which
_SHARE = 0.2  # counts this share of mean vectors for those not chosen yet


def solve(
    problem: Problem,
    *,
    seed: int,
    restarts: int | None,
    time_limit: float | None,
    best: int,
) -> Solution:
    """The solver "exact"; 10 s where no time limit is given."""
    deadline = Deadline(time_limit or TIME_LIMIT)
    restarts = restarts or _starts(problem)
    solution = solve_exact(problem, best, deadline, restarts, seed)
    return dataclasses.replace(solution, seed=seed, restarts=restarts)


def solve_auto(
    problem: Problem,
    *,
    seed: int,
    restarts: int | None,
    time_limit: float | None,
    least_efficiency: float,
) -> Solution:
    """The solver "auto": the search ends once its bound proves ``least_efficiency``.

    ``method`` is "exact" where it ran to its end or its time limit, else "exchange".
    """
    limit = time_limit or (TIME_LIMIT if problem.rank_one else _BLOCKS_LIMIT)
    deadline = Deadline(limit)
    restarts = restarts or _starts(problem)
    solution = solve_exact(problem, 1, deadline, restarts, seed, least_efficiency)
    started: dict[str, Any] = {"seed": seed, "restarts": restarts}
    if solution.reason:  # rounding
        return dataclasses.replace(solution, method="exact", **started)
    share = _share(problem, solution)
    method, reason = "exact", "the exact search proved this optimum"
    if not solution.proven:
        name = problem.criterion.efficiency_name
        article = "an" if name[0] in "AEIe" else "a"
        at_least = f"{article} {name} of at least {share:.6f}"
        reason = f"the exact search stopped after {limit:g} s with {at_least} proven; "
        if share >= least_efficiency:
            method, reason = "exchange", f"the bound proves {at_least}, and "
        reason += f"{least_efficiency:g} was asked for"
    return dataclasses.replace(solution, method=method, reason=reason, **started)


def _share(problem: Problem, solution: Solution) -> float:
    """The efficiency that the bound of a solution leaves."""
    assert solution.value is not None and solution.bound is not None
    return float(problem.criterion.efficiency(solution.value, solution.bound))


def _starts(problem: Problem) -> int:
    """Restarts of the exchange; E of several scenarios is as slow as its proof."""
    if problem.joint is not None and problem.criterion.kind == "least":
        return default_restarts(problem)
    return STARTING_RESTARTS


def solve_exact(
    problem: Problem,
    best: int = 1,
    deadline: Deadline = NEVER,
    restarts: int = STARTING_RESTARTS,
    seed: int = 0,
    enough: float | None = None,
) -> Solution:
    """The ``best`` selections, none singular, as ``alternatives``, or the best found by
    ``deadline`` and a true bound. ``enough`` is the efficiency in (0, 1] at which to
    stop, unless the proof is cheap."""
    if best == 1 and problem.simplex:
        pool, cheap = _pool(problem)
        if enough and not cheap:
            part = deadline.part(0.5)
            begun = np.sort(exchange_indices(problem, restarts, seed, part))
            least = relaxed(problem, begun, deadline)
            relaxation = _solution_of(problem, [begun], best, least, 1)
            if _share(problem, relaxation) >= enough:
                return relaxation
        return _enumerate(problem, pool, deadline)
    # Half of the time: a bound takes time as well.
    start = exchange_indices(problem, restarts, seed, deadline.part(0.5))
    keep, first = _groups(problem, merge=best == 1)
    counts = np.bincount(start, minlength=len(problem.blocks))
    rules = (problem.lower, problem.upper, counts)
    low, high, begun = (np.add.reduceat(numbers[keep], first) for numbers in rules)
    more = default_restarts(problem)
    time = deadline.part(_SEARCHED) if more > restarts else deadline
    searched = _branched(
        problem, keep[first], low, np.minimum(high, problem.k), begun,
        best=best, deadline=time, enough=enough,
    )  # fmt: skip
    subsets = [_expand(problem, keep, first, numbers) for numbers in searched.counts]
    if not searched.proven and more > restarts:  # no worse than the exchange alone
        other = np.sort(exchange_indices(problem, more, seed, deadline))
        if not any(np.array_equal(other, np.sort(one)) for one in subsets):
            subsets.append(other)
    bound = None if searched.proven else searched.bound
    return _solution_of(problem, subsets, best, bound, searched.nodes)


def upper_bound(problem: Problem) -> float:
    """The reported value that no selection betters, by the optimum if that is cheap."""
    if problem.simplex:
        pool, cheap = _pool(problem)
        if cheap:
            solution = _enumerate(problem, pool, NEVER)
            assert solution.bound is not None
            return solution.bound
    bound = relaxed(problem, greedy_indices(problem))
    return float(problem.criterion.reported(bound))


def relaxed(problem: Problem, start: Indices, deadline: Deadline = NEVER) -> float:
    """Upper bound on phi of the criterion, from a selection (k,) to climb from."""
    keep = np.flatnonzero(problem.available)
    counts = np.bincount(start, minlength=len(problem.blocks))
    rules = problem.lower[keep], problem.upper[keep], counts[keep]
    return _branched(problem, keep, *rules, deadline=deadline, root_only=True).bound


def _branched(
    problem: Problem, keep: Indices, *rules: Any, **options: Any
) -> BranchResult:
    """Branch and bound over the candidates ``keep``, in all scenarios."""
    members = [
        Scenario(member.blocks[keep], member.prior, member.criterion)
        for member in problem.members
    ]
    judged_by: Scenario | JointScenarios = members[0]
    if (joint := problem.joint) is not None:
        terms = joint.terms()
        judged_by = JointScenarios(members, joint.criterion, joint.weights, terms)
    elif problem.constraints is None:
        return _of_sharper(members[0], *rules, **options)
    if problem.constraints is not None:
        options["rules"] = problem.constraints.of(keep)
    return branch_and_bound(judged_by, *rules, **options)


def _of_sharper(
    scenario: Scenario, lower: Indices, upper: Indices, start: Indices, **options: Any
) -> BranchResult:
    """Search the choice, or what is left out where its bound is sharper at first."""
    bounds = lower, upper
    other = complement(*scenario, *bounds, int(start.sum()))
    if other is not None:
        apart = Scenario(other.blocks, other.prior, other.criterion)
        begun, ends = other.start(start), (0 * other.which, 0 * other.which + 1)
        here = branch_and_bound(scenario, *bounds, start, root_only=True).bound
        there = branch_and_bound(apart, *ends, begun, root_only=True).bound
        if there + other.shift < here:
            result = branch_and_bound(apart, *ends, begun, **options)
            return dataclasses.replace(
                result, counts=other.counts(result.counts),
                values=result.values + other.shift,
                bound=result.bound + other.shift + other.rounding,
            )  # fmt: skip
    return branch_and_bound(scenario, *bounds, start, **options)


def _pool(problem: Problem) -> tuple[Indices, bool]:
    """What may join the required ones in an optimum with k = p; are choices few?"""
    pool = _hull(problem)
    return pool, math.comb(len(pool), problem.k - len(problem.required)) <= _CHEAP


def _hull(problem: Problem) -> Indices:
    """Candidates that are not required; of many those on the convex hull."""
    usable = problem.available.copy()
    usable[problem.required] = False
    pool = np.flatnonzero(usable)
    n = problem.num_regressors - 1
    few = math.comb(len(pool), n + 1) <= _CHEAP  # faster than loading qhull
    if n > _LARGEST_HULL_DIMENSION or few:
        return pool
    # Whitened postures lie in a plane across the sum of all rows: reflected so that it
    # is the first axis, the other axes are coordinates in that plane.
    rows, mirror = problem.rows[pool], problem.rows.sum(axis=0)
    mirror[0] += np.copysign(np.sqrt(mirror @ mirror), mirror[0])
    mirror *= np.sqrt(2.0 / (mirror @ mirror))
    points = rows[:, 1:] - (rows @ mirror)[:, None] * mirror[1:]
    if n == 1:
        return pool[np.unique([points.argmin(), points.argmax()])]
    from scipy.spatial import ConvexHull, QhullError

    try:
        return pool[ConvexHull(points).vertices]
    except QhullError:  # flat without the required ones: every candidate stays in
        return pool


def _enumerate(problem: Problem, pool: Indices, deadline: Deadline) -> Solution:
    """The largest volume beside the required rows, in the space these leave free."""
    required = problem.rows[problem.required]
    vectors = problem.rows[pool]
    if len(required):
        # The rows outside the span of the required ones keep all the volume there is.
        basis = np.linalg.qr(required.T, mode="complete")[0][:, len(required) :]
        vectors = vectors @ basis
    volume = largest_volume(vectors, deadline)
    subset = np.sort(np.concatenate([problem.required, pool[volume.subset]]))
    if volume.complete:
        return _solution_of(problem, [subset], 1, None, volume.examined)
    # Out of time: whatever greedy has, if that is better, and the sharper bound.
    greedy = np.sort(greedy_indices(problem))
    # log det(X_s.T X_s) is twice the log of the volume, beside that of ``required``.
    fixed = np.linalg.slogdet(required @ required.T)[1] if len(required) else 0.0
    bound = min(relaxed(problem, greedy), fixed + 2.0 * float(np.log(volume.bound)))
    return _solution_of(problem, [subset, greedy], 1, bound, volume.examined)


@dataclasses.dataclass(frozen=True)
class Volume:
    """The largest volume found."""

    subset: Indices  # (q,) sorted
    size: float  # |det|
    examined: int  # nodes of the search
    complete: bool  # False when the deadline passed first
    bound: float  # no subset has a larger |det|; ``size`` where complete


def largest_volume(vectors: Array, deadline: Deadline = NEVER) -> Volume:
    """The q of (h, q) vectors with the largest |det|, to a share of 1e-10."""
    h, q = vectors.shape
    unit = float(np.abs(vectors).max(initial=0.0)) ** q
    if q == 0 or unit == 0.0:
        return Volume(np.arange(q), unit, 1, True, unit)
    vectors = vectors / np.abs(vectors).max()
    if q == 1:
        longest = np.abs(vectors[:, 0]).argmax(axis=0, keepdims=True)
        return Volume(longest, unit, h, True, unit)
    vectors, triangle = np.linalg.qr(vectors)
    unit *= float(np.prod(np.abs(np.diag(triangle))))
    subset, largest, kept = np.arange(q), np.zeros(1), np.arange(h)
    if math.comb(h, q) > _PREPARED:
        subset = _climbed(vectors)
        # Of equal vectors one is enough: two of them span no volume.
        kept = np.unique(np.round(vectors, 13), axis=0, return_index=True)[1]
        vectors, shrink = _evened(vectors, kept)
        unit *= shrink
        largest[0] = abs(np.linalg.det(vectors[subset]))
    lengths = np.linalg.norm(vectors[kept], axis=1)
    order = np.argsort(-lengths, kind="stable")
    kept, lengths = kept[order], lengths[order]  # the longest first
    points = np.empty((q - 1, len(kept), q))
    index, place = np.empty(points.shape[:2], dtype=np.int64), np.zeros(q - 1, np.int64)
    points[0], index[0] = vectors[kept], kept
    time = deadline.remaining_s
    complete, nodes = descend(points, index, place, subset, largest, time)
    size = bound = float(largest[0])
    if not complete:  # of the vectors that come first
        begun = max(0, int(place[0]) - 1)
        bound = max(bound, float(np.prod(lengths[begun : begun + q])))
    return Volume(np.sort(subset), unit * size, nodes, complete, unit * bound)


def _climbed(vectors: Array) -> Indices:
    """(q,) vectors of large volume by exchange: its square is their det S."""
    kernel = compiled.kernel("jaxcal.selection.exchange.exchange_kernel")
    q, none = vectors.shape[1], np.zeros(0, dtype=np.int64)
    blocks = np.ascontiguousarray(vectors[:, None])
    nothing, unit, once = np.zeros((q, q)), np.eye(q), np.ones(len(blocks), np.intp)
    climber = kernel.Climber(
        "det", blocks, nothing, unit, once, none, q, 0, *rules_of(None, len(blocks))
    )
    chosen, phi = climber.climb(none, _SHARE, 1, math.inf)
    return np.asarray(climber.random_climbs(_STARTS, chosen, phi, math.inf)[0])


def _evened(vectors: Array, kept: Indices) -> tuple[Array, float]:
    """The vectors in a metric where bounds, products of lengths, are sharp, and its
    unit: near that of the D-optimal weights, by a few of Titterington's steps."""
    q = vectors.shape[1]
    weights = np.full(len(kept), 1.0 / len(kept))
    for _ in range(_STEPS):
        rows = np.sqrt(weights)[:, None] * vectors[kept]
        triangle = np.linalg.qr(rows)[1]
        even = np.linalg.solve(triangle.T, vectors.T).T
        weights *= (even[kept] ** 2).sum(axis=1) / q
    return even, float(np.prod(np.abs(np.diag(triangle))))


def _solution_of(
    problem: Problem, subsets: list[Indices], best: int, phi: float | None, nodes: int
) -> Solution:
    """Values in the caller's unit, singular subsets left out, best first; ``phi``: an
    upper bound on it, None where the first is proven."""
    chosen, criterion = np.array(subsets), problem.criterion
    value, log_det = problem.values(chosen)
    order = np.argsort(-value if criterion.larger_is_better else value, kind="stable")
    order = order[:best]
    order = order[np.isfinite(log_det[order])]
    if not order.size:
        raise ValueError(
            f"{problem.subject} allow no invertible selection: the best, "
            f"{chosen[0].tolist()}, is singular"
        )
    subsets, worth = list(chosen[order]), value[order].tolist()
    log_dets = log_det[order].tolist()
    bound, proven, reason = _proof(problem, subsets[0], worth[0], phi)
    listed = tuple(zip(subsets, worth, log_dets, strict=True))
    return Solution(*listed[0], bound, proven, nodes, listed, reason=reason)


def _proof(
    problem: Problem, indices: Indices, value: float, phi: float | None
) -> tuple[float, bool, str]:
    """Bound of a reported value, given one on phi; is it proven, and if not why."""
    criterion, bound = problem.criterion, value
    if phi is not None:
        better = max if criterion.larger_is_better else min
        bound = better(bound, float(criterion.reported(phi)))
    unsure, reason = problem.uncertainty(indices), ""
    off = 0.0 if problem.model is None else problem.model.fitting.resolution
    if off > _ROUGH:
        unsure = min(2.0 * off, 1.0)
        reason = (
            f"not proven: the model's derivatives are differences, off by {off:.1g}"
        )
    elif unsure <= TOLERATED:
        return bound, phi is None, ""
    elif phi is None:
        reason = (
            "not proven in double precision: the search is complete, but rounding may "
            f"change the variances by {unsure:.1g} (relative)"
        )
    return criterion.bettered(bound, unsure), False, reason


def _groups(problem: Problem, merge: bool) -> tuple[Indices, Indices]:
    """Available candidates (N,), and where in them each of G groups begins (G,): equal
    ones are a group where ``merge``."""
    keep = np.flatnonzero(problem.available)
    if merge:
        raw = [member.raw[keep].reshape(len(keep), -1) for member in problem.members]
        if problem.constraints is not None:
            raw.append(problem.constraints.costs[:, keep].T)
        flat = np.concatenate(raw, axis=1) if len(raw) > 1 else raw[0]
        total = np.sort(flat.sum(axis=1))
        if (total[1:] == total[:-1]).any():  # otherwise no two are equal
            label = np.unique(flat, axis=0, return_inverse=True)[1]
            order = np.argsort(label, kind="stable")
            return keep[order], np.flatnonzero(np.diff(label[order], prepend=-1))
    return keep, np.arange(len(keep))


def _expand(
    problem: Problem, keep: Indices, first: Indices, counts: Indices
) -> Indices:
    """(k,) sorted candidates of group counts (G,), of a group the required first."""
    if len(first) == len(keep):
        return np.repeat(keep, counts)
    take = problem.lower[keep]
    room = problem.upper[keep] - take
    for group, count in zip(
        np.split(np.arange(len(keep)), first[1:]), counts, strict=True
    ):
        before = np.cumsum(room[group]) - room[group]  # in the places before
        missing = count - take[group].sum()
        take[group] += (missing - before).clip(0, room[group])
    return np.sort(np.repeat(keep, take))
