"""Inputs of the compact network: geometry of a candidate set and of a decision.

The best subset does not change under an affine map of the commands, so the policy works
on whitened regressors ``x_i`` (mean over the candidates of ``x x.T`` is the identity).
A choice is a projection: its direction is removed from every remaining ``x_i``, whose
squared length is then the gain of choosing it.

Shapes: M candidates, n inputs, p = n + 1, K choices; leading axes ``...``.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.learning.small_matrices import cholesky, solve_lower

_LOWEST = -30.0  # log-volume of a candidate that is not active
ALL_START = 1024  # M up to which all are looked ahead from
STARTS = 512  # of more, those of largest gain that are
_TAKEN = -1e9  # gain of a candidate that cannot be chosen
_LEAST_GAIN = 1e-5  # of whitened vectors; smaller gains are float32 rounding errors
_FLOOR = -8.0  # least log-volume, relative to the best, that a feature can show
_RIDGE = 0.01  # of the mean square of a whitened coordinate, which is one
_CLOSE = (32.0, 256.0, 2048.0)  # scales at which near-equal look-aheads differ


class VectorFeatures(NamedTuple):
    """Inputs of the network from vectors y, one per candidate; those of numpy are in
    ``selection/policy/policy_kernel.py``."""

    columns: jax.Array  # (..., M, F) half of ``ahead``, exp of it, exp of 4 x it; half
    # of the log square less the mean's; of close-ups exp of _CLOSE x the last of it
    moments: jax.Array  # (..., M, p (p + 1) / 2) products of coordinates, scaled so
    # that messages keep their size whatever M is
    active: jax.Array  # (..., M) bool, which candidates count
    ahead: jax.Array  # (..., M, 4) log-volume after 1, 2, 3 and all greedy choices
    # that begin with this candidate, relative to the best candidate's
    best: jax.Array  # (..., 4) that of the best candidate

    @property
    def to_the_end(self) -> jax.Array:
        """(..., M) the last of ``ahead``."""
        return self.ahead[..., -1]


class CandidateFeatures(NamedTuple):
    """A candidate set before any choice."""

    vectors: VectorFeatures  # of the whitened regressors
    whitened: jax.Array  # (..., M, p) regressors with mean x x.T = I
    offset: jax.Array  # (...,) log det(Z_s.T Z_s) of any subset less log det(X_s.T X_s)


class DecisionFeatures(NamedTuple):
    """One decision: what is left of a set after some choices."""

    vectors: VectorFeatures  # of what is left of the regressors
    chosen: jax.Array  # (..., M) 1 / count where chosen already, else 0
    reached: jax.Array  # (...,) log det(Z.T Z) of the best look-ahead to the end
    progress: jax.Array  # (..., 7) left == 1, == 2, == 3, then 1 / left, count / p,
    # left / p (3 at most), K > p; left = K - count


def decision_features(
    features: CandidateFeatures,
    chosen: jax.Array,
    available: jax.Array,
    count: jax.typing.ArrayLike,
    lookahead: int,
    close_up: bool,
) -> DecisionFeatures:
    """Features of the decision after ``count`` choices, one count for the whole batch.

    Arguments are those of ``Network.decision_features``; ``lookahead`` is the largest
    number of greedy choices ahead, ``close_up`` adds the columns that tell near-equal
    look-aheads apart.
    """
    x = features.whitened
    p, total = x.shape[-1], chosen.shape[-1]
    begins = isinstance(count, int) and count == 0
    count = jnp.asarray(count)
    which = jax.nn.one_hot(chosen, x.shape[-2], dtype=x.dtype)  # zeros: none yet
    picked = jnp.einsum(
        "...km,...mp->...kp", which, x, precision=jax.lax.Precision.HIGHEST
    )
    # A choice multiplies the determinant by |y|^2, or by 1 + |y|^2.
    if total == p and begins:  # the look-ahead of the set is that of the decision
        vectors, so_far = features.vectors, jnp.zeros(x.shape[:-2], x.dtype)
    else:
        if total == p:
            # Every choice is a new direction: exact projections.
            y, so_far = projected(x, picked, count)
        else:
            # The metric of the chosen; until they span the space, with a ridge small
            # beside what a posture contributes.
            ridge = jnp.where(count < p, _RIDGE, 0.0)
            y, so_far = normalised_by(x, picked, ridge)
        depth = jnp.minimum(lookahead, total - count)
        vectors = vector_features(y, total != p, available, depth, close_up)
    remaining = total - count
    ends = (remaining == 1, remaining == 2, remaining == 3, 1.0 / remaining)
    shares = (count / p, jnp.minimum(remaining / p, 3.0), total > p)
    progress = jnp.stack([jnp.asarray(number, x.dtype) for number in (*ends, *shares)])
    return DecisionFeatures(
        vectors,
        chosen=which.sum(-2) / jnp.maximum(count, 1).astype(x.dtype),
        reached=features.offset + so_far + vectors.best[..., -1],
        progress=jnp.broadcast_to(progress, (*so_far.shape, len(progress))),
    )


def close_up_of(ahead: jax.Array) -> jax.Array:
    """(..., 3) ``exp(scale * ahead)`` of (...,) log-volumes relative to the best."""
    return jnp.stack([jnp.exp(scale * ahead) for scale in _CLOSE], axis=-1)


def vector_features(
    y: jax.Array,
    spanned: bool,
    active: jax.Array,
    depth: jax.typing.ArrayLike,
    close_up: bool,
) -> VectorFeatures:
    """Features of vectors y (..., M, p); arguments as in ``lookahead``."""
    y = y * active[..., None].astype(y.dtype)
    number = jnp.maximum(active.sum(-1).astype(y.dtype), 1.0)
    square = (y * y).sum(-1)
    mean_square = jnp.maximum(square.sum(-1) / number, 1e-8)
    unit = y * jax.lax.rsqrt(mean_square)[..., None, None]
    moments = _second_moments(unit) * jax.lax.rsqrt(number)[..., None, None]
    ahead = jnp.stack(lookahead(y, spanned, active, depth), axis=-1)
    best = ahead.max(-2)
    ahead = jnp.maximum(ahead - best[..., None, :], -30.0)
    level = jnp.log(jnp.maximum(square, 1e-6) / mean_square[..., None])
    short = jnp.maximum(ahead, _FLOOR)
    shown = [
        short / 2.0,
        jnp.exp(short),
        jnp.exp(4.0 * short),
        jnp.clip(level, _FLOOR, 4.0)[..., None] / 2.0,
    ]
    if close_up:
        shown.append(close_up_of(short[..., 3]))
    columns = jnp.concatenate(shown, axis=-1)
    columns = jnp.where(active[..., None], columns, 0.0)
    return VectorFeatures(columns, moments, active, ahead, best)


def _second_moments(x: jax.Array) -> jax.Array:
    """(..., M, p) -> (..., M, p (p + 1) / 2) with phi(x) . phi(y) = (x . y)^2."""
    p = x.shape[-1]
    first, second = np.triu_indices(p)
    # Products of columns picked by two small matrix products: written one by one, each
    # would be a kernel of its own.
    eye = np.eye(p, dtype=x.dtype)
    scale = np.where(first == second, 1.0, 2.0**0.5).astype(x.dtype)
    picked = functools.partial(jnp.matmul, x, precision=jax.lax.Precision.HIGHEST)
    return picked(eye[:, first]) * picked(eye[:, second] * scale)


def whiten(candidates: jax.Array, usable: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(..., M, n + 1) whitened regressors x of (..., M, n), with mean ``x x.T = I``
    over the ``usable`` (..., M), zero elsewhere; and (...,) the log-determinant of
    ``Z_s.T Z_s`` of any subset less that of ``X_s.T X_s``."""
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


def projected(
    x: jax.Array, chosen: jax.Array, count: jax.typing.ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """(..., M, p) components of every vector x orthogonal to the chosen ones, whose
    squared lengths are the Schur-complement gains; and (...,) the log of the squared
    volume that the chosen span, 0 where nothing is chosen.

    Of ``chosen`` (..., c, p), c <= p, the first ``count`` are chosen so far, the others
    zero. One in the span of those before it is not projected out again.
    """
    eye = jnp.eye(x.shape[-1], dtype=x.dtype)

    def project(carry: Any, now: Any) -> tuple[Any, None]:
        projection, volume = carry  # (..., p, p) on what the chosen leave
        vector, number = now
        rest = (projection * vector[..., None, :]).sum(-1)
        square = (rest * rest).sum(-1)
        grown = jnp.log(jnp.maximum(square, 1e-9))
        volume = volume + jnp.where(number < jnp.asarray(count), grown, 0.0)
        independent = square > 1e-9 * (vector * vector).sum(-1)
        factor = jnp.where(independent, 1.0 / jnp.where(independent, square, 1.0), 0.0)
        along = rest[..., :, None] * rest[..., None, :]
        return (projection - factor[..., None, None] * along, volume), None

    start = (
        jnp.broadcast_to(eye, (*chosen.shape[:-2], *eye.shape)),
        jnp.zeros(chosen.shape[:-2], chosen.dtype),
    )
    vectors = jnp.moveaxis(chosen, -2, 0), jnp.arange(chosen.shape[-2])
    # A loop: written out it takes three times as long to compile.
    (projection, volume), _ = jax.lax.scan(project, start, vectors)
    return jnp.einsum("...mp,...pq->...mq", x, projection), volume


def normalised_by(
    x: jax.Array, chosen: jax.Array, ridge: jax.typing.ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """(..., M, p) vectors y, x in the metric of the ``chosen`` (..., c, p): choosing i
    multiplies det G by ``1 + |y_i|^2``; and (...,) log det G.

    ``|y_i|^2 = x_i.T G^-1 x_i``, ``G = C.T C + ridge I``; a ridge of 0 needs vectors
    that span the space, zeros among them count nothing.
    """
    p = x.shape[-1]
    gram = jnp.einsum(
        "...ci,...cj->...ij", chosen, chosen, precision=jax.lax.Precision.HIGHEST
    )
    gram = jnp.broadcast_to(gram, (*x.shape[:-2], p, p))
    eye = jnp.eye(p, dtype=x.dtype)
    least = jnp.maximum(jnp.asarray(ridge, x.dtype), 1e-6)
    lower = cholesky(gram + least * jnp.broadcast_to(eye, gram.shape))
    log_det = 2.0 * jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return solve_lower(lower, x), log_det


def lookahead(
    y: jax.Array, spanned: bool, active: jax.Array, depth: jax.typing.ArrayLike
) -> list[jax.Array]:
    """Log gain of the determinant from each candidate and greedy choices after it.

    Args:
        y: (..., M, p) conditional vectors (``projected`` or ``normalised_by``), zero
            where not active.
        spanned: True where choosing i multiplies the determinant by ``1 + |y_i|^2``,
            False where by ``|y_i|^2``.
        active: (..., M) bool.
        depth: () number of choices, that candidate included; at least 1.

    Returns:
        Four arrays (..., M): the log of the factor by which the determinant grows over
        the first 1 (the gain), 2 (the best pair, exactly), 3 and ``depth`` choices, all
        of them where there are fewer; -30 where not active. Of more than 1,024
        candidates only the 512 of largest gain are looked ahead from, as in
        ``selection/policy/policy_kernel.py``: of the others all but the first are -30.
    """
    m, p = y.shape[-2:]
    base = 1.0 if spanned else 0.0
    square = (y * y).sum(-1)
    gain = jnp.log(jnp.maximum(base + square, _LEAST_GAIN))
    first = jnp.where(active, gain, _LOWEST)
    # For every start i (axis -2): the gains of all j (axis -1) after its choices.
    starts = jnp.broadcast_to(jnp.arange(m), square.shape)
    picked, reached, begins = y, first, active  # of each start, its newest choice
    if m > ALL_START:
        starts = jax.lax.top_k(jnp.where(active, square, -1.0), STARTS)[1]
        picked = jnp.take_along_axis(y, starts[..., None], axis=-2)
        reached, begins = (
            jnp.take_along_axis(x, starts, axis=-1) for x in (reached, begins)
        )
    shape = (*starts.shape, m)
    column = jnp.broadcast_to(jnp.arange(m), shape)
    gains = jnp.where(active, square, _TAKEN)[..., None, :]
    eye = jnp.broadcast_to(jnp.eye(p, dtype=y.dtype), (*starts.shape, p, p))
    parts = [y[..., None, :, i] for i in range(p)]

    def further(d: jax.Array, carry: Any) -> Any:
        """One more greedy choice of every start; ``metric`` (..., S, p, p) turns inner
        products into those of what its choices have left."""
        gains, metric, picked, newest, values = carry
        back = (metric * picked[..., None, :]).sum(-1)
        size = jnp.maximum((back * picked).sum(-1), _LEAST_GAIN)
        shrink = 1.0 / (base + size)
        inner = back[..., 0, None] * parts[0]
        for i in range(1, p):
            inner = inner + back[..., i, None] * parts[i]
        gains = gains - inner * inner * shrink[..., None]
        gains = jnp.where(column == newest[..., None], _TAKEN, gains)
        along = back[..., :, None] * back[..., None, :]
        metric = metric - shrink[..., None, None] * along
        newest = jnp.argmax(gains, axis=-1).astype(newest.dtype)
        grown = jnp.maximum(base + jnp.maximum(gains.max(-1), 0.0), _LEAST_GAIN)
        reached = values[3] + jnp.log(grown)
        ends = (d < 2, d < 3, jnp.array(True))  # the pair, the triple, the last
        later = [
            jnp.where(end, reached, value)
            for end, value in zip(ends, values[1:], strict=True)
        ]
        picked = jnp.take_along_axis(y, newest[..., None], axis=-2)
        return gains, metric, picked, newest, [values[0], *later]

    carry = (jnp.broadcast_to(gains, shape), eye, picked, starts, [reached] * 4)
    # A loop: as many copies of it as choices would take ten times as long to compile.
    *_, values = jax.lax.fori_loop(1, depth, further, carry)
    values = [jnp.where(begins, value, _LOWEST) for value in values[1:]]
    if m > ALL_START:
        lowest = jnp.full_like(square, _LOWEST)
        some = jnp.asarray(depth) > 1
        values = [
            jnp.where(
                some, jnp.put_along_axis(lowest, starts, x, -1, inplace=False), first
            )
            for x in values
        ]
    return [first, *values]
