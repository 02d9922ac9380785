"""Information blocks: their log det, the rule of singularity, and whitening.

Measuring candidate i adds ``B_i.T @ B_i`` to the information, B_i a block (q, p): q
readings, p parameters. A prior of precision P comes as a root (r, p) with
``root.T @ root = P``, which is one more block. An affine posture is the block [u, 1].

Columns that are the same in every block (the ones that multiply a bias) are used to
centre the other columns: a linear map of the parameters with determinant one, exact to
the last place of the numbers given, so encoder pulses far from zero keep their digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Whitened",
    "coarseness",
    "largest_rank",
    "log_det_blocks",
    "missing_directions",
    "null_directions",
    "prior_root",
    "rank_of_blocks",
    "rank_rule",
    "significant",
    "triangle",
    "whiten",
    "without",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SINGULAR = 1e-10  # share of the largest; derivatives are exact to about 1e-13 of it
_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_SURE = 1e5  # times the tolerance: pivots above it leave no doubt of the rank
_LOSS = 1e-9  # of orthogonality that whitened rows may have
_MENDED = 1e-3  # loss below which a second factor restores all of it


def triangle(rows: Array) -> Array:
    """(..., min(R, p), p) R of the QR factors of rows (..., R, p).

    Many rows go in parts: BLAS shares a large part out among threads, which for these
    sizes takes ten times as long as one thread does.
    """
    *lead, count, p = rows.shape
    part = max(128, 2 * p)
    while count > part:
        short = np.zeros((*lead, -count % part, p))
        parts = np.concatenate([rows, short], axis=-2).reshape(*lead, -1, part, p)
        rows = np.asarray(np.linalg.qr(parts, mode="r")).reshape(*lead, -1, p)
        count = rows.shape[-2]
    return np.asarray(np.linalg.qr(rows, mode="r"))


def rank_rule(
    columns: Array, largest: Array, count: int | None = None
) -> tuple[NDArray[np.int64], Array]:
    """Rank and log det of ``columns.T @ columns``: the one rule of what is singular.

    Numbers are exact to half a unit in the last place of their size, not of their
    spread: a direction no wider than that is rounding, not information.

    Args:
        columns: (..., R, p) stacked blocks, centred.
        largest: (..., p) largest entry of each column before centring.
        count: rows that rounding errors add up over; R when not given.

    Returns:
        (...,) rank, and (...,) natural log det, -inf where the rank is below p.
    """
    num_rows, p = columns.shape[-2:]
    norms, flat, rounding = _norms(columns, largest, count or num_rows)
    if flat.any():
        columns, norms = np.where(flat, 0.0, columns), np.where(flat, 1.0, norms)
    unit, rounding = columns / norms, np.asarray(rounding)
    if num_rows >= p:  # pivots first: they cost a third of the singular values
        pivots = np.abs(np.diagonal(triangle(unit), axis1=-2, axis2=-1))
        rank = np.full(rounding.shape, p)
    else:
        pivots, rank = np.zeros((*rounding.shape, p)), np.zeros(rounding.shape, int)
    doubtful = np.asarray(pivots.min(axis=-1) <= _SURE * rounding)
    sizes = np.maximum(pivots, _TINY)
    if doubtful.any():
        singular = np.linalg.svd(unit[doubtful], compute_uv=False)
        rank[doubtful] = (singular > rounding[doubtful, None]).sum(axis=-1)
    value = 2.0 * (np.log(sizes).sum(axis=-1) + np.log(norms[..., 0, :]).sum(axis=-1))
    return rank, np.where(rank == p, value, -np.inf)


def _norms(columns: Array, largest: Array, count: int) -> tuple[Array, Mask, Array]:
    """Column norms (..., 1, p), which are mere rounding, and the tolerance (...,)."""
    norms = np.sqrt(np.einsum("...ij,...ij->...j", columns, columns))
    resolution = _EPS * max(count, 1)
    flat = norms <= resolution * largest
    rounding = (largest / np.where(flat, np.inf, norms)).max(axis=-1)
    return (
        norms[..., None, :],
        flat[..., None, :],
        resolution * np.maximum(8.0, rounding),
    )


def null_directions(columns: Array, largest: Array) -> list[Array]:
    """Directions (p,) of which ``columns`` (R, p) say nothing by the rule above.

    Axes that no row moves come first, then a basis of the rest of the null space.
    """
    p = columns.shape[1]
    norms, flat, tolerance = _norms(columns, largest, len(columns))
    norms, flat = norms[0], flat[0]
    scaled = np.where(flat, 0.0, columns / np.where(flat, 1.0, norms))
    scaled = np.pad(scaled, ((0, max(0, p - len(scaled))), (0, 0)))
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    null = [np.eye(p)[i] for i in np.flatnonzero(flat)]
    free = right[singular <= tolerance][:, ~flat]
    if free.size:
        basis, size, _ = np.linalg.svd(free.T, full_matrices=False)
        for vector in basis.T[size > 0.5]:
            direction = np.zeros(p)
            direction[~flat] = vector / norms[~flat]
            null.append(direction)
    return null


def significant(size: NDArray[Any], squares: bool = False) -> Mask:
    """Which singular values (..., r) of columns in comparable units are no rounding.

    The rule above is for the caller's own numbers, this one for what follows from them.

    Args:
        size: singular values, or eigenvalues.
        squares: they are eigenvalues of a product of these columns with themselves.
    """
    share = 8.0 * _EPS * size.shape[-1] if squares else SINGULAR
    return size > share * size.max(axis=-1, initial=0.0, keepdims=True)


def without(nuisance: Array, *others: Array) -> list[Array]:
    """``others`` (R, ...) in a basis across the columns of ``nuisance`` (R, s)."""
    basis, size, _ = np.linalg.svd(nuisance, full_matrices=False)
    basis = basis[:, significant(size)]
    across = np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :].T
    return [across @ each for each in others]


def prior_root(precision: Array) -> Array:
    """(r, p) root of a precision (p, p) of rank r, ``root.T @ root = precision``.

    Raises:
        ValueError: it is not symmetric or not positive semidefinite.
    """
    p = len(precision)
    size = np.sqrt(np.abs(np.diagonal(precision)))
    scale = np.where(size > 0.0, size, 1.0)
    unit = precision / scale[:, None] / scale
    tolerance = 1e-9 * p
    if np.abs(unit - unit.T).max(initial=0.0) > tolerance:
        raise ValueError(
            "prior must be a symmetric precision matrix, got one that is not"
        )
    values, vectors = np.linalg.eigh((unit + unit.T) / 2.0)
    if values.min(initial=0.0) < -tolerance:
        raise ValueError(
            "prior must be a positive semidefinite precision matrix, got eigenvalue "
            f"{values.min():.3g} in units of its diagonal"
        )
    keep = significant(values, squares=True)
    return np.sqrt(values[keep])[:, None] * vectors.T[keep] * scale


def _stack(
    blocks: Array, usable: Mask | None, root: Array
) -> tuple[Array, Array, Array]:
    """Centred rows (..., N q + r, p) of blocks and prior, and the largest entries.

    The third is the map (..., p, p) that was subtracted: rows are ``B - B @ shift``.
    """
    *batch, count, q, p = blocks.shape
    if usable is None:
        first = blocks[..., :1, :, :]
        same = blocks == first
    else:
        weight = usable[..., None, None]
        blocks = blocks * weight
        at = usable.argmax(axis=-1)[..., None, None, None]
        first = np.take_along_axis(blocks, at, axis=-3)
        same = (blocks == first) | ~weight
    same = same.all(axis=(-3, -2))[..., None, :]
    constant = first[..., 0, :, :] * same
    rows = np.empty((*batch, count * q + len(root), p))
    centred = rows[..., : count * q, :].reshape(*batch, count, q, p)  # a view
    if constant.any() and not same.all():
        number = count if usable is None else usable.sum(axis=-1)[..., None, None]
        if q == 1:
            square = (constant * constant).sum(axis=-1, keepdims=True)
            inverse = np.matrix_transpose(constant) / np.maximum(square, _TINY)
        else:
            inverse = np.linalg.pinv(constant)
        shift = inverse @ (blocks.sum(axis=-3) / number * ~same)
        np.subtract(blocks, (constant @ shift)[..., None, :, :], out=centred)
        if usable is not None:
            centred *= weight
    else:
        shift = np.zeros((*batch, p, p))
        centred[...] = blocks
    largest = np.abs(blocks).max(axis=(-3, -2))
    if len(root):
        rows[..., count * q :, :] = root - root @ shift
        largest = np.maximum(largest, np.abs(root).max(axis=0))
    return rows, largest, shift


def log_det_blocks(blocks: Array, root: Array) -> Array:
    """``log det(root.T @ root + sum of B_i.T @ B_i)`` of blocks measured together.

    Args:
        blocks: (..., N, q, p).
        root: (r, p) of the prior precision, r = 0 without one.

    Returns:
        (...,) natural log; -inf where singular.
    """
    rows, largest, _ = _stack(blocks, None, root)
    return rank_rule(rows, largest, blocks.shape[-3])[1]


def rank_of_blocks(blocks: Array, root: Array) -> NDArray[np.int64]:
    """(...,) rank of the information of blocks (..., N, q, p) measured together."""
    rows, largest, _ = _stack(blocks, None, root)
    return rank_rule(rows, largest, blocks.shape[-3])[0]


def largest_rank(blocks: Array) -> int:
    """Of single blocks (N, q, p); the first is nearly always of full rank.

    1 for one reading each, looked at or not: what is zero adds no direction anyway.
    """
    if blocks.shape[1] == 1:
        return 1
    full, none = min(blocks.shape[1:]), np.zeros((0, blocks.shape[2]))
    gram = blocks[0] @ blocks[0].T
    scale = np.sqrt(np.diagonal(gram))
    if len(gram) == full and scale.all():  # cheap, and enough where it is clear
        if np.linalg.eigvalsh(gram / scale / scale[:, None])[0] > SINGULAR:
            return full
    for some in (blocks[:1], blocks):
        rank = int(rank_of_blocks(some[:, None], none).max(initial=0))
        if rank == full:
            break
    return rank


def missing_directions(blocks: Array, root: Array, coarse: float = 1.0) -> list[Array]:
    """Directions (p,) that neither blocks (N, q, p) nor the prior say anything of."""
    rows, largest, _ = _stack(blocks, None, root)
    return null_directions(rows, coarse * largest)


def coarseness(given: object) -> float:
    """How many times coarser than float64 the numbers of an array are."""
    kind = getattr(given, "dtype", np.asarray(given).dtype)
    if isinstance(kind, np.dtype) and kind.kind == "f":
        return max(1.0, float(np.finfo(kind).eps) / _EPS)
    return 1.0


class Whitened(NamedTuple):
    """S sets of blocks in coordinates where everything together has information I."""

    blocks: Array  # (S, M, q, p), zero where not usable
    prior: Array  # (S, p, p) precision
    basis: Array  # (S, p, p): raw blocks times it are whitened
    log_scale: Array  # (S,) log det of unwhitened less whitened information
    singular: NDArray[np.int64]  # the sets whose information is; the rest is not theirs
    triangle: Array  # (S, p, p): whitened blocks times it are the centred raw ones
    size: Array  # (S, p) of what the centred blocks are rounded by, beside themselves


def whiten(
    blocks: Array,
    usable: Mask,
    root: Array,
    *,
    coarse: float = 1.0,
    computed: bool = False,
) -> Whitened:
    """Blocks in coordinates where everything measured at once has information I.

    With T = prior + sum of the usable ``B_i.T @ B_i`` = R.T R the whitened block is
    ``B_i R^-1``, and log det of any selection is its whitened log det plus log det T. A
    linear map of the parameters rotates the whitened blocks and nothing else.

    Args:
        blocks: (S, M, q, p) of S sets.
        usable: (S, M) which count.
        root: (r, p) of the prior precision.
        coarse: how many times coarser than float64 the numbers are, for the rule of
            what is singular.
        computed: the blocks are rounded themselves, as a model's derivatives are.
    """
    num_sets, count, q, p = blocks.shape
    everything = bool(usable.all())
    rows, largest, shift = _stack(blocks, None if everything else usable, root)
    coarsest = coarse * largest
    gram = np.matrix_transpose(rows) @ rows
    norms = np.sqrt(np.diagonal(gram, axis1=1, axis2=2))
    scale = np.where(norms == 0.0, 1.0, norms)
    triangle, inverse = _triangle(gram, rows, scale)
    pivots = np.abs(np.diagonal(triangle, axis1=1, axis2=2))
    # A cheap test first: only a set that looks nearly singular pays for the rule.
    doubtful = (norms < 1e-6 * coarsest).any(axis=1) | (pivots < 1e-6).any(axis=1)
    at = np.flatnonzero(doubtful)
    if at.size:
        at = at[np.isneginf(rank_rule(rows[at], coarsest[at], count)[1])]
        inverse[at] = np.eye(p)
    with np.errstate(divide="ignore"):
        log_scale = 2.0 * np.log(pivots * scale).sum(axis=1)
    basis = inverse / scale[:, :, None]
    white = rows @ basis
    of_prior = white[:, count * q :]
    return Whitened(
        white[:, : count * q].reshape(num_sets, count, q, p),
        np.matrix_transpose(of_prior) @ of_prior,
        basis - shift @ basis,
        log_scale,
        at,
        triangle * scale[:, None],
        largest if computed else np.zeros_like(largest),
    )


def _triangle(gram: Array, rows: Array, scale: Array) -> tuple[Array, Array]:
    """R (S, p, p) with ``R.T @ R = rows.T @ rows`` in unit columns, and its inverse.

    The factor of the Gram matrix is the cheapest; it leaves ``rows R^-1`` orthonormal
    to about ``eps |R^-1|^2``. Where that is too much, the same of ``rows R^-1`` makes
    up for it, and of nearly dependent columns the factor is by rotations.

    Args:
        gram: (S, p, p) of the rows.
        rows: (S, R, p).
        scale: (S, p) lengths of the columns, 1 where one is zero.
    """
    p = gram.shape[-1]
    try:
        lower = np.linalg.cholesky(gram / scale[:, :, None] / scale[:, None])
        inverse = np.matrix_transpose(np.linalg.inv(lower))
        lost = _EPS * float((inverse * inverse).sum(axis=(1, 2)).max())
        if lost <= _LOSS:
            return np.matrix_transpose(lower), inverse
        if lost <= _MENDED:
            near = rows @ (inverse / scale[:, :, None])
            second = np.linalg.cholesky(np.matrix_transpose(near) @ near)
            inverse = inverse @ np.matrix_transpose(np.linalg.inv(second))
            return np.matrix_transpose(lower @ second), inverse
    except np.linalg.LinAlgError:
        pass
    short = max(0, p - rows.shape[1])
    padded = np.pad(rows / scale[:, None], ((0, 0), (0, short), (0, 0)))
    factor = triangle(padded)
    regular = (np.diagonal(factor, axis1=1, axis2=2) != 0.0).all(axis=1)
    whole = np.where(regular[:, None, None], factor, np.eye(p))
    return factor, np.linalg.inv(whole)
