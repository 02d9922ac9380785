"""What a choice is worth by D, A, I or E, in logarithms that can be compared.

With the information ``M = X.T X`` of the chosen regressors, p of them,

=========  ============================  ===============================
criterion  worth                         in which coordinates
=========  ============================  ===============================
``D``      log det M                     any: it only shifts
``A``      -p log(trace M^-1 / p)        the commands' own, beside a 1
``E``      p log(least eigenvalue of M)  the commands' own, beside a 1
``I``      -p log(trace M^-1 / p)        whitened: of the predictions of
                                         all usable candidates
=========  ============================  ===============================

so that e^(difference / p) is the efficiency of one choice against another by each
criterion, as ``jaxcal.selection.criteria`` reports it. Only D and I are the same for
every affine map of the commands.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxcal.learning.small_matrices import cholesky, solve_lower

__all__ = ["inverse_of", "product", "regressors", "worth_of_inverse"]

_SQUARINGS = 8  # the largest eigenvalue is exact to a factor p^(1/256)


def regressors(
    criterion: str, candidates: jax.Array, usable: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Regressors in which the worth is that of the module's table.

    Args:
        criterion: A, I or E.
        candidates: (..., M, n) commands.
        usable: (..., M) bool, available or chosen.

    Returns:
        (..., M, n + 1), zero where not usable, with a mean square of 1 over what is
        usable; and () or (...,) by how much the worth of any choice in the table's
        coordinates is above that in these.
    """
    weight = usable[..., None].astype(candidates.dtype)
    rows = jnp.concatenate([candidates, jnp.ones_like(weight)], axis=-1) * weight
    number = jnp.maximum(weight.sum((-2, -1)), 1.0)
    p = rows.shape[-1]
    if criterion == "I":
        moments = jnp.einsum(
            "...mi,...mj->...ij", rows, rows, precision=jax.lax.Precision.HIGHEST
        )
        lower = cholesky(moments / number[..., None, None])
        return solve_lower(lower, rows), jnp.zeros_like(number)
    square = (rows * rows).sum((-2, -1)) / (number * p)
    return rows * jax.lax.rsqrt(square)[..., None, None], p * jnp.log(square)


def product(a: jax.Array, b: jax.Array) -> jax.Array:
    """(..., p, p) products of matrices of a few rows.

    ``a @ b`` is a call for each matrix on a CPU: forty times slower.
    """
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def inverse_of(matrix: jax.Array) -> jax.Array:
    """(..., p, p) inverse of symmetric positive definite matrices of a few rows."""
    eye = jnp.eye(matrix.shape[-1], dtype=matrix.dtype)
    columns = solve_lower(cholesky(matrix), jnp.broadcast_to(eye, matrix.shape))
    return columns @ jnp.matrix_transpose(columns)


def worth_of_inverse(criterion: str, inverse: jax.Array) -> jax.Array:
    """(...,) worth by A, I or E of inverses (..., p, p) of the information."""
    p = inverse.shape[-1]
    trace = _trace(inverse)
    if criterion != "E":
        return -p * jnp.log(trace / p)
    power, log_largest = inverse / trace[..., None, None], jnp.log(trace)
    for number in range(1, _SQUARINGS + 1):
        power = product(power, power)
        trace = _trace(power)
        power = power / trace[..., None, None]
        log_largest = log_largest + jnp.log(trace) / 2**number
    return -p * log_largest


def _trace(matrix: jax.Array) -> jax.Array:
    return jnp.trace(matrix, axis1=-2, axis2=-1)
