"""The solvers over many candidate sets at once, for labels and evaluation.

Each function takes candidates (B, M, n) and k, and by keyword ``available`` (B, M)
bool, ``required`` (B, r), ``max_replicates`` and ``num_outputs`` as ``select`` does.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import whole_number
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange import exchange
from jaxcal.selection.problem import Found, Problem, make_problems
from jaxcal.selection.result import BatchSelection
from jaxcal.selection.solvers import checked_seed, solve_random

__all__ = ["exact_batch", "exchange_batch", "greedy_batch", "random_batch"]


def random_batch(
    candidates: ArrayLike, k: int, *, seed: int = 0, **rules: Any
) -> BatchSelection:
    """A random selection per set, never singular; one seed draws the whole batch."""
    rng = np.random.default_rng(checked_seed(seed))
    return _solve(
        "random", lambda problem: solve_random(problem, seed=rng), candidates, k, rules
    )


def greedy_batch(candidates: ArrayLike, k: int, **rules: Any) -> BatchSelection:
    """Greedy from nothing, or from the partial selections in ``required``."""
    return _solve("greedy", exchange.solve_greedy, candidates, k, rules)


def exchange_batch(
    candidates: ArrayLike,
    k: int,
    *,
    restarts: int | None = None,
    seed: int = 0,
    **rules: Any,
) -> BatchSelection:
    """Fedorov exchange from ``restarts`` random starts, the same seed in every set."""
    if restarts is not None:
        restarts = whole_number("restarts", restarts, 1)
    seed = checked_seed(seed)

    def solve(problem: Problem) -> Found:
        return exchange.solve(problem, seed=seed, restarts=restarts)

    return _solve("exchange", solve, candidates, k, rules, threads=True)


def exact_batch(
    candidates: ArrayLike, k: int, *, time_limit: float | None = None, **rules: Any
) -> BatchSelection:
    """The proven optimum of every set.

    ``time_limit`` is in seconds for the whole batch, after which the remaining sets
    return the best found with ``proven`` False; there is no limit when it is None.
    """
    deadline = None if time_limit is None else time.perf_counter() + time_limit

    def solve(problem: Problem) -> Found:
        return solve_exact(problem, deadline=deadline)

    return _solve("exact", solve, candidates, k, rules, threads=True)


def _solve(
    method: str,
    solve: Callable[[Problem], Found],
    candidates: ArrayLike,
    k: int,
    rules: dict[str, Any],
    threads: bool = False,
) -> BatchSelection:
    start = time.perf_counter()
    problems = make_problems(candidates, k, **rules)
    # Compiled solvers release the interpreter; of a simplex most is the hull, which
    # keeps other threads waiting.
    if (
        threads
        and len(problems) > 1
        and not (method == "exact" and problems[0].simplex)
    ):
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            found = list(pool.map(solve, problems))
    else:
        found = [solve(problem) for problem in problems]
    indices = np.stack([one.indices for one in found])
    values = np.array(
        [
            problem.log_det(one.indices) if one.value is None else one.value
            for problem, one in zip(problems, found, strict=True)
        ]
    )
    singular = np.flatnonzero(np.isneginf(values))
    if singular.size:
        raise ValueError(
            f"candidates of set {singular[0]} must allow an invertible selection, but "
            f"{method} ended in one plane at {indices[singular[0]].tolist()}"
        )
    return BatchSelection(
        indices=indices,
        log_det=values,
        proven=np.array([one.proven for one in found]),
        bound=np.array([np.inf if one.bound is None else one.bound for one in found]),
        nodes=np.array([one.nodes or 0 for one in found]),
        method=method,
        seconds=time.perf_counter() - start,
    )
