"""The run that trains a policy, and the policy in its checkpoint."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.adaptive.episodes import play
from jaxcal.adaptive.policy.config import PolicyConfig
from jaxcal.adaptive.policy.network import Exercise, PolicyDecider, initial
from jaxcal.adaptive.tasks import registry
from jaxcal.learning.core.ppo import TrainState
from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.weights import Weights
from jaxcal.learning.training import checkpoint
from jaxcal.learning.training.checkpoint import CheckpointError
from jaxcal.learning.training.run import Recipe, run

SCHEMA = "jaxcal-sequential-policy"
MEASURED = ("nats", "nats_over_base")
_VALIDATED = 1024  # sessions of a validation
_FRESH = 2**31 - 1  # their seed


@dataclasses.dataclass(frozen=True)
class TaskPolicy:
    """A policy from a checkpoint."""

    params: Any
    config: PolicyConfig
    meta: dict[str, Any]

    @property
    def decider(self) -> PolicyDecider:
        """The policy, ready to choose."""
        return PolicyDecider(
            self.params, self.config.base, self.config.per_group, self.config.width
        )

    @property
    def weights(self) -> Weights:
        """The policy in plain arrays, for a file of weights."""
        return checkpoint.as_weights(self.params, self.meta)


def exercise(config: PolicyConfig) -> Exercise:
    """What ``make_train(config)`` is given; numbers are arrays, so that other constants
    do not compile again. The registry or the task may refuse its options."""
    task = registry.load(config.task).make(**config.options)
    return jax.tree.map(jnp.asarray, Exercise(task, config.base))


def train(config: PolicyConfig, folder: str | pathlib.Path, **rest: Any) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save.

    It is validated on fresh sessions: ``nats`` of the averaged weights, and
    ``nats_over_base`` in pairs. The registry or the task may refuse its options.

    Args:
        config: the run.
        folder: of the run; made where missing.
        rest: ``num_devices``, ``resume``, ``report``, ``should_stop`` and
            ``num_updates`` of ``training.run.run``, whose errors are raised too.
    """
    played = exercise(config)
    keys = jax.random.split(jax.random.key(_FRESH), _VALIDATED)
    task, base = played.task, played.base
    rules: list[float] = []  # nats of the base rule, once it is played

    def validate(average: Any) -> tuple[float, float]:
        policy = PolicyDecider(average, base, config.per_group, config.width)
        if not rules:
            rules.append(float(play(task, base, keys).gain.mean()))
        nats = float(play(task, policy, keys).gain.mean())
        return nats, nats - rules[0]

    recipe = Recipe(
        config=config,
        given=(played,),
        schema=SCHEMA,
        columns=("choices",),
        measured=MEASURED,
        validate=validate,
    )
    return run(recipe, folder, **rest)


def load(path: str | pathlib.Path | None = None) -> TaskPolicy:
    """The policy in a weights file or a run's folder, with several seeds the best by
    validation; that of KNEE which ships when None. A CheckpointError where there is
    none, it is damaged, or it is of another kind."""
    path = weights.shipped("knee") if path is None else path
    source, meta = checkpoint.read_meta(path, SCHEMA)
    try:
        config = PolicyConfig.from_meta(meta)
        like = jax.eval_shape(
            lambda: initial(jax.random.key(0), config.per_group, 1, config.width)
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {source} has an unknown policy: {error}"
        ) from error
    return TaskPolicy(checkpoint.read(source, meta, like), config, meta)
