"""Information blocks: their log det, rank and whitening.

Measuring candidate i adds ``B_i.T @ B_i`` to the information, B_i a block (q, p): q
readings, p parameters. A prior of precision P is one more block, a root (r, p) with
``root.T @ root = P``. An affine posture is the block [u, 1].

Columns that are the same in every block (the ones that multiply a bias) centre the
others: a linear map of the parameters with determinant one, exact to the last place, so
encoder pulses far from zero keep their digits. Columns that could over- or underflow
are first divided by powers of two. A row far from all others (1e7 beside 1) must not
hide what distinguishes these: columns with such rows are centred where rows are densest
and made orthogonal first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxcal import compiled
from jaxcal.checks import Array, Mask
from jaxcal.information.singular import (
    SINGULAR,
    SMALL,
    SURE,
    null_directions,
    power_of_two,
    rank_rule,
    significant,
)

_EPS = float(np.finfo(np.float64).eps)
_LOSS = 1e-9  # of orthogonality that whitened rows may have
_CLEAR = 1e6  # share of its digits that a column may lose by centring
_FAR = 1e5  # times the distance of neighbours: such a row hides what these differ by
_SOME = 256  # candidates, or a few less, of which neighbours are looked at
_UNTHREADED = 240_000  # multiplications up to which BLAS starts no threads
_ROWS = 200  # of fewer a product takes less time than its sum


class _CentredBlocks(NamedTuple):
    """Rows of blocks and prior, less what is the same in every block of a set."""

    rows: Array  # (S, M q + r, p) ``(B - B @ shift) / scale``
    largest: Array  # (S, p) largest entry of each column of B / scale
    scale: Array | None  # (S, p) powers of two; None: all 1
    shift: Array | None  # (S, p, p), of columns divided by ``scale``; None: zero
    far: Mask | None  # (S,) whether a row is far from the others; None: none is


def _centred(
    blocks: Array, usable: Mask | None, root: Array, look: bool = False
) -> _CentredBlocks:
    """Blocks (S, M, q, p), zero where not ``usable`` (S, M), and ``root``, centred;
    ``look`` whether rows are far from the others."""
    sets, count, q, p = blocks.shape
    first, masked = blocks[:, :1], usable is not None and not usable.all()
    if masked:
        assert usable is not None
        first = blocks[np.arange(sets), usable.argmax(axis=1)][:, None]
        blocks = np.where(usable[..., None, None], blocks, first)
    columns = np.ascontiguousarray(blocks.transpose(0, 2, 3, 1))  # reduced in order
    # Some candidates, each column in order: all where they are not many.
    ordered = np.sort(columns[..., :: 1 + count // _SOME])
    least, most = ordered[..., 0], ordered[..., -1]  # (S, q, p)
    if count >= _SOME:
        least, most = columns.min(axis=-1), columns.max(axis=-1)
    same, largest = least == most, np.maximum(most, -least)
    if q > 1:
        same, largest = same.all(axis=1, keepdims=True), largest.max(axis=1)
    largest = largest.reshape(sets, p)
    if len(root):
        largest = np.maximum(largest, np.abs(root).max(axis=0))
    scale = None
    sizes = largest.ravel().tolist()
    if not (SMALL < min(sizes) and max(sizes) < 1.0 / SMALL):
        scale = power_of_two(largest)
        largest = largest / scale
        blocks, first = blocks / scale[:, None, None], first / scale[:, None, None]
        columns, ordered = (x / scale[:, None, :, None] for x in (columns, ordered))
        root = root / scale[:, None]
    where_far, dense = _far(ordered, largest, same) if look else (None, None)
    shift, constant = None, first[:, 0] * same
    if np.count_nonzero(constant) and np.count_nonzero(same) < same.size:
        mean = _mean(columns, first, usable if masked else None)
        if where_far is not None and dense is not None:
            mean = np.where(where_far, dense, mean)
        shift, centre = _shift(constant, mean * ~same)
        blocks = blocks - centre[:, None]
    if masked:
        blocks = np.where(usable[..., None, None], blocks, 0.0)  # type: ignore[index]
    rows = blocks.reshape(sets, count * q, p)
    if len(root):
        prior = root if shift is None else root - root @ shift
        prior = np.broadcast_to(prior, (sets, *prior.shape[-2:]))
        rows = np.concatenate([rows, prior], axis=1)
    far = None if where_far is None else np.asarray(where_far.any(axis=(1, 2)))
    return _CentredBlocks(rows, largest, scale, shift, far)


def _mean(columns: Array, first: Array, usable: Mask | None) -> Array:
    """(S, q, p) of (S, q, p, M) that are usable; the others are equal to ``first``."""
    total, count = np.add.reduce(columns, axis=-1), columns.shape[-1]
    if usable is None:
        total /= count
        return total
    missing = count - usable.sum(axis=1)[:, None, None]
    return np.asarray((total - missing * first[:, 0]) / np.maximum(count - missing, 1))


def _shift(constant: Array, centre: Array) -> tuple[Array, Array]:
    """(S, p, p) with ``constant @ shift`` nearest the centre, and (S, q, p) that."""
    sets, q, _ = constant.shape
    if q > 1:
        shift = np.linalg.pinv(constant) @ centre
        return shift, constant @ shift
    size = np.vecdot(constant, constant)[..., None]
    if sets == 1:
        return constant.mT / size * centre, centre
    size[size == 0.0] = 1.0
    shift = constant.mT / size * centre
    return shift, constant @ shift  # of sets without constants it is zero


def _far(
    ordered: Array, largest: Array, same: Mask
) -> tuple[Mask | None, Array | None]:
    """Where entries (S, q, p, N), in order, are far, and where densest, (S, q, p), by
    the smallest distance between a few neighbours; None where none is far."""
    few = 1 + ordered.shape[-1] // 32
    apart = ordered[..., few:] - ordered[..., :-few]
    near = apart * _FAR < largest[:, None, :, None]
    if np.count_nonzero(near) == apart.size - np.count_nonzero(apart):  # zeros
        return None, None
    near &= apart > 0.0
    at = np.where(apart > 0.0, apart, np.inf).argmin(axis=-1)[..., None]
    return near.any(axis=-1) & ~same, np.take_along_axis(ordered, at, axis=-1)[..., 0]


def _parts(rows: Array) -> Array:
    """(..., parts, R, p) of (..., N, p), filled with zeros: BLAS starts no threads."""
    *sets, count, p = rows.shape
    part = max(1, _UNTHREADED // (p * p))
    empty = np.zeros((*sets, -count % part, p))
    return np.concatenate([rows, empty], axis=-2).reshape(*sets, -1, part, p)


def _times(rows: Array, matrix: Array) -> Array:
    """``rows @ matrix`` of (..., N, p) and (..., p, p)."""
    if rows[..., 0].size * matrix.shape[-1] ** 2 <= _UNTHREADED:
        return np.asarray(rows @ matrix)
    product = _parts(rows) @ matrix[..., None, :, :]
    return product.reshape(*rows.shape[:-2], -1, rows.shape[-1])[
        ..., : rows.shape[-2], :
    ]


def gram(rows: Array) -> Array:
    """``rows.T @ rows`` (..., p, p)."""
    if rows.size * rows.shape[-1] <= _UNTHREADED:
        return np.asarray(rows.mT @ rows)
    if rows.ndim == 2:  # each product symmetric, which takes half of the operations
        part = max(_ROWS, _UNTHREADED // rows.shape[1] ** 2)
        square = rows[:part].T @ rows[:part]
        for first in range(part, len(rows), part):
            some = rows[first : first + part]
            square += some.T @ some
        return np.asarray(square)
    parts = _parts(rows)
    return np.asarray((parts.mT @ parts).sum(axis=-3))


def triangle(rows: Array) -> Array:
    """(min(R, p), p) R of the QR factors of rows (R, p), in parts: BLAS shares large
    ones out among threads, which here takes ten times as long as one."""
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
    """(r, p) root of a precision (p, p) of rank r, ``root.T @ root = precision``."""
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
    """Ranks and natural log det (S,), -inf where singular, of information blocks
    (S, N, q, p), the N of each set measured together, and a prior's root (r, p).
    ``size`` (p,) is the largest of the derivatives that the blocks were computed
    beside; None: they are the caller's own numbers."""
    if not blocks.shape[1]:  # the prior alone
        blocks = np.broadcast_to(root, (len(blocks), 1, *root.shape))
        root = root[:0]
    kernel = compiled.kernel("jaxcal.information.rank_kernel")
    beside = np.zeros(blocks.shape[3]) if size is None else size
    share = 0.0 if size is None else SINGULAR
    log_det, clear = kernel.clear_log_dets(blocks, root, beside, SMALL, share, SURE)
    ranks = [blocks.shape[3]] * len(blocks)
    for n in () if clear else np.flatnonzero(np.isnan(log_det)).tolist():
        centred = _centred(blocks[n : n + 1], None, root)
        largest, scale = centred.largest, centred.scale
        if size is not None:
            largest = np.maximum(largest, size if scale is None else size / scale)
        judged = rank_rule(centred.rows, largest, blocks.shape[1], size is not None)
        ranks[n], log_det[n] = judged[0][0], judged[1][0]
        if scale is not None:
            log_det[n] += 2.0 * np.log(scale).sum()
    return ranks, log_det


def largest_rank(blocks: Array) -> int:
    """Largest rank of single blocks (N, q, p); 1 for one reading each, zero or not."""
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
    blocks: Array, root: Array, computed: bool = False
) -> list[Array]:
    """Directions (p,) that neither blocks (N, q, p) nor the prior say anything of."""
    centred = _centred(blocks[None], None, root)
    null = null_directions(centred.rows[0], centred.largest[0], computed)
    if centred.scale is None:
        return null
    back = centred.scale[0].min() / centred.scale[0]
    return [direction * back for direction in null]


class WhiteBlocks(NamedTuple):
    """Blocks in coordinates where everything together has information I."""

    blocks: Array  # (M, q, p), zero where not usable
    prior: Array  # (p, p) precision
    triangle: Array  # (p, p): whitened blocks times it are the centred raw ones
    size: Array | None  # (p,) of what computed blocks are rounded by, or None
    log_scale: float  # log det of unwhitened less whitened information
    shift: Array | None  # (p, p): raw blocks less them times it are centred
    inverse: Array  # (p, p): centred blocks times it are whitened

    @property
    def basis(self) -> Array:
        """(p, p): raw blocks times it are whitened."""
        shift, inverse = self.shift, self.inverse
        return inverse if shift is None else inverse - shift @ inverse

    def of(self, rows: Array) -> Array:
        """Other rows (..., p) of the caller's numbers in these coordinates."""
        centred = rows if self.shift is None else rows - rows @ self.shift
        return np.asarray(centred @ self.inverse)


def whiten(
    blocks: Array, usable: Mask, root: Array, *, computed: bool = False
) -> list[WhiteBlocks | None]:
    """Blocks in coordinates where everything measured at once has information I; of
    every set, read-only, None where all together are singular.

    With T = prior + sum of the usable ``B_i.T @ B_i`` = R.T R the whitened block is
    ``B_i R^-1``, and log det of any selection is its whitened log det plus log det T.
    R is Cholesky's factor of ``rows.T @ rows``, the cheapest; where columns are nearly
    dependent, or rows far apart, that of rotations.

    Args:
        blocks: (S, M, q, p) of S sets, zero where not usable.
        usable: (S, M) which count.
        root: (r, p) of the prior precision.
        computed: the blocks are rounded themselves, as a model's derivatives are.
    """
    sets, num, q, p = blocks.shape
    centred = _centred(blocks, usable, root, look=True)
    rows, largest, scale = centred.rows, centred.largest, centred.scale
    far = centred.far
    inverse, back, log_det, good = _cholesky_factors(rows, largest, far)
    white = _times(rows, inverse)
    singular = [False] * sets
    for n in np.flatnonzero(~good) if np.count_nonzero(good) < sets else ():
        ranks, _ = rank_rule(rows[n : n + 1], largest[n : n + 1], num, computed)
        singular[n] = ranks[0] < p
        if not singular[n]:
            inverse[n], back[n], white[n] = _by_rotations(
                rows[n], far is not None and bool(far[n])
            )
            log_det[n] = 2.0 * np.linalg.slogdet(back[n])[1]
    prior = gram(white[:, num * q :]) if len(root) else np.zeros((sets, p, p))
    sizes = _sizes(blocks, centred) if computed else None
    shift = centred.shift
    if scale is not None:
        log_det += 2.0 * np.log(scale).sum(axis=1)
        inverse = inverse / scale[..., None]
        back = back * scale[:, None]
        shift = None if shift is None else shift / scale[..., None] * scale[:, None]
    white = white[:, : num * q].reshape(blocks.shape)
    for part in (white, prior, back, inverse):
        part.flags.writeable = False
    none = [None] * sets
    parts = zip(
        white, prior, back, none if sizes is None else sizes, log_det.tolist(),
        none if shift is None else shift, inverse, strict=True,
    )  # fmt: skip
    return [
        None if alone else WhiteBlocks(*part)
        for part, alone in zip(parts, singular, strict=True)
    ]


def _cholesky_factors(
    rows: Array, largest: Array, far: Mask | None
) -> tuple[Array, Array, Array, Mask]:
    """Inverse(R), R, log det of ``R.T R = rows.T rows`` (S, N, p), by Cholesky's factor
    in units of the columns' lengths, and which can be trusted."""
    information = gram(rows)
    scale = np.sqrt(information.diagonal(axis1=1, axis2=2))
    kernel = compiled.kernel("jaxcal.information.rank_kernel")
    back, inverse, log_det = kernel.factors(information)
    unit = (inverse * scale[:, :, None]).reshape(len(rows), -1)
    good = np.vecdot(unit, unit) <= _LOSS / _EPS  # not where there is none, NaN
    good &= (scale * _CLEAR > largest).all(axis=1)
    if far is not None:
        good &= ~far
    return inverse, back, log_det, good


def _by_rotations(rows: Array, far: bool) -> tuple[Array, Array, Array]:
    """Inverse(R), R and ``rows @ inverse(R)``, by rotations, twice; columns with rows
    ``far`` from the others come first, and these rows, so that others keep digits."""
    p = rows.shape[1]
    order, sorted_rows = np.arange(p), rows
    if far:
        size = np.abs(rows)
        middle = np.median(size, axis=0)
        apart = size.max(axis=0) / np.where(middle > 0.0, middle, np.inf)
        order = np.argsort(-np.where(middle > 0.0, apart, np.inf), kind="stable")
        sorted_rows = rows[np.argsort(-size.max(axis=1), kind="stable")]
    scale = np.linalg.norm(rows, axis=0)[order]
    first = triangle(sorted_rows[:, order] / scale)
    inverse = np.linalg.inv(first) / scale[:, None]
    second = triangle(sorted_rows[:, order] @ inverse)
    inverse = inverse @ np.linalg.inv(second)
    all_inverse, back = np.empty((p, p)), np.empty((p, p))
    all_inverse[order], back[:, order] = inverse, second @ first * scale
    white = _times(rows, all_inverse)
    if far:
        noise = 4.0 * _EPS * _times(np.abs(rows), np.abs(all_inverse))
        white[np.abs(white) <= noise] = 0.0
    return all_inverse, back, white


def _sizes(blocks: Array, centred: _CentredBlocks) -> Array:
    """(S, p) largest entries, beside which the blocks were computed; a row that is far
    from the others, as x = 1e7 beside 1, is rounded more than these."""
    largest = centred.largest * (1.0 if centred.scale is None else centred.scale)
    for n in () if centred.far is None else np.flatnonzero(centred.far):
        size = np.abs(blocks[n]).reshape(-1, blocks.shape[3])
        real = np.where(size > SINGULAR * size.max(axis=0), size, np.nan)
        usual = np.where(largest[n] > 0.0, largest[n], 1.0)
        some = ~np.isnan(real).all(axis=0)
        usual[some] = np.nanmedian(real[:, some], axis=0)
        beside = np.maximum((size / usual).max(axis=1) / 100.0, 1.0)
        largest[n] = (size / beside[:, None]).max(axis=0)
    return np.asarray(largest)
