"""The paper's view of a state: ten numbers beside the candidates."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxcal.learning import geometry

__all__ = ["context_features"]


def context_features(candidates: jax.Array, chosen: jax.Array) -> jax.Array:
    """The paper's ten context numbers: statistics, progress, matrix features.

    Args:
        candidates: (..., M, n).
        chosen: (..., K) int, -1 where nothing is chosen yet.

    Returns:
        (..., 2 n + 4): mean and standard deviation, per axis, of the postures chosen so
        far (0 before the first); progress in [0, 1]; and three features of the chosen
        regressors with a ridge of 0.01: log-determinant, trace, and the log ratio of
        the least to the largest Cholesky pivot, each scaled to order one.
    """
    present = (chosen >= 0).astype(candidates.dtype)[..., None]
    index = jnp.maximum(chosen, 0)[..., None]
    postures = jnp.take_along_axis(candidates, index, axis=-2) * present
    number = jnp.maximum(present.sum(-2), 1.0)
    mean = postures.sum(-2) / number
    spread = (postures - mean[..., None, :]) * present
    variance = (spread * spread).sum(-2) / number
    std = jnp.sqrt(jnp.where(variance > 0, variance, 1.0)) * (variance > 0)
    z = jnp.concatenate([postures, present], axis=-1)
    p, total = z.shape[-1], chosen.shape[-1]
    gram = jnp.einsum("...ki,...kj->...ij", z, z)
    gram = geometry.plus_ridge(gram, 0.01)
    pivots = geometry.cholesky(gram)
    pivots = jnp.log(jnp.diagonal(pivots, axis1=-2, axis2=-1))
    trace = jnp.trace(gram, axis1=-2, axis2=-1)
    scalars = jnp.stack(
        [
            present[..., 0].sum(-1) / total,
            pivots.sum(-1) / (1.25 * p),
            trace / (total * p),
            (pivots.min(-1) - pivots.max(-1)) / 4.0,
        ],
        axis=-1,
    )
    return jnp.concatenate([mean, std, scalars], axis=-1)
