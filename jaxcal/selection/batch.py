"""The solvers over many candidate sets at once, for labels and evaluation."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.information.regression import log_det_information
from jaxcal.selection.exact.exact import ExactResult, solve_exact
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.greedy import greedy_rows
from jaxcal.selection.problem import Problem, make_problems, whole_number
from jaxcal.selection.random import random_indices
from jaxcal.selection.result import BatchSelection

__all__ = ["exact_batch", "exchange_batch", "greedy_batch", "random_batch"]

T = TypeVar("T")


def random_batch(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    seed: int = 0,
) -> BatchSelection:
    """A random selection a set, never singular.

    Args:
        candidates: (B, M, n).
        k: postures a set.
        available: (B, M) bool, True where a candidate may be chosen.
        required: (B, r) candidates that must be chosen.
        max_replicates: how often one candidate may be chosen.
        num_outputs: m; as many as inputs when not given.
        seed: one seed draws the whole batch.
    """
    start = time.perf_counter()
    problems = make_problems(
        candidates,
        k,
        available=available,
        required=required,
        max_replicates=max_replicates,
        num_outputs=num_outputs,
    )
    rng = np.random.default_rng(whole_number("seed", seed, 0))
    indices = np.stack([random_indices(problem, rng) for problem in problems])
    return _unproven(problems, indices, "random", start)


def greedy_batch(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> BatchSelection:
    """Greedy from nothing, or from the partial selections in ``required``.

    Args: those of :func:`random_batch`.
    """
    start = time.perf_counter()
    problems = make_problems(
        candidates,
        k,
        available=available,
        required=required,
        max_replicates=max_replicates,
        num_outputs=num_outputs,
    )
    indices = greedy_rows(
        np.stack([problem.rows for problem in problems]),
        np.stack([problem.upper for problem in problems]),
        problems[0].k,
        np.stack([problem.required for problem in problems]),
    )
    return _unproven(problems, indices, "greedy", start)


def exchange_batch(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    restarts: int | None = None,
    seed: int = 0,
) -> BatchSelection:
    """Fedorov exchange, the same seed in every set.

    Args: those of :func:`random_batch`, and the random starts a set.
    """
    start = time.perf_counter()
    if restarts is not None:
        restarts = whole_number("restarts", restarts, 1)
    seed = whole_number("seed", seed, 0)
    problems = make_problems(
        candidates,
        k,
        available=available,
        required=required,
        max_replicates=max_replicates,
        num_outputs=num_outputs,
    )
    found = _over(problems, lambda problem: exchange_indices(problem, restarts, seed))
    return _unproven(problems, np.stack(found), "exchange", start)


def exact_batch(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    time_limit: float | None = None,
) -> BatchSelection:
    """The proven optimum of every set.

    Args: those of :func:`random_batch`, and seconds for the whole batch, after which
        the remaining sets return the best found with ``proven`` False.
    """
    start = time.perf_counter()
    problems = make_problems(
        candidates,
        k,
        available=available,
        required=required,
        max_replicates=max_replicates,
        num_outputs=num_outputs,
    )
    deadline = None if time_limit is None else start + time_limit
    found: list[ExactResult] = _over(
        problems, lambda problem: solve_exact(problem, deadline=deadline)
    )
    indices = np.stack([result.subsets[0] for result in found])
    return BatchSelection(
        indices=indices,
        log_det=np.array([result.log_dets[0] for result in found]),
        proven=np.array([result.proven for result in found]),
        bound=np.array([result.bound for result in found]),
        nodes=np.array([result.nodes for result in found]),
        method="exact",
        seconds=time.perf_counter() - start,
    )


def _over(problems: list[Problem], solve: Callable[[Problem], T]) -> list[T]:
    """Solve every set; compiled solvers release the interpreter, so threads help."""
    if len(problems) == 1 or problems[0].k == problems[0].num_regressors:
        return [solve(problem) for problem in problems]
    first = solve(problems[0])  # compiles once, before the threads start
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return [first, *pool.map(solve, problems[1:])]


def _log_dets(
    problems: list[Problem], indices: NDArray[np.int64], method: str
) -> NDArray[np.float64]:
    candidates = np.stack([problem.candidates for problem in problems])
    chosen = np.take_along_axis(candidates, indices[..., None], axis=1)
    values = np.asarray(log_det_information(chosen, problems[0].num_outputs))
    singular = np.flatnonzero(np.isneginf(values))
    if singular.size:
        raise ValueError(
            f"candidates of set {singular[0]} must allow an invertible selection, but "
            f"{method} ended in one plane at {indices[singular[0]].tolist()}"
        )
    return values


def _unproven(
    problems: list[Problem], indices: NDArray[np.int64], method: str, start: float
) -> BatchSelection:
    log_det = _log_dets(problems, indices, method)
    size = len(problems)
    return BatchSelection(
        indices=indices,
        log_det=log_det,
        proven=np.zeros(size, dtype=np.bool_),
        bound=np.full(size, np.inf),
        nodes=np.zeros(size, dtype=np.int64),
        method=method,
        seconds=time.perf_counter() - start,
    )
