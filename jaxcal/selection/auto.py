"""The cheapest way to an answer that is proven good enough.

Small problems are solved to the proven optimum. On larger ones the exact search stops
as soon as its bound proves the best selection found (by exchange, at first) to have
``least_efficiency``; the bound at the root of the search often does. JAX is not used.
"""

from __future__ import annotations

import time

from jaxcal.selection.exact.exact import (
    STARTING_RESTARTS,
    TIME_LIMIT,
    as_found,
    solve_exact,
)
from jaxcal.selection.problem import Problem
from jaxcal.selection.solver import Found

__all__ = ["solve"]

_BLOCKS_LIMIT = 2.0  # seconds: what is not proven by then often takes minutes


def solve(
    problem: Problem,
    *,
    seed: int,
    restarts: int | None,
    time_limit: float | None,
    least_efficiency: float,
) -> Found:
    """The solver "auto"; where no time limit is given 10 s, 2 s on blocks.

    The answer's ``method`` is "exact" where the search was run to its end or its time
    limit, "exchange" where the bound proved enough before.
    """
    limit = time_limit or (TIME_LIMIT if problem.rank_one else _BLOCKS_LIMIT)
    restarts = restarts or STARTING_RESTARTS
    deadline = time.perf_counter() + limit
    result = solve_exact(problem, 1, deadline, restarts, seed, least_efficiency)
    name = f"{problem.criterion.name}-efficiency"
    proven_share = problem.criterion.efficiency(float(result.values[0]), result.bound)
    close = proven_share >= least_efficiency
    if result.proven:
        reason = "the exact search proved this optimum"
    elif close:
        reason = (
            f"the bound proves a {name} of at least {proven_share:.6f}, and "
            f"{least_efficiency:g} was asked for"
        )
    else:
        reason = (
            f"the exact search ran out of time after {limit:g} s with a {name} "
            f"of at least {proven_share:.6f} proven; {least_efficiency:g} was asked for"
        )
    stopped = not result.proven and close and not result.rounding
    return as_found(
        result,
        method="exchange" if stopped else "exact",
        reason=reason,
        seed=seed,
        restarts=restarts,
    )
