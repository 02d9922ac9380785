"""An upper bound on log det from the concave relaxation, in numpy alone.

Let the count of every candidate be a real number in [lower, upper] with sum k. For any
positive definite M0 and W = M0^-1, concavity and a scaling of W give

    log det M(c) <= log det M0 + p log(a / p),   a = max over c of trace(W M(c)),

so every approximate solution yields a true bound; at the relaxed optimum it is tight.
Source: Ponte, Fampa and Lee, Branch-and-bound for integer D-Optimality with fast local
search and variable-bound tightening, arXiv 2302.07386 (the bound in its unscaled form).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["linear_maximum", "relaxed_bound"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MAX_ITERATIONS = 2000


def relaxed_bound(
    rows: Array, lower: Indices, upper: Indices, start: Indices, tolerance: float = 1e-4
) -> float:
    """Upper bound on ``log det(X_s.T X_s)`` over all selections within the counts.

    Weight moves between two candidates at a time, along which det is a quadratic with a
    closed maximum, until the bound is within ``tolerance`` of the relaxed value.

    Args:
        rows: (M, p) whitened regressors.
        lower: (M,) least counts.
        upper: (M,) largest counts.
        start: (k,) a selection that is not singular.
        tolerance: gap to the relaxed optimum at which to stop.
    """
    p = rows.shape[1]
    k = len(start)
    c = np.bincount(start, minlength=len(rows)).astype(np.float64)
    best = np.inf
    for iteration in range(_MAX_ITERATIONS):
        gram = (rows * c[:, None]).T @ rows
        value = float(np.linalg.slogdet(gram)[1])
        scaled = rows @ np.linalg.inv(gram)
        leverage = np.einsum("mp,mp->m", scaled, rows)
        can_rise, can_fall = c < upper - 1e-12, c > lower + 1e-12
        rising = np.where(can_rise, leverage, -np.inf)
        i = int(rising.argmax())
        falling = np.where(can_fall, leverage, np.inf)
        if iteration % 8 == 0 or not can_rise.any() or not can_fall.any():
            most = linear_maximum(leverage, lower, upper, k)
            best = min(best, value + p * float(np.log(most / p)))
            if best - value <= tolerance or falling.min() >= rising[i]:
                break
        cross = scaled @ rows[i]
        slope = leverage[i] - leverage
        curve = np.maximum(leverage[i] * leverage - cross**2, 1e-300)
        step = np.clip(slope / (2 * curve), 0.0, np.minimum(upper[i] - c[i], c - lower))
        gain = np.where(can_fall, step * slope - step**2 * curve, -np.inf)
        j = int(gain.argmax())
        if not gain[j] > 0.0:
            break
        c[i] += step[j]
        c[j] -= step[j]
    gram = (rows * c[:, None]).T @ rows
    leverage = np.einsum("mp,mp->m", rows @ np.linalg.inv(gram), rows)
    most = linear_maximum(leverage, lower, upper, k)
    value = float(np.linalg.slogdet(gram)[1])
    return min(best, value + p * float(np.log(most / p)))


def linear_maximum(gain: Array, lower: Indices, upper: Indices, k: int) -> float:
    """Largest ``sum of c_i gain_i`` with counts within bounds and sum k."""
    order = np.argsort(-gain)
    room = (upper - lower)[order]
    free = k - int(lower.sum())
    filled = np.clip(free - (np.cumsum(room) - room), 0, room)
    return float(lower @ gain + filled @ gain[order])
