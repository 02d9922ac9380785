"""One call for every solver: ``select``, and ``score`` for subsets made elsewhere."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.selection.auto import check_least_efficiency, solve_auto
from jaxcal.selection.exact.exact import STARTING_RESTARTS, solve_exact
from jaxcal.selection.exchange.exchange import default_restarts, exchange_indices
from jaxcal.selection.greedy import greedy_indices
from jaxcal.selection.problem import Problem, make_problem, whole_number
from jaxcal.selection.random import random_indices
from jaxcal.selection.result import Selection, Subset

__all__ = ["METHODS", "score", "select"]

METHODS = ("random", "greedy", "exchange", "exact", "policy")
_CHOICES = (*METHODS, "auto")  # auto is one of the last two, whichever suffices
_REFERENCES = ("bound", "exact")
_PROVEN = 1e-9  # log det S this near a proven optimum is that optimum


def select(
    candidates: ArrayLike,
    k: int = 4,
    method: str = "policy",
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    seed: int = 0,
    restarts: int | None = None,
    time_limit: float | None = None,
    best: int = 1,
    reference: str = "bound",
    checkpoint: Any = None,
    decoding: str = "greedy",
    num: int = 16,
    least_efficiency: float = 0.999,
) -> Selection:
    """Choose the k postures whose information matrix has the largest determinant.

    Args:
        candidates: (M, n) commands that could be measured, in any unit.
        k: postures to choose, at least n + 1.
        method: "random", "greedy", "exchange" (near-optimal), "exact" (proven),
            "policy" (the trained network) or "auto": the policy where it provably has
            ``least_efficiency``, else exact; ``method`` of the answer says which.
        available: (M,) bool, True where a candidate may be chosen; all when not given.
        required: (r,) candidates that must be among the chosen.
        max_replicates: how often one candidate may be chosen; 1 keeps them distinct.
        num_outputs: m, as many as inputs when not given; log det S is m times that of
            the (n + 1) x (n + 1) matrix.
        seed: for random and exchange, and for the policy where it samples.
        restarts: random starts of the exchange; when not given 200, with replicates
            400, and 30 where it only starts the exact search.
        time_limit: seconds after which exact, also within auto, returns the best found,
            not proven.
        best: how many best subsets exact proves, in ``alternatives``.
        reference: what ``bound`` and ``efficiency`` are measured against, "bound" (the
            cheapest upper bound, computed when read) or "exact" (the proven optimum).
        checkpoint: folder of a trained policy; the one that ships when not given.
        decoding: how the policy chooses, see ``jaxcal.selection.policy``.
        num: decodings the policy tries, where ``decoding`` tries several.
        least_efficiency: of auto, the D-efficiency in (0, 1] against the optimum or an
            upper bound on it from which the policy's answer is kept.

    Returns:
        The selection; never a singular one. That of auto also has a ``reason``.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    if method not in _CHOICES:
        raise ValueError(f"method must be one of {', '.join(_CHOICES)}, got {method!r}")
    _check_reference(reference)
    least_efficiency = check_least_efficiency(least_efficiency)
    seed = whole_number("seed", seed, 0)
    if restarts is not None:
        restarts = whole_number("restarts", restarts, 1)
    best = whole_number("best", best, 1)
    if best > 1 and method != "exact":
        raise ValueError(f'best must be 1 unless method is "exact", got {best}')
    _check_time_limit(time_limit)
    start = time.perf_counter()
    problem = make_problem(
        candidates,
        k,
        available=available,
        required=required,
        max_replicates=max_replicates,
        num_outputs=num_outputs,
    )
    if method == "exact":
        deadline = None if time_limit is None else start + time_limit
        starts = restarts or STARTING_RESTARTS
        return _exact(problem, best, deadline, starts, seed, start)
    if method == "auto":
        return solve_auto(
            problem,
            lambda: _policy(problem, checkpoint, decoding, num, seed),
            least_efficiency,
            reference,
            time_limit,
            restarts or STARTING_RESTARTS,
            seed,
        )
    starts = restarts or default_restarts(problem.max_replicates)
    used_seed: int | None = seed
    used_restarts: int | None = None
    if method == "random":
        indices = random_indices(problem, np.random.default_rng(seed))
    elif method == "greedy":
        indices, used_seed = greedy_indices(problem), None
    elif method == "exchange":
        indices, used_restarts = exchange_indices(problem, starts, seed), starts
    else:
        indices = _policy(problem, checkpoint, decoding, num, seed)
    log_det = _judge(problem, indices, method)
    seconds = time.perf_counter() - start
    bound = _reference_bound(problem, reference, time_limit)
    return Selection(
        indices=indices,
        log_det=log_det,
        method=method,
        proven=_is_proven(log_det, bound),
        seconds=seconds,
        seed=used_seed,
        restarts=used_restarts,
        alternatives=(Subset(indices, log_det),),
        known_bound=None if bound is None else bound[0],
        problem=problem,
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
        candidates: (M, n), in any unit.
        indices: (k,) the subset; repeated entries are replicates.
        available: (M,) bool, True where a candidate could have been chosen.
        num_outputs: m; as many as inputs when not given.
        reference: "bound" or "exact", as in :func:`select`.
        max_replicates: the cap that the optimum is allowed; as often as the subset
            repeats a candidate when not given.
        time_limit: seconds for ``reference="exact"``.

    Raises:
        ValueError: also where the subset is singular.
    """
    _check_reference(reference)
    _check_time_limit(time_limit)
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
    cap = repeats if max_replicates is None else max_replicates
    problem = make_problem(
        candidates,
        len(subset),
        available=available,
        max_replicates=cap,
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
    log_det = _judge(problem, subset, "score")
    seconds = time.perf_counter() - start
    bound = _reference_bound(problem, reference, time_limit)
    return Selection(
        indices=subset,
        log_det=log_det,
        method="score",
        proven=_is_proven(log_det, bound),
        seconds=seconds,
        alternatives=(Subset(subset, log_det),),
        known_bound=None if bound is None else bound[0],
        problem=problem,
    )


def _exact(
    problem: Problem,
    best: int,
    deadline: float | None,
    restarts: int,
    seed: int,
    start: float,
) -> Selection:
    found = solve_exact(problem, best, deadline, restarts, seed)
    return Selection(
        indices=found.subsets[0],
        log_det=float(found.log_dets[0]),
        method="exact",
        proven=found.proven,
        seconds=time.perf_counter() - start,
        seed=seed,
        restarts=restarts,
        nodes=found.nodes,
        alternatives=tuple(
            Subset(indices, float(value))
            for indices, value in zip(found.subsets, found.log_dets, strict=True)
        ),
        known_bound=found.bound,
        problem=problem,
    )


def _policy(
    problem: Problem, checkpoint: Any, decoding: str, num: int, seed: int
) -> NDArray[np.int64]:
    from jaxcal.selection.policy import select_batch

    if problem.max_replicates > 1:
        raise ValueError(
            'max_replicates must be 1 with method "policy", which picks distinct '
            f"postures, got {problem.max_replicates}"
        )
    indices = select_batch(
        problem.candidates[None],
        problem.k,
        available=problem.available[None],
        required=problem.required[None] if len(problem.required) else None,
        decoding=decoding,
        num=num,
        seed=seed,
        checkpoint=checkpoint,
    )
    return np.asarray(indices[0], dtype=np.int64)


def _judge(problem: Problem, indices: NDArray[np.int64], method: str) -> float:
    """log det S, or a ValueError where the selection is singular."""
    log_det = problem.log_det(indices)
    if np.isneginf(log_det):
        name = "indices" if method == "score" else "method"
        what = "" if method == "score" else f", which {method!r} returned"
        raise ValueError(
            f"{name} must give an invertible information matrix, but the postures "
            f"{indices.tolist()}{what} lie in one plane"
        )
    return log_det


def _check_reference(reference: str) -> None:
    if reference not in _REFERENCES:
        raise ValueError(
            f"reference must be one of {', '.join(_REFERENCES)}, got {reference!r}"
        )


def _check_time_limit(time_limit: Any) -> None:
    if time_limit is None:
        return
    number = isinstance(time_limit, int | float | np.integer | np.floating)
    if not number or not time_limit > 0.0:
        raise ValueError(
            f"time_limit must be a number above 0 in seconds, got {time_limit!r}"
        )


def _reference_bound(
    problem: Problem, reference: str, time_limit: float | None
) -> tuple[float, bool] | None:
    """Upper bound and whether it is the optimum; None leaves it until it is read."""
    if reference == "bound":
        return None
    deadline = None if time_limit is None else time.perf_counter() + time_limit
    found = solve_exact(problem, deadline=deadline)
    return found.bound, found.proven


def _is_proven(log_det: float, bound: tuple[float, bool] | None) -> bool:
    return bound is not None and bound[1] and log_det >= bound[0] - _PROVEN
