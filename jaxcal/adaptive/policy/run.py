"""The run that trains a policy, and the checkpoint that it leaves."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.adaptive.episodes import play
from jaxcal.adaptive.policy.config import PolicyConfig
from jaxcal.adaptive.policy.network import Policy, initial
from jaxcal.adaptive.policy.training import updater
from jaxcal.adaptive.tasks import registry
from jaxcal.learning.runtime import weights
from jaxcal.learning.training import checkpoint, loop, optimiser
from jaxcal.learning.training.checkpoint import CheckpointError
from jaxcal.learning.training.optimiser import Keys, TrainState

__all__ = ["Trained", "load", "train"]

SCHEMA = "jaxcal-sequential-policy"
COLUMNS = (
    *("update", "episodes", "seconds", "reward_mean", "choices", "nats"),
    *("nats_over_base", "entropy", "policy_loss", "value_loss", "kl", "learning_rate"),
)
_VALIDATED = 1024  # sessions
_FRESH = 2**31 - 1  # their seed


@dataclasses.dataclass(frozen=True)
class Trained:
    """A policy as it lies in a checkpoint."""

    params: Any
    config: PolicyConfig
    meta: dict[str, Any]
    step: int

    @property
    def decider(self) -> Policy:
        """The policy, ready to choose."""
        return Policy(
            self.params, self.config.base, self.config.per_group, self.config.width
        )


def train(
    config: PolicyConfig,
    folder: str | pathlib.Path,
    *,
    resume: bool = False,
    report: Callable[[loop.Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
    num_updates: int | None = None,
) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save.

    Args:
        config: the run.
        folder: of the run; made where missing.
        resume: go on from the newest checkpoint in ``folder``.
        report: called after every validation: fresh sessions of the first task, whose
            columns ``nats`` and ``nats_over_base`` (in pairs) are of averaged weights.
        should_stop: asked between updates.
        num_updates: stop after this update instead of at the end of the budget.

    Raises:
        CheckpointError: nothing to resume from, or damaged.
        ValueError: the registry or the task refuses its options.
        OSError: the folder cannot be written.
    """
    entry = registry.load(config.task)
    tasks = [_arrays(entry.make(**options)) for options in config.options]
    base = _arrays(config.base)

    update = updater(config.ppo, config.per_group, config.width)

    keys = jax.random.split(jax.random.key(_FRESH), _VALIDATED)
    rules: list[float] = []  # nats of the base rule, once it is played

    def validate(average: Any) -> dict[str, float]:
        policy = Policy(average, base, config.per_group, config.width)
        if not rules:
            rules.append(float(play(tasks[0], base, keys).gain.mean()))
        nats = float(play(tasks[0], policy, keys).gain.mean())
        return {"nats": nats, "nats_over_base": nats - rules[0]}

    recipe = loop.Recipe(
        ppo=config.ppo,
        meta=config.as_meta(),
        init=lambda: _init(config),
        update=lambda done, state: update(state, tasks[done % len(tasks)], base),
        validate=validate,
        validate_every=config.validate_every,
        save_every=config.save_every,
        columns=COLUMNS,
        schema=SCHEMA,
    )
    return loop.run(
        recipe,
        folder,
        resume=resume,
        report=report,
        should_stop=should_stop,
        num_updates=num_updates,
    )


def _arrays(tree: Any) -> Any:
    """Numbers as arrays, so that other constants do not compile again."""
    return jax.tree.map(jnp.asarray, tree)


def _init(config: PolicyConfig) -> TrainState:
    keys = Keys.of(config.ppo.seed)
    params = initial(keys.weights, config.per_group, 1, config.width)
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser.optimiser(config.ppo).init(params),
        key=jax.random.key_data(keys.updates),
        num_updates=jnp.zeros((), jnp.int32),
    )


def load(folder: str | pathlib.Path | None = None) -> Trained:
    """The newest policy in a folder.

    Args:
        folder: a checkpoint folder or a training run's; the one of KNEE that ships
            when None.

    Raises:
        CheckpointError: there is none, it is damaged, or it is of another kind.
    """
    folder = weights.shipped("knee") if folder is None else folder
    path, meta = checkpoint.latest(folder, SCHEMA)
    try:
        config = PolicyConfig.from_meta(meta)
        like = jax.eval_shape(
            lambda: initial(jax.random.key(0), config.per_group, 1, config.width)
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} names no policy this jaxcal knows: {error}"
        ) from error
    params = checkpoint.read_policy(path, like)
    return Trained(params, config, meta, int(path.name))
