"""Products of learned features of the paper's 210 numbers; the kind ``observation``.

Nothing here computes a gain, a projection or a determinant. The chosen postures are
read one after another, ``h <- W (U h * V x)``, and candidates attend to one another by
a power of a learned bilinear score. docs/policy.md says what each part brings.
"""

from __future__ import annotations

import itertools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.learning.core.network import Scores, mask_logits
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.paper.network import Decision, Observing

_STATE = 64  # numbers that the chosen postures become
_HEADS = 4
_READ = 4  # squares that are read from every layer
_DOUBLINGS = 2  # attention by the squared score to the power 2^2
_SMALL = 1e-4  # added to squares of order one before their logarithm
_SCALE = 12.0**0.5  # 1 / standard deviation of uniform commands in [0, 1]


class ProductNetwork(Observing):
    """Products, attention and dense layers over the paper's observation.

    Candidates that are not available are those that were chosen, read in their order:
    all must be available at first. The value is 0: siblings are the baseline.
    """

    config: NetworkConfig

    @property
    def mask_is_chosen(self) -> bool:
        return True

    def require_choices(self, num_inputs: int, num_selected: int) -> None:
        if num_selected > num_inputs + 1:
            raise ValueError(
                f"kind observation reads at most {num_inputs} chosen postures: "
                f"num_selected must be at most num_inputs + 1 = {num_inputs + 1}, got "
                f"{num_selected}"
            )

    def encode(self, features: jax.Array) -> jax.Array:
        """(..., M, n + 1) centred and scaled commands, and 1."""
        x = (features - 0.5) * _SCALE
        return jnp.concatenate([x, jnp.ones_like(x[..., :1])], -1)

    def decode(self, memory: jax.Array, decision: Decision) -> Scores:
        """Scores of the next choice; ``mirrored``: from each of the 2^n mirror images
        of the set, what most of them choose from the beginning has the largest logits.
        Where none chose what is chosen already, the mean probability decides."""
        x, available = memory, decision.available
        value = jnp.zeros(available.shape[:-1])
        if not self.config.mirrored:
            return self._logits(x, available), value
        p = x.shape[-1]
        signs = np.array([(*s, 1) for s in itertools.product((1, -1), repeat=p - 1)])
        signs = signs.reshape(-1, *(1,) * (x.ndim - 1), p)
        images = x[None] * signs.astype(x.dtype)
        now = jnp.broadcast_to(available, (len(signs), *available.shape))
        mean = nn.softmax(self._logits(images, now)).mean(0)
        own, weights = self.clone(parent=None), self.variables

        def choose(free: jax.Array, _: None) -> tuple[jax.Array, None]:
            logits: Any = own.apply(weights, images, free, method="_logits")
            return free & (jax.nn.one_hot(logits.argmax(-1), free.shape[-1]) == 0), None

        free, _ = jax.lax.scan(choose, jnp.ones_like(now), length=p)
        alike = (free[:, None] == free[None]).all(-1).sum(1)  # (2^n, ...) images
        fits = (available[None] | ~free).all(-1)  # chose what is chosen already
        votes = jnp.where(fits, (alike / len(signs)) ** 4, 0.0)[..., None] * ~free
        logits = jnp.log(votes.sum(0) + 1e-6 * mean + 1e-30)
        return mask_logits(logits, available), value

    @nn.compact
    def _logits(self, x: jax.Array, available: jax.Array) -> jax.Array:
        width, rounds, p = self.config.width, self.config.decoder_rounds, x.shape[-1]
        free = available.astype(x.dtype)
        number = free.sum(-1, keepdims=True)
        step = jnp.minimum((~available).sum(-1), p - 1)
        state, level = self._chosen(x, available, step)
        # The products are linear in x: taken of its axes, once for all candidates.
        first = _Product(4 * width, width, name="read_0")
        axes = jnp.broadcast_to(jnp.eye(p), (*state.shape[:-1], p, p))
        w, shown = x @ first(state[..., None, :], axes), []
        for i in range(rounds + 1):
            square = ((w * w).mean(-1) * free).sum(-1, keepdims=True) / number + 1e-10
            w = w * jax.lax.rsqrt(square)[..., None]
            level = level + jnp.log(square)
            read = _dense(_READ, f"squares_{i}")(w)
            shown.append(jnp.log(_SMALL + read**2) + level[..., None])
            if i < rounds:
                query = _dense(_HEADS * p, f"query_{i}")(w)
                means, height = _attention(query, x, free)
                shown.append(height + level[..., None])
                w = _Product(4 * width, width, name=f"read_{i + 1}")(w, means)
        logs = jnp.where(available[..., None], jnp.concatenate(shown, -1), -30.0)
        below = jnp.maximum(logs - logs.max(-2, keepdims=True), -12.0)
        now = jax.nn.one_hot(step, p)[..., None, :]
        by_step = jnp.broadcast_to(now, (*x.shape[:-1], p))
        hidden = jnp.concatenate([jnp.maximum(below, -6.0) / 2.0, x, by_step], -1)
        for i in range(2):
            hidden = nn.relu(nn.Dense(width, name=f"hidden_{i}")(hidden))
        logits = nn.Dense(1, False, kernel_init=_normal(0.01), name="actor")(hidden)
        size = below.shape[-1]
        even = nn.initializers.constant(0.2 / size)
        linear = now @ self.param("linear", even, (p, size))
        logits = logits[..., 0] + (below * linear).sum(-1)
        return mask_logits(logits, available)

    def _chosen(
        self, x: jax.Array, available: jax.Array, step: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """(..., 64) the chosen postures as one vector, (..., 1) log of its square."""
        read = _Product(4 * _STATE, _STATE, name="read_chosen")
        start = self.param("start", _normal(1.0), (_STATE,))
        state = jnp.broadcast_to(start, (*step.shape, _STATE))
        level, left = jnp.zeros((*step.shape, 1)), ~available
        for i in range(x.shape[-1] - 1):
            first = jax.nn.one_hot(jnp.argmax(left, -1), x.shape[-2])
            left &= first == 0.0
            after = read(state, (first[..., None] * x).sum(-2))
            square = (after * after).mean(-1, keepdims=True) + 1e-8
            here = (i < step)[..., None]
            state = jnp.where(here, after * jax.lax.rsqrt(square), state)
            level = jnp.where(here, level + jnp.log(square), level)
        return state, level


_normal = nn.initializers.normal


def _dense(features: int, name: str) -> nn.Dense:
    return nn.Dense(features, use_bias=False, name=name)


class _Product(nn.Module):
    """``W (U a * V b)``: products of learned features of two vectors."""

    hidden: int
    width: int

    @nn.compact
    def __call__(self, a: jax.Array, b: jax.Array) -> jax.Array:
        left, right = _dense(self.hidden, "left")(a), _dense(self.hidden, "right")(b)
        return _dense(self.width, "out")(left * right)


def _attention(
    query: jax.Array, x: jax.Array, free: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Means (..., M, H p) of x (..., M, p), whose last column is 1, weighted by powers
    of squared scores with ``query`` (..., M, H p), and (..., M, H) log of the largest
    of these; ``free`` (..., M) is 1 or 0, what is attended to."""
    *lead, m, _ = query.shape
    p = x.shape[-1]
    rows = query.reshape(*lead, -1, p)
    square = jnp.einsum("...ka,...ja->...kj", rows, x) ** 2 * free[..., None, :]
    most = square.max(-1, keepdims=True) + 1e-6
    weight = square / jax.lax.stop_gradient(most)
    for _ in range(_DOUBLINGS):
        weight = weight * weight
    total = jnp.einsum("...kj,...ja->...ka", weight, x)
    means = total / (total[..., -1:] + 1e-6)
    return means.reshape(query.shape), jnp.log(most).reshape(*lead, m, -1)
