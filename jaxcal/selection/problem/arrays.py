"""Arrays of candidates as the caller gives them, checked."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, require_finite

__all__ = ["check_available", "filled", "one_array", "usable_numbers"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FILLED = ", none of them 0"
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
