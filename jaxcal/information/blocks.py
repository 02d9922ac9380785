"""Information blocks: their log det, rank and whitening.

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

from jaxcal import compiled
from jaxcal.information.singular import (
    SINGULAR,
    null_directions,
    rank_rule,
    significant,
)

__all__ = [
    "Whitened",
    "coarseness",
    "largest_rank",
    "missing_directions",
    "prior_root",
    "rank_of_blocks",
    "triangle",
    "whiten",
    "without",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EPS = float(np.finfo(np.float64).eps)
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


def rank_of_blocks(
    blocks: Array, root: Array, size: Array | None = None
) -> tuple[list[int], Array]:
    """Rank and natural log det, -inf where singular, of information blocks.

    Args:
        blocks: (S, N, q, p), the N of each of S sets measured together.
        root: (r, p) of the prior precision, r = 0 without one.
        size: (p,) of what the blocks were computed beside, the largest of a model's
            derivatives; None: they are the caller's own numbers.

    Returns:
        (S,) of both.
    """
    rows, largest, _ = _kernel().centred(blocks, None, root)
    if size is None:
        return rank_rule(rows, largest, blocks.shape[1])
    largest = np.maximum(largest, size)
    return rank_rule(rows, largest, blocks.shape[1], computed=True)


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
        rank = max(rank, rank_of_blocks(block[None, None], none)[0][0])
        if rank == full:
            break
    return rank


def missing_directions(
    blocks: Array, root: Array, coarse: float = 1.0, computed: bool = False
) -> list[Array]:
    """Directions (p,) that neither blocks (N, q, p) nor the prior say anything of."""
    rows, largest, _ = _kernel().centred(blocks[None], None, root)
    return null_directions(rows[0], coarse * largest[0], computed)


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
    triangle: Array  # (p, p): whitened blocks times it are the centred raw ones
    size: Array | None  # (p,) of what computed blocks are rounded by, or None
    log_scale: float  # log det of unwhitened less whitened information


def whiten(
    blocks: Array,
    usable: Mask,
    root: Array,
    *,
    coarse: float = 1.0,
    computed: bool = False,
) -> list[Whitened | None]:
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

    Returns:
        One of every set, read-only; None where T is singular.
    """
    rows, largest, shift, white, back, basis, log_scale, lost = _kernel().whitened(
        blocks, usable.view(np.uint8), root, coarse
    )
    sets, num, q, p = blocks.shape
    for n in range(sets):
        if lost[n] <= _LOSS:
            continue
        # Columns are nearly dependent: by rotations, twice.
        one, size = rows[n : n + 1], coarse * largest[n : n + 1]
        if rank_rule(one, size, num, computed)[0][0] < p:
            continue
        scale = np.linalg.norm(rows[n], axis=0)
        first = triangle(rows[n] / scale)
        once = np.linalg.inv(first) / scale[:, None]
        second = triangle(rows[n] @ once)
        once = once @ np.linalg.inv(second)
        back[n], white[n] = second @ first * scale, rows[n] @ once
        basis[n] = once - shift[n] @ once
        log_scale[n] = 2.0 * float(np.log(np.abs(np.diagonal(back[n]))).sum())
        lost[n] = 0.0
    prior = np.zeros((sets, p, p))
    if len(root):
        known, white = white[:, num * q :], white[:, : num * q]
        prior = known.transpose(0, 2, 1) @ known
    parts = (white.reshape(blocks.shape), prior, basis, back)
    for part in (*parts, largest):
        part.flags.writeable = False
    size = largest if computed else [None] * sets
    found = map(Whitened, *parts, size, log_scale)
    return [one if lost[n] <= _LOSS else None for n, one in enumerate(found)]
