"""A selection problem, checked once, in coordinates no unit or axis can distort.

Solvers read whitened information blocks: candidate i adds ``B_i.T @ B_i`` to the
prior's precision, and with everything available measured at once the sum is the
identity (see :mod:`jaxcal.information.blocks`). A solver that reads nothing else picks
the same candidates in pulses, degrees or [0, 1]. Postures of the affine model are
blocks [u, 1] whose log det counts once per output.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import axis_names, numbers, require_finite, whole_number
from jaxcal.information.blocks import (
    log_det_blocks,
    missing_directions,
    prior_root,
    rank_of_blocks,
    whiten,
)
from jaxcal.information.excitation import directions_in_words, require_excited
from jaxcal.models.affine import Affine

__all__ = [
    "Problem",
    "log_dets",
    "make_block_problem",
    "make_problem",
    "make_problems",
    "whole_number",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_IN_PLANE = 1e-7  # of whitened rows of height one above the origin


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """Choose ``k`` of M candidates so that log det of the information is largest.

    All arrays are the problem's own and cannot be written to.
    """

    blocks: Array  # (M, q, p) whitened information blocks, zero where not available
    prior: Array  # (p, p) precision known beforehand, in the same coordinates
    k: int  # candidates to choose
    available: Mask  # (M,) True where a candidate may be chosen
    required: Indices  # (r,) candidates that must be chosen, r <= k
    max_replicates: int  # how often one candidate may be chosen
    multiplicity: int  # how often log det of the blocks counts
    log_scale: float  # log det of unwhitened less whitened information, of any choice
    raw: Array  # (M, q, p) blocks in the caller's numbers
    root: Array  # (r, p) root of the caller's prior precision
    candidates: Array | None = None  # (M, n) in the caller's unit, where there are any
    model: Affine | None = None  # what made blocks of the candidates

    @property
    def rows(self) -> Array:
        """(M, p) the blocks of a problem with one reading per candidate."""
        if self.blocks.shape[1] != 1:
            raise ValueError(
                "rows exist for one reading per candidate only, but blocks have "
                f"{self.blocks.shape[1]}"
            )
        return self.blocks[:, 0]

    @property
    def num_regressors(self) -> int:
        """p, n + 1 for the affine model."""
        return self.blocks.shape[2]

    @property
    def num_outputs(self) -> int:
        """m of the affine model: its multiplicity."""
        return self.multiplicity

    @property
    def num_parameters(self) -> int:
        """Size of the whole information matrix S."""
        return self.multiplicity * self.num_regressors

    @property
    def subject(self) -> str:
        """The argument that errors are about."""
        return "blocks" if self.candidates is None else "candidates"

    @property
    def lower(self) -> Indices:
        """(M,) how often each candidate must be chosen."""
        lower = np.zeros(len(self.blocks), dtype=np.int64)
        lower[self.required] = 1
        return lower

    @property
    def upper(self) -> Indices:
        """(M,) how often each candidate may be chosen."""
        return np.where(self.available, min(self.max_replicates, self.k), 0)

    @property
    def simplex(self) -> bool:
        """The k = p chosen span a simplex, and det is its squared volume.

        True where each candidate gives one reading, nothing is known beforehand and all
        rows lie in one plane off the origin, as those of [u, 1] do: the optimum then
        uses vertices of the convex hull only.
        """
        _, q, p = self.blocks.shape
        if q > 1 or self.k != p or len(self.root):
            return False
        height = self.rows @ self.rows.sum(axis=0)
        return bool((np.abs(height - 1.0) <= _IN_PLANE)[self.available].all())

    def log_det(self, indices: Indices) -> float:
        """log det S of a subset, natural, in the caller's units; -inf if singular."""
        return float(log_dets([self], np.asarray(indices)[None, None])[0, 0])


def log_dets(problems: list[Problem], indices: Indices) -> Array:
    """log det S (S, R) of subsets (S, R, k) of S problems made together."""
    chosen = [problem.raw[of] for problem, of in zip(problems, indices, strict=True)]
    value = log_det_blocks(np.stack(chosen), problems[0].root)
    return problems[0].multiplicity * value


def make_problem(
    candidates: ArrayLike,
    k: int | None = None,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> Problem:
    """Check one set of candidates (M, n); arguments as for :func:`make_problems`."""
    array = numbers("candidates", candidates, finite=False)
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
    k: int | None = None,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
    single: bool = False,
) -> list[Problem]:
    """Check a batch of candidate sets and whiten it.

    Args:
        candidates: (B, M, n) float, any unit; NaN where masked does no harm.
        k: postures to choose in each set, at least n + 1, which is the default.
        available: (B, M) bool, True where a candidate may be chosen.
        required: (B, r) indices that must be chosen.
        max_replicates: how often one candidate may be chosen.
        num_outputs: m; as many as inputs when not given.
        single: leave the batch axis out of error messages.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    array = numbers("candidates", candidates, finite=False)
    if array.ndim != 3 or array.shape[2] < 1 or array.shape[0] < 1:
        raise ValueError(f"candidates must have shape (B, M, n), got {array.shape}")
    n = array.shape[2]
    mask = _check_available(available, array.shape[:2], single)
    array = _usable_numbers("candidates", array, mask, single)
    k = n + 1 if k is None else whole_number("k", k, 1)
    if k < n + 1:
        raise ValueError(
            f"k must be at least {n + 1}, the number of regressors of {n} inputs and a "
            f"bias, got {k}"
        )
    m = n if num_outputs is None else whole_number("num_outputs", num_outputs, 1)
    model = Affine(n, m)
    cap, forced = _check_counts(mask, k, required, max_replicates, single)
    raw, root = model.blocks(array), np.zeros((0, n + 1))
    blocks, prior, _, log_scale, singular = whiten(raw, mask, root)
    if singular.size:
        b = int(singular[0])
        where = "available ones" + _in_set(b, single)
        names = axis_names("names", None, "u", n)
        require_excited(array[b][mask[b]], names, "candidates", where)
    for each in (array, raw, blocks, prior, mask, forced):
        each.flags.writeable = False
    problems = [
        Problem(
            blocks[b], prior[b], k, mask[b], forced[b], cap, model.multiplicity,
            float(log_scale[b]), raw[b], root, array[b], model,
        )
        for b in range(len(array))
    ]  # fmt: skip
    if forced.shape[1]:
        for b, problem in enumerate(problems):
            _check_required_rank(problem, _in_set(b, single))
    return problems


def make_block_problem(
    blocks: ArrayLike,
    k: int | None = None,
    *,
    prior: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> Problem:
    """Check information blocks and whiten them.

    Args:
        blocks: (M, q, p); candidate i gives q readings, ``y = B_i theta + noise`` with
            noise of unit variance, and adds ``B_i.T @ B_i`` to the information.
        k: candidates to choose; enough that they alone identify p when not given.
        prior: (p, p) precision of what is known beforehand, zero when not given.
        available, required, max_replicates: as above, (M,) and (r,).
        num_outputs: how often log det counts, 1 when not given.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    array = numbers("blocks", blocks, finite=False)
    if array.ndim != 3 or 0 in array.shape:
        raise ValueError(
            f"blocks must have shape (M, q, p) with none of them 0, got {array.shape}"
        )
    _, q, p = array.shape
    given = None if available is None else _leading_axis("available", available)
    mask = _check_available(given, (1, len(array)), True)
    raw = _usable_numbers("blocks", array[None], mask, True)
    root = np.zeros((0, p))
    if prior is not None:
        precision = numbers("prior", prior)
        if precision.shape != (p, p):
            raise ValueError(
                f"prior must be a precision of shape ({p}, {p}), got {precision.shape}"
            )
        root = prior_root(precision)
    most = q if q == 1 else int(rank_of_blocks(raw[0][:, None], root[:0]).max())
    if k is None:
        k = -(-p // max(most, 1))
    k = whole_number("k", k, 1)
    if k * most + len(root) < p:
        known = f" and {len(root)} known beforehand" if len(root) else ""
        raise ValueError(
            f"k must be at least {-(-(p - len(root)) // max(most, 1))} for {p} "
            f"parameters, at most {most} of them from a candidate{known}, got {k}"
        )
    m = 1 if num_outputs is None else whole_number("num_outputs", num_outputs, 1)
    forced = None if required is None else _leading_axis("required", required)
    cap, chosen = _check_counts(mask, k, forced, max_replicates, True)
    white, whitened_prior, _, log_scale, singular = whiten(raw, mask, root)
    if singular.size:
        null = missing_directions(raw[0][mask[0]], root)
        names = tuple(f"theta{i + 1}" for i in range(p))
        raise ValueError(
            "blocks must inform every parameter, but the available ones"
            + (" and the prior" if len(root) else "")
            + directions_in_words(" say nothing of the direction{} ", null, names)
        )
    for each in (raw, root, white, whitened_prior, mask, chosen):
        each.flags.writeable = False
    problem = Problem(
        white[0], whitened_prior[0], k, mask[0], chosen[0], cap, m,
        float(log_scale[0]), raw[0], root,
    )  # fmt: skip
    if len(problem.required):
        _check_required_rank(problem, "")
    return problem


def _usable_numbers(name: str, array: Array, mask: Mask, single: bool) -> Array:
    """A copy, finite where available; what is not finite elsewhere becomes zero."""
    own = np.array(array, order="C")
    bad = ~np.isfinite(own)
    if bad.any():
        hidden = bad & ~mask.reshape(*mask.shape, *[1] * (own.ndim - 2))
        own[hidden] = 0.0
        require_finite(name, own[0] if single else own)
    return own


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
    available: ArrayLike | None, shape: tuple[int, ...], single: bool
) -> Mask:
    if available is None:
        return np.ones(shape, dtype=np.bool_)
    mask = np.array(available)
    if mask.dtype != np.bool_:
        raise ValueError(
            "available must be an array of bool (True = may be chosen), "
            f"got dtype {mask.dtype}"
        )
    if mask.shape != shape:
        want, got = (shape[1:], mask.shape[1:]) if single else (shape, mask.shape)
        raise ValueError(f"available must have shape {want}, got {got}")
    return mask


def _check_counts(
    mask: Mask, k: int, required: ArrayLike | None, max_replicates: int, single: bool
) -> tuple[int, Indices]:
    """The cap on replicates and the required candidates (B, r)."""
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
            + f"{_in_set(short[0], single)}, got {k}"
        )
    return cap, _check_required(required, mask, k, single)


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
    r, p = len(problem.required), problem.num_regressors
    rank = int(rank_of_blocks(problem.raw[problem.required], problem.root))
    room = (problem.k - r) * problem.blocks.shape[1]
    if p - rank > room:
        raise ValueError(
            f"required must leave room for an invertible selection: the {r} required "
            f"candidates{where} span {rank} of {p} regressors, so at least {p - rank} "
            f"more are needed, got room for {room} (k = {problem.k})"
        )
