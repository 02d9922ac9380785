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
    """A copy, finite where available; what is not finite elsewhere becomes zero."""
    _keep_freed_pages()
    own = np.array(array, order="C")
    bad = ~np.isfinite(own)
    if bad.any():
        hidden = bad & ~mask.reshape(*mask.shape, *[1] * (own.ndim - mask.ndim))
        own[hidden] = 0.0
        require_finite(name, own)
    return own


def flatten_rounding(
    given: ArrayLike,
    usable: Mask,
    candidates: Array,
    measured: Array | None = None,
    *,
    bias: bool = False,
) -> None:
    """Put rows that lie in a plane but for rounding to float32 into it, in place.

    In double precision that rounding would pass for information: of a third column that
    is the sum of two others in float32 a design would be made, and proven. Numbers
    given in double precision stay as they are.

    Args:
        given: the candidates as the caller gave them, whose type tells the rounding.
        usable: (M,) which of them count.
        candidates: (M, ..., p) of them in double precision.
        measured: (N, ..., p) rows known beforehand, in the same plane or in none.
        bias: a column of ones stands beside them, so the plane need not pass through 0.
    """
    kind, p = np.asarray(given).dtype, candidates.shape[-1]
    if kind.kind != "f" or kind.itemsize >= candidates.itemsize:
        return
    rows = candidates[usable].reshape(-1, p)
    count = len(rows)
    if measured is not None and measured.shape[1:] == candidates.shape[1:]:
        rows = np.concatenate([rows, measured.reshape(-1, p)])
    middle = rows.mean(axis=0) if bias and count else np.zeros(p)
    largest = np.abs(rows).max(axis=0, initial=0.0)
    scale = np.where(largest > 0.0, largest, 1.0)
    left, size, right = np.linalg.svd((rows - middle) / scale, full_matrices=False)
    rounding = _ROUNDED * np.finfo(kind).eps * np.sqrt(rows.size)
    if size.min(initial=np.inf) > rounding:
        return
    flat = middle + (left * np.where(size > rounding, size, 0.0)) @ right * scale
    candidates[usable] = flat[:count].reshape(-1, *candidates.shape[1:])
    if measured is not None and len(flat) > count:
        measured[...] = flat[count:].reshape(measured.shape)


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
