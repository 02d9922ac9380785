"""How many postures for a wanted accuracy: the smallest K, with a table to judge it by.

With noise of standard deviation sigma on an output, the fitted model predicts that
output at z = [u, 1] with the standard error ``sigma sqrt(z.T G^-1 z)``, G = Z.T Z of
the postures measured. Over the region of interest (R postures) two summaries:

- ``"G"``: the largest standard error anywhere in the region;
- ``"I"``: the root of the mean variance over the region (I-optimality's average).

For each K a design is sought by exchange on the criterion itself, started from the
D-optimal selection (exact where time allows), from the design for K - 1 plus its best
addition, and from random ones. It need not be the best of its size; so every K also has
a **lower bound** that no design of K measurements beats. The K returned is proven the
smallest where the bound of K - 1 lies above the target.

The bound: for weights w over the region with W = sum of w z z.T and any positive
definite M0, convexity and the best scaling of M0 give for every design M of K

    trace(W M^-1) >= trace(W M0^-1)^2 / (largest sum of K gains x.T M0^-1 W M0^-1 x),

and the largest variance is at least every weighted mean of it. For G the weights are
those of the D-optimal measure of the region, which make the bound p / K where the
region is the candidates and replicates are free (Kiefer and Wolfowitz 1960).

Sources: Atkinson, Donev and Tobias, Optimum Experimental Designs; Pukelsheim, Optimal
Design of Experiments, chapter 9 (the dual bound).
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.greedy import greedy_indices
from jaxcal.selection.problem import Problem, make_problem, whole_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Plan", "PlanRow", "plan", "plan_figure"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CRITERIA = ("G", "I")
DESIGNS = ("exact", "exchange")

_LARGEST_K = 200  # looked for where max_k is not given
_RANDOM_STARTS = 4  # of the exchange on the criterion, beside the three good ones
_ITERATIONS = 300  # of the measure behind a bound; any count gives a true bound


@dataclasses.dataclass(frozen=True, eq=False)
class PlanRow:
    """The design of one K."""

    k: int
    indices: Indices  # (k,) sorted; a posture measured r times appears r times
    standard_error: Array  # (m,) predicted, by the criterion, measured unit
    least_error: Array  # (m,) lower bound of any design of k, measured unit
    method: str  # "exact" or "exchange": the D-optimal selection, or one from exchange
    proven: bool  # the design is a proven D-optimum; never: proven best by G or I
    d_optimal_error: Array  # (m,) standard error of the D-optimal selection of k

    @property
    def num_distinct(self) -> int:
        """Different postures to drive to."""
        return len(np.unique(self.indices))


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """The smallest K found for a target, and the table behind it."""

    k: int
    indices: Indices  # (k,) sorted, into the candidates
    standard_error: Array  # (m,) predicted by the criterion, measured unit
    target_accuracy: Array  # (m,) measured unit
    noise_std: Array  # (m,) measured unit
    criterion: str  # "G" or "I"
    smallest_proven: bool  # no design of fewer measurements reaches the target
    rows: tuple[PlanRow, ...]  # every K tried, in order
    seconds: float

    def table(self) -> str:
        """K against accuracy, a line each, of the output that is furthest from it."""
        name = {"G": "largest", "I": "average"}[self.criterion]
        worst = int((self.noise_std / self.target_accuracy).argmax())
        target = self.target_accuracy[worst]
        lines = [
            f"{name} standard error of a prediction, output {worst + 1}, "
            f"noise {self.noise_std[worst]:g}, target {target:g}",
            "   K  distinct  standard error  no design below  D-optimal     design",
        ]
        for row in self.rows:
            kind = row.method + (", proven D-optimal" if row.proven else "")
            mark = " <-" if row.k == self.k else ""
            lines.append(
                f"{row.k:4d} {row.num_distinct:9d} {row.standard_error[worst]:15.6g} "
                f"{row.least_error[worst]:16.6g} {row.d_optimal_error[worst]:10.6g}   "
                f"{kind}{mark}"
            )
        lines.append(
            f"K = {self.k} is "
            + ("proven" if self.smallest_proven else "not proven to be")
            + " the smallest"
        )
        return "\n".join(lines)


def plan(
    candidates: ArrayLike,
    *,
    target_accuracy: ArrayLike,
    noise_std: ArrayLike,
    criterion: str = "G",
    region: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    max_k: int | None = None,
    more: int = 0,
    design: str = "exact",
    time_limit: float = 1.0,
    seed: int = 0,
) -> Plan:
    """The smallest number of measurements that predicts accurately enough.

    Args:
        candidates: (M, n) commands that could be measured, in any unit.
        target_accuracy: () or (m,) standard error a prediction may have, measured unit.
        noise_std: () or (m,) standard deviation of one measurement, measured unit.
            Noise is taken as white: measuring a posture twice halves its variance.
        criterion: "G", the largest standard error over the region, or "I", the root of
            the mean variance over it. Both must hold for every output.
        region: (R, n) commands at which predictions are wanted; the available
            candidates when not given.
        available: (M,) bool, True where a candidate may be measured.
        required: (r,) candidates that must be measured.
        max_replicates: how often one candidate may be measured.
        num_outputs: m; the length of ``noise_std`` or ``target_accuracy`` where one is
            an array, as many as inputs otherwise.
        max_k: largest K allowed; what is available, up to 200, when not given.
        more: rows of the table beyond the K that suffices.
        design: the D-optimal selection to start from, "exact" or "exchange".
        time_limit: seconds for the exact selection of each K.
        seed: of the exchange.

    Returns:
        The plan.

    Raises:
        ValueError: naming the argument, the rule and the value; where no K up to
            ``max_k`` suffices, with the accuracy that can be reached.
    """
    begun = time.perf_counter()
    if criterion not in CRITERIA:
        raise ValueError(
            f"criterion must be one of {', '.join(CRITERIA)}, got {criterion!r}"
        )
    if design not in DESIGNS:
        raise ValueError(f"design must be one of {', '.join(DESIGNS)}, got {design!r}")
    limit = numbers("time_limit", time_limit, finite=False)
    if limit.ndim or not limit > 0.0:
        raise ValueError(f"time_limit must be above 0 seconds, got {time_limit!r}")
    more = whole_number("more", more, 0)
    seed = whole_number("seed", seed, 0)
    noise, target = _levels(noise_std, target_accuracy, num_outputs, candidates)
    least_k = _least_k(candidates, required)

    def problem_of(k: int) -> Problem:
        return make_problem(
            candidates,
            k,
            available=available,
            required=required,
            max_replicates=max_replicates,
            num_outputs=len(noise),
        )

    problem = problem_of(least_k)
    caps = np.where(problem.available, problem.max_replicates, 0)
    total = int(caps.sum())
    if max_k is None:
        max_k = min(total, max(_LARGEST_K, least_k))
    max_k = whole_number("max_k", max_k, least_k)
    if max_k > total:
        raise ValueError(
            f"max_k must not exceed the {total} measurements allowed, got {max_k}"
        )
    points = _region_rows(problem, region)
    allowed = float((target / noise).min())  # of sqrt(criterion), unit noise
    measure = _measure(problem, points, criterion)

    @functools.cache
    def bound_of(k: int) -> float:
        if k == total:  # there is one design only
            everything = np.repeat(np.arange(len(problem.rows)), caps)
            return _criterion(problem.rows, everything, points, criterion)
        return _lower_bound(problem, measure, k)

    def error(variance: float) -> Array:
        return noise * np.sqrt(variance)

    def refuse(reached: float, least: float, k: int) -> ValueError:
        one = int((target / noise).argmin())
        return ValueError(
            f"target_accuracy must be reachable with max_k = {k} measurements"
            + (" (all that are allowed)" if k == total else "")
            + f": the best design found has a {_WORDS[criterion]} standard error of "
            f"{float(error(reached)[one]):.6g}, no design has less than "
            f"{float(error(least)[one]):.6g}, got {target[one]:g}"
        )

    # The cheap look first: is the largest K enough at all?
    last = _row(problem_of(max_k), points, criterion, "exchange", None, None, seed)
    if last.variance > allowed**2 * (1 + 1e-12) and bound_of(max_k) > allowed**2:
        raise refuse(last.variance, bound_of(max_k), max_k)
    rows: list[PlanRow] = []
    found: int | None = None
    previous: Indices | None = None
    for k in range(least_k, max_k + 1):
        row = _row(problem_of(k), points, criterion, design, time_limit, previous, seed)
        previous = row.indices
        rows.append(
            PlanRow(
                k=k,
                indices=row.indices,
                standard_error=error(row.variance),
                least_error=error(min(bound_of(k), row.variance)),
                method=row.method,
                proven=row.proven,
                d_optimal_error=error(row.d_optimal),
            )
        )
        if found is None and row.variance <= allowed**2 * (1 + 1e-12):
            found = len(rows) - 1
        if found is not None and len(rows) > found + more:
            break
    if found is None:
        raise refuse(
            float((rows[-1].standard_error / noise).min() ** 2), bound_of(max_k), max_k
        )
    chosen = rows[found]
    return Plan(
        k=chosen.k,
        indices=chosen.indices,
        standard_error=chosen.standard_error,
        target_accuracy=target,
        noise_std=noise,
        criterion=criterion,
        smallest_proven=chosen.k == least_k or bound_of(chosen.k - 1) > allowed**2,
        rows=tuple(rows),
        seconds=time.perf_counter() - begun,
    )


_WORDS = {"G": "largest", "I": "average"}


def plan_figure(result: Plan) -> Figure:
    """Accuracy against K: the designs, what no design beats, and the target."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    from jaxcal.plots import BLACK, COLOURS, GREY, MARKERS, plain_axes

    worst = int((result.noise_std / result.target_accuracy).argmax())
    ks = [row.k for row in result.rows]
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    series: tuple[tuple[str, str, str, Any], ...] = (
        ("standard_error", "design found", MARKERS[0], "-"),
        ("d_optimal_error", "D-optimal selection", MARKERS[1], "--"),
    )
    for colour, (field, label, marker, style) in zip(COLOURS, series, strict=False):
        values = [getattr(row, field)[worst] for row in result.rows]
        axes.plot(ks, values, marker=marker, linestyle=style, color=colour, label=label)
    least = [row.least_error[worst] for row in result.rows]
    axes.plot(ks, least, linestyle=":", color=GREY, label="no design below")
    axes.axhline(
        result.target_accuracy[worst], color=BLACK, linewidth=0.8, label="target"
    )
    axes.axvline(result.k, color=BLACK, linewidth=0.8, linestyle=":")
    axes.set_xlabel("number of measurements K")
    axes.set_ylabel(
        f"{_WORDS[result.criterion]} standard error of a prediction (measured unit)"
    )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    plain_axes(axes)
    return figure


# -- inside ----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Design:
    indices: Indices
    variance: float  # the criterion for unit noise
    d_optimal: float  # the criterion of the D-optimal selection
    method: str
    proven: bool


def _levels(
    noise_std: ArrayLike,
    target_accuracy: ArrayLike,
    num_outputs: int | None,
    candidates: ArrayLike,
) -> tuple[Array, Array]:
    """(m,) noise and (m,) target."""
    given = {
        "noise_std": numbers("noise_std", noise_std),
        "target_accuracy": numbers("target_accuracy", target_accuracy),
    }
    m = None if num_outputs is None else whole_number("num_outputs", num_outputs, 1)
    for value in given.values():
        if m is None and value.ndim == 1 and value.size:
            m = value.size
    shape = np.shape(candidates)
    m = m or (shape[-1] if shape else 1)
    for name, value in given.items():
        if value.shape not in ((), (m,)):
            raise ValueError(f"{name} must be one number or ({m},), got {value.shape}")
        if (value <= 0.0).any():
            raise ValueError(f"{name} must be positive, got {value.min():g}")
    noise, target = (np.broadcast_to(value, (m,)).copy() for value in given.values())
    return noise, target


def _least_k(candidates: ArrayLike, required: ArrayLike | None) -> int:
    """n + 1, or what the required candidates and the span they miss need."""
    points = numbers("candidates", candidates)
    if points.ndim != 2 or points.shape[1] < 1:
        raise ValueError(f"candidates must have shape (M, n), got {points.shape}")
    p = points.shape[1] + 1
    kept = np.unique(np.asarray(() if required is None else required, dtype=object))
    try:
        rows = points[kept.astype(np.int64)]
    except (IndexError, TypeError, ValueError):
        return p  # make_problem says what is wrong
    if not len(rows):
        return p
    spread = np.ptp(points, axis=0)
    scaled = (rows - points.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    rank = int(np.linalg.matrix_rank(np.c_[scaled, np.ones(len(rows))], tol=1e-8))
    return max(p, len(rows) + p - rank)


def _region_rows(problem: Problem, region: ArrayLike | None) -> Array:
    """(R, p) regressors of the region in the problem's whitened coordinates."""
    if region is None:
        return problem.rows[problem.available]
    where = numbers("region", region)
    n = problem.num_regressors - 1
    if where.ndim != 2 or where.shape[1] != n or not len(where):
        raise ValueError(f"region must have shape (R, {n}), got {where.shape}")
    usable = problem.candidates[problem.available]
    centre = usable.mean(axis=0)
    scale = np.abs(usable - centre).max(axis=0)
    ours = np.c_[(usable - centre) / scale, np.ones(len(usable))]
    theirs = np.c_[(where - centre) / scale, np.ones(len(where))]
    # rows = ours @ map, exactly; the map carries the region along.
    transform = np.linalg.lstsq(ours, problem.rows[problem.available], rcond=None)[0]
    return theirs @ transform


def _criterion(rows: Array, indices: Indices, points: Array, criterion: str) -> float:
    """The criterion of a design for unit noise; inf where it is singular."""
    singular, right = np.linalg.svd(rows[indices])[1:]
    if len(singular) < rows.shape[1] or singular[-1] <= 1e-7 * singular[0]:
        return np.inf
    variance = np.sum((points @ (right.T / singular)) ** 2, axis=1)
    return float(variance.max() if criterion == "G" else variance.mean())


def _row(
    problem: Problem,
    points: Array,
    criterion: str,
    design: str,
    time_limit: float | None,
    previous: Indices | None,
    seed: int,
) -> _Design:
    """The best design of ``problem.k`` found."""
    proven = False
    if design == "exact":
        assert time_limit is not None
        found = solve_exact(problem, deadline=time.perf_counter() + time_limit)
        optimal, proven = found.subsets[0], found.proven
    else:
        optimal = exchange_indices(problem, 50, seed)
    base = _criterion(problem.rows, optimal, points, criterion)
    starts = [optimal, greedy_indices(problem)]
    if previous is not None:
        starts.append(_with_best_addition(problem, previous, points, criterion))
    rng = np.random.default_rng([seed, problem.k])
    starts += [_random_start(problem, rng) for _ in range(_RANDOM_STARTS)]
    best, value = optimal, base
    for start in starts:
        indices, reached = _exchange(problem, start, points, criterion)
        if reached < value * (1.0 - 1e-12):
            best, value = indices, reached
    same = np.array_equal(np.sort(best), np.sort(optimal))
    return _Design(
        indices=np.sort(best),
        variance=value,
        d_optimal=base,
        method="exact" if same and design == "exact" else "exchange",
        proven=same and proven,
    )


def _random_start(problem: Problem, rng: np.random.Generator) -> Indices:
    room = problem.upper - problem.lower
    pool = rng.permutation(np.repeat(np.arange(len(room)), room))
    return np.concatenate([problem.required, pool[: problem.k - len(problem.required)]])


def _room(problem: Problem, indices: Indices) -> Indices:
    """Candidates that may be chosen once more."""
    counts = np.bincount(indices, minlength=len(problem.rows))
    return np.flatnonzero(counts < problem.upper)


def _with_best_addition(
    problem: Problem, previous: Indices, points: Array, criterion: str
) -> Indices:
    """One more measurement: ``v - a_j^2 / (1 + d_j)`` is the variance after j."""
    rows = problem.rows
    more = _room(problem, previous)
    inverse = np.linalg.inv(rows[previous].T @ rows[previous])
    new = rows[more]
    a = points @ inverse @ new.T  # (R, candidates)
    d = np.einsum("mp,pq,mq->m", new, inverse, new)
    v = np.einsum("rp,pq,rq->r", points, inverse, points)
    after = v[:, None] - a**2 / (1.0 + d)
    value = after.max(axis=0) if criterion == "G" else after.mean(axis=0)
    return np.append(previous, more[int(value.argmin())])


def _swapped(
    problem: Problem, chosen: Indices, free: Indices, more: Indices, points: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """What every swap of ``chosen[free]`` for ``more`` needs, from one inverse."""
    rows = problem.rows
    inverse = np.linalg.inv(rows[chosen].T @ rows[chosen])
    out, new = rows[chosen[free]], rows[more]
    return (
        np.einsum("rp,pq,rq->r", points, inverse, points),  # (R,) variances now
        points @ inverse @ out.T,  # (R, free)
        points @ inverse @ new.T,  # (R, more)
        np.einsum("ip,pq,iq->i", out, inverse, out),  # (free,)
        np.einsum("jp,pq,jq->j", new, inverse, new),  # (more,)
        out @ inverse @ new.T,  # (free, more)
    )


def _values_after_swaps(
    problem: Problem,
    chosen: Indices,
    free: Indices,
    more: Indices,
    points: Array,
    criterion: str,
) -> Array:
    """(free, more) criterion after each swap, by the Woodbury identity.

    Taking x_i out and x_j in changes the variance v at z by ``-((1 - d_i) a_j^2 +
    2 d_ij a_i a_j - (1 + d_j) a_i^2) / D`` with a = z.T M^-1 x, d likewise between the
    two, and ``D = (1 - d_i)(1 + d_j) + d_ij^2`` the factor of the determinant.
    """
    v, a_out, a_new, d_out, d_new, d_both = _swapped(
        problem, chosen, free, more, points
    )
    values = np.full((len(free), len(more)), np.inf)
    for i in range(len(free)):
        factor = (1.0 - d_out[i]) * (1.0 + d_new) + d_both[i] ** 2
        sound = factor > 1e-9
        a_i, a_j = a_out[:, i : i + 1], a_new[:, sound]
        after = (
            v[:, None]
            - (
                (1.0 - d_out[i]) * a_j**2
                + 2.0 * d_both[i, sound] * a_i * a_j
                - (1.0 + d_new[sound]) * a_i**2
            )
            / factor[sound]
        )
        values[i, sound] = after.max(0) if criterion == "G" else after.mean(0)
    return values


def _exchange(
    problem: Problem, start: Indices, points: Array, criterion: str
) -> tuple[Indices, float]:
    """Swap one posture at a time, the best swap first, until none lowers the criterion.

    The required candidates stay, one measurement of each. A singular start stays too.
    """
    rows = problem.rows
    chosen = np.array(start)
    value = _criterion(rows, chosen, points, criterion)
    while np.isfinite(value):
        fixed = [int(np.flatnonzero(chosen == i)[0]) for i in problem.required]
        free = np.setdiff1d(np.arange(len(chosen)), fixed)
        free = free[np.unique(chosen[free], return_index=True)[1]]
        more = _room(problem, chosen)
        if not len(free) or not len(more):
            break
        values = _values_after_swaps(problem, chosen, free, more, points, criterion)
        i, j = divmod(int(values.argmin()), len(more))
        tried = chosen.copy()
        tried[free[i]] = more[j]
        reached = _criterion(rows, tried, points, criterion)
        if not reached < value * (1.0 - 1e-9):
            break
        chosen, value = tried, reached
    return chosen, value


@dataclasses.dataclass(frozen=True)
class _Measure:
    """A weighting W of the region and, for any k, where to put the dual's M0."""

    weighting: Array  # (p, p) sum of w z z.T over the region, the w sum to 1


def _measure(problem: Problem, points: Array, criterion: str) -> _Measure:
    if criterion == "I":
        return _Measure(points.T @ points / len(points))
    # D-optimal measure of the region: w_r <- w_r (z.T W^-1 z) / p (Titterington).
    p = points.shape[1]
    weight = np.full(len(points), 1.0 / len(points))
    for _ in range(_ITERATIONS):
        gram = (points * weight[:, None]).T @ points
        inverse = np.linalg.pinv(gram, hermitian=True)
        weight *= np.einsum("ra,ab,rb->r", points, inverse, points) / p
        weight /= weight.sum()
    return _Measure((points * weight[:, None]).T @ points)


def _lower_bound(problem: Problem, measure: _Measure, k: int) -> float:
    """No design of k within the counts has a smaller ``trace(W M^-1)``.

    M0 is the relaxed minimiser, from multiplicative steps on counts that are clipped
    to their limits; whatever M0 they end in, the bound holds.
    """
    w, rows = measure.weighting, problem.rows
    upper = np.where(problem.available, min(problem.max_replicates, k), 0)
    lower = problem.lower
    count = np.where(problem.available, k / problem.available.sum(), 0.0)
    best = 0.0
    for iteration in range(_ITERATIONS):
        gram = (rows * count[:, None]).T @ rows
        inverse = np.linalg.pinv(gram, hermitian=True)
        middle = inverse @ w @ inverse
        gain = np.einsum("ma,ab,mb->m", rows, middle, rows)
        if iteration % 10 == 0 or iteration == _ITERATIONS - 1:
            most = _largest_sum(gain, lower, upper, k)
            best = max(best, float(np.trace(w @ inverse)) ** 2 / most)
        count = _scaled_to(count * np.sqrt(np.maximum(gain, 0.0)), lower, upper, k)
    return best


def _largest_sum(gain: Array, lower: Indices, upper: Indices, k: int) -> float:
    order = np.argsort(-gain)
    room = (upper - lower)[order]
    free = k - int(lower.sum())
    filled = np.clip(free - (np.cumsum(room) - room), 0, room)
    return float(lower @ gain + filled @ gain[order])


def _scaled_to(count: Array, lower: Indices, upper: Indices, k: int) -> Array:
    """``clip(c count, lower, upper)`` with the c that makes the sum k, by bisection."""
    low, high = 0.0, 1.0
    while np.clip(high * count, lower, upper).sum() < k and high < 1e12:
        high *= 2.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if np.clip(middle * count, lower, upper).sum() < k:
            low = middle
        else:
            high = middle
    return np.clip(high * count, lower, upper)
