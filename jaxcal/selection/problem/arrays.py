"""Arrays of candidates as the caller gives them, checked."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, require_finite

__all__ = [
    "check_available",
    "filled",
    "flatten_rounding",
    "one_array",
    "rounding_of",
    "usable_numbers",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FILLED = ", none of them 0"
_ROUNDED = 4.0  # units in the last place that short sums of rounded numbers are off by
_NUMBERS = 2**21  # of 8 bytes; beyond 32 MiB glibc no longer follows


def filled(name: str, values: ArrayLike, *letters: str) -> Array:
    """``values`` as float64 with an axis for each letter, none of them empty."""
    array = array_of(name, values, *letters, rule=_FILLED, finite=False)
    if 0 in array.shape:
        raise ValueError(
            f"{name} must have shape ({', '.join(letters)}){_FILLED}, got {array.shape}"
        )
    return array


@functools.cache
def _keep_freed_pages() -> None:
    """Let glibc's malloc keep the pages of freed arrays for the next problem.

    It returns the top of its heap to the system where that is larger than twice the
    largest array freed so far. A problem frees two such arrays at least, its blocks and
    the whitened ones, so the next one waits for all of their pages again: 109 page
    faults, .3 of .7 ms, with blocks (2000, 3, 6). An array of 16 MiB that is freed
    raises the limit to 32 MiB; nothing is written to it, so it takes no memory. Other
    allocators ignore it.
    """
    np.empty(_NUMBERS)


def usable_numbers(name: str, array: Array, mask: Mask) -> Array:
    """The array, finite where available; what is not elsewhere becomes zero in it."""
    _keep_freed_pages()
    finite = np.isfinite(array)
    if not finite.all():
        hidden = ~finite & ~mask.reshape(*mask.shape, *[1] * (array.ndim - mask.ndim))
        array[hidden] = 0.0
        require_finite(name, array)
    return array


def rounding_of(values: ArrayLike) -> float:
    """Spacing at 1 of numbers that are coarser than double precision, else 0."""
    kind = np.asarray(values).dtype
    coarse = kind.kind == "f" and kind.itemsize < np.dtype(np.float64).itemsize
    return float(np.finfo(kind).eps) if coarse else 0.0


def flatten_rounding(
    spacing: float,
    candidates: Array,
    usable: Mask,
    measured: Array | None = None,
    *,
    bias: bool = False,
) -> None:
    """Put blocks that lie in a plane but for rounding to float32 into it, in place.

    In double precision that rounding would pass for information: of a third column that
    is the sum of two others in float32 a design would be made, and proven.

    Args:
        spacing: of the numbers that the caller gave, see ``rounding_of``; 0: nothing.
        candidates: (S, M, q, p) of S sets; readings and columns of any unit.
        usable: (S, M) which of them count.
        measured: (S, N, q, p) known beforehand, put into the plane with them.
        bias: a column of ones stands beside them, so the plane need not pass through 0.
    """
    if not spacing:
        return
    blocks, counted = candidates, usable
    if measured is not None and measured.shape[2:] == candidates.shape[2:]:
        blocks = np.concatenate([candidates, measured], axis=1)
        always = np.ones(measured.shape[:2], dtype=np.bool_)
        counted = np.concatenate([usable, always], axis=1)
    counts = counted[..., None, None]
    blocks = np.where(counts, blocks, 0.0)
    scale = _sizes(blocks, (1, 3))
    scale = scale * _sizes(blocks / scale, (1, 2))
    unit = blocks / scale
    middle = np.zeros((len(unit), 1, *unit.shape[2:]))
    if bias:
        number = np.maximum(counts.sum(axis=1, keepdims=True), 1)
        middle = unit.sum(axis=1, keepdims=True) / number
    rows = np.where(counts, unit - middle, 0.0).reshape(len(unit), -1, unit.shape[3])
    left, size, right = np.linalg.svd(rows, full_matrices=False)
    real = size > _ROUNDED * spacing * np.sqrt(rows[0].size)
    num = candidates.shape[1]
    for n in np.flatnonzero(~real.all(axis=1)):
        flat = (left[n] * np.where(real[n], size[n], 0.0)) @ right[n]
        flat = (flat.reshape(unit.shape[1:]) + middle[n]) * scale[n]
        candidates[n][usable[n]] = flat[:num][usable[n]]
        if measured is not None and len(flat) > num:
            measured[n] = flat[num:]


def _sizes(blocks: Array, axes: tuple[int, int]) -> Array:
    """The largest of each reading or column, 1 where all are zero."""
    largest = np.abs(blocks).max(axis=axes, initial=0.0, keepdims=True)
    return np.where(largest > 0.0, largest, 1.0)


def check_available(available: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """(M,) or, of many sets, (B, M), as ``shape`` says."""
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


def one_array(name: str, values: ArrayLike) -> NDArray[np.generic]:
    """A copy of ``values`` as an array of any kind."""
    try:
        return np.array(values)
    except ValueError as error:
        raise ValueError(
            f"{name} must be one array, got {type(values).__name__} of mixed lengths"
        ) from error
