"""The paper's view of a state: ten numbers beside the candidates."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxcal.learning.small_matrices import factored, picked, row_dot, row_parts, row_sum


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
    n, total = candidates.shape[-1], chosen.shape[-1]
    postures = picked(candidates, chosen)
    present = row_parts((chosen >= 0).astype(candidates.dtype))
    rows = [row_parts(postures[..., j]) for j in range(n)]
    rows = [[x * w for x, w in zip(row, present, strict=True)] for row in rows]
    count = row_sum(present)
    number = jnp.maximum(count, 1.0)
    mean = [row_sum(row) / number for row in rows]
    std = []
    for row, middle in zip(rows, mean, strict=True):
        spread = [(x - middle) * w for x, w in zip(row, present, strict=True)]
        variance = row_dot(spread, spread) / number
        std.append(jnp.sqrt(jnp.where(variance > 0, variance, 1.0)) * (variance > 0))
    z = [*rows, present]
    p = n + 1
    gram = [[row_dot(z[i], z[j]) for j in range(i + 1)] for i in range(p)]
    for i in range(p):
        gram[i][i] = gram[i][i] + 0.01
    pivots = [jnp.log(row[-1]) for row in factored(gram)]
    trace = sum(gram[i][i] for i in range(p))
    least, largest = pivots[0], pivots[0]
    for pivot in pivots[1:]:
        least, largest = jnp.minimum(least, pivot), jnp.maximum(largest, pivot)
    scalars = [
        count / total,
        sum(pivots) / (1.25 * p),
        trace / (total * p),
        (least - largest) / 4.0,
    ]
    # Written in one pass: joined, each number would be a copy of its own.
    parts = [*mean, *std, *scalars]
    column = jnp.arange(len(parts))
    out = jnp.asarray(parts[0])
    for i, part in enumerate(parts[1:], start=1):
        out = jnp.where(column < i, out, part)
    return out
