"""FIGAROH's rule for choosing poses: relax, and measure every pose that has weight.

FIGAROH (https://github.com/thanhndv212/figaroh) solves the D-optimal design relaxed to
weights that sum to one, without a number of poses and without a prior, on the
combinations of parameters that can be identified, and measures every pose whose weight
is above 1e-5. Its solver is a semidefinite programme of PICOS and CVXOPT; here the same
optimum is found by multiplicative steps, then by SLSQP on the poses that may matter,
until the duality gap is below what is asked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

LEAST_WEIGHT = 1e-5
_STEPS = 300  # multiplicative, before SLSQP
_DROPPED = 1e-9
_ROUNDS = 60

Array = NDArray[np.float64]


def identified(blocks: Array) -> Array:
    """(M, q, rank) blocks of the combinations that they identify, without a prior."""
    size = np.sqrt((blocks**2).sum(axis=(0, 1)))
    shown = size > 1e-9 * size.max()  # derivatives are exact to 1e-13
    scaled = blocks[..., shown] / size[shown]
    flat = scaled.reshape(-1, scaled.shape[2])
    _, sizes, right = np.linalg.svd(flat, full_matrices=False)
    return np.asarray(scaled @ right[sizes > 1e-6 * sizes[0]].T)


def _sensitivity(blocks: Array, weight: Array) -> tuple[float, Array]:
    """log det of the weighted information, and its slope by every weight."""
    flat = blocks.reshape(-1, blocks.shape[2])
    gram = (flat * np.repeat(weight, blocks.shape[1])[:, None]).T @ flat
    slope = (flat @ np.linalg.inv(gram) * flat).sum(axis=1)
    return float(np.linalg.slogdet(gram)[1]), slope.reshape(len(blocks), -1).sum(axis=1)


def relaxed_weights(blocks: Array, gap: float = 1e-4) -> tuple[Array, float]:
    """(M,) weights of the D-optimal measure, and how far log det may be from optimal.

    Raises:
        RuntimeError: the gap asked for was not reached.
    """
    count, _, p = blocks.shape
    weight = np.full(count, 1.0 / count)
    for _ in range(_STEPS):
        weight *= _sensitivity(blocks, weight)[1] / p
    for _ in range(_ROUNDS):
        slope = _sensitivity(blocks, weight)[1]
        left = float(slope.max()) - p
        if left < gap:
            return weight, left
        wanted = np.argsort(-slope)[: 2 * p]
        heavy = np.argsort(-weight)[: 4 * p]
        some = np.union1d(heavy[weight[heavy] > _DROPPED], wanted)
        start = np.maximum(weight[some], _DROPPED)

        def loss(weights: Array, near: Array = blocks[some]) -> tuple[float, Array]:
            value, slopes = _sensitivity(near, weights)
            return -value, -slopes

        found = minimize(
            loss, start / start.sum(), jac=True, method="SLSQP",
            bounds=[(0.0, 1.0)] * len(some), options={"maxiter": 200, "ftol": 1e-13},
            constraints={
                "type": "eq",
                "fun": lambda w: w.sum() - 1.0,
                "jac": lambda w: np.ones((1, len(w))),
            },
        )  # fmt: skip
        weight = np.zeros(count)
        weight[some] = np.maximum(found.x, 0.0) / np.maximum(found.x, 0.0).sum()
    raise RuntimeError(f"the relaxation is within {left:.2g} only, not {gap:.2g}")


def chosen(weight: Array) -> NDArray[np.int64]:
    """The poses that the rule measures."""
    return np.flatnonzero(weight > LEAST_WEIGHT)
