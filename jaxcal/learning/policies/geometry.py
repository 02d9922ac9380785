"""Geometry of a policy's inputs: whitening, projection, volumes, log-determinants.

The best subset does not change under an affine map of the commands, so the policy
works on whitened regressors ``x_i`` (mean over the candidates of ``x x.T`` is the
identity; ``x_i . x_j / M`` is the hat matrix). A choice is a projection: its
direction is removed from every remaining ``x_i``, whose squared length is then the gain
of choosing it. All functions broadcast over leading axes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxcal.learning.small_matrices import cholesky, solve_lower

__all__ = [
    "lookahead",
    "normalised_by",
    "projected",
    "whiten",
]

_LOWEST = -30.0  # log-volume of a candidate that is not active
_ALL_START = 1024  # M up to which all are looked ahead from
_STARTS = 512  # of more, those of largest gain that are
_LEAST_GAIN = 1e-5  # of whitened vectors; smaller gains are float32 rounding errors


def whiten(candidates: jax.Array, usable: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whitened regressors of a candidate set.

    Args:
        candidates: (..., M, n) commands.
        usable: (..., M) bool, the candidates that count (available or chosen).

    Returns:
        (..., M, n + 1) vectors x with mean ``x x.T = I`` over the usable candidates,
        zero elsewhere, and (...,) the log-determinant of ``Z_s.T Z_s`` of a subset less
        that of ``X_s.T X_s``.
    """
    weight = usable.astype(candidates.dtype)
    number = jnp.maximum(weight.sum(-1), 1.0)
    mean = (weight[..., None] * candidates).sum(-2, keepdims=True)
    centred = (candidates - mean / number[..., None, None]) * weight[..., None]
    covariance = jnp.einsum(
        "...mi,...mj->...ij", centred, centred, precision=jax.lax.Precision.HIGHEST
    )
    lower = cholesky(covariance / number[..., None, None])
    white = solve_lower(lower, centred)
    offset = 2.0 * jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return jnp.concatenate([white, weight[..., None]], axis=-1), offset


def projected(x: jax.Array, chosen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Components of every vector orthogonal to the chosen ones.

    A chosen vector in the span of those before it is not projected out again.

    Args:
        x: (..., M, p).
        chosen: (..., c, p) vectors chosen so far, c <= p.

    Returns:
        (..., M, p), whose squared lengths are the Schur-complement gains; and (...,)
        the log of the squared volume that the chosen span, 0 where nothing is chosen.
    """
    rest = [x[..., i] for i in range(x.shape[-1])]
    basis: list[list[jax.Array]] = []
    volume = jnp.zeros(chosen.shape[:-2], chosen.dtype)
    for j in range(chosen.shape[-2]):
        v = [chosen[..., j, i] for i in range(chosen.shape[-1])]
        scale = _dot(v, v)
        for e in basis:
            along = _dot(v, e)
            v = [a - along * b for a, b in zip(v, e, strict=True)]
        square = _dot(v, v)
        volume = volume + jnp.log(jnp.maximum(square, 1e-9))
        independent = square > 1e-9 * scale
        factor = jax.lax.rsqrt(jnp.where(independent, square, 1.0))
        basis.append([a * jnp.where(independent, factor, 0.0) for a in v])
        wide = [b[..., None] for b in basis[-1]]
        along = _dot(rest, wide)
        rest = [a - along * b for a, b in zip(rest, wide, strict=True)]
    return jnp.stack(rest, axis=-1), volume


def _dot(a: list[jax.Array], b: list[jax.Array]) -> jax.Array:
    """Inner product of vectors held as lists of components."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = total + left * right
    return total


def normalised_by(
    x: jax.Array, chosen: jax.Array, ridge: float
) -> tuple[jax.Array, jax.Array]:
    """Every vector in the metric of the chosen: ``|y_i|^2 = x_i.T G^-1 x_i``.

    Args:
        x: (..., M, p).
        chosen: (..., c, p) vectors chosen so far.
        ridge: ``G = C.T C + ridge I``; 0 needs vectors that span the space.

    Returns:
        (..., M, p) vectors y: choosing i multiplies det G by ``1 + |y_i|^2``; and
        (...,) log det G.
    """
    p = x.shape[-1]
    gram = jnp.einsum(
        "...ci,...cj->...ij", chosen, chosen, precision=jax.lax.Precision.HIGHEST
    )
    gram = jnp.broadcast_to(gram, (*x.shape[:-2], p, p))
    eye = jnp.eye(p, dtype=x.dtype)
    lower = cholesky(gram + max(ridge, 1e-6) * jnp.broadcast_to(eye, gram.shape))
    log_det = 2.0 * jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return solve_lower(lower, x), log_det


def lookahead(
    y: jax.Array, spanned: bool, active: jax.Array, depth: int
) -> list[jax.Array]:
    """Log gain of the determinant from each candidate and greedy choices after it.

    Args:
        y: (..., M, p) conditional vectors (``projected`` or ``normalised_by``), zero
            where not active.
        spanned: True where choosing i multiplies the determinant by ``1 + |y_i|^2``,
            False where by ``|y_i|^2``.
        active: (..., M) bool.
        depth: number of choices, that candidate included; at least 1.

    Returns:
        ``depth`` arrays (..., M): the log of the factor by which the determinant grows
        over the first 1, 2, ... choices; -30 where not active. The first is the gain.
        The second is the gain of the best pair, exactly; later ones are what greedy
        choices reach. Cost: ``depth - 1`` products of (M, p) with (p, M). Of more than
        1,024 candidates only the 512 of largest gain are looked ahead from, as in
        ``selection/policy/policy_kernel.py``: of the others all but the first are -30.
    """
    m = y.shape[-2]
    base = 1.0 if spanned else 0.0
    square = (y * y).sum(-1)
    first = jnp.log(jnp.maximum(base + square, _LEAST_GAIN))
    values = [jnp.where(active, first, _LOWEST)]
    if depth == 1:
        return values
    # For every start i (axis -2): the gains of all j (axis -1) after its choices.
    starts = jnp.broadcast_to(jnp.arange(m), square.shape)
    picked, reached, begins = y, values[0], active  # of each start, its newest choice
    if m > _ALL_START:
        starts = jax.lax.top_k(jnp.where(active, square, -1.0), _STARTS)[1]
        picked = jnp.take_along_axis(y, starts[..., None], axis=-2)
        reached, begins = (
            jnp.take_along_axis(x, starts, axis=-1) for x in (reached, begins)
        )
    shape = (*starts.shape, m)
    gains = jnp.broadcast_to(square[..., None, :], shape)
    itself = jax.nn.one_hot(starts, m, dtype=bool)
    rest = jnp.broadcast_to(active[..., None, :], shape) & ~itself
    along: list[tuple[jax.Array, jax.Array]] = []  # directions, and how far they shrink
    for _ in range(1, depth):
        size = jnp.maximum((picked * picked).sum(-1), _LEAST_GAIN)
        unit = picked * jax.lax.rsqrt(size)[..., None]
        # A choice removes its direction; where the chosen span all, it shortens it.
        keep = jax.lax.rsqrt(1.0 + size) if spanned else jnp.zeros_like(size)
        along.append((unit, 1.0 - keep))
        # The direction in y's own coordinates, through the earlier ones, newest first.
        back = unit
        for before, shrink in reversed(along[:-1]):
            back = back - ((back * before).sum(-1) * shrink)[..., None] * before
        inner = jnp.einsum(
            "...ip,...jp->...ij", back, y, precision=jax.lax.Precision.HIGHEST
        )
        gains = gains - inner * inner * (1.0 - keep * keep)[..., None]
        ranked = jnp.where(rest, gains, -1.0)
        best = jnp.argmax(ranked, axis=-1)
        gain = jnp.maximum(ranked.max(-1), 0.0)
        step = jnp.log(jnp.maximum(base + gain, _LEAST_GAIN))
        which = jax.nn.one_hot(best, m, dtype=bool)
        rest = rest & ~which
        reached = jnp.where(begins, reached + step, _LOWEST)
        of_all = reached
        if m > _ALL_START:
            lowest = jnp.full_like(square, _LOWEST)
            of_all = jnp.put_along_axis(lowest, starts, reached, -1, inplace=False)
        values.append(of_all)
        picked = jnp.einsum(
            "...ij,...jp->...ip",
            which.astype(y.dtype),
            y,
            precision=jax.lax.Precision.HIGHEST,
        )
        for before, shrink in along:
            overlap = (picked * before).sum(-1) * shrink
            picked = picked - overlap[..., None] * before
    return values
