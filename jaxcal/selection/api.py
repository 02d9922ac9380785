"""One call for every solver: ``select``, and ``score`` for subsets made elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import one_of, seconds
from jaxcal.models.model import Model, by_name
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.exact.exact import TIME_LIMIT, solve_exact
from jaxcal.selection.problem import (
    Problem,
    make_block_problem,
    make_problem,
    values,
)
from jaxcal.selection.result import Selection, Subset
from jaxcal.selection.solver import Found
from jaxcal.selection.solvers import SOLVERS, checked_options

__all__ = ["score", "select"]

_REFERENCES = ("bound", "exact")
_PROVEN = 1e-9  # a value this near a proven optimum, relative above 1, is that optimum


def select(
    candidates: ArrayLike | None = None,
    k: int | None = None,
    method: str = "auto",
    *,
    model: Model | None = None,
    blocks: ArrayLike | None = None,
    prior: Prior | ArrayLike | None = None,
    noise: Noise | None = None,
    criterion: str | None = None,
    parameters: Sequence[str | int] | None = None,
    region: ArrayLike | None = None,
    measured: ArrayLike | None = None,
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
    """Choose the k candidates whose measurements say most about the parameters.

    Args:
        candidates: (M, n) commands that could be measured, in any unit; an array or a
            data frame, whose labels are kept. Rows that are not available may hold NaN.
        k: candidates to choose; the fewest that identify (n + 1) when not given.
        method: "auto" (the cheapest way to an answer proven to have
            ``least_efficiency``), "exact" (proven), "exchange" (near-optimal),
            "greedy", "random" or "policy" (the trained network; affine model, D).
        model: of ``jaxcal.models``; ``y = A u + b`` when not given.
        blocks: (M, q, p) instead of candidates, for any model: candidate i gives q
            readings ``B_i theta`` with noise of unit variance.
        prior: a ``jaxcal.Prior`` of the model's parameters, its own default when not
            given; with blocks, (p, p) precision of what is known of theta beforehand.
        noise: a ``jaxcal.Noise``; when not given ``model.default_noise()`` where the
            model has one (an arm), else of unit variance.
        criterion: "D" (joint uncertainty of the parameters), "A" (sum of their
            variances), "I" (mean variance of the predictions over ``region``), "E" (the
            worst-known combination), "Ds" or "As" (of ``parameters`` alone). D for the
            affine model and for blocks, I for other models.
        parameters: names or indices of the parameters of interest, for Ds and As.
        region: (R, n) commands, or (R, q, p) blocks, at which predictions are wanted,
            for I; the available candidates when not given.
        measured: (N, n) commands, or (N, q, p) blocks, measured already: their
            information is there, and k counts the new ones.
        names: (M,) names of the candidates, for the answer.
        available: (M,) bool, True where a candidate may be chosen; all when not given.
        required: (r,) candidates that must be among the chosen.
        max_replicates: how often one candidate may be chosen; 1 keeps them distinct.
        num_outputs: m, as many as inputs when not given; log det S is m times that of
            the (n + 1) x (n + 1) matrix. With blocks, how often log det counts, 1.
        reference: what ``bound`` and ``efficiency`` are measured against, "bound" (the
            cheapest bound, computed when read) or "exact" (the proven optimum).
        seed: whole number or numpy Generator; of all methods but greedy.
        restarts: starts of exchange, and of the one that starts exact and auto; see
            ``exchange.default_restarts`` for how many when not given, 30 with these.
        time_limit: seconds after which exact and auto return the best found with a true
            ``bound``, not proven; ``math.inf`` for none. When not given 10, and 2 for
            auto with more than one reading per candidate, a prior or another criterion
            than D.
        best: of exact, how many best subsets to prove, in ``alternatives``.
        least_efficiency: of auto, the efficiency in (0, 1] that suffices.
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
    candidates = by_name(model, candidates)
    names, axes = _labels(candidates, names)
    problem = _problem(
        candidates, k, blocks, model=model, prior=prior, noise=noise,
        criterion=criterion, parameters=parameters, region=region, measured=measured,
        available=available, required=required, max_replicates=max_replicates,
        num_outputs=num_outputs,
    )  # fmt: skip
    names = _checked_names(names, len(problem.blocks))
    found = SOLVERS[method].solve(problem, **options)
    return _selection(
        problem, found, method, start, reference, time_limit, names=names, axes=axes
    )


def score(
    candidates: ArrayLike | None,
    indices: ArrayLike,
    *,
    available: ArrayLike | None = None,
    num_outputs: int | None = None,
    reference: str = "bound",
    max_replicates: int | None = None,
    time_limit: float | None = None,
    **about: Any,
) -> Selection:
    """Judge a subset made elsewhere as if a solver had returned it.

    Args:
        candidates: (M, n), in any unit; an array or a data frame. None with blocks.
        indices: (k,) the subset; repeated entries are replicates.
        available: (M,) bool, True where a candidate could have been chosen.
        num_outputs: m; as many as inputs when not given.
        reference: "bound" or "exact", as in :func:`select`.
        max_replicates: the cap that the optimum is allowed; as often as the subset
            repeats a candidate when not given.
        time_limit: seconds for ``reference="exact"``, 10 when not given.
        about: model, blocks, prior, noise, criterion, parameters, region and measured,
            as in :func:`select`.

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
        raise ValueError("indices must name at least one candidate, got none")
    blocks = about.pop("blocks", None)
    offered = candidates if blocks is None else blocks
    num_candidates = len(np.atleast_1d(np.asarray(offered, dtype=object)))
    outside = (subset < 0) | (subset >= num_candidates)
    if outside.any():
        raise ValueError(
            f"indices must lie in [0, {num_candidates}), got {subset[outside][0]}"
        )
    repeats = int(np.unique(subset, return_counts=True)[1].max())
    candidates = by_name(about.get("model"), candidates)
    names, axes = _labels(candidates, None)
    cap = repeats if max_replicates is None else max_replicates
    problem = _problem(
        candidates, len(subset), blocks, available=available, max_replicates=cap,
        num_outputs=num_outputs, **about,
    )  # fmt: skip
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


def _problem(
    candidates: ArrayLike | None, k: int | None, blocks: ArrayLike | None, **given: Any
) -> Problem:
    """The problem of candidates and a model, or of blocks."""
    if (candidates is None) == (blocks is None):
        got = "neither" if blocks is None else "both"
        raise ValueError(f"either candidates or blocks must be given, got {got}")
    if candidates is not None:
        model = given.get("model")
        if model is not None:
            if isinstance(model, type) or not hasattr(model, "default_prior"):
                raise ValueError(
                    "model must be of jaxcal.models, or an object with the methods of "
                    f"jaxcal.models.Model, got {model!r}"
                )
        return make_problem(candidates, k, **given)
    if given.pop("model", None) is not None:
        raise ValueError("model must come with candidates, not with blocks")
    if isinstance(given.get("prior"), Prior):
        raise ValueError("prior must be a (p, p) precision with blocks, got a Prior")
    return make_block_problem(blocks, k, **given)  # type: ignore[arg-type]  # not None


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
    indices, value = found.indices, found.value
    if value is None or problem.criterion.name != "D":
        value, log_det = (float(each[0]) for each in values(problem, indices[None]))
    else:
        log_det = value
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
        bounds = [optimum.bound] if bound is None else [optimum.bound, bound]
        bound = min(bounds) if problem.criterion.larger_is_better else max(bounds)
        near = abs(value - optimum.bound) <= _PROVEN * max(1.0, abs(optimum.bound))
        proven = optimum.proven and near
    subsets = [Subset(indices, value, log_det)]
    if found.alternatives:
        others = np.stack([each for each, _ in found.alternatives])
        subsets = [
            Subset(each, float(worth), float(of_all))
            for each, worth, of_all in zip(
                others, *values(problem, others), strict=True
            )
        ]
    return Selection(
        indices=indices,
        value=value,
        log_det=log_det,
        method=found.method or method,
        proven=proven,
        seconds=taken,
        problem=problem,
        reason=found.reason,
        seed=found.seed,
        restarts=found.restarts,
        nodes=found.nodes,
        alternatives=tuple(subsets),
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
