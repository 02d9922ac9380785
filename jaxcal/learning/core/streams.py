"""Streams: sessions of any length played one after another, as experience for PPO.

An update plays B streams of T decisions, however long the sessions in them are. The
value after a decision is the expectation over its possible outcomes, not the value of
the outcome that was drawn: the advantages have the same expectation without the
randomness of outcomes, which is most of their variance.

The task is an argument of the environment's functions, as arrays: another task of the
same shapes compiles nothing.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.config import StreamsConfig
from jaxcal.learning.core.ppo import Batch, Metrics, advantages, normalised, surrogate

__all__ = ["Environment", "Step", "Streams"]


@struct.dataclass
class Step:
    """Result of a decision: Y states that may follow, one of which was drawn."""

    reward: jax.Array  # () expected of the decision
    states: Any  # leaves (Y, ...)
    ended: jax.Array  # (Y,) bool, whether the session ends in that state
    chance: jax.Array  # (Y,) probabilities; [1.0] if only the drawn state is known
    happened: jax.Array  # () int32, index of the state that was drawn


class Environment(Protocol):
    """Sessions, as pure functions of a task's arrays, for one session. Hashable."""

    def reset(self, task: Any, key: jax.Array) -> Any:
        """The state of a new session."""

    def observe(self, task: Any, state: Any, key: jax.Array) -> Any:
        """Inputs of the network: a tree of arrays, which includes the options."""

    def step(
        self, task: Any, state: Any, seen: Any, action: jax.Array, key: jax.Array
    ) -> Step:
        """Take the option with index ``action``, () int32, of those in ``seen``."""


@dataclasses.dataclass(frozen=True)
class Streams:
    """The learner of sessions of the task it is given."""

    config: StreamsConfig
    environment: Environment
    network: nn.Module  # of what is observed: masked logits (..., A), values (...)

    def init(self, key: jax.Array, task: Any) -> Any:
        """Parameters before training."""
        state = self.environment.reset(task, key)
        return self.network.init(key, self.environment.observe(task, state, key))

    def gather(self, params: Any, keys: jax.Array, task: Any) -> tuple[Batch, Metrics]:
        """Play a stream with each of the keys (B,)."""
        play = jax.vmap(self._play, in_axes=(None, 0, None))
        batch, reward, ended = play(params, keys, task)  # the last two (B, T + 1)
        metrics = {
            "reward_mean": reward.sum() / jnp.maximum(ended.sum(), 1.0),
            "choices": 1.0 / jnp.maximum(ended.mean(), 1e-6),
        }
        return normalised(self.config, batch), metrics

    def loss(
        self, params: Any, experience: Batch, done: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """PPO loss of some streams."""
        logits, value = cast(Any, self.network.apply(params, experience.seen))
        return surrogate(self.config, logits, value, experience, done)

    def _play(
        self, params: Any, key: jax.Array, task: Any
    ) -> tuple[Batch, jax.Array, jax.Array]:
        """A row of T decisions; (T + 1,) rewards; (T + 1,) 1.0 where a session ended.
        Decision T + 1 is played for the value that follows decision T."""
        environment = self.environment

        def score(state: Any, key: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
            seen = environment.observe(task, state, key)
            return seen, *cast(Any, self.network.apply(params, seen))

        def decide(state: Any, key: jax.Array) -> tuple[Any, dict[str, Any]]:
            key_seen, key_action, key_step, key_next = jax.random.split(key, 4)
            seen, logits, value = score(state, key_seen)
            action = jax.random.categorical(key_action, logits).astype(jnp.int32)
            step = environment.step(task, state, seen, action, key_step)
            happened, number = step.happened, len(step.chance)

            # The drawn state is valued at the next decision, only the others here.
            others = jnp.zeros(())
            if number > 1:
                elsewhere = (happened + jnp.arange(1, number)) % number
                states = jax.tree.map(lambda leaf: leaf[elsewhere], step.states)
                values = jax.vmap(score, (0, None))(states, key_seen)[2]
                values = jnp.where(step.ended[elsewhere], 0.0, values)
                others = step.chance[elsewhere] @ values
            ended = step.ended[happened]
            state = jax.tree.map(
                lambda fresh, after: jnp.where(ended, fresh, after[happened]),
                environment.reset(task, key_next),
                step.states,
            )
            return state, {
                "seen": seen,
                "action": action,
                "log_prob": jax.nn.log_softmax(logits)[action],
                "value": value,
                "reward": step.reward,
                "ended": ended.astype(value.dtype),
                "chance": step.chance[happened],
                "others": others,
            }

        key_reset, key_steps = jax.random.split(key)
        keys = jax.random.split(key_steps, self.config.stream_length + 1)
        every = jax.lax.scan(decide, environment.reset(task, key_reset), keys)[1]
        row = jax.tree.map(lambda leaf: leaf[:-1], every)
        goes_on = 1.0 - row["ended"]
        following = row["chance"] * goes_on * every["value"][1:] + row["others"]
        reward, value = row["reward"], row["value"]
        advantage = advantages(self.config, reward, value, following, goes_on)
        batch = Batch(
            seen=row["seen"],
            action=row["action"],
            log_prob=row["log_prob"],
            advantage=advantage,
            target=advantage + value,
        )
        return batch, every["reward"], every["ended"]
