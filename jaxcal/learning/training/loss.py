"""What PPO minimises. Source: Schulman et al. 2017 (clipped surrogate)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.rollout import Rollout
from jaxcal.learning.training.rules import Rules

__all__ = ["surrogate"]


def surrogate(
    params: Any,
    batch: Rollout,
    entropy_bonus: jax.Array,
    config: PPOConfig,
    task: Rules,
    network: Network,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate, squared value error and entropy bonus of whole episodes.

    The set is encoded once and all its decisions are scored together.
    """
    memory = networks.encode(network, params, batch.features)
    decode = jax.vmap(
        jax.vmap(
            lambda seen: networks.decode(network, params, memory, seen),
            in_axes=1,
            out_axes=1,
        ),
        in_axes=1,
        out_axes=1,
    )
    logits, value = decode(batch.decisions)  # (B, T, G, M), (B, T, G)
    value = value * task.value_scale
    log_probs = jax.nn.log_softmax(logits)
    log_prob = jnp.take_along_axis(log_probs, batch.action[..., None], axis=-1)
    log_ratio = log_prob[..., 0] - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip_range, 1.0 + config.clip_range)
    number = jnp.maximum(batch.counted.sum(), 1.0)

    def mean(array: jax.Array) -> jax.Array:
        return (array * batch.counted).sum() / number

    gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    policy_loss = -mean(gain)
    limit = config.value_error_limit
    error = jnp.clip(value - batch.target, -limit, limit)
    value_loss = mean(error**2)
    entropy = mean(-(jnp.exp(log_probs) * log_probs).sum(-1))
    loss = policy_loss + config.value_coefficient * value_loss - entropy_bonus * entropy
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "kl": mean(ratio - 1.0 - log_ratio),
    }
    return loss, metrics
