"""Proximal policy optimisation over candidate sets.

An update draws fresh candidate sets, plays ``episodes_per_set`` episodes on each
(``rollout``), and takes minibatch epochs (``optimiser``) on the clipped surrogate;
``update`` makes one jitted call of it. Source: Schulman et al. 2017.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.training import rollout, update
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.optimiser import Metrics
from jaxcal.learning.training.rollout import Rollout
from jaxcal.learning.training.rules import Rules
from jaxcal.learning.training.update import Update

__all__ = ["surrogate", "updater"]


def surrogate(
    params: Any,
    batch: Rollout,
    entropy_bonus: jax.Array,
    config: PPOConfig,
    task: Rules,
    network: Network,
) -> tuple[jax.Array, Metrics]:
    """Clipped surrogate, squared value error and entropy bonus of whole episodes.

    The set is encoded once and all its decisions are scored together.
    """
    memory = networks.encode(network, params, batch.features)
    # (B, T, G, M), (B, T, G)
    logits, value = networks.decode(network, params, memory, batch.decisions, axes=2)
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


@functools.lru_cache(maxsize=32)
def updater(
    config: PPOConfig, task: Rules, network: Network, mesh: Mesh | None = None
) -> Update:
    """An update: state, given up -> the next state and metrics.

    Metrics are scalars, and ``rewards`` (episodes_per_update,).

    Args:
        config, task, network: what is trained, and how.
        mesh: from ``devices.make_mesh``; None for one device.
    """
    num_sets = config.episodes_per_update // config.episodes_per_set

    # The key of an update is split in three, here and below: sets, actions, starts.
    def draw(key: jax.Array) -> Any:
        return rollout.draw(task, num_sets, jax.random.split(key, 3)[0])

    def play(params: Any, sets: Any, key: jax.Array) -> tuple[Rollout, Metrics]:
        _, key_actions, key_starts = jax.random.split(key, 3)
        return rollout.play(
            config, task, network, params, sets, key_actions, key_starts
        )

    def loss(params: Any, batch: Rollout, done: jax.Array) -> tuple[jax.Array, Metrics]:
        progress = jnp.minimum(done / config.num_updates, 1.0)
        bonus = config.entropy_start + progress * (
            config.entropy_end - config.entropy_start
        )
        return surrogate(params, batch, bonus, config, task, network)

    return update.jitted(config, mesh, draw=draw, gather=play, loss=loss)
