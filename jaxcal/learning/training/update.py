"""One jitted update: gather experience, learn from it. Only this places on devices.

Whatever is gathered, an update has this shape:

    sets       = draw(key)                candidate sets, spread over the devices
    experience = gather(params, sets)     each device its share; then whole on every one
    state      = learn(...)               each minibatch spread over the devices

So a minibatch is any of the sets, as on a single device, and is cut without further
communication. With one device (``mesh`` None) nothing is placed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import Mesh

from jaxcal.learning.runtime import devices
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.optimiser import Metrics, TrainState, learn

__all__ = ["Update", "jitted"]

Update = Callable[..., tuple[TrainState, Metrics]]
"""(state, given up; what ``draw`` is given) -> the next state and metrics."""


def jitted(
    config: PPOConfig,
    mesh: Mesh | None,
    *,
    draw: Callable[..., Any],
    gather: Callable[[Any, Any, jax.Array], tuple[Any, Metrics]],
    loss: Callable[[Any, Any, jax.Array], tuple[jax.Array, Metrics]],
) -> Update:
    """Build an update.

    Args:
        config: the optimisation.
        mesh: from ``devices.make_mesh``; None for one device.
        draw: (key, what the update is called with) -> sets, one leading row each.
        gather: (parameters, sets, key) -> experience, one leading row a set; metrics.
        loss: (parameters, rows of experience, number of updates made) -> loss, metrics.
    """

    def update(state: TrainState, *given: Any) -> tuple[TrainState, Metrics]:
        key, key_gather, key_epochs = jax.random.split(
            jax.random.wrap_key_data(state.key), 3
        )
        sets = devices.by_set(draw(key_gather, *given), mesh)
        experience, metrics = gather(state.params, sets, key_gather)
        experience = devices.everywhere(experience, mesh)

        def minibatch(index: jax.Array) -> Any:
            rows = jax.tree.map(lambda leaf: leaf[index], experience)
            return devices.by_set(rows, mesh)

        after, losses = learn(
            state,
            config,
            len(jax.tree.leaves(experience)[0]),
            minibatch,
            lambda params, batch: loss(params, batch, state.num_updates),
            key_epochs,
        )
        after = dataclasses.replace(after, key=jax.random.key_data(key))
        return devices.everywhere((after, metrics | losses), mesh)

    return jax.jit(update, donate_argnums=0)
