"""The compact network: invariant, for any M, K and n; docs/policy.md describes it."""

from __future__ import annotations

import itertools

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import Network, Scores, mask_logits
from jaxcal.learning.policies.features import (
    CandidateFeatures,
    DecisionFeatures,
    VectorFeatures,
    close_up_of,
    decision_features,
    vector_features,
    whiten,
)

_SHARP = 60.0  # inverse temperature of the choices that need no learning


class _Dense(nn.Module):
    """A dense layer on concatenated inputs, as a product of each with its kernel rows:
    one that all candidates of a set share is multiplied once."""

    width: int

    @nn.compact
    def __call__(self, *parts: jax.Array) -> list[jax.Array]:
        """Products (..., width), to be added up; the bias is in the first."""
        sizes = [part.shape[-1] for part in parts]
        init = nn.initializers.lecun_normal()
        kernel = self.param("kernel", init, (sum(sizes), self.width))
        bias = self.param("bias", nn.initializers.zeros, (self.width,))
        cuts = itertools.accumulate(sizes)
        products = [
            part @ kernel[end - size : end]
            for part, size, end in zip(parts, sizes, cuts, strict=True)
        ]
        products[0] = products[0] + jnp.broadcast_to(bias, products[0].shape)
        return products


class _Round(nn.Module):
    """One round of messages among the active candidates, then a residual MLP. That to
    i, ``sum_j (x_i . x_j)^2 v_j``, is computed through the second moments of the whole
    set, so that the cost grows with M and not M squared."""

    width: int

    @nn.compact
    def __call__(self, h: jax.Array, vectors: VectorFeatures) -> jax.Array:
        width = self.width
        active = vectors.active[..., None].astype(h.dtype)
        u = nn.LayerNorm(name="norm")(h)
        v = nn.Dense(width, use_bias=False, name="send")(u) * active
        total = jnp.einsum("...mf,...mw->...fw", vectors.moments, v)
        number = jnp.maximum(active.sum(-2, keepdims=True), 1.0)
        mean = (u * active).sum(-2, keepdims=True) / number
        # The layer is linear: it is applied to p (p + 1) / 2 totals, not M messages.
        direct, sent = _Dense(2 * width, name="mix")(u, total)
        inner = direct + jnp.einsum("...mf,...fw->...mw", vectors.moments, sent)
        pooled = nn.Dense(2 * width, use_bias=False, name="pool")(mean)
        out = nn.Dense(width, name="out")(nn.relu(inner + pooled))
        return h + out * active


class CompactNetwork(Network):
    """Permutation-equivariant, affine-invariant, for any M, K and n.

    The look-ahead makes the last two choices (``num_unlearned``): the best pair given
    the choices before, then the largest gain. At K = n + 2 the choices before the pair
    do not span the space, so pairs are compared with the ridge of ``features`` added:
    the pair may be second best where those choices nearly coincide (docs/policy.md).
    """

    config: NetworkConfig

    def setup(self) -> None:
        config = self.config
        self.embed = nn.Dense(config.width)
        self.encoder = [_Round(config.width) for _ in range(config.encoder_rounds)]
        self.join = _Dense(config.width)
        self.decoder = [_Round(config.width) for _ in range(config.decoder_rounds)]
        self.final_norm = nn.LayerNorm()
        self.actor = nn.Dense(
            1,
            use_bias=False,
            kernel_init=nn.initializers.orthogonal(config.initial_actor),
        )
        trust = nn.initializers.constant(config.initial_trust)
        self.trust = self.param("trust", trust, ())
        self.critic_hidden = nn.Dense(config.width)
        self.critic = nn.Dense(1, kernel_init=nn.initializers.orthogonal(0.1))

    @property
    def num_unlearned(self) -> int:
        return min(self.config.lookahead, 2)

    def candidate_features(
        self, candidates: jax.Array, usable: jax.Array
    ) -> CandidateFeatures:
        whitened, offset = whiten(candidates, usable)
        depth = min(self.config.lookahead, whitened.shape[-1])
        close_up = self.config.close_up
        vectors = vector_features(whitened, False, usable, depth, close_up)
        return CandidateFeatures(vectors, whitened, offset)

    def decision_features(
        self,
        features: CandidateFeatures,
        chosen: jax.Array,
        available: jax.Array,
        count: jax.typing.ArrayLike,
    ) -> DecisionFeatures:
        config = self.config
        return decision_features(
            features, chosen, available, count, config.lookahead, config.close_up
        )

    def encode(self, features: CandidateFeatures) -> jax.Array:
        columns, active = features.vectors.columns, features.vectors.active
        size = jnp.log(jnp.maximum(active.sum(-1).astype(columns.dtype), 1.0) / 50.0)
        dimension = jnp.full_like(size, features.whitened.shape[-1] / 4.0 - 1.0)
        scalars = jnp.stack([size / 3.0, dimension], axis=-1)[..., None, :]
        scalars = jnp.broadcast_to(scalars, (*columns.shape[:-1], 2))
        h = self.embed(jnp.concatenate([columns, scalars], axis=-1))
        h = h * active[..., None]
        for layer in self.encoder:
            h = layer(h, features.vectors)
        return h

    def decode(self, memory: jax.Array, decision: DecisionFeatures) -> Scores:
        h, vectors = memory, decision.vectors
        columns, active = vectors.columns, vectors.active
        mean = jnp.einsum("...m,...mw->...w", decision.chosen, h)
        state = jnp.concatenate([mean, decision.progress], axis=-1)[..., None, :]
        of_set, of_candidate, of_decision = self.join(h, columns, state)
        g = (of_set + of_candidate + of_decision) * active[..., None]
        for layer in self.decoder:
            g = layer(g, vectors)
        g = self.final_norm(g)
        # The weight of the greedy look-ahead is learned.
        rule = 20.0 * vectors.to_the_end
        if self.config.close_up:
            rule = rule + close_up_of(vectors.to_the_end).sum(-1)
        logits = self.actor(g)[..., 0] + self.trust * rule
        logits = mask_logits(logits, active)
        weight = active[..., None].astype(g.dtype)
        number = jnp.maximum(weight.sum(-2), 1.0)
        pooled = jnp.concatenate(
            [(g * weight).sum(-2) / number, (g - 1e3 * (1.0 - weight)).max(-2)], axis=-1
        )
        value = self.critic(nn.relu(self.critic_hidden(pooled)))[..., 0]
        return logits, decision.reached + value

    def lookahead_logits(self, decision: DecisionFeatures) -> Scores:
        vectors = decision.vectors
        logits = mask_logits(_SHARP * vectors.to_the_end, vectors.active)
        return logits, decision.reached
