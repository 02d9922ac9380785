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

from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import Scores, mask_logits
from jaxcal.paper.network import Decision, Observing

_STATE = 64  # numbers that the chosen postures become
_HEADS = 4
_READ = 4  # squares that are read from every layer
_DOUBLINGS = 2  # attention by the squared score to the power 2^2
_SMALL = 1e-4  # added to squares of order one before their logarithm
_APART = 1e6  # by which logits of the whole choice are higher
_SCALE = 12.0**0.5  # 1 / standard deviation of uniform commands in [0, 1]

Memory = tuple[jax.Array, jax.Array | None]


class ProductNetwork(Observing):
    """Products, attention and dense layers over the paper's observation.

    Candidates that are not available are those that were chosen, read in their order:
    all must be available at first. The value is 0: siblings are the baseline.
    """

    config: NetworkConfig
    num_selected: int | None = None  # of mirror images; n + 1 where None

    @property
    def mask_is_chosen(self) -> bool:
        return True

    def of_choices(self, num_selected: int) -> ProductNetwork:
        return self.clone(num_selected=num_selected)

    def require_choices(self, num_inputs: int, num_selected: int) -> None:
        if num_selected > num_inputs + 1 and not self.config.mirrored:
            raise ValueError(
                f"kind observation is trained to read {num_inputs} chosen postures: "
                f"num_selected must be at most num_inputs + 1 = {num_inputs + 1}, got "
                f"{num_selected}"
            )

    def encode(self, features: jax.Array) -> Memory:
        """(..., M, n + 1) centred and scaled commands, and 1; ``mirrored``: with the
        postures that it chooses of the set, (..., M) bool."""
        x = (features - 0.5) * _SCALE
        x = jnp.concatenate([x, jnp.ones_like(x[..., :1])], -1)
        if not self.config.mirrored or self.is_initializing():
            return x, None
        return x, self._whole_choice(x, self.num_selected or x.shape[-1])

    def decode(self, memory: Memory, decision: Decision) -> Scores:
        """Scores of the next choice; ``mirrored``: those of the whole choice first,
        unless others than these are chosen already."""
        (x, whole), available = memory, decision.available
        logits = self._logits(x, available, ~available[..., None, :])
        if whole is not None:
            fits = (available | whole).all(-1, keepdims=True)
            logits = jnp.where(fits & whole & available, _APART, 0.0) + logits
        return logits, jnp.zeros(available.shape[:-1])

    def _whole_choice(self, x: jax.Array, k: int) -> jax.Array:
        """(..., M) bool, k postures of a set: in each of its 2^n mirror images k are
        chosen, and each is twice taken back and chosen again, as the last; of what most
        images chose, each is chosen again by the mean over all images."""
        m, p = x.shape[-2:]
        signs = np.array([(*s, 1) for s in itertools.product((1, -1), repeat=p - 1)])
        images = x[None] * signs.reshape(-1, *(1,) * (x.ndim - 1), p).astype(x.dtype)
        own, weights = self.clone(parent=None), self.variables

        def mask(chosen: jax.Array) -> jax.Array:
            return jax.nn.one_hot(chosen, m, dtype=bool).any(-2)

        def logits(chosen: jax.Array) -> jax.Array:
            size = chosen.shape[-1]
            groups = [*itertools.combinations(range(size), min(size, p - 1))]
            read = mask(chosen[..., np.array(groups, int)])
            answer: Any = own.apply(
                weights, images, ~mask(chosen), read, method="_logits"
            )
            return answer

        def again(chosen: jax.Array, _: None) -> tuple[jax.Array, None]:
            some = chosen[..., 1:]
            return _with(some, logits(some)), None

        def again_by_all(chosen: jax.Array, _: None) -> tuple[jax.Array, None]:
            some = chosen[..., 1:]
            mean = nn.log_softmax(logits(some)).mean(0, keepdims=True)
            return _with(some, jnp.broadcast_to(mean, images.shape[:-1])), None

        chosen = jnp.full((*images.shape[:-2], min(k, p)), -1)  # none, as its mask says
        chosen = jax.lax.scan(again, chosen, length=chosen.shape[-1])[0]
        while chosen.shape[-1] < k:
            chosen = _with(chosen, logits(chosen))
        chosen = jax.lax.scan(again, chosen, length=2 * k)[0]
        sets = mask(chosen)
        alike = (sets[:, None] == sets[None]).all(-1).sum(1)  # (2^n, ...) images
        most = alike.argmax(0, keepdims=True)[..., None]
        chosen = jnp.broadcast_to(jnp.take_along_axis(chosen, most, 0), chosen.shape)
        return mask(jax.lax.scan(again_by_all, chosen, length=k)[0][0])

    @nn.compact
    def _logits(self, x: jax.Array, free: jax.Array, groups: jax.Array) -> jax.Array:
        """(..., M) scores of the ``free`` (..., M), given the chosen: at most n in each
        of the ``groups`` (..., S, M) bool, of which squares are summed."""
        width, rounds, p = self.config.width, self.config.decoder_rounds, x.shape[-1]
        step = jnp.minimum(groups.sum(-1), p - 1)
        state, level = self._chosen(x, groups, step)
        x, weight = x[..., None, :, :], free.astype(x.dtype)[..., None, :]
        number = weight.sum(-1, keepdims=True)
        # The products are linear in x: taken of its axes, once for all candidates.
        first = _Product(4 * width, width, name="read_0")
        axes = jnp.broadcast_to(jnp.eye(p), (*state.shape[:-1], p, p))
        w, shown = x @ first(state[..., None, :], axes), []
        for i in range(rounds + 1):
            square = ((w * w).mean(-1) * weight).sum(-1, keepdims=True) / number + 1e-10
            w = w * jax.lax.rsqrt(square)[..., None]
            level = level + jnp.log(square)
            read = _dense(_READ, f"squares_{i}")(w)
            shown.append(jnp.log(_SMALL + read**2) + level[..., None])
            if i < rounds:
                query = _dense(_HEADS * p, f"query_{i}")(w)
                means, height = _attention(query, x, weight)
                shown.append(height + level[..., None])
                w = _Product(4 * width, width, name=f"read_{i + 1}")(w, means)
        logs = nn.logsumexp(jnp.concatenate(shown, -1), -3)
        logs = jnp.where(free[..., None], logs, -30.0)
        below = jnp.maximum(logs - logs.max(-2, keepdims=True), -12.0)
        now = jax.nn.one_hot(step[..., 0], p)[..., None, :]
        x = x[..., 0, :, :]
        by_step = jnp.broadcast_to(now, (*below.shape[:-1], p))
        hidden = jnp.concatenate([jnp.maximum(below, -6.0) / 2.0, x, by_step], -1)
        for i in range(2):
            hidden = nn.relu(nn.Dense(width, name=f"hidden_{i}")(hidden))
        logits = nn.Dense(1, False, kernel_init=_normal(0.01), name="actor")(hidden)
        size = below.shape[-1]
        even = nn.initializers.constant(0.2 / size)
        linear = now @ self.param("linear", even, (p, size))
        return mask_logits(logits[..., 0] + (below * linear).sum(-1), free)

    def _chosen(
        self, x: jax.Array, groups: jax.Array, step: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """(..., S, 64) each group as one vector, (..., S, 1) log of its square."""
        read = _Product(4 * _STATE, _STATE, name="read_chosen")
        start = self.param("start", _normal(1.0), (_STATE,))
        state = jnp.broadcast_to(start, (*step.shape, _STATE))
        level, left = jnp.zeros((*step.shape, 1)), groups
        for i in range(x.shape[-1] - 1):
            first = jax.nn.one_hot(jnp.argmax(left, -1), x.shape[-2])
            left &= first == 0.0
            after = read(state, first @ x)
            square = (after * after).mean(-1, keepdims=True) + 1e-8
            here = (i < step)[..., None]
            state = jnp.where(here, after * jax.lax.rsqrt(square), state)
            level = jnp.where(here, level + jnp.log(square), level)
        return state, level


def _with(chosen: jax.Array, logits: jax.Array) -> jax.Array:
    """The (..., c) chosen and the likeliest of (..., M)."""
    return jnp.concatenate([chosen, logits.argmax(-1, keepdims=True)], -1)


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
