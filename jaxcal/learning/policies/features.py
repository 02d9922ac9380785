"""Inputs of the compact network: geometry of a candidate set and of a decision.

Nothing here has parameters, so training computes it once for a decision and not in
every epoch. Shapes: M candidates, n inputs, p = n + 1, K choices; leading axes ``...``.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.learning.policies import geometry

_FLOOR = -8.0  # least log-volume, relative to the best, that a feature can show
_RIDGE = 0.01  # of the mean square of a whitened coordinate, which is one
_CLOSE = (32.0, 256.0, 2048.0)  # scales at which near-equal look-aheads differ

AHEAD = ("gain", "best pair", "greedy triple", "greedy to the end")
"""Choices that a look-ahead makes: 1, 2, 3 and all to the end."""
FEATURES = (
    *(f"half of {name}" for name in AHEAD),
    *(f"exp of {name}" for name in AHEAD),
    *(f"exp of 4 x {name}" for name in AHEAD),
    "half of the squared length's log, less the mean's",
    *(f"exp of {scale:g} x {AHEAD[-1]}" for scale in _CLOSE),  # with ``close_up``
)
"""Columns of a candidate; log-volumes ahead are relative to the best candidate's.
``selection/policy/policy_kernel.py`` computes the same."""


class VectorFeatures(NamedTuple):
    """Inputs of the network from vectors y, one per candidate."""

    columns: jax.Array  # (..., M, F) FEATURES, without close-ups all but the last three
    moments: jax.Array  # (..., M, p (p + 1) / 2) products of coordinates, scaled so
    # that messages keep their size whatever M is
    active: jax.Array  # (..., M) bool, which candidates count
    ahead: jax.Array  # (..., M, 4) AHEAD: log-volume after the greedy choices that
    # begin with this candidate, relative to the best candidate's
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

    Args:
        features: of the set.
        chosen: (..., K) int, of which the first ``count`` are chosen, the rest -1.
        available: (..., M) bool; at the number 0 of ``count`` those of the set itself,
            whose look-ahead is then that of the decision.
        count: () choices made; may be traced: one program serves every decision.
        lookahead: most greedy choices to look ahead.
        close_up: adds the columns that tell near-equal look-aheads apart.
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
            y, so_far = geometry.projected(x, picked, count)
        else:
            # The metric of the chosen; until they span the space, with a ridge small
            # beside what a posture contributes.
            ridge = jnp.where(count < p, _RIDGE, 0.0)
            y, so_far = geometry.normalised_by(x, picked, ridge)
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
    """Features of vectors y (..., M, p); arguments as in ``geometry.lookahead``."""
    y = y * active[..., None].astype(y.dtype)
    number = jnp.maximum(active.sum(-1).astype(y.dtype), 1.0)
    square = (y * y).sum(-1)
    mean_square = jnp.maximum(square.sum(-1) / number, 1e-8)
    unit = y * jax.lax.rsqrt(mean_square)[..., None, None]
    moments = _second_moments(unit) * jax.lax.rsqrt(number)[..., None, None]
    ahead = jnp.stack(geometry.lookahead(y, spanned, active, depth), axis=-1)
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
