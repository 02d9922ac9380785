"""Checks of which candidates may be chosen and how many, over a batch of sets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, require_finite, require_none, whole_number
from jaxcal.information.blocks import SINGULAR, largest_rank, rank_of_blocks
from jaxcal.selection.problem.problem import Problem

__all__ = [
    "check_available",
    "check_counts",
    "check_k",
    "check_required_rank",
    "filled",
    "in_set",
    "one_array",
    "usable_numbers",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_FILLED = ", none of them 0"


def filled(name: str, values: ArrayLike, *letters: str) -> Array:
    """``values`` as float64 with an axis for each letter, none of them empty."""
    array = array_of(name, values, *letters, rule=_FILLED, finite=False)
    if 0 in array.shape:
        raise ValueError(
            f"{name} must have shape ({', '.join(letters)}){_FILLED}, got {array.shape}"
        )
    return array


def usable_numbers(name: str, array: Array, mask: Mask) -> Array:
    """A copy, finite where available; what is not finite elsewhere becomes zero."""
    own = np.array(array, order="C")
    bad = ~np.isfinite(own)
    if bad.any():
        hidden = bad & ~mask.reshape(*mask.shape, *[1] * (own.ndim - mask.ndim))
        own[hidden] = 0.0
        require_finite(name, own)
    return own


def in_set(b: int | np.integer[Any], count: int) -> str:
    """Which of the sets an error is about, where there are several."""
    return "" if count == 1 else f" in set {int(b)}"


def one_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """A copy of ``values`` as an array of any kind."""
    try:
        return np.array(values)
    except ValueError as error:
        raise ValueError(
            f"{name} must be one array, got {type(values).__name__} of mixed lengths"
        ) from error


def check_available(available: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """(S, M) or (M,), as ``shape`` says."""
    if available is None:
        return np.ones(shape, dtype=np.bool_)
    mask = one_array("available", available)
    if mask.shape != shape:
        raise ValueError(f"available must have shape {shape}, got {mask.shape}")
    if mask.dtype.kind not in "biuf" or not np.isin(mask, (0, 1)).all():
        wrong = mask[~np.isin(mask, (0, 1))] if mask.dtype.kind in "iuf" else mask
        raise ValueError(
            "available must hold True or 1 where a candidate may be chosen, else False "
            f"or 0, got {wrong.flat[0]}"
        )
    return mask.astype(np.bool_)


def check_counts(
    mask: Mask, k: int, required: ArrayLike | None, max_replicates: int
) -> tuple[int, Indices]:
    """The cap on replicates and the required candidates (S, r)."""
    cap = whole_number("max_replicates", max_replicates, 1)
    count = mask.sum(axis=1)
    if (count == 0).any():
        raise ValueError(f"available must leave at least {k} candidates, got none")
    short = np.flatnonzero(count * cap < k)
    if short.size:
        have = int(count[short[0]])
        raise ValueError(
            f"k must not exceed what is available: {have} candidates"
            + (f", each at most {cap} times" if cap > 1 else "")
            + f"{in_set(short[0], len(mask))}, got {k}"
        )
    return cap, _check_required(required, mask, k)


def _check_required(required: ArrayLike | None, mask: Mask, k: int) -> Indices:
    num_sets, num_candidates = mask.shape
    if required is None or np.size(required) == 0:
        return np.zeros((num_sets, 0), dtype=np.int64)
    given = one_array("required", required)
    if given.ndim != 2 or len(given) != num_sets:
        single = num_sets == len(given) == 1  # given without this axis
        want, got = ("(r,)", given.shape[1:]) if single else ("(B, r)", given.shape)
        raise ValueError(f"required must have shape {want}, got {got}")
    if not np.issubdtype(given.dtype, np.integer):
        raise ValueError(f"required must hold whole numbers, got dtype {given.dtype}")
    forced = given.astype(np.int64)
    if forced.shape[1] > k:
        raise ValueError(
            f"required must name at most k = {k} candidates, got {forced.shape[1]}"
        )
    outside = (forced < 0) | (forced >= num_candidates)
    require_none(outside, forced, f"required must lie in [0, {num_candidates})")
    ordered = np.sort(forced, axis=1)
    twice = ordered[:, 1:] == ordered[:, :-1]
    require_none(
        twice, ordered[:, 1:], "required must not repeat a candidate", " twice"
    )
    masked = ~np.take_along_axis(mask, forced, axis=1)
    require_none(masked, forced, "required must be available", ", which is masked")
    return forced


def check_k(
    k: int | None, raw: Array, mask: Mask, root: Array, regressors: bool
) -> int:
    """k, by default the fewest candidates that identify every parameter alone.

    Args:
        k: as asked for.
        raw, mask, root: blocks (S, M, q, p), available (S, M), what is known (r, p).
        regressors: the blocks are [u, 1].
    """
    q, p = raw.shape[2:]
    usable = raw.reshape(-1, q, p) if mask.all() else raw[mask]
    most = largest_rank(usable)
    if k is None:
        k = p if regressors else _cover(usable)
    k = whole_number("k", k, 1)
    known = int(rank_of_blocks(root[None], root[:0])) if len(root) else 0
    if k * most + known >= p:
        return k
    if regressors and not known:
        raise ValueError(
            f"k must be at least {p}, the number of regressors of {p - 1} inputs and a "
            f"bias, got {k}"
        )
    raise ValueError(
        f"k must be at least {-(-(p - known) // max(most, 1))} for {p} parameters, at "
        f"most {most} of them from a candidate"
        + (f" and {known} known beforehand" if known else "")
        + f", got {k}"
    )


def _cover(blocks: Array) -> int:
    """How many blocks (N, q, p), widest first, span what all of them span."""
    norms = np.sqrt((blocks**2).sum(axis=(0, 1)))
    rest = blocks / np.where(norms > 0.0, norms, 1.0)
    count, least = 0, 0.0
    while True:
        size = np.linalg.svd(rest, compute_uv=False)
        least = least or SINGULAR * float(size.max())
        rank = (size > least).sum(axis=1)
        if not rank.any():
            return max(count, 1)
        volume = np.log(np.where(size > least, size, 1.0)).sum(axis=1)
        widest = int(np.where(rank == rank.max(), volume, -np.inf).argmax())
        basis = np.linalg.svd(rest[widest], full_matrices=False)[2][: rank.max()]
        rest = rest - (rest @ basis.T) @ basis
        count += 1


def check_required_rank(problem: Problem, where: str) -> None:
    """Enough free choices must remain to complete the span of the required ones."""
    r, p = len(problem.required), problem.num_regressors
    rank = problem.held_rank
    room = (problem.k - r) * problem.blocks.shape[1]
    if p - rank > room:
        raise ValueError(
            f"required must leave room for an invertible selection: the {r} required "
            f"candidates{where} span {rank} of {p} regressors, so at least {p - rank} "
            f"more are needed, got room for {room} (k = {problem.k})"
        )
