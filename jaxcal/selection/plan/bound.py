"""What no design of K measurements beats: lower bounds on the variances of a region.

For weights w over the region with W = sum of w z z.T and any positive definite M0,
convexity and the best scaling of M0 give for every design M of K measurements and a
prior P

    trace(W M^-1) >= trace(W M0^-1)^2 / (trace(G P) + largest sum of K trace(B G B.T))

with ``G = M0^-1 W M0^-1``, and the largest variance is at least every weighted mean of
it. For G the weights are those of the D-optimal measure of the region, which make the
bound p / K where the region is the candidates and replicates are free (Kiefer and
Wolfowitz 1960). Source: Pukelsheim, Optimal Design of Experiments, chapter 9.
"""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.problem import Problem

__all__ = ["lower_bound", "region_weighting"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ITERATIONS = 300  # any count gives a true bound


def region_weighting(points: Array, criterion: str) -> Array:
    """(p, p) W, the sum of w z z.T over the region, of weights that sum to 1.

    Args:
        points: (R, s, p) whitened rows of the region.
        criterion: "I", equal weights, or "G", those of the D-optimal measure of the
            region by Titterington's steps w <- w (z.T W^-1 z) / p.
    """
    rows = points.reshape(-1, points.shape[-1])
    weight = np.full(len(rows), 1.0 / len(rows))
    for _ in range(_ITERATIONS if criterion == "G" else 0):
        inverse = np.linalg.pinv((rows * weight[:, None]).T @ rows, hermitian=True)
        weight *= np.einsum("ra,ab,rb->r", rows, inverse, rows)
        weight /= weight.sum()
    return (rows * weight[:, None]).T @ rows


def lower_bound(problem: Problem, weighting: Array, k: int) -> float:
    """No design of k within the counts has a smaller ``trace(W M^-1)``.

    M0 is the relaxed minimiser, from multiplicative steps on counts that are clipped
    to their limits; whatever M0 they end in, the bound holds.
    """
    blocks, lower = problem.blocks, problem.lower
    rows = blocks.reshape(-1, blocks.shape[2])
    upper = np.where(problem.available, min(problem.max_replicates, k), 0)
    count = np.where(problem.available, k / problem.available.sum(), 0.0)
    best = 0.0
    for iteration in range(_ITERATIONS):
        counts = np.repeat(count, blocks.shape[1])[:, None]
        inverse = np.linalg.pinv((rows * counts).T @ rows + problem.prior)
        slope = inverse @ weighting @ inverse
        gain = np.einsum("mqa,ab,mqb->m", blocks, slope, blocks)
        if iteration % 10 == 0 or iteration == _ITERATIONS - 1:
            most = _largest_sum(gain, lower, upper, k) + (slope * problem.prior).sum()
            best = max(best, float(np.trace(weighting @ inverse)) ** 2 / most)
        count = _scaled_to(count * np.sqrt(np.maximum(gain, 0.0)), lower, upper, k)
    return best


def _largest_sum(gain: Array, lower: Indices, upper: Indices, k: int) -> float:
    """Largest ``sum of c_i gain_i`` with counts within their limits and sum k."""
    order = np.argsort(-gain)
    room = (upper - lower)[order]
    free = k - int(lower.sum())
    filled = np.clip(free - (np.cumsum(room) - room), 0, room)
    return float(lower @ gain + filled @ gain[order])


def _scaled_to(count: Array, lower: Indices, upper: Indices, k: int) -> Array:
    """``clip(c count, lower, upper)`` with the c that makes the sum k.

    The sum rises piecewise linearly in c, with corners where a count leaves its lower
    limit and where it meets its upper one: bisection over the corners, then one
    division.
    """
    some = count > 0.0
    corners = np.append(lower[some] / count[some], upper[some] / count[some])
    corners.sort()

    def scaled(scale: float) -> Array:
        return np.clip(scale * count, lower, upper)

    above = bisect.bisect_left(corners, k, key=lambda scale: scaled(scale).sum())
    if above == len(corners):  # every count at its upper limit
        return scaled(corners[-1])
    between = scaled(0.5 * (corners[max(above - 1, 0)] + corners[above]))
    free = (between > lower) & (between < upper)
    if free.any():
        between[free] = count[free] * (k - between[~free].sum()) / count[free].sum()
    return np.clip(between, lower, upper)
