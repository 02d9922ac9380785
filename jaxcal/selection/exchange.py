"""Fedorov exchange with random restarts: near-optimal in milliseconds, no proof.

Each start is a random selection that is not singular; each chosen posture in turn is
swapped for the candidate that raises det most, ``(1 + d_j)(1 - d_i) + d_ij^2`` times,
until no swap helps. Source: Fedorov, Theory of Optimal Experiments, 1972; Cook and
Nachtsheim 1980 for one posture at a time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.problem import Problem

__all__ = ["DEFAULT_RESTARTS", "exchange_from", "exchange_indices"]

DEFAULT_RESTARTS = 200


def exchange_indices(
    problem: Problem, restarts: int = DEFAULT_RESTARTS, seed: int = 0
) -> NDArray[np.int64]:
    """(k,) the best local optimum, required candidates first."""
    from jaxcal.selection.exchange_kernel import exchange_starts

    usable = np.flatnonzero(problem.available)
    rows = np.ascontiguousarray(problem.rows[usable])
    chosen, log_det, _ = exchange_starts(
        rows,
        np.ascontiguousarray(rows.T),
        problem.upper[usable],
        np.searchsorted(usable, problem.required),
        problem.k,
        restarts,
        np.uint64(seed % 2**64),
    )
    if not np.isfinite(log_det):
        raise ValueError(
            "candidates must allow an invertible selection, "
            "but every start was singular"
        )
    return usable[chosen]


def exchange_from(problem: Problem, indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """(k,) the local optimum that a given selection climbs to.

    Args:
        problem: what may be chosen; its required candidates stay.
        indices: (k,) where to start, required candidates first.
    """
    from jaxcal.selection.exchange_kernel import climb

    p = problem.num_regressors
    chosen = np.array(indices, dtype=np.int64)
    climb(
        problem.rows,
        np.ascontiguousarray(problem.rows.T),
        problem.upper,
        len(problem.required),
        chosen,
        np.bincount(chosen, minlength=len(problem.rows)),
        np.empty((p, p)),
        np.empty((p, p)),
    )
    return chosen
