"""One call for every solver: ``select``, and ``score`` for subsets made elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import one_of, seconds
from jaxcal.selection.exact.exact import TIME_LIMIT, solve_exact
from jaxcal.selection.problem import Problem, make_block_problem, make_problem
from jaxcal.selection.result import Selection, Subset
from jaxcal.selection.solver import Found
from jaxcal.selection.solvers import SOLVERS, checked_options

__all__ = ["score", "select"]

_REFERENCES = ("bound", "exact")
_PROVEN = 1e-9  # log det S this near a proven optimum is that optimum


def select(
    candidates: ArrayLike | None = None,
    k: int | None = None,
    method: str = "auto",
    *,
    blocks: ArrayLike | None = None,
    prior: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    reference: str = "bound",
    seed: int | np.random.Generator = 0,
    restarts: int | None = None,
    time_limit: float | None = None,
    best: int = 1,
    least_efficiency: float = 0.999,
    checkpoint: Any = None,
    decoding: str = "greedy",
    num: int = 16,
) -> Selection:
    """Choose the k candidates whose information matrix has the largest determinant.

    Args:
        candidates: (M, n) commands that could be measured, in any unit, of the affine
            model ``y = A u + b``; an array or a data frame, whose labels are kept. Rows
            that are not available may hold NaN.
        k: candidates to choose; the fewest that identify (n + 1) when not given.
        method: "auto" (the cheapest way to an answer proven to have
            ``least_efficiency``), "exact" (proven), "exchange" (near-optimal),
            "greedy", "random" or "policy" (the trained network).
        blocks: (M, q, p) instead of candidates, for any model: candidate i gives q
            readings ``B_i theta`` with noise of unit variance.
        prior: with blocks, (p, p) precision of what is known of theta beforehand.
        names: (M,) names of the candidates, for the answer.
        available: (M,) bool, True where a candidate may be chosen; all when not given.
        required: (r,) candidates that must be among the chosen.
        max_replicates: how often one candidate may be chosen; 1 keeps them distinct.
        num_outputs: m, as many as inputs when not given; log det S is m times that of
            the (n + 1) x (n + 1) matrix. With blocks, how often log det counts, 1.
        reference: what ``bound`` and ``efficiency`` are measured against, "bound" (the
            cheapest upper bound, computed when read) or "exact" (the proven optimum).
        seed: whole number or numpy Generator; of all methods but greedy.
        restarts: random starts of exchange (200, or 400 with replicates, when not
            given), and of the one that starts exact and auto (30).
        time_limit: seconds after which exact and auto return the best found with a true
            ``bound``, not proven; 10 when not given, ``math.inf`` for none.
        best: of exact, how many best subsets to prove, in ``alternatives``.
        least_efficiency: of auto, the D-efficiency in (0, 1] that suffices.
        checkpoint: of policy, folder of a trained one; that which ships when not given.
        decoding: of policy, how it chooses, see ``jaxcal.selection.policy``.
        num: of policy, decodings tried, where ``decoding`` tries several.

    Returns:
        The selection; never a singular one.

    Raises:
        ValueError: naming the argument, the rule and the value; also where an option is
            given that the method does not read.
    """
    one_of("reference", reference, _REFERENCES)
    given = {
        "seed": seed, "restarts": restarts, "time_limit": time_limit, "best": best,
        "least_efficiency": least_efficiency, "checkpoint": checkpoint,
        "decoding": decoding, "num": num,
    }  # fmt: skip
    also = ("time_limit",) if reference == "exact" else ()
    options = checked_options(method, given, also)
    start = time.perf_counter()
    rules: dict[str, Any] = {
        "available": available,
        "required": required,
        "max_replicates": max_replicates,
        "num_outputs": num_outputs,
    }
    if (candidates is None) == (blocks is None):
        got = "neither" if blocks is None else "both"
        raise ValueError(f"either candidates or blocks must be given, got {got}")
    axes = None
    if blocks is not None:
        problem = make_block_problem(blocks, k, prior=prior, **rules)
    elif prior is not None:
        raise ValueError("prior must come with blocks, whose parameters it is about")
    else:
        names, axes = _labels(candidates, names)
        problem = make_problem(candidates, k, **rules)  # type: ignore[arg-type]  # not None
    names = _checked_names(names, len(problem.blocks))
    found = SOLVERS[method].solve(problem, **options)
    return _selection(
        problem, found, method, start, reference, time_limit, names=names, axes=axes
    )


def score(
    candidates: ArrayLike,
    indices: ArrayLike,
    *,
    available: ArrayLike | None = None,
    num_outputs: int | None = None,
    reference: str = "bound",
    max_replicates: int | None = None,
    time_limit: float | None = None,
) -> Selection:
    """Judge a subset made elsewhere as if a solver had returned it.

    Args:
        candidates: (M, n), in any unit; an array or a data frame.
        indices: (k,) the subset; repeated entries are replicates.
        available: (M,) bool, True where a candidate could have been chosen.
        num_outputs: m; as many as inputs when not given.
        reference: "bound" or "exact", as in :func:`select`.
        max_replicates: the cap that the optimum is allowed; as often as the subset
            repeats a candidate when not given.
        time_limit: seconds for ``reference="exact"``, 10 when not given.

    Raises:
        ValueError: also where the subset is singular.
    """
    one_of("reference", reference, _REFERENCES)
    if time_limit is not None:
        seconds("time_limit", time_limit)
    start = time.perf_counter()
    subset = np.asarray(indices)
    if subset.ndim != 1 or not np.issubdtype(subset.dtype, np.integer):
        raise ValueError(
            "indices must be a (k,) array of whole numbers, got shape "
            f"{subset.shape} and dtype {subset.dtype}"
        )
    if len(subset) == 0:
        raise ValueError("indices must name at least n + 1 candidates, got none")
    num_candidates = len(np.atleast_1d(np.asarray(candidates, dtype=object)))
    outside = (subset < 0) | (subset >= num_candidates)
    if outside.any():
        raise ValueError(
            f"indices must lie in [0, {num_candidates}), got {subset[outside][0]}"
        )
    repeats = int(np.unique(subset, return_counts=True)[1].max())
    names, axes = _labels(candidates, None)
    problem = make_problem(
        candidates,
        len(subset),
        available=available,
        max_replicates=repeats if max_replicates is None else max_replicates,
        num_outputs=num_outputs,
    )
    if repeats > problem.max_replicates:
        raise ValueError(
            f"indices must repeat a candidate at most {problem.max_replicates} times, "
            f"got {repeats}"
        )
    subset = subset.astype(np.int64)
    if not problem.available[subset].all():
        masked = subset[~problem.available[subset]][0]
        raise ValueError(f"indices must be available, got {masked}, which is masked")
    found = Found(subset)
    return _selection(
        problem, found, "score", start, reference, time_limit, names=names, axes=axes
    )


def _selection(
    problem: Problem,
    found: Found,
    method: str,
    start: float,
    reference: str,
    time_limit: float | None,
    **labels: tuple[str, ...] | None,
) -> Selection:
    """Judge what a solver found; with ``reference="exact"`` also find the optimum."""
    indices, log_det = found.indices, found.log_det
    if log_det is None:
        log_det = problem.log_det(indices)
    if np.isneginf(log_det):
        name = "indices" if method == "score" else "method"
        what = "" if method == "score" else f", which {method!r} returned"
        raise ValueError(
            f"{name} must give an invertible information matrix, but that of "
            f"{indices.tolist()}{what} is singular"
        )
    taken = time.perf_counter() - start
    bound, proven = found.bound, found.proven
    if reference == "exact" and not proven:
        deadline = time.perf_counter() + (time_limit or TIME_LIMIT)
        optimum = solve_exact(problem, deadline=deadline)
        bound = optimum.bound if bound is None else min(bound, optimum.bound)
        proven = optimum.proven and log_det >= optimum.bound - _PROVEN
    subsets = found.alternatives or ((indices, log_det),)
    return Selection(
        indices=indices,
        log_det=log_det,
        method=found.method or method,
        proven=proven,
        seconds=taken,
        problem=problem,
        reason=found.reason,
        seed=found.seed,
        restarts=found.restarts,
        nodes=found.nodes,
        alternatives=tuple(Subset(*each) for each in subsets),
        known_bound=bound,
        **labels,
    )


def _labels(
    candidates: Any, names: Sequence[str] | None
) -> tuple[tuple[str, ...] | None, tuple[str, ...] | None]:
    """Names of the candidates and of their axes, from a data frame where it is one."""
    if not hasattr(candidates, "to_numpy") or not hasattr(candidates, "columns"):
        return None if names is None else tuple(names), None
    axes = tuple(str(column) for column in candidates.columns)
    rows = tuple(str(label) for label in getattr(candidates, "index", ()))
    if names is None and rows and rows != tuple(map(str, range(len(rows)))):
        return rows, axes
    return None if names is None else tuple(names), axes


def _checked_names(names: Sequence[str] | None, count: int) -> tuple[str, ...] | None:
    if names is None:
        return None
    given = tuple(names)
    if len(given) != count or not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"names must be {count} texts, one for each candidate, got {len(given)} of "
            f"{', '.join(sorted({type(name).__name__ for name in given}))}"
        )
    return given
