"""The number of measurements that a wanted accuracy needs, with a table.

With noise of standard deviation sigma on an output, the fitted model predicts it with
the standard error ``sigma sqrt(z.T M^-1 z)``, z a row of its derivative, M the
information of what is measured in units of the noise. Two summaries over the region of
interest: "G", the largest standard error in it, and "I", the root of the mean variance.
The standard errors of the parameters are those of a region of unit vectors.

The best design of each K is looked for by exchange on the criterion itself. What none
of K measurements beats: with weights w over the region and W = sum of w z z.T, the
largest variance is at least the weighted mean trace(W M^-1), and that at least what the
relaxation of branch and bound proves. For G the weights are those of the D-optimal
measure of the region, which make the bound p / K where the region is the candidates and
replicates are free (Kiefer and Wolfowitz 1960). Source: Atkinson, Donev and Tobias,
Optimum Experimental Designs.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, Indices, array_of, levels, one_of, whole_number
from jaxcal.information.blocks import largest_rank
from jaxcal.information.singular import significant
from jaxcal.late import late
from jaxcal.models.uncertainty import Noise
from jaxcal.selection.criteria import I, Mean, positions
from jaxcal.selection.exact.exact import relaxed
from jaxcal.selection.exchange.exchange import exchange_indices, greedy_indices
from jaxcal.selection.problem import (
    Blocks,
    CandidateSet,
    Problem,
    blocks_of,
    problem_of,
    shares_regressor,
)
from jaxcal.selection.problem.problem import joined_problem
from jaxcal.selection.solvers import checked_seed

if TYPE_CHECKING:
    from jaxcal.selection.design import Design

# Over the region, of the variances of an output; of several the worst counts.
_MEANS: dict[str, Callable[..., Any]] = {"G": np.max, "I": np.mean}

_RANDOM_STARTS = 4  # where a candidate gives one reading: swaps of more take longer
_D_RESTARTS = 50  # of the exchange that looks for the D-optimal selection
_ITERATIONS = 300  # of the weights of G: any count gives a true bound
_SUMMARIES = {"G": "largest", "I": "average", "parameters": "largest"}
_LARGEST_K = 200  # looked for where max_k is not given
_ENOUGH = 1.0 + 1e-12  # variance that is accurate enough


@dataclasses.dataclass(frozen=True, eq=False)
class PlanRow:
    """The design of one K."""

    k: int
    indices: Indices  # (k,) sorted; a posture measured r times appears r times
    standard_error: Array  # (m,) predicted, by the criterion, measured unit
    least_error: Array  # (m,) lower bound of any design of k, measured unit

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
    accuracy: Array  # (m,) measured unit
    noise_std: Array | None  # one an output, measured unit; None where Noise says more
    names: tuple[str, ...]  # (m,) of the parameters, or output 1, ...
    criterion: str  # "G", "I" or "parameters"
    smallest_proven: bool  # no design of fewer measurements reaches the target
    rows: tuple[PlanRow, ...]  # every K tried, in order
    seconds: float

    @property
    def summary(self) -> str:
        return _SUMMARIES[self.criterion]

    @property
    def hardest_output(self) -> int:
        """The output, or parameter, that is furthest from its target."""
        return int((self.standard_error / self.accuracy).argmax())

    def worst(self, errors: Array) -> float:
        """Largest of (m,) errors over their targets, times that of the hardest output:
        where the targets are equal, the largest error."""
        share = (errors / self.accuracy).max()
        return float(share * self.accuracy[self.hardest_output])

    plot = late("jaxcal.reports.shown:plot_plan")
    _repr_html_ = late("jaxcal.reports.shown:as_html")

    def __str__(self) -> str:
        """K against accuracy, a line each, of the output that is furthest from it."""
        worst = self.hardest_output
        what = f"{self.summary} standard error of a prediction, {self.names[worst]}"
        if self.criterion == "parameters":
            what = f"standard error of parameter {self.names[worst]}"
        elif self.noise_std is not None:
            what += f", noise {self.noise_std[worst]:g}"
        lines = [f"{what}, target {self.accuracy[worst]:g}"]
        lines.append("   K  distinct  standard error      lower bound")
        for row in self.rows:
            error, least = map(self.worst, (row.standard_error, row.least_error))
            mark = " <-" if row.k == self.k else ""
            distinct = f"{row.k:4d} {row.num_distinct:9d}"
            lines.append(f"{distinct} {error:15.6g} {least:16.6g}{mark}")
        proof = "proven" if self.smallest_proven else "not proven to be"
        return "\n".join([*lines, f"K = {self.k} is {proof} the smallest"])


def plan(
    design: Design,
    accuracy: ArrayLike,
    noise_std: ArrayLike | None = None,
    criterion: str = "G",
    *,
    parameters: Any = None,
    region: ArrayLike | None = None,
    max_k: int | None = None,
    more: int = 0,
    seed: int | np.random.Generator = 0,
) -> Plan:
    """The smallest number of measurements that predicts accurately enough.

    Args:
        design: what may be measured; ``design.plan(accuracy, ...)`` asks the same.
        accuracy: () or (m,) standard error a prediction may have, measured unit; with
            "parameters" () or (s,), that of each parameter of interest.
        noise_std: () or (m,) standard deviation of one measurement, measured unit; the
            noise of the design when not given. With blocks it is 1. Noise is taken as
            white: measuring a posture twice halves its variance.
        criterion: "G", the largest standard error over the region, "I", the root of the
            mean variance over it, or "parameters", the standard error of the parameters
            themselves. It must hold for every output or parameter.
        parameters: names or indices of the s parameters of interest, or all.
        region: (R, n) commands at which predictions are wanted, with blocks (R, m, p)
            what is predicted, ``region @ theta``; what is available when not given.
        max_k: largest K allowed; what is available, up to 200, when not given.
        more: rows of the table beyond the K that suffices.
        seed: of the exchange.

    Raises:
        ValueError: naming the argument, the rule and the value; where no K up to
            ``max_k`` suffices, with the accuracy that can be reached.
    """
    begun, offer = time.perf_counter(), design
    one_of("criterion", criterion, tuple(_SUMMARIES))
    more, start = whole_number("more", more, 0), checked_seed(seed)
    requests = [
        _request(alone, criterion, accuracy, noise_std, parameters, region)
        for alone in offer.by_scenario()
    ]
    request, problem = requests[0], requests[0].problem
    if offer.scenarios is not None:
        members, weights = [x.problem for x in requests], offer.scenarios.weights
        problem = joined_problem(members, weights, Mean("D"), None)
    identify, least_k = _fewest(problem)
    if max_k is None:
        max_k = min(problem.k, max(_LARGEST_K, least_k))
    elif whole_number("max_k", max_k, least_k) > problem.k:
        raise ValueError(
            f"max_k must not exceed the {problem.k} measurements allowed, got {max_k}"
        )
    sizes = _Sizes(problem, requests, "I" if criterion == "I" else "G", start)
    rows, chosen = _rows(sizes, request.unit, least_k, max_k, more)
    if chosen is None:
        raise _unreachable(sizes, request, rows, max_k, _SUMMARIES[criterion])
    smallest = chosen.k == identify or sizes.bound(chosen.k - 1) > 1.0
    return Plan(
        chosen.k, chosen.indices, chosen.standard_error, request.target,
        request.noise_std, request.names, criterion, smallest, tuple(rows),
        time.perf_counter() - begun,
    )  # fmt: skip


class _Sizes:
    """Designs of every K, with variances of which 1 is accurate enough."""

    def __init__(
        self, problem: Problem, cases: list[_Request], how: str, seed: int
    ) -> None:
        self.problem = problem  # of all that may be measured
        self.cases, self.seed = cases, seed
        self.over = _MEANS[how]  # the region
        self._roots = [_region_root(case.points, how) for case in cases]
        self._bounds: dict[int, float] = {}

    def bound(self, k: int) -> float:
        """No design of k has a smaller largest variance."""
        if k == self.problem.k:  # there is one design only
            every = np.repeat(np.arange(len(self.problem.blocks)), self.problem.upper)
            return float(self.variances(every).max())
        if k not in self._bounds:
            alone = [
                dataclasses.replace(case.problem, k=k, criterion=I.of_rows(root))
                for case, root in zip(self.cases, self._roots, strict=True)
            ]
            self._bounds[k] = max(-relaxed(one, greedy_indices(one)) for one in alone)
        return self._bounds[k]

    def variances(self, indices: Indices) -> Array:
        """(s,) the criterion of each output in the worst scenario; inf if singular."""
        worst = [self._variances(case, indices) for case in self.cases]
        return np.asarray(np.max(worst, axis=0))

    def _variances(self, case: _Request, indices: Indices) -> Array:
        problem, points = case.problem, case.points
        rows = problem.blocks[indices].reshape(-1, points.shape[-1])
        if problem.prior.any():
            size, vectors = np.linalg.eigh(problem.prior)
            rows = np.vstack([rows, np.sqrt(size.clip(0.0))[:, None] * vectors.T])
        singular, right = np.linalg.svd(rows)[1:]
        if significant(singular).sum() < rows.shape[1]:
            return np.full(points.shape[1], np.inf)
        return np.asarray(self.over(((points @ (right.T / singular)) ** 2).sum(2), 0))

    def best(self, k: int, previous: Indices | None) -> tuple[Indices, Array]:
        """(k,) the best design found, from that of k - 1; its variances (s,)."""
        problem = self.problem.of_size(k)
        best = exchange_indices(problem, _D_RESTARTS, self.seed)
        value = float(self.variances(best).max())
        starts = [best, greedy_indices(problem)]
        if previous is not None:
            more = _room(problem, previous)
            values = self._worst_after(previous, [None], more)[0]
            starts.append(np.append(previous, more[int(values.argmin())]))
        if problem.blocks.shape[1] == 1:
            rng = np.random.default_rng([self.seed, k])
            every = np.arange(len(problem.blocks))
            room = np.repeat(every, problem.upper - problem.lower)
            for _ in range(_RANDOM_STARTS):
                drawn = rng.permutation(room)[: k - len(problem.required)]
                starts.append(np.concatenate([problem.required, drawn]))
        for start in starts:
            indices, reached = self._exchanged(problem, start)
            if reached < value * (1.0 - 1e-12):
                best, value = indices, reached
        best = np.sort(best)
        return best, self.variances(best)

    def _exchanged(self, problem: Problem, start: Indices) -> tuple[Indices, float]:
        """Swap one posture at a time, the best swap first, until none helps; the
        required stay, one measurement of each, and a singular start."""
        chosen = np.array(start)
        value = float(self.variances(chosen).max())
        while np.isfinite(value):
            fixed = [int(np.flatnonzero(chosen == i)[0]) for i in problem.required]
            free = np.setdiff1d(np.arange(len(chosen)), fixed)
            free = free[np.unique(chosen[free], return_index=True)[1]]
            more = _room(problem, chosen)
            if not len(free) or not len(more):
                break
            values = self._worst_after(chosen, list(chosen[free]), more)
            i, j = divmod(int(values.argmin()), len(more))
            tried = chosen.copy()
            tried[free[i]] = more[j]
            reached = float(self.variances(tried).max())
            if not reached < value * (1.0 - 1e-9):
                break
            chosen, value = tried, reached
        return chosen, value

    def _worst_after(self, *swap: Any) -> Array:
        """(out, new) criterion of the worst scenario after a swap, see ``_after``."""
        after = [self._after(case, *swap) for case in self.cases]
        return np.asarray(np.max(after, axis=0))

    def _after(
        self, case: _Request, chosen: Indices, out: list[int | None], new: Indices
    ) -> Array:
        """(out, new) criterion after taking one out (None: nothing) and one in.

        By the Woodbury identity: with U the blocks that go and come, V = M^-1 and S =
        -1 for a row that goes, 1 for one that comes, the variance at z falls by ``a.T
        (S + U V U.T)^-1 a``, a = U V z, and that matrix is singular where the design
        becomes so.
        """
        problem, points = case.problem, case.points
        blocks, (regions, outputs, p) = problem.blocks, points.shape
        held = blocks[chosen].reshape(-1, p)
        inverse = np.linalg.inv(held.T @ held + problem.prior)
        rows = points.reshape(-1, p)
        before = np.einsum("np,pq,nq->n", rows, inverse, rows)
        values = np.full((len(out), len(new)), np.inf)
        q = blocks.shape[1]
        for row, i in enumerate(out):
            gone = blocks[[] if i is None else [i]].reshape(-1, p)
            u = np.empty((len(new), len(gone) + q, p))
            u[:, : len(gone)], u[:, len(gone) :] = gone, blocks[new]
            scaled = u @ inverse
            sign = np.r_[-np.ones(len(gone)), np.ones(q)]
            inner = np.diag(sign) + scaled @ np.matrix_transpose(u)
            sound = np.abs(np.linalg.det(inner)) > 1e-9
            along = scaled[sound] @ rows.T
            less = (along * np.linalg.solve(inner[sound], along)).sum(axis=1)
            after = (before - less).reshape(-1, regions, outputs)
            values[row, sound] = self.over(after, 1).max(axis=1)
        return values


def _room(problem: Problem, indices: Indices) -> Indices:
    """Candidates that may be chosen once more."""
    counts = np.bincount(indices, minlength=len(problem.blocks))
    return np.flatnonzero(counts < problem.upper)


def _region_root(points: Array, how: str) -> Array:
    """(r, p) root of W, of points (R, s, p) and weights: for "I" equal ones, for "G" by
    Titterington's steps w <- w (z.T W^-1 z) / p."""
    rows = points.reshape(-1, points.shape[-1])
    weight = np.full(len(rows), 1.0 / len(rows))
    for _ in range(_ITERATIONS if how == "G" else 0):
        inverse = np.linalg.pinv((rows * weight[:, None]).T @ rows, hermitian=True)
        weight *= np.einsum("ra,ab,rb->r", rows, inverse, rows)
        weight /= weight.sum()
    size, vectors = np.linalg.eigh((rows * weight[:, None]).T @ rows)
    keep = significant(size, squares=True)
    return np.asarray(np.sqrt(size[keep])[:, None] * vectors.T[keep])


def _rows(
    sizes: _Sizes, unit: Array, least_k: int, max_k: int, more: int
) -> tuple[list[PlanRow], PlanRow | None]:
    """A row of every K up to ``more`` beyond the first that suffices, and that one."""
    rows: list[PlanRow] = []
    chosen: PlanRow | None = None
    indices: Indices | None = None
    ks = range(least_k, max_k + 1) if sizes.bound(max_k) <= _ENOUGH else ()
    for k in ks:  # none where no K allowed is enough
        try:
            indices, variance = sizes.best(k, indices)
        except ValueError:  # singular in a scenario
            if rows or k == max_k:
                raise
            continue
        bound = max(min(sizes.bound(k), variance.max()), 0.0)
        row = PlanRow(k, indices, unit * np.sqrt(variance), unit * np.sqrt(bound))
        rows.append(row)
        if chosen is None and variance.max() <= _ENOUGH:
            chosen = row
        if chosen is not None and k >= chosen.k + more:
            break
    return rows, chosen


def _unreachable(
    sizes: _Sizes, request: _Request, rows: list[PlanRow], max_k: int, summary: str
) -> ValueError:
    """What can be reached with ``max_k``, where that is not accurate enough."""
    indices = rows[-1].indices if rows else sizes.best(max_k, None)[0]
    variance = sizes.variances(indices)
    unit = request.unit
    hardest = int((unit * np.sqrt(variance) / request.target).argmax())
    bound = sizes.bound(max_k)
    reached, least = unit[hardest] * np.sqrt([variance.max(), bound])
    all_of = "all " if max_k == sizes.problem.k else ""
    return ValueError(
        f"accuracy = {request.target[hardest]:g} cannot be reached: {all_of}{max_k} "
        f"measurements give a {summary} standard error of {reached:.6g}, and no "
        f"selection gives less than {least:.6g}. Repeat rows (max_replicates, "
        "--replicates) or measure with less noise"
    )


class _Request(NamedTuple):
    """What a design is judged by: the errors of m outputs or parameters."""

    problem: Problem  # measuring all that may be, as often as it may
    points: Array  # (R, s, p) whitened rows, where a variance of 1 is enough
    unit: Array  # (m,) or (1,) standard error that is 1 at ``points``, measured unit
    target: Array  # (m,) measured unit
    noise_std: Array | None  # one an output, measured unit; None where Noise says more
    names: tuple[str, ...]  # (m,)


def _request(
    offer: CandidateSet,
    criterion: str,
    accuracy: ArrayLike,
    noise_std: ArrayLike | None,
    parameters: Any,
    region: ArrayLike | None,
) -> _Request:
    """Check the arguments of ``plan``."""
    of_parameters = criterion == "parameters"
    if parameters is not None and not of_parameters:
        raise ValueError("parameters needs criterion='parameters'")
    if offer.constraints is not None:
        raise ValueError("constraints work with select and score, not with plan")
    total = max(1, int((offer.available * np.int64(offer.max_replicates)).sum()))
    model, std = offer.model, _reading_std(offer, noise_std)
    shared = False  # one regressor for all outputs?
    if model is not None and std is not None:
        shared = not of_parameters and shares_regressor(model, offer.prior, None)
        # Where outputs share a regressor the noise is in the targets.
        offer = offer.but(noise=None if shared else Noise(std))
    problem = problem_of(offer, total, "D")
    blocks = blocks_of(offer.but(noise=None), not shared)
    region = offer.by_name("region", region)
    names, rows = blocks.names, _region_rows(blocks, problem, region)
    if of_parameters:
        at = positions(names if parameters is None else parameters, names)
        rows, names = np.eye(len(names))[None, at], tuple(names[i] for i in at)
    if not len(rows):
        raise ValueError("region must hold at least one row, got none")
    m = model.num_outputs if shared and model is not None else rows.shape[1]
    if not of_parameters:
        names = tuple(f"output {i + 1}" for i in range(m))
    target = levels("accuracy", accuracy, m)
    scale = unit = target
    if std is not None and shared:
        scale = (target / std).min(keepdims=True)
        unit = std * scale
    elif model is None:
        std = np.ones(m)
    points = problem.white.of(rows) / scale[:, None]
    if criterion == "I" and len(points) > points.shape[2]:  # fewer rows, the same mean
        root = np.linalg.qr(np.moveaxis(points, 1, 0))[1]
        points = np.moveaxis(root, 0, 1) * np.sqrt(root.shape[1] / len(points))
    return _Request(problem, points, unit, target, std, names)


def _reading_std(offer: CandidateSet, noise_std: ArrayLike | None) -> Array | None:
    """(m,) of a reading, as given or of the design; None: blocks, or its noise says
    more."""
    noise = offer.noise
    if offer.model is None:
        if not (noise_std is noise is None):
            raise ValueError(
                "noise and noise_std must be left out with blocks, which are in units "
                "of the noise"
            )
        return None
    if noise_std is None:
        if noise is None:
            raise ValueError("noise_std is missing: the design has no noise")
        if noise.covariance is not None or noise.command_std is not None:
            return None
        noise_std = 1.0 if noise.std is None else noise.std
        if np.ndim(noise_std) > 1:  # of each candidate
            return None
    return levels("noise_std", noise_std, offer.model.num_outputs)


def _region_rows(blocks: Blocks, problem: Problem, region: ArrayLike | None) -> Array:
    """(R, m, p) what is predicted in the region; of what is available if not given."""
    if problem.model is None:
        if region is None:
            return problem.readings[problem.available]
        return array_of("region", region, "R", "m", len(blocks.names))
    assert problem.candidates is not None
    where = problem.candidates[problem.available] if region is None else region
    return blocks.at("region", where, readings=False)


def _fewest(problem: Problem) -> tuple[int, int]:
    """Measurements below which none identify, and the fewest found that do: they differ
    where blocks of several rows overlap in what they tell."""
    missing = problem.num_regressors - problem.held_rank
    most = largest_rank(problem.blocks)
    least = k = max(1, len(problem.required) - (-missing // most))
    if problem.blocks.shape[1] > 1:
        while k < problem.k and np.isneginf(
            problem.log_det(greedy_indices(problem.of_size(k)))
        ):
            k += 1
    return least, k
