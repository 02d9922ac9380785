"""The order of least travel time through some postures."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers

__all__ = ["fastest_tour"]


def fastest_tour(
    times: ArrayLike, start: ArrayLike | None = None
) -> tuple[NDArray[np.int64], float]:
    """The order of least time through all postures, ending anywhere.

    Optimal up to 12 postures (Held and Karp 1962). Beyond that the shortest
    nearest-neighbour tours are improved by reversing pieces (2-opt) and moving single
    postures, which proves nothing.

    Args:
        times: (K, K) seconds from each posture to each, symmetric.
        start: (K,) seconds to each from where the device stands; it begins at any
            posture when not given.

    Returns:
        (K,) order, and the seconds of travel.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    between = np.ascontiguousarray(numbers("times", times))
    k = len(between) if between.ndim else 0
    if between.shape != (k, k) or not k:
        raise ValueError(f"times must have shape (K, K), got {between.shape}")
    uneven = np.abs(between - between.T)
    if uneven.max() > 1e-9 * max(float(np.abs(between).max()), 1.0):
        i, j = np.unravel_index(uneven.argmax(), uneven.shape)
        raise ValueError(
            "times must be symmetric, got "
            f"{between[i, j]:g} from {i} to {j} and {between[j, i]:g} back"
        )
    begin = np.zeros(k) if start is None else numbers("start", start)
    if begin.shape != (k,):
        raise ValueError(f"start must have shape ({k},), got {begin.shape}")
    from jaxcal.selection.fastest.kernel import best_order

    order, seconds = best_order(between, begin)
    return order, float(seconds)
