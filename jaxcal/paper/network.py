"""The paper's attention policy (its Table 2); a network of the kind ``paper``."""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import Network, Scores, mask_logits
from jaxcal.learning.environments.selection import context_features

HEADS = ("actor", "critic_1", "critic_2")  # everything else is shared


class Decision(NamedTuple):
    context: jax.Array  # (..., 2 n + 4), see ``context_features``
    available: jax.Array  # (..., M) bool


class _Keys(nn.Module):
    """A linear map of candidates that is applied to a few queries instead: a score ``q
    . (K.T p + b)`` is ``(K q) . p`` and a number that no softmax sees, and a mean of
    keys is the key of the mean."""

    width: int

    def setup(self) -> None:
        shape = (self.width, self.width)
        self.kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        self.bias = self.param("bias", nn.initializers.zeros, (self.width,))

    def __call__(self, poses: jax.Array) -> jax.Array:
        keys = poses @ self.kernel
        return keys + jnp.broadcast_to(self.bias, keys.shape)

    def scores(self, query: jax.Array, poses: jax.Array) -> jax.Array:
        """(..., M) inner products with the keys, less what all of them share."""
        return jnp.einsum("...w,...mw->...m", query @ self.kernel.T, poses)


class Observing(Network):
    """A network whose decisions are functions of the paper's observation alone."""

    def candidate_features(self, candidates: jax.Array, usable: jax.Array) -> jax.Array:
        return candidates

    def decision_features(
        self,
        features: jax.Array,
        chosen: jax.Array,
        available: jax.Array,
        count: jax.typing.ArrayLike,
    ) -> Decision:
        self.require_choices(features.shape[-1], chosen.shape[-1])
        return Decision(context_features(features, chosen), available)

    def require_choices(self, num_inputs: int, num_selected: int) -> None:
        """Refuse more choices than the network can read; here it reads any number."""

    def from_observation(
        self, observation: jax.Array, num_candidates: int, num_inputs: int
    ) -> Scores:
        """Logits and value from the (..., 210) numbers of ``selection.observe``."""
        m, n = num_candidates, num_inputs
        poses = observation[..., : n * m].reshape(*observation.shape[:-1], m, n)
        available = observation[..., n * m : (n + 1) * m] > 0.5
        decision = Decision(observation[..., (n + 1) * m :], available)
        return self.decode(self.encode(poses), decision)


class PaperNetwork(Observing):
    """The paper's attention policy: hidden 768, 3.5 M parameters, 71 % shared.

    Candidates are encoded one by one, a context encoder reads the other ten numbers,
    attention relates the two, and an actor and a critic stand on that shared encoder.
    """

    config: NetworkConfig

    def setup(self) -> None:
        width = self.config.width
        self.pose_1, self.pose_2 = nn.Dense(width), nn.Dense(width)
        self.pose_norm = nn.LayerNorm()
        self.key = _Keys(width)
        self.context_1, self.context_2 = nn.Dense(width), nn.Dense(width)
        self.context_norm = nn.LayerNorm()
        self.query = nn.Dense(width)
        self.squeeze = nn.Dense(max(width * 3 // 32, 1))
        self.expand = nn.Dense(width)
        self.actor = nn.Dense(width)
        self.critic_1 = nn.Dense(max(width * 2 // 3, 1))
        self.critic_2 = nn.Dense(1, kernel_init=nn.initializers.orthogonal(0.1))

    def encode(self, features: jax.Array) -> jax.Array:
        poses = nn.relu(self.pose_1(2.0 * features - 1.0))
        return self.pose_norm(nn.relu(self.pose_2(poses)))

    def decode(self, memory: jax.Array, decision: Decision) -> Scores:
        context = nn.relu(self.context_1(decision.context))
        context = self.context_norm(nn.relu(self.context_2(context)))
        scale = self.config.width**-0.5
        scores = self.key.scores(self.query(context), memory) * scale
        weights = nn.softmax(mask_logits(scores, decision.available))
        glimpse = self.key(jnp.einsum("...m,...mw->...w", weights, memory))
        shared = context + self.expand(nn.relu(self.squeeze(context + glimpse)))
        logits = self.key.scores(self.actor(shared), memory) * scale
        value = self.critic_2(nn.relu(self.critic_1(shared)))[..., 0]
        return mask_logits(logits, decision.available), value
