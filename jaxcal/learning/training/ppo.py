"""Proximal policy optimisation over candidate sets.

An update draws fresh candidate sets, plays ``episodes_per_set`` episodes on each
(``rollout``), and takes minibatch epochs (``optimiser``) on the clipped surrogate
(``loss``); ``update`` makes one jitted call of it.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from jaxcal.learning.policies.networks import Network
from jaxcal.learning.training import rollout, update
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.loss import surrogate
from jaxcal.learning.training.optimiser import Metrics
from jaxcal.learning.training.rollout import Rollout
from jaxcal.learning.training.rules import Rules
from jaxcal.learning.training.update import Update

__all__ = ["updater"]


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
