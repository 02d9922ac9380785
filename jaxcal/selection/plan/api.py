"""How many measurements a wanted accuracy takes, with a table to judge it by.

With noise of standard deviation sigma on an output, the fitted model predicts that
output at z = [u, 1] with the standard error ``sigma sqrt(z.T G^-1 z)``, G = Z.T Z of
the postures measured; likewise any model, z a row of its derivative and G the
information in units of the noise. Two summaries over the region of interest:

- ``"G"``: the largest standard error anywhere in the region;
- ``"I"``: the root of the mean variance over the region (I-optimality's average).

The standard errors of the parameters are those of a region of unit vectors.

For each K ``designs`` looks for a good design and ``bound`` says what no design of K
measurements beats. The K returned is proven the smallest where the bound of K - 1 lies
above the target. Source: Atkinson, Donev and Tobias, Optimum Experimental Designs.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import one_of, seconds, whole_number
from jaxcal.selection.plan.bound import lower_bound, region_weighting
from jaxcal.selection.plan.designs import Design, best_design, variances_of
from jaxcal.selection.plan.request import fewest, make_request
from jaxcal.selection.problem import Asked
from jaxcal.selection.solvers import checked_seed

__all__ = ["Plan", "PlanRow", "make_plan"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DESIGNS = ("exact", "exchange")

_SUMMARIES = {"G": "largest", "I": "average", "parameters": "largest"}
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
    accuracy: Array  # (m,) measured unit
    noise_std: Array | None  # one an output, measured unit; None where Noise says more
    names: tuple[str, ...]  # (m,) of the parameters, or output 1, ...
    criterion: str  # "G", "I" or "parameters"
    smallest_proven: bool  # no design of fewer measurements reaches the target
    rows: tuple[PlanRow, ...]  # every K tried, in order
    seconds: float

    @property
    def summary(self) -> str:
        """The criterion in a word."""
        return _SUMMARIES[self.criterion]

    @property
    def hardest_output(self) -> int:
        """The output, or parameter, that is furthest from its target."""
        return int((self.standard_error / self.accuracy).argmax())

    def worst(self, errors: Array) -> float:
        """Largest of (m,) errors over their targets, times that of the hardest output.

        Where the targets are equal, the largest error.
        """
        share = (errors / self.accuracy).max()
        return float(share * self.accuracy[self.hardest_output])

    def __str__(self) -> str:
        return self.table()

    def table(self) -> str:
        """K against accuracy, a line each, of the output that is furthest from it."""
        worst = self.hardest_output
        what = f"{self.summary} standard error of a prediction, {self.names[worst]}"
        if self.criterion == "parameters":
            what = f"standard error of parameter {self.names[worst]}"
        elif self.noise_std is not None:
            what += f", noise {self.noise_std[worst]:g}"
        lines = [
            f"{what}, target {self.accuracy[worst]:g}",
            "   K  distinct  standard error  no design below  D-optimal     design",
        ]
        for row in self.rows:
            kind = row.method + (", proven D-optimal" if row.proven else "")
            mark = " <-" if row.k == self.k else ""
            lines.append(
                f"{row.k:4d} {row.num_distinct:9d} "
                f"{self.worst(row.standard_error):15.6g} "
                f"{self.worst(row.least_error):16.6g} "
                f"{self.worst(row.d_optimal_error):10.6g}   {kind}{mark}"
            )
        proof = "proven" if self.smallest_proven else "not proven to be"
        return "\n".join([*lines, f"K = {self.k} is {proof} the smallest"])


def make_plan(
    asked: Asked,
    accuracy: ArrayLike,
    noise_std: ArrayLike | None,
    criterion: str,
    parameters: Any,
    region: ArrayLike | None,
    *,
    max_k: int | None,
    more: int,
    design: str,
    time_limit: float,
    seed: int | np.random.Generator,
) -> Plan:
    """See :meth:`jaxcal.Design.plan`."""
    begun = time.perf_counter()
    one_of("criterion", criterion, tuple(_SUMMARIES))
    one_of("design", design, DESIGNS)
    limit = seconds("time_limit", time_limit)
    more, start = whole_number("more", more, 0), checked_seed(seed)
    how = "I" if criterion == "I" else "G"
    problem, points, unit, target, level, names = make_request(
        asked, criterion, accuracy, noise_std, parameters, region
    )
    total, (identify, least_k) = problem.k, fewest(problem)
    if max_k is None:
        max_k = min(total, max(_LARGEST_K, least_k))
    max_k = whole_number("max_k", max_k, least_k)
    if max_k > total:
        raise ValueError(
            f"max_k must not exceed the {total} measurements allowed, got {max_k}"
        )
    weighting = region_weighting(points, how)

    @functools.cache
    def bound_of(k: int) -> float:
        if k == total:  # there is one design only
            every = np.repeat(np.arange(len(problem.blocks)), problem.upper)
            return float(variances_of(problem, every, points, how).max())
        return lower_bound(problem, weighting, k)

    def design_of(k: int, kind: str, previous: Indices | None) -> Design:
        one = dataclasses.replace(problem, k=k)
        return best_design(one, points, how, kind, limit, previous, start)

    def enough(found: Design) -> bool:
        return bool(found.variance.max() <= 1 + 1e-12)

    rows: list[PlanRow] = []
    chosen: PlanRow | None = None
    last: Design | None = None
    if bound_of(max_k) <= 1 + 1e-12:  # else no K allowed is enough
        for k in range(least_k, max_k + 1):
            last = design_of(k, design, None if last is None else last.indices)
            rows.append(
                PlanRow(
                    k=k,
                    indices=last.indices,
                    standard_error=unit * np.sqrt(last.variance),
                    least_error=unit * np.sqrt(min(bound_of(k), last.variance.max())),
                    method=last.method,
                    proven=last.proven,
                    d_optimal_error=unit * np.sqrt(last.d_optimal),
                )
            )
            if chosen is None and enough(last):
                chosen = rows[-1]
            if chosen is not None and k >= chosen.k + more:
                break
    if chosen is None:
        last = last or design_of(max_k, "exchange", None)
        one = int((unit * np.sqrt(last.variance) / target).argmax())
        best, least = unit[one] * np.sqrt([last.variance.max(), bound_of(max_k)])
        raise ValueError(
            f"accuracy must be reachable with max_k = {max_k} measurements"
            + (" (all that are allowed)" if max_k == total else "")
            + f": the best design found has a {_SUMMARIES[criterion]} standard error "
            f"of {best:.6g}, no design has less than {least:.6g}, got {target[one]:g}"
        )
    return Plan(
        k=chosen.k,
        indices=chosen.indices,
        standard_error=chosen.standard_error,
        accuracy=target,
        noise_std=level,
        names=names,
        criterion=criterion,
        smallest_proven=chosen.k == identify or bound_of(chosen.k - 1) > 1.0,
        rows=tuple(rows),
        seconds=time.perf_counter() - begun,
    )
