"""The solvers over many candidate sets (B, M, n) at once; by keyword ``available`` (B,
M) bool, ``required`` (B, r), ``max_replicates`` and ``num_outputs``, as ``select``.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Indices, whole_number
from jaxcal.deadline import NEVER, Deadline
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange import exchange
from jaxcal.selection.problem import Problem, Solution, log_dets, make_problems
from jaxcal.selection.solvers import checked_seed, random_indices


@dataclasses.dataclass(frozen=True, eq=False)
class BatchSelection:
    """One selection per candidate set."""

    indices: Indices  # (B, k)
    log_det: NDArray[np.float64]  # (B,) natural log det S
    proven: NDArray[np.bool_]  # (B,)
    bound: NDArray[np.float64]  # (B,) upper bound on log det S, inf where none is known
    nodes: Indices  # (B,) nodes examined, 0 where not counted
    method: str
    seconds: float  # wall time of the whole batch


def random_batch(
    candidates: ArrayLike, k: int, *, seed: int = 0, **rules: Any
) -> BatchSelection:
    """A random selection per set, never singular; one seed draws the whole batch."""
    rng = np.random.default_rng(checked_seed(seed))

    def solve(problems: list[Problem]) -> list[Solution]:
        return list(map(Solution, random_indices(problems, rng)[0]))

    return _solved("random", solve, candidates, k, rules)


def greedy_batch(candidates: ArrayLike, k: int, **rules: Any) -> BatchSelection:
    """Greedy from nothing, or from the partial selections in ``required``."""
    solve = functools.partial(map, exchange.solve_greedy)
    return _solved("greedy", solve, candidates, k, rules)


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
    one = functools.partial(exchange.solve, seed=checked_seed(seed), restarts=restarts)
    solve = functools.partial(_in_threads, one)
    return _solved("exchange", solve, candidates, k, rules)


def exact_batch(
    candidates: ArrayLike, k: int, *, time_limit: float | None = None, **rules: Any
) -> BatchSelection:
    """The proven optimum of every set; ``time_limit``: seconds for the whole batch,
    after which the remaining sets return the best found with ``proven`` False."""
    deadline = NEVER if time_limit is None else Deadline(time_limit)
    one = functools.partial(solve_exact, deadline=deadline)

    def solve(problems: list[Problem]) -> Iterable[Solution]:
        # Of a simplex most is the hull, which keeps other threads waiting.
        return (map if problems[0].simplex else _in_threads)(one, problems)

    return _solved("exact", solve, candidates, k, rules)


def _in_threads(
    solve: Callable[[Problem], Solution], problems: list[Problem]
) -> Iterable[Solution]:
    """On every core: compiled solvers release the interpreter."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(problems))) as pool:
        return list(pool.map(solve, problems))


def _solved(
    method: str,
    solve: Callable[[list[Problem]], Iterable[Solution]],
    candidates: ArrayLike,
    k: int,
    rules: dict[str, Any],
) -> BatchSelection:
    start = time.perf_counter()
    problems = make_problems(candidates, k, **rules)
    solutions = list(solve(problems))
    indices = np.stack([one.indices for one in solutions])
    values = log_dets(problems, indices)
    singular = np.flatnonzero(np.isneginf(values))
    if singular.size:
        raise ValueError(
            f"candidates of set {singular[0]} allow no invertible selection: {method} "
            f"ended in one plane at {indices[singular[0]].tolist()}"
        )
    proven = np.array([one.proven for one in solutions])
    bounds = np.array([np.inf if x.bound is None else x.bound for x in solutions])
    nodes, spent = np.array([x.nodes or 0 for x in solutions]), time.perf_counter()
    return BatchSelection(indices, values, proven, bounds, nodes, method, spent - start)
