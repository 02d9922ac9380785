"""The solvers over many candidate sets at once, for labels and evaluation.

Each function takes candidates (B, M, n) and k, and by keyword ``available`` (B, M)
bool, ``required`` (B, r), ``max_replicates`` and ``num_outputs`` as ``select`` does.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import whole_number
from jaxcal.selection.problem import log_dets, make_problems
from jaxcal.selection.result import BatchSelection
from jaxcal.selection.solvers import SOLVERS, checked_seed

__all__ = ["exact_batch", "exchange_batch", "greedy_batch", "random_batch"]


def random_batch(
    candidates: ArrayLike, k: int, *, seed: int = 0, **rules: Any
) -> BatchSelection:
    """A random selection per set, never singular; one seed draws the whole batch."""
    return _solve("random", candidates, k, rules, seed=checked_seed(seed))


def greedy_batch(candidates: ArrayLike, k: int, **rules: Any) -> BatchSelection:
    """Greedy from nothing, or from the partial selections in ``required``."""
    return _solve("greedy", candidates, k, rules)


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
    options = {"restarts": restarts, "seed": checked_seed(seed)}
    return _solve("exchange", candidates, k, rules, **options)


def exact_batch(
    candidates: ArrayLike, k: int, *, time_limit: float | None = None, **rules: Any
) -> BatchSelection:
    """The proven optimum of every set.

    ``time_limit`` is in seconds for the whole batch, after which the remaining sets
    return the best found with ``proven`` False; there is no limit when it is None.
    """
    return _solve("exact", candidates, k, rules, time_limit=time_limit)


def _solve(
    method: str, candidates: ArrayLike, k: int, rules: dict[str, Any], **options: Any
) -> BatchSelection:
    start = time.perf_counter()
    problems = make_problems(candidates, k, **rules)
    solver = SOLVERS[method]
    if solver.solve_many is None:
        found = [solver.solve(problem, **options) for problem in problems]
    else:
        found = solver.solve_many(problems, **options)
    indices = np.stack([one.indices for one in found])
    if found[0].value is None:
        values = log_dets(problems, indices[:, None])[:, 0]
    else:
        values = np.array([one.value for one in found])
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
