"""The policy, held to a proof: its answer where that is good enough, else the optimum.

One pass of the policy is checked against the cheapest upper bound (the optimum itself
for k = n + 1, the concave relaxation above). Where the D-efficiency against that bound
is at least the one asked for, the policy answers; otherwise the exact search does. The
relaxation can hide a perfect pick behind a loose bound: the exact search then says so.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.criteria import d_efficiency
from jaxcal.selection.exact.exact import (
    STARTING_RESTARTS,
    ExactResult,
    solve_exact,
    upper_bound,
)
from jaxcal.selection.problem import Problem
from jaxcal.selection.result import Selection, Subset

__all__ = ["AutoSelection", "check_least_efficiency", "solve_auto"]

Indices = NDArray[np.int64]

_PROVEN = 1e-9  # log det S this near an upper bound is the optimum


@dataclasses.dataclass(frozen=True, eq=False)
class AutoSelection(Selection):
    """A selection, and why it is the policy's or the exact one.

    ``method`` is "policy" or "exact", whichever answered.
    """

    reason: str = ""  # one sentence
    policy_log_det: float | None = None  # of the policy's pick; None where singular


def check_least_efficiency(value: Any) -> float:
    """``value`` as a float in (0, 1], or a ValueError naming it."""
    number = isinstance(value, int | float | np.integer | np.floating)
    if not number or isinstance(value, bool) or not 0.0 < value <= 1.0:
        raise ValueError(f"least_efficiency must be in (0, 1], got {value!r}")
    return float(value)


def solve_auto(
    problem: Problem,
    pick: Callable[[], Indices],
    least_efficiency: float,
    reference: str = "bound",
    time_limit: float | None = None,
    restarts: int = STARTING_RESTARTS,
    seed: int = 0,
) -> AutoSelection:
    """The policy's pick where it is efficient enough, else the proven optimum.

    Args:
        problem: what to choose from.
        pick: the policy's (k,) indices for this problem.
        least_efficiency: D-efficiency in (0, 1] the policy must prove to answer.
        reference: what it is proven against: "bound", the cheapest upper bound, or
            "exact", the proven optimum, which costs the exact search every time.
        time_limit: seconds for the exact search; when it runs out the better of the two
            answers comes back, with ``proven`` False and an honest bound.
        restarts, seed: of the exchange that starts the exact search.

    Returns:
        The selection. ``efficiency`` is at least ``least_efficiency`` unless the time
        ran out, and ``reason`` says so then.
    """
    start = time.perf_counter()

    def search() -> ExactResult:
        deadline = None if time_limit is None else time.perf_counter() + time_limit
        return solve_exact(problem, 1, deadline, restarts, seed)

    def answer(log_det: float, bound: float, proven: bool, **record: Any) -> Any:
        indices = record["indices"]
        return AutoSelection(
            log_det=log_det,
            known_bound=bound,
            proven=proven,
            seconds=time.perf_counter() - start,
            alternatives=(Subset(indices, log_det),),
            problem=problem,
            policy_log_det=None if np.isneginf(value) else value,
            **record,
        )

    picked, value, bound = None, -np.inf, np.inf
    found = search() if reference == "exact" else None
    if problem.max_replicates > 1:
        why = "the policy picks distinct postures, and replicates were asked for"
    else:
        picked = pick()
        value = problem.log_det(picked)
        known = upper_bound(problem) if found is None else found.bound
        bound = max(known, value)
        parameters = problem.num_outputs * problem.num_regressors
        share = d_efficiency(value, bound, parameters)
        if value >= bound - _PROVEN:
            why = "the policy reaches the upper bound, so its pick is optimal"
            return answer(
                value, bound, True, indices=picked, method="policy", reason=why
            )
        if share >= least_efficiency:
            why = (
                f"the policy has a D-efficiency of at least {share:.6f}, and "
                f"{least_efficiency:g} was asked for"
            )
            return answer(
                value, bound, False, indices=picked, method="policy", reason=why
            )
        why = (
            "the policy's pick is singular"
            if np.isneginf(value)
            else f"the policy's D-efficiency is proven to be {share:.6f} only, and "
            f"{least_efficiency:g} was asked for"
        )
    found = found or search()
    best = float(found.log_dets[0])
    if found.proven:
        bound, end = max(best, value), "the exact search proved this optimum"
    else:
        bound = max(min(bound, found.bound), best, value)
        end = "the exact search ran out of time, this is the best found"
    if picked is not None and value >= best - _PROVEN:
        return answer(
            value,
            bound,
            found.proven,
            indices=picked,
            method="policy",
            nodes=found.nodes,
            reason=f"{why}; {end}, the policy's own",
        )
    return answer(
        best,
        bound,
        found.proven,
        indices=found.subsets[0],
        method="exact",
        nodes=found.nodes,
        seed=seed,
        restarts=restarts,
        reason=f"{why}; {end}",
    )
