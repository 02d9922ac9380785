"""Named configurations, and how single values of one are changed."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from jaxcal.learning.environments.scenarios import SHAPES
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.training.ppo import PPOConfig, Task
from jaxcal.learning.training.run import TrainConfig

__all__ = ["PRESETS", "field_names", "fields", "with_values"]

_COMPACT = TrainConfig(
    preset="compact",
    network=NetworkConfig(),
    ppo=PPOConfig(num_episodes=200_000),
)


_ALL = ("uniform", *SHAPES)  # uniform twice as often as any other


def _task(
    num_candidates: int = 50,
    num_selected: int = 4,
    num_inputs: int = 3,
    shapes: tuple[str, ...] = ("uniform",),
    masked: float = 0.0,
    random_starts: float = 0.0,
) -> Task:
    environment = SelectionConfig(
        num_candidates,
        num_selected,
        num_inputs,
        num_inputs,
        reward_gain=num_selected > num_inputs + 1,
    )
    return Task(environment, shapes, masked, random_starts)


# What ships. It begins as the look-ahead rule and imitates the solvers, which is what
# adds most to the rule in a given time (docs/policy.md): the paper's task, other shapes
# of candidates, masks, given postures, other numbers of postures and of inputs.
_GENERAL = TrainConfig(
    preset="general",
    network=NetworkConfig(close_up=True, initial_trust=4.0, initial_actor=0.05),
    ppo=PPOConfig(
        num_episodes=300_000,
        entropy_start=0.002,
        imitation=1.0,
    ),
    tasks=(
        _task(),
        _task(num_selected=6),
        _task(shapes=SHAPES, masked=0.4, random_starts=0.3),
        _task(num_selected=5, shapes=_ALL),
        _task(),
        _task(num_selected=6, masked=0.3, random_starts=0.2),
        _task(num_candidates=20, shapes=_ALL),
        _task(num_selected=8, shapes=_ALL),
        _task(shapes=_ALL),
        _task(num_selected=5),
        _task(num_selected=3, num_inputs=2),
        _task(num_selected=5, num_inputs=4),
    ),
)

# Table 2: an update every 16 episodes, 10 epochs, 200,000 episodes, and no more. The
# paper gives no learning rate, clip range or entropy bonus: Adam at 1e-4, 0.2 and 0.01
# without schedule are the usual ones for a network of this size.
_PAPER = TrainConfig(
    preset="paper",
    network=NetworkConfig(kind="paper", width=768),
    ppo=PPOConfig(
        num_episodes=200_000,
        episodes_per_update=16,
        episodes_per_set=1,
        num_epochs=10,
        num_minibatches=1,
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        entropy_start=0.01,
        entropy_end=0.01,
        normalise_per_decision=False,
        value_error_limit=1e9,
        advantage_limit=1e9,
        average_decay=0.99,
    ),
)


PRESETS = {config.preset: config for config in (_COMPACT, _GENERAL, _PAPER)}

_PARTS = {"ppo": PPOConfig, "network": NetworkConfig, "environment": SelectionConfig}


def fields(
    part: str, skip: set[str] | frozenset[str] = frozenset()
) -> Iterator[tuple[str, type]]:
    """Names and types of a part's fields: "ppo", "network" or "environment"."""
    kinds = typing.get_type_hints(_PARTS[part])
    for field in dataclasses.fields(_PARTS[part]):
        if field.name not in skip:
            yield field.name, kinds[field.name]


def field_names() -> set[str]:
    """Every field that ``with_values`` can change."""
    return {name for part in _PARTS for name, _ in fields(part)}


def with_values(config: TrainConfig, values: dict[str, Any]) -> TrainConfig:
    """A configuration with single fields changed, wherever they live.

    Args:
        config: where to start.
        values: field name to value; environment fields change the first task.

    Raises:
        ValueError: no part has such a field, or a part refuses the value.
    """
    left = dict(values)
    parts: dict[str, dict[str, Any]] = {}
    for part in _PARTS:
        names = {name for name, _ in fields(part)}
        parts[part] = {name: left.pop(name) for name in list(left) if name in names}
    if left:
        raise ValueError(f"no configuration has the field {sorted(left)[0]}")
    first = config.tasks[0]
    environment = dataclasses.replace(first.environment, **parts["environment"])
    first = dataclasses.replace(first, environment=environment)
    return dataclasses.replace(
        config,
        network=dataclasses.replace(config.network, **parts["network"]),
        ppo=dataclasses.replace(config.ppo, **parts["ppo"]),
        tasks=(first, *config.tasks[1:]),
    )
