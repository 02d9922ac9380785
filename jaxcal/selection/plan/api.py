"""How many postures for a wanted accuracy: the smallest K, with a table to judge it by.

With noise of standard deviation sigma on an output, the fitted model predicts that
output at z = [u, 1] with the standard error ``sigma sqrt(z.T G^-1 z)``, G = Z.T Z of
the postures measured. Over the region of interest (R postures) two summaries:

- ``"G"``: the largest standard error anywhere in the region;
- ``"I"``: the root of the mean variance over the region (I-optimality's average).

For each K ``designs`` looks for a good design and ``bound`` says what no design of K
measurements beats. The K returned is proven the smallest where the bound of K - 1 lies
above the target. Source: Atkinson, Donev and Tobias, Optimum Experimental Designs.
"""

from __future__ import annotations

import dataclasses
import functools
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, one_of, seconds, whole_number
from jaxcal.selection.plan.bound import lower_bound, region_weighting
from jaxcal.selection.plan.designs import CRITERIA, Design, best_design, criterion_of
from jaxcal.selection.problem import Problem, make_problem
from jaxcal.selection.solvers import checked_seed

__all__ = ["Plan", "PlanRow", "plan"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DESIGNS = ("exact", "exchange")

_SUMMARIES = {"G": "largest", "I": "average"}
_LARGEST_K = 200  # looked for where max_k is not given


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

    @property
    def summary(self) -> str:
        """The criterion in a word."""
        return _SUMMARIES[self.criterion]

    @property
    def hardest_output(self) -> int:
        """The output that is furthest from its target, whatever the design."""
        return int((self.noise_std / self.target_accuracy).argmax())

    def __str__(self) -> str:
        return self.table()

    def table(self) -> str:
        """K against accuracy, a line each, of the output that is furthest from it."""
        worst = self.hardest_output
        lines = [
            f"{self.summary} standard error of a prediction, output {worst + 1}, noise "
            f"{self.noise_std[worst]:g}, target {self.target_accuracy[worst]:g}",
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
        proof = "proven" if self.smallest_proven else "not proven to be"
        return "\n".join([*lines, f"K = {self.k} is {proof} the smallest"])


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
    seed: int | np.random.Generator = 0,
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
    one_of("criterion", criterion, tuple(CRITERIA))
    one_of("design", design, DESIGNS)
    limit = seconds("time_limit", time_limit)
    more, start = whole_number("more", more, 0), checked_seed(seed)
    noise, target = _levels(noise_std, target_accuracy, num_outputs, candidates)
    everything = _whole_problem(
        candidates, available, required, max_replicates, len(noise)
    )
    total, least_k = everything.k, _least_k(everything)
    if max_k is None:
        max_k = min(total, max(_LARGEST_K, least_k))
    max_k = whole_number("max_k", max_k, least_k)
    if max_k > total:
        raise ValueError(
            f"max_k must not exceed the {total} measurements allowed, got {max_k}"
        )
    points = _region_rows(everything, region)
    weighting = region_weighting(points, criterion)
    allowed = float((target / noise).min()) ** 2  # of the criterion, unit noise

    @functools.cache
    def bound_of(k: int) -> float:
        if k == total:  # there is one design only
            every = np.repeat(np.arange(len(everything.rows)), everything.upper)
            return criterion_of(everything.rows, every, points, criterion)
        return lower_bound(everything, weighting, k)

    def design_of(k: int, how: str, previous: Indices | None) -> Design:
        problem = dataclasses.replace(everything, k=k)
        return best_design(problem, points, criterion, how, limit, previous, start)

    def enough(found: Design) -> bool:
        return found.variance <= allowed * (1 + 1e-12)

    # Cheap first: is the largest K enough at all?
    last = design_of(max_k, "exchange", None)
    rows: list[PlanRow] = []
    chosen: PlanRow | None = None
    previous: Indices | None = None
    if enough(last) or bound_of(max_k) <= allowed:
        for k in range(least_k, max_k + 1):
            last = design_of(k, design, previous)
            previous = last.indices
            rows.append(
                PlanRow(
                    k=k,
                    indices=last.indices,
                    standard_error=noise * np.sqrt(last.variance),
                    least_error=noise * np.sqrt(min(bound_of(k), last.variance)),
                    method=last.method,
                    proven=last.proven,
                    d_optimal_error=noise * np.sqrt(last.d_optimal),
                )
            )
            if chosen is None and enough(last):
                chosen = rows[-1]
            if chosen is not None and k >= chosen.k + more:
                break
    if chosen is None:
        one = int((target / noise).argmin())
        best, least = noise[one] * np.sqrt([last.variance, bound_of(max_k)])
        raise ValueError(
            f"target_accuracy must be reachable with max_k = {max_k} measurements"
            + (" (all that are allowed)" if max_k == total else "")
            + f": the best design found has a {_SUMMARIES[criterion]} standard error "
            f"of {best:.6g}, no design has less than {least:.6g}, got {target[one]:g}"
        )
    return Plan(
        k=chosen.k,
        indices=chosen.indices,
        standard_error=chosen.standard_error,
        target_accuracy=target,
        noise_std=noise,
        criterion=criterion,
        smallest_proven=chosen.k == least_k or bound_of(chosen.k - 1) > allowed,
        rows=tuple(rows),
        seconds=time.perf_counter() - begun,
    )


def _levels(
    noise_std: ArrayLike,
    target_accuracy: ArrayLike,
    num_outputs: int | None,
    candidates: ArrayLike,
) -> tuple[Array, Array]:
    """(m,) noise and (m,) target; copies that cannot be written to."""
    given = {
        "noise_std": numbers("noise_std", noise_std),
        "target_accuracy": numbers("target_accuracy", target_accuracy),
    }
    m = None if num_outputs is None else whole_number("num_outputs", num_outputs, 1)
    for value in given.values():
        if m is None and value.ndim == 1 and value.size:
            m = value.size
    m = m or (np.shape(candidates) or (1,))[-1]
    for name, value in given.items():
        if value.shape not in ((), (m,)):
            raise ValueError(f"{name} must be one number or ({m},), got {value.shape}")
        if (value <= 0.0).any():
            raise ValueError(f"{name} must be positive, got {value.min():g}")
        given[name] = np.array(np.broadcast_to(value, (m,)))
        given[name].flags.writeable = False
    return given["noise_std"], given["target_accuracy"]


def _whole_problem(
    candidates: ArrayLike,
    available: ArrayLike | None,
    required: ArrayLike | None,
    max_replicates: int,
    num_outputs: int,
) -> Problem:
    """The problem of measuring all that may be measured, every time it may."""
    shape = np.shape(candidates)
    usable = np.ones(shape[:1]) if available is None else available
    cap = whole_number("max_replicates", max_replicates, 1)
    return make_problem(
        candidates,
        max(
            int(np.count_nonzero(usable)) * cap, shape[1] + 1 if len(shape) == 2 else 1
        ),
        available=available,
        required=required,
        max_replicates=cap,
        num_outputs=num_outputs,
    )


def _least_k(problem: Problem) -> int:
    """n + 1, or what the required candidates and the span they miss need."""
    p, kept = problem.num_regressors, problem.rows[problem.required]
    if not len(kept):
        return p
    return max(p, len(kept) + p - int(np.linalg.matrix_rank(kept, rtol=1e-9)))


def _region_rows(problem: Problem, region: ArrayLike | None) -> Array:
    """(R, p) regressors of the region in the problem's whitened coordinates."""
    if region is None:
        return problem.rows[problem.available]
    where = numbers("region", region)
    n = problem.num_regressors - 1
    if where.ndim != 2 or where.shape[1] != n or not len(where):
        raise ValueError(f"region must have shape (R, {n}), got {where.shape}")
    assert problem.candidates is not None
    usable = problem.candidates[problem.available]
    centre = usable.mean(axis=0)
    scale = np.abs(usable - centre).max(axis=0)
    ours = np.c_[(usable - centre) / scale, np.ones(len(usable))]
    theirs = np.c_[(where - centre) / scale, np.ones(len(where))]
    # rows = ours @ map, exactly; the map carries the region along.
    transform = np.linalg.lstsq(ours, problem.rows[problem.available], rcond=None)[0]
    return theirs @ transform
