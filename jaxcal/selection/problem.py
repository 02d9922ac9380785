"""A selection problem, checked once, in coordinates no unit or axis can distort.

Solvers work on whitened regressors: with Z = [candidates, 1] of the available
candidates and Z = X R its QR factors, the rows x_i of X satisfy ``X.T @ X = I``, and
``log det(Z_s.T Z_s) = log det(X_s.T X_s) + log det(Z.T Z)`` for all subsets s. An
affine map of the candidates rotates X and nothing else, so a solver that looks only at
X picks the same postures in pulses, degrees or [0, 1].
"""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.information.regression import log_det_gram

__all__ = ["Problem", "make_problem", "make_problems", "whole_number"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Problem:
    """Choose ``k`` of M candidates so that log det of the information is largest."""

    candidates: Array  # (M, n) in the caller's unit
    k: int  # postures to choose, at least n + 1
    available: Mask  # (M,) True where a candidate may be chosen
    required: Indices  # (r,) candidates that must be chosen, r <= k
    max_replicates: int  # how often one candidate may be chosen
    num_outputs: int  # m
    rows: Array  # (M, n + 1) whitened regressors, zero where not available
    log_scale: float  # log det(Z_s.T Z_s) - log det(X_s.T X_s), the same for all s

    @property
    def num_regressors(self) -> int:
        """n + 1."""
        return self.rows.shape[1]

    @property
    def lower(self) -> Indices:
        """(M,) how often each candidate must be chosen."""
        lower = np.zeros(len(self.rows), dtype=np.int64)
        lower[self.required] = 1
        return lower

    @property
    def upper(self) -> Indices:
        """(M,) how often each candidate may be chosen."""
        return np.where(self.available, min(self.max_replicates, self.k), 0)

    def log_det(self, indices: Indices) -> float:
        """log det S of a subset, natural, in the candidates' unit; -inf if singular."""
        return self.num_outputs * float(log_det_gram(self.candidates[indices]))


def whole_number(name: str, value: Any, least: int) -> int:
    """``value`` as an int of at least ``least``, or a ValueError naming it."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, got {value!r}") from None
    if number < least:
        raise ValueError(f"{name} must be at least {least}, got {number}")
    return number


def make_problem(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> Problem:
    """Check one set of candidates; see :func:`make_problems`.

    Args:
        candidates: (M, n).
        k: postures to choose.
        available: (M,) bool, True where a candidate may be chosen; all when not given.
        required: (r,) indices that must be among the chosen; none when not given.
        max_replicates: how often one candidate may be chosen.
        num_outputs: m; as many as inputs when not given.
    """
    array = _numbers("candidates", candidates)
    if array.ndim != 2 or array.shape[1] < 1:
        raise ValueError(f"candidates must have shape (M, n), got {array.shape}")
    return make_problems(
        array[None],
        k,
        available=None if available is None else _leading_axis("available", available),
        required=None if required is None else _leading_axis("required", required),
        max_replicates=max_replicates,
        num_outputs=num_outputs,
        single=True,
    )[0]


def make_problems(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    single: bool = False,
) -> list[Problem]:
    """Check a batch of candidate sets and whiten it.

    Args:
        candidates: (B, M, n) float, any unit.
        k: postures to choose in each set, at least n + 1.
        available: (B, M) bool, True where a candidate may be chosen.
        required: (B, r) indices that must be chosen.
        max_replicates: how often one candidate may be chosen.
        num_outputs: m; as many as inputs when not given.
        single: leave the batch axis out of error messages.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    array = _numbers("candidates", candidates)
    if array.ndim != 3 or array.shape[2] < 1 or array.shape[0] < 1:
        raise ValueError(f"candidates must have shape (B, M, n), got {array.shape}")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        place = where[1:] if single else where
        raise ValueError(f"candidates must be finite, got {array[where]} at {place}")
    num_sets, num_candidates, num_inputs = array.shape
    k = whole_number("k", k, 1)
    if k < num_inputs + 1:
        raise ValueError(
            f"k must be at least {num_inputs + 1}, the number of regressors of "
            f"{num_inputs} inputs and a bias, got {k}"
        )
    cap = whole_number("max_replicates", max_replicates, 1)
    m = (
        num_inputs
        if num_outputs is None
        else whole_number("num_outputs", num_outputs, 1)
    )
    mask = _check_available(available, (num_sets, num_candidates), single)
    count = mask.sum(axis=1)
    if (count == 0).any():
        raise ValueError(f"available must leave at least {k} candidates, got none")
    short = np.flatnonzero(count * cap < k)
    if short.size:
        have = int(count[short[0]])
        raise ValueError(
            f"k must not exceed what is available: {have} candidates"
            + (f", each at most {cap} times" if cap > 1 else "")
            + f"{_in_set(short[0], single)}, got {k}"
        )
    forced = _check_required(required, mask, k, single)
    rows, log_scale = _whiten(array, mask, single)
    problems = [
        Problem(array[b], k, mask[b], forced[b], cap, m, rows[b], float(log_scale[b]))
        for b in range(num_sets)
    ]
    if forced.shape[1]:
        for b, problem in enumerate(problems):
            _check_required_rank(problem, _in_set(b, single))
    return problems


def _numbers(name: str, values: ArrayLike) -> Array:
    try:
        return np.ascontiguousarray(np.asarray(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} must be an array of numbers, got {type(values).__name__}"
        ) from error


def _leading_axis(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        return np.asarray(values)[None]
    except ValueError as error:
        raise ValueError(
            f"{name} must be one array, got {type(values).__name__} of mixed lengths"
        ) from error


def _in_set(b: int | np.integer[Any], single: bool) -> str:
    return "" if single else f" in set {int(b)}"


def _check_available(
    available: ArrayLike | None, shape: tuple[int, int], single: bool
) -> Mask:
    if available is None:
        return np.ones(shape, dtype=np.bool_)
    mask = np.asarray(available)
    if mask.dtype != np.bool_:
        raise ValueError(
            "available must be an array of bool (True = may be chosen), "
            f"got dtype {mask.dtype}"
        )
    if mask.shape != shape:
        want, got = (shape[1:], mask.shape[1:]) if single else (shape, mask.shape)
        raise ValueError(f"available must have shape {want}, got {got}")
    return mask


def _check_required(
    required: ArrayLike | None, mask: Mask, k: int, single: bool
) -> Indices:
    num_sets, num_candidates = mask.shape
    if required is None or np.size(required) == 0:
        return np.zeros((num_sets, 0), dtype=np.int64)
    given = np.asarray(required)
    if given.ndim != 2 or len(given) != num_sets:
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
    if outside.any():
        raise ValueError(
            f"required must lie in [0, {num_candidates}), got {forced[outside][0]}"
        )
    ordered = np.sort(forced, axis=1)
    twice = ordered[:, 1:][ordered[:, 1:] == ordered[:, :-1]]
    if twice.size:
        raise ValueError(f"required must not repeat a candidate, got {twice[0]} twice")
    masked = ~np.take_along_axis(mask, forced, axis=1)
    if masked.any():
        raise ValueError(
            f"required must be available, got {forced[masked][0]}, which is masked"
        )
    return forced


def _check_required_rank(problem: Problem, where: str) -> None:
    """Enough free choices must remain to complete the span of the required ones."""
    r = len(problem.required)
    singular = np.linalg.svd(problem.rows[problem.required], compute_uv=False)
    rank = int((singular > 1e-9 * singular[0]).sum())
    missing = problem.num_regressors - rank
    if missing > problem.k - r:
        raise ValueError(
            f"required must leave room for an invertible selection: the {r} required "
            f"candidates{where} span {rank} of {problem.num_regressors} regressors, so "
            f"at least {missing} more are needed, got room for {problem.k - r} (k = "
            f"{problem.k})"
        )


def _whiten(candidates: Array, mask: Mask, single: bool) -> tuple[Array, Array]:
    """(B, M, n + 1) rows, ``X.T @ X = I`` over the mask, and (B,) log det(Z.T Z)."""
    weight = mask[..., None].astype(np.float64)
    count = mask.sum(axis=1)
    mean = (candidates * weight).sum(axis=1) / count[:, None]
    offset = (candidates - mean[:, None]) * weight
    scale = np.abs(offset).max(axis=1, keepdims=True)
    q, r = np.linalg.qr(offset / np.where(scale == 0.0, 1.0, scale))
    diagonal = np.abs(np.diagonal(r, axis1=1, axis2=2))
    # Cheap test first; only a set that looks nearly flat pays for the careful one.
    doubtful = np.flatnonzero(
        (diagonal < 1e-6).any(axis=1)
        | (scale[:, 0] < 1e-6 * np.abs(candidates).max(axis=1)).any(axis=1)
        | (count < candidates.shape[2] + 1)
    )
    for b in doubtful:
        chosen = candidates[b][mask[b]]
        if np.isneginf(log_det_gram(chosen)):
            raise ValueError(_flat_message(chosen, _in_set(b, single)))
    constant = weight / np.sqrt(count)[:, None, None]
    log_scale = np.log(count) + 2.0 * np.log(diagonal * scale[:, 0]).sum(axis=1)
    return np.concatenate([q * weight, constant], axis=2), log_scale


def _flat_message(chosen: Array, where: str) -> str:
    """Name the direction in which nothing moves, in the caller's axes."""
    n = chosen.shape[1]
    offset = chosen - chosen.mean(axis=0)
    norms = np.linalg.norm(offset, axis=0)
    resolution = 8 * np.finfo(np.float64).eps * len(chosen)
    flat = norms <= resolution * np.abs(chosen).max(axis=0)
    if flat.any():
        direction = flat.astype(np.float64) * (np.cumsum(flat) == 1)
    else:
        direction = np.linalg.svd(offset / norms)[2][-1] / norms
    direction /= np.linalg.norm(direction)
    direction *= np.sign(direction[np.abs(direction).argmax()])
    vector = ", ".join(
        f"{x + 0.0:.4g}" for x in np.where(abs(direction) < 1e-12, 0, direction)
    )
    place = {1: "at one point", 2: "on one line"}.get(n, "in one plane")
    return (
        f"candidates must vary in every direction, but the {len(chosen)} available "
        f"ones{where} lie {place}: none differs along the missing direction ({vector})"
    )
