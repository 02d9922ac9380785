"""The problem of a question to a candidate set, checked and whitened."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, Indices, Mask, axis_names, require_none, whole_number
from jaxcal.information.blocks import (
    WhiteBlocks,
    largest_rank,
    missing_directions,
    rank_of_blocks,
    whiten,
)
from jaxcal.information.singular import SINGULAR, directions_in_words, require_excited
from jaxcal.models.linear import Affine
from jaxcal.selection.criteria import (
    CRITERIA,
    Coordinates,
    Criterion,
    G,
    Largest,
    Mean,
    ScenarioCriterion,
    criterion_of,
)
from jaxcal.selection.problem.blocks import blocks_of
from jaxcal.selection.problem.candidate_set import (
    CandidateSet,
    check_available,
    filled,
    flatten_rounding,
    one_array,
    rounding_of,
    usable_numbers,
)
from jaxcal.selection.problem.problem import Problem, joined_problem, scenario_problem

_LARGEST = 3e7  # numbers of all predictions' problems: 240 MB


def problem_of(
    offer: CandidateSet,
    k: int | None = None,
    criterion: Any = None,
    region: ArrayLike | None = None,
) -> Problem:
    """The problem of choosing k of the candidates by a criterion; see
    ``Design.select``."""
    joined = criterion if isinstance(criterion, ScenarioCriterion) else Mean(criterion)
    default = "I" if offer.model and not offer.model.fitting.multiplicity else "D"
    of_one = criterion_of(joined.criterion, region, default)
    scenarios, members = offer.scenarios, []
    for s, alone in enumerate(offer.by_scenario()):
        try:
            members.append(_problem_of_one(alone, k, of_one))
        except ValueError as error:
            if scenarios is None:
                raise
            raise ValueError(f"in scenario {s}: {error}") from None
    if isinstance(of_one, G):
        if scenarios and (not joined.least or joined.of_efficiency):
            raise ValueError('for G in scenarios use jaxcal.Worst("G")')
        return _of_largest(members)
    compared = offer.model is not None and len(members) > 1
    nominal = _problem_of_one(offer, k, of_one) if compared else None
    weights = scenarios.weights if scenarios else np.ones(1)
    return joined_problem(members, weights, joined, nominal)


def _problem_of_one(
    offer: CandidateSet, k: int | None, criterion: Criterion
) -> Problem:
    """The problem of one scenario, or at the nominal."""
    about = criterion.by_name, criterion.of_region, criterion.name == "D"
    blocks = blocks_of(offer, *about)
    raw, root = blocks.of_candidates(), blocks.root
    if offer.measured is not None:
        measured = blocks.at("measured", offer.measured, readings=True)
        root = np.concatenate([root, measured.reshape(-1, root.shape[1])])
        if len(root) > root.shape[1]:  # as much in fewer rows
            root = np.linalg.qr(root)[1]
    blocks.require_identified(offer.measured)
    where = offer.by_name("region", criterion.region)
    if where is None and criterion.of_region:
        where = blocks.predicted()
    region = None if where is None else blocks.at("region", where, readings=False)
    more: dict[str, Any] = {"names": blocks.names, "times": blocks.times}
    return _checked_problem(offer, raw, root, criterion, k, region=region, **more)


def _of_largest(problems: list[Problem]) -> Problem:
    """The problem of the largest variance of all predictions, in every scenario."""
    k, members = max(one.k for one in problems), []
    for one in problems:
        for row in one.criterion.root:
            of_row = one.criterion.of_rows(row[None], unit=one.criterion.unit)
            members.append(dataclasses.replace(one, k=k, criterion=of_row))
    if not members:
        raise ValueError("criterion G needs predictions that depend on a parameter")
    if len(members) * problems[0].blocks.size > _LARGEST:
        raise ValueError(
            f"criterion G allows at most {_LARGEST:.0e} numbers, got {len(members)} "
            f"predictions with {problems[0].blocks.size} numbers of the candidates; "
            "give a smaller region"
        )
    weights = np.full(len(members), 1.0 / len(members))
    return scenario_problem(members, Largest(), weights)


def make_problems(
    candidates: ArrayLike,
    k: int | None = None,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> list[Problem]:
    """The problems of candidate sets (B, M, n) of the affine model, for criterion D;
    ``available`` (B, M), ``required`` (B, r), the others as of ``Design``."""
    array = filled("candidates", candidates, "B", "M", "n")
    mask = check_available(available, array.shape[:2])
    array = usable_numbers("candidates", array, mask)
    spacing = rounding_of(candidates)
    for one, usable in zip(array, mask, strict=True):
        flatten_rounding(spacing, one[:, None], usable, bias=True)
    array.flags.writeable = False  # and so of every set
    m = array.shape[2] if num_outputs is None else num_outputs
    model = Affine(array.shape[2], whole_number("num_outputs", m, 1))
    forced = None if required is None else one_array("required", required)
    if forced is not None and (forced.ndim != 2 or len(forced) != len(array)):
        raise ValueError(f"required must have shape (B, r), got {forced.shape}")
    raw = model.blocks(array)
    raw.flags.writeable = mask.flags.writeable = False
    root, criterion = np.zeros((0, model.num_inputs + 1)), CRITERIA["D"]()
    white = whiten(raw, mask, root)
    k = _check_k(k, raw[0], mask[0], root, regressors=True)  # of no one set
    first = CandidateSet(array[0], model, max_replicates=max_replicates)
    problems = []
    for b in range(len(array)):
        offer = first.but(
            candidates=array[b],
            available=mask[b],
            required=None if forced is None else forced[b],
        )
        rest = offer, raw[b], root, criterion, k
        try:
            problems.append(_checked_problem(*rest, white=white[b], times=m))
        except ValueError as error:
            raise ValueError(f"in set {b}: {error}") from None
    return problems


def _checked_problem(
    offer: CandidateSet,
    raw: Array,
    root: Array,
    criterion: Criterion,
    k: int | None,
    *,
    white: WhiteBlocks | None = None,
    names: tuple[str, ...] = (),
    times: int = 1,
    region: Array | None = None,
) -> Problem:
    """The problem of checked blocks (M, q, p), zero where not available, whitened here
    unless they are; ``names`` are empty where they are [u, 1], ``region`` (R, q, p)."""
    available, candidates = offer.available, offer.candidates
    readings, count = raw, int(np.count_nonzero(available)) * raw.shape[1]
    if raw.shape[1] > raw.shape[2]:  # as much information in p rows, at q^3 less cost
        if criterion.of_each and region is None:
            region = raw[available]
        raw = np.asarray(np.linalg.qr(raw, mode="r"))
    k = _check_k(k, raw, available, root, regressors=not names)
    cap = offer.max_replicates
    _require_enough(available, k, cap)
    forced = _checked_required(offer.required, available, k)
    computed = bool(names) and offer.model is not None
    if white is None:
        white = whiten(raw[None], available[None], root, computed=computed)[0]
    if white is None:
        if not names and candidates is not None:
            axes = axis_names("names", offer.axes, "u", candidates.shape[1])
            names = (*axes, "the bias")
            if not len(root):
                about = "candidates", "available ones"
                require_excited(candidates[available], names[:-1], *about)
        null = missing_directions(raw[available], root, computed)
        raise ValueError(
            "blocks must inform every parameter, but the available ones"
            + (" and what is known" if len(root) else "")
            + directions_in_words(" do not inform the direction{} ", null, names)
            + "; give prior, the precision known beforehand"
        )
    at = Coordinates(white, names, count, region, times)
    problem = Problem(
        white, k, available, forced, cap, criterion.within(at), times, raw, readings,
        root, candidates, offer.model, offer.constraints,
    )  # fmt: skip
    for array in (raw, readings, root, available, forced):
        array.flags.writeable = False
    if len(forced):
        _check_required_rank(problem)
    rules = offer.constraints
    if rules and rules.selection(k, problem.lower, problem.upper) is None:
        raise ValueError(f"constraints allow no selection of k = {k}")
    return problem


def _require_enough(mask: Mask, k: int, cap: int | Indices) -> None:
    """Refuse fewer available candidates (M,) than k takes."""
    count = int(np.count_nonzero(mask))
    if not count:
        raise ValueError(f"available must leave at least {k} candidates, got none")
    if int((mask * np.int64(cap)).sum()) < k:
        often = "at most max_replicates" if np.ndim(cap) else f"at most {cap}"
        raise ValueError(
            f"k must not exceed {count} available candidates"
            + (f", each {often} times" if np.ndim(cap) or cap > 1 else "")
            + f", got {k}"
        )


def _checked_required(required: ArrayLike | None, mask: Mask, k: int) -> Indices:
    """(r,) candidates, at most k, each available and named once."""
    array = np.zeros(0) if required is None else one_array("required", required)
    if not array.size:
        return np.zeros(0, dtype=np.int64)
    if array.ndim != 1:
        raise ValueError(f"required must have shape (r,), got {array.shape}")
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"required must hold whole numbers, got dtype {array.dtype}")
    forced = array.astype(np.int64)
    if len(forced) > k:
        raise ValueError(
            f"required must name at most k = {k} candidates, got {len(forced)}"
        )
    outside = (forced < 0) | (forced >= len(mask))
    require_none(outside, forced, f"required must lie in [0, {len(mask)})")
    ordered = np.sort(forced)
    twice = ordered[1:] == ordered[:-1]
    require_none(twice, ordered[1:], "required must not repeat a candidate", " twice")
    masked = ~mask[forced]
    require_none(masked, forced, "required must be available", ", which is masked")
    return forced


def _check_k(
    k: int | None, raw: Array, mask: Mask, root: Array, regressors: bool
) -> int:
    """k, by default the fewest that identify alone; ``regressors``: blocks are [u,
    1]."""
    p = raw.shape[2]
    usable = raw if raw.shape[1] == 1 and k is not None else raw[mask]
    most = largest_rank(usable)
    if k is None:
        k = p if regressors else _cover(usable)
    k = whole_number("k", k, 1)
    prior_rank = rank_of_blocks(root[None, None], root[:0])[0][0] if len(root) else 0
    if k * most + prior_rank >= p:
        return k
    if regressors and not prior_rank:
        raise ValueError(
            f"k must be at least {p}, the number of regressors ({p - 1} inputs and an "
            f"offset), got {k}"
        )
    least = -(-(p - prior_rank) // max(most, 1))
    raise ValueError(
        f"k must be at least {least} for {p} parameters, at "
        f"most {most} of them from a candidate"
        + (f" and {prior_rank} known beforehand" if prior_rank else "")
        + f", got {k}"
    )


def _cover(blocks: Array) -> int:
    """How many blocks (N, q, p), widest first, span what all of them span."""
    norms = np.sqrt((blocks**2).sum(axis=(0, 1)))
    rest = blocks / np.where(norms > 0.0, norms, 1.0)
    count, least = 0, 0.0
    while True:
        size = np.linalg.svd(rest, compute_uv=False)
        least = least or SINGULAR * float(size.max(initial=0.0))
        rank = (size > least).sum(axis=1)
        if not rank.any():
            return max(count, 1)
        volume = np.log(np.where(size > least, size, 1.0)).sum(axis=1)
        widest = int(np.where(rank == rank.max(), volume, -np.inf).argmax())
        basis = np.linalg.svd(rest[widest], full_matrices=False)[2][: rank.max()]
        rest = rest - (rest @ basis.T) @ basis
        count += 1


def _check_required_rank(problem: Problem) -> None:
    """Enough free choices must remain to complete the span of the required ones."""
    r, p = len(problem.required), problem.num_regressors
    rank = problem.held_rank
    room = (problem.k - r) * problem.blocks.shape[1]
    if p - rank > room:
        raise ValueError(
            "required candidates leave too little room for an invertible selection: "
            f"the {r} required candidates span {rank} of {p} regressors, so at least "
            f"{p - rank} more are needed, and k = {problem.k} leaves {room}"
        )
