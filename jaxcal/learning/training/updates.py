"""An update of training as a program that is kept: a later start traces nothing.

``ppo.update`` takes seconds to trace and to lower before its code can be looked up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import Mesh

from jaxcal.learning.policies.networks import Network
from jaxcal.learning.runtime import programs
from jaxcal.learning.training import ppo
from jaxcal.learning.training.ppo import PPOConfig, Task, TrainState

__all__ = ["Update", "updater"]

Update = Callable[[TrainState], tuple[TrainState, dict[str, jax.Array]]]


def updater(
    config: PPOConfig, task: Task, network: Network, mesh: Mesh | None, like: TrainState
) -> Update:
    """``ppo.update`` of a configuration; gives up the state it is called with.

    Args:
        config, task, network, mesh: see ``ppo.update``.
        like: a state, for shapes and types.
    """
    if mesh is not None or not programs.are_kept():
        return lambda state: ppo.update(state, config, task, network, mesh)
    leaves, tree = jax.tree.flatten(like)
    is_key = [jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]

    def plain(state: TrainState) -> list[Any]:
        return [
            jax.random.key_data(leaf) if key else leaf
            for leaf, key in zip(jax.tree.leaves(state), is_key, strict=True)
        ]

    def whole(leaves: list[Any]) -> Any:
        return jax.tree.unflatten(
            tree,
            [
                jax.random.wrap_key_data(leaf) if key else leaf
                for leaf, key in zip(leaves, is_key, strict=True)
            ],
        )

    def update(_: Any, *leaves: Any) -> tuple[list[Any], dict[str, jax.Array]]:
        state, metrics = ppo.update(whole(list(leaves)), config, task, network)
        return plain(state), metrics

    shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in plain(like))
    name = programs.name_of("update", config, task, network, shapes)
    program = programs.load(name) or programs.make(
        name, update, None, shapes, {}, donate=True
    )

    def call(state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        leaves, metrics = program(*plain(state))
        return whole(leaves), metrics

    return call
