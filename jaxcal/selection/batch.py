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
from jaxcal.selection.problem import Found, Problem, log_dets, make_problems
from jaxcal.selection.result import BatchSelection
from jaxcal.selection.solvers import checked_seed, random_indices

__all__ = ["exact_batch", "exchange_batch", "greedy_batch", "random_batch"]


def random_batch(
    candidates: ArrayLike, k: int, *, seed: int = 0, **rules: Any
) -> BatchSelection:
    """A random selection per set, never singular; one seed draws the whole batch."""
    rng = np.random.default_rng(checked_seed(seed))

    def solve(problems: list[Problem]) -> list[Found]:
        return [Found(drawn) for drawn in random_indices(problems, rng)[0]]

    return _solve("random", solve, candidates, k, rules)


def greedy_batch(candidates: ArrayLike, k: int, **rules: Any) -> BatchSelection:
    """Greedy from nothing, or from the partial selections in ``required``."""

    def solve(problems: list[Problem]) -> list[Found]:
        return list(map(exchange.solve_greedy, problems))

    return _solve("greedy", solve, candidates, k, rules)


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

    def solve(problems: list[Problem]) -> list[Found]:
        return _in_threads(
            lambda one: exchange.solve(one, seed=seed, restarts=restarts), problems
        )

    return _solve("exchange", solve, candidates, k, rules)


def exact_batch(
    candidates: ArrayLike, k: int, *, time_limit: float | None = None, **rules: Any
) -> BatchSelection:
    """The proven optimum of every set.

    ``time_limit`` is in seconds for the whole batch, after which the remaining sets
    return the best found with ``proven`` False; there is no limit when it is None.
    """
    deadline = None if time_limit is None else time.perf_counter() + time_limit

    def solve(problems: list[Problem]) -> list[Found]:
        # Of a simplex most is the hull, which keeps other threads waiting.
        each = map if problems[0].simplex else _in_threads
        return list(each(lambda one: solve_exact(one, deadline=deadline), problems))

    return _solve("exact", solve, candidates, k, rules)


def _in_threads(
    solve: Callable[[Problem], Found], problems: list[Problem]
) -> list[Found]:
    """On every core: compiled solvers release the interpreter."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(problems))) as pool:
        return list(pool.map(solve, problems))


def _solve(
    method: str,
    solve: Callable[[list[Problem]], list[Found]],
    candidates: ArrayLike,
    k: int,
    rules: dict[str, Any],
) -> BatchSelection:
    start = time.perf_counter()
    problems = make_problems(candidates, k, **rules)
    found = solve(problems)
    indices = np.stack([one.indices for one in found])
    values = log_dets(problems, indices)
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
