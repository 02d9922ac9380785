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
from numpy.typing import ArrayLike, NDArray

from jaxcal import compiled

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
_SURE = 1e5  # times the tolerance: pivots above it leave no doubt of the rank
_LOSS = 1e-9  # of orthogonality that whitened rows may have


def _kernel() -> Any:
    return compiled.kernel("jaxcal.information.kernel")


def triangle(rows: Array) -> Array:
    """(min(R, p), p) R of the QR factors of rows (R, p).

    Many rows go in parts: BLAS shares a large part out among threads, which for these
    sizes takes ten times as long as one thread does.
    """
    count, p = rows.shape
    part = max(128, 2 * p)
    while count > part:
        parts = np.concatenate([rows, np.zeros((-count % part, p))])
        rows = np.asarray(np.linalg.qr(parts.reshape(-1, part, p), mode="r"))
        rows = rows.reshape(-1, p)
        count = len(rows)
    return np.asarray(np.linalg.qr(rows, mode="r"))


def rank_rule(
    columns: Array, largest: Array, count: int | None = None
) -> tuple[int, float]:
    """Rank and log det of ``columns.T @ columns``: the one rule of what is singular.

    Numbers are exact to half a unit in the last place of their size, not of their
    spread: a direction no wider than that is rounding, not information.

    Args:
        columns: (R, p) stacked blocks, centred.
        largest: (p,) largest entry of each column before centring.
        count: rows that rounding errors add up over; R when not given.

    Returns:
        Rank, and natural log det, -inf where the rank is below p.
    """
    columns = np.ascontiguousarray(columns)
    p, count = columns.shape[1], count or len(columns)
    norms, rounding, least, value = _kernel().scaled(columns, largest, count)
    rank = p
    if least <= _SURE * rounding:  # distances of columns are cheaper
        unit = columns / np.where(norms > 0.0, norms, np.inf)
        rank = int((np.linalg.svd(unit, compute_uv=False) > rounding).sum())
    return rank, value if rank == p else -np.inf


def null_directions(columns: Array, largest: Array) -> list[Array]:
    """Directions (p,) of which ``columns`` (R, p) say nothing by the rule above.

    Axes that no row moves come first, then a basis of the rest of the null space.
    """
    columns, p = np.ascontiguousarray(columns), columns.shape[1]
    norms, rounding, *_ = _kernel().scaled(columns, largest, len(columns))
    flat = norms == 0.0
    unit = columns / np.where(flat, np.inf, norms)
    unit = np.pad(unit, ((0, max(0, p - len(unit))), (0, 0)))
    _, singular, right = np.linalg.svd(unit, full_matrices=False)
    null = [np.eye(p)[i] for i in np.flatnonzero(flat)]
    free = right[singular <= rounding][:, ~flat]
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


def rank_of_blocks(blocks: Array, root: Array) -> tuple[int, float]:
    """Rank and log det of the information of blocks (N, q, p) measured together."""
    rows, largest, _ = _kernel().centred(blocks, None, root)
    return rank_rule(rows, largest, len(blocks))


def log_det_blocks(blocks: ArrayLike, root: Array) -> Array:
    """``log det(root.T @ root + sum of B_i.T @ B_i)`` of blocks measured together.

    Args:
        blocks: (..., N, q, p).
        root: (r, p) of the prior precision, r = 0 without one.

    Returns:
        (...,) natural log; -inf where singular.
    """
    array = np.ascontiguousarray(blocks, dtype=np.float64)
    sets = array.reshape(-1, *array.shape[-3:])
    values = [rank_of_blocks(each, root)[1] for each in sets]
    return np.array(values).reshape(array.shape[:-3])


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
    rank = 0
    for block in blocks:
        rank = max(rank, rank_of_blocks(block[None], none)[0])
        if rank == full:
            break
    return rank


def missing_directions(blocks: Array, root: Array, coarse: float = 1.0) -> list[Array]:
    """Directions (p,) that neither blocks (N, q, p) nor the prior say anything of."""
    rows, largest, _ = _kernel().centred(blocks, None, root)
    return null_directions(rows, coarse * largest)


def coarseness(given: object) -> float:
    """How many times coarser than float64 the numbers of an array are."""
    kind = getattr(given, "dtype", np.asarray(given).dtype)
    if isinstance(kind, np.dtype) and kind.kind == "f":
        return max(1.0, float(np.finfo(kind).eps) / _EPS)
    return 1.0


class Whitened(NamedTuple):
    """Blocks in coordinates where everything together has information I."""

    blocks: Array  # (M, q, p), zero where not usable
    prior: Array  # (p, p) precision
    basis: Array  # (p, p): raw blocks times it are whitened
    log_scale: float  # log det of unwhitened less whitened information
    triangle: Array  # (p, p): whitened blocks times it are the centred raw ones
    size: Array  # (p,) of what the centred blocks are rounded by, beside themselves


def whiten(
    blocks: Array,
    usable: Mask,
    root: Array,
    *,
    coarse: float = 1.0,
    computed: bool = False,
) -> Whitened | None:
    """Blocks in coordinates where everything measured at once has information I.

    With T = prior + sum of the usable ``B_i.T @ B_i`` = R.T R the whitened block is
    ``B_i R^-1``, and log det of any selection is its whitened log det plus log det T. A
    linear map of the parameters rotates the whitened blocks and nothing else. None
    where T is singular.

    Args:
        blocks: (M, q, p).
        usable: (M,) which count.
        root: (r, p) of the prior precision.
        coarse: how many times coarser than float64 the numbers are, for the rule of
            what is singular.
        computed: the blocks are rounded themselves, as a model's derivatives are.
    """
    rows, largest, shift, white, back, basis, log_scale, lost = _kernel().whitened(
        blocks, usable.view(np.uint8), root, coarse
    )
    if not lost <= _LOSS:  # of nearly dependent columns by rotations, twice
        if rank_rule(rows, coarse * largest, len(blocks))[0] < rows.shape[1]:
            return None
        scale = np.linalg.norm(rows, axis=0)
        first = triangle(rows / scale)
        basis = np.linalg.inv(first) / scale[:, None]
        second = triangle(rows @ basis)
        basis = basis @ np.linalg.inv(second)
        back, white = second @ first * scale, rows @ basis
        log_scale = 2.0 * float(np.log(np.abs(np.diagonal(back))).sum())
    count, p = blocks.shape[0] * blocks.shape[1], blocks.shape[2]
    known = white[count:]
    return Whitened(
        white[:count].reshape(blocks.shape),
        known.T @ known if len(root) else np.zeros((p, p)),
        basis - shift @ basis,
        log_scale,
        back,
        largest if computed else np.zeros(p),
    )
