"""Posture selection as an environment in JAX, and the training of policies for it.

``reset``, ``step`` and ``observe`` are pure functions of one episode, ``PosturesEnv``
has them as gymnax users write them, ``make_train`` gives a whole training. Names load
on first use, since inference without JAX imports this package too.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxcal.learning.brax import SelectionEnv, brax_networks, repaired, wrap_fresh
    from jaxcal.learning.config import EpisodesConfig, NetworkConfig, StreamsConfig
    from jaxcal.learning.core.network import Network, mask_logits
    from jaxcal.learning.core.postures import Episode, Postures
    from jaxcal.learning.core.ppo import Learner
    from jaxcal.learning.core.streams import Environment, Step, Streams
    from jaxcal.learning.environments.functional import FunctionalEnv, PosturesEnv
    from jaxcal.learning.environments.selection import (
        SelectionConfig,
        SelectionState,
        observe,
        reset,
        start,
        step,
    )
    from jaxcal.learning.environments.task import Task
    from jaxcal.learning.training.presets import TrainConfig, preset

__all__ = [
    "Environment",
    "Episode",
    "EpisodesConfig",
    "FunctionalEnv",
    "Learner",
    "Network",
    "NetworkConfig",
    "Postures",
    "PosturesEnv",
    "SelectionConfig",
    "SelectionEnv",
    "SelectionState",
    "Step",
    "Streams",
    "StreamsConfig",
    "Task",
    "TrainConfig",
    "brax_networks",
    "make_train",
    "mask_logits",
    "observe",
    "preset",
    "repaired",
    "reset",
    "start",
    "step",
    "wrap_fresh",
]

_HOME = {
    "brax": ("SelectionEnv", "brax_networks", "repaired", "wrap_fresh"),
    "config": ("EpisodesConfig", "NetworkConfig", "StreamsConfig"),
    "core.network": ("Network", "mask_logits"),
    "core.postures": ("Episode", "Postures"),
    "core.ppo": ("Learner",),
    "core.streams": ("Environment", "Step", "Streams"),
    "environments.functional": ("FunctionalEnv", "PosturesEnv"),
    "environments.selection": (
        *("SelectionConfig", "SelectionState", "observe", "reset", "start", "step"),
    ),
    "environments.task": ("Task",),
    "training.presets": ("TrainConfig", "preset"),
}


def __getattr__(name: str) -> Any:
    for module, names in _HOME.items():
        if name in names:
            return getattr(importlib.import_module(f"jaxcal.learning.{module}"), name)
    raise AttributeError(f"module 'jaxcal.learning' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def make_train(config: Any) -> Any:
    """A whole training as one pure function, to be jitted, scanned or vmapped.

    Args:
        config: the name of a preset, a ``TrainConfig``, or any object with ``ppo`` and
            ``learners``, of which update u trains number u modulo theirs; or one
            learner, such as ``Postures(ppo, task, network)``. None that imitates a
            teacher.

    Returns:
        ``train(key, *given, **values)`` -> the last state, whose ``average`` are the
        weights of the policy, and metrics with a leading axis of
        ``config.ppo.num_updates``. ``given``: none for postures, the arrays of a task
        for streams. ``values``: arrays in place of the configuration's learning rate,
        entropy bonus, clipping and others (``learning.config.TRACED``).
    """
    from jaxcal.learning.core import ppo
    from jaxcal.learning.training import presets

    return ppo.make_train(presets.load(config) if isinstance(config, str) else config)
