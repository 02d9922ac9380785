"""What is asked of a plan: levels, the problem of measuring all, and the region."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, whole_number
from jaxcal.selection.greedy import greedy_indices
from jaxcal.selection.problem import Problem, make_block_problem, make_problem

__all__ = ["fewest", "level", "whole_problem"]

Array = NDArray[np.float64]


def level(name: str, value: ArrayLike, m: int) -> Array:
    """(m,) positive numbers; a copy that cannot be written to."""
    given = numbers(name, value)
    if given.shape not in ((), (m,)):
        raise ValueError(f"{name} must be one number or ({m},), got {given.shape}")
    if (given <= 0.0).any():
        raise ValueError(f"{name} must be positive, got {given.min():g}")
    own = np.array(np.broadcast_to(given, (m,)))
    own.flags.writeable = False
    return own


def whole_problem(
    candidates: ArrayLike | None,
    blocks: ArrayLike | None,
    region: ArrayLike | None,
    max_replicates: int,
    *,
    prior: ArrayLike | None,
    available: ArrayLike | None,
    **rules: Any,
) -> tuple[Problem, Array]:
    """Measuring all that may be, as often as it may; the region, whitened (R, m, p)."""
    given: Any = candidates if blocks is None else blocks
    shape = np.shape(given)
    cap = whole_number("max_replicates", max_replicates, 1)
    usable = np.ones(shape[:1]) if available is None else available
    k = max(1, int(np.count_nonzero(usable)) * cap)
    rules |= {"available": available, "max_replicates": cap}
    if blocks is None:
        k = max(k, shape[1] + 1) if len(shape) == 2 else k
        problem = make_problem(given, k, **rules)
    else:
        problem = make_block_problem(blocks, k, prior=prior, **rules)
    raw, root, p = problem.raw, problem.root, problem.num_regressors
    # Whitened here, so that the region goes the same way: rows = Q R, basis = R^-1.
    rows = np.vstack([raw[problem.available].reshape(-1, p), root])
    size = np.sqrt((rows**2).sum(axis=0))
    basis = np.linalg.inv(np.linalg.qr(rows / size, mode="r")) / size[:, None]
    white, known = raw @ basis, root @ basis
    white[~problem.available] = 0.0
    problem = dataclasses.replace(problem, blocks=white, prior=known.T @ known)
    if region is None:
        return problem, white[problem.available]
    wanted = numbers("region", region)
    n = p - 1
    if blocks is not None:
        if wanted.ndim != 3 or wanted.shape[2] != p or 0 in wanted.shape:
            raise ValueError(f"region must have shape (R, m, {p}), got {wanted.shape}")
        return problem, wanted @ basis
    if wanted.ndim != 2 or wanted.shape[1] != n or not len(wanted):
        raise ValueError(f"region must have shape (R, {n}), got {wanted.shape}")
    return problem, np.c_[wanted, np.ones(len(wanted))][:, None] @ basis


def fewest(problem: Problem) -> tuple[int, int]:
    """Measurements below which none identify, and the fewest found that do.

    The two differ only where blocks of several rows overlap in what they tell.
    """
    p = problem.num_regressors
    kept = problem.blocks[problem.required].reshape(-1, p)
    known = np.linalg.matrix_rank(np.vstack([kept, problem.prior]), rtol=1e-9)
    most = int(np.linalg.matrix_rank(problem.blocks, rtol=1e-9).max())
    least = k = max(1, len(problem.required) - (-(p - int(known)) // most))
    if problem.blocks.shape[1] > 1:
        while k < problem.k and np.isneginf(
            problem.log_det(greedy_indices(dataclasses.replace(problem, k=k)))
        ):
            k += 1
    return least, k
