"""Streams: sessions of any length played one after another, as experience for PPO.

An update plays T further decisions of B streams; the next goes on where they are cut.
The value after a decision is the expectation over its possible outcomes, not that of
the outcome drawn: the advantages have the same expectation without most of their
variance.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.config import StreamsConfig
from jaxcal.learning.core import ppo
from jaxcal.learning.core.ppo import Batch, Metrics


@struct.dataclass
class Step:
    """Result of a decision: Y states that may follow, one of which was drawn."""

    reward: jax.Array  # () expected of the decision
    states: Any  # leaves (Y, ...)
    ended: jax.Array  # (Y,) bool, whether the session ends in that state
    chance: jax.Array  # (Y,) probabilities; [1.0] if only the drawn state is known
    happened: jax.Array  # () int32, index of the state that was drawn

    @staticmethod
    def known(state: Any, reward: Any, ended: jax.Array) -> Step:
        """The step of an environment that knows the state that follows and no other."""
        return Step(
            reward=jnp.asarray(reward, float),
            states=jax.tree.map(lambda leaf: leaf[None], state),
            ended=ended[None],
            chance=jnp.ones(1),
            happened=jnp.int32(0),
        )


class Environment(Protocol):
    """Sessions, as pure functions of a task's arrays, for one session. Hashable."""

    def reset(self, task: Any, key: jax.Array) -> Any:
        """The state of a new session."""

    def observe(self, task: Any, state: Any, key: jax.Array) -> Any:
        """Inputs of the network: a tree of arrays, which includes the options."""

    def step(
        self, task: Any, state: Any, observation: Any, action: jax.Array, key: jax.Array
    ) -> Step:
        """Take the option with index ``action``, () int32, of those observed."""


@struct.dataclass
class Stream:
    """Where a stream goes on: in the middle of a session."""

    key: jax.Array  # (2,) uint32, data of the key of the next decision
    state: Any  # of the environment
    reward: jax.Array  # () received in this session so far
    choices: jax.Array  # () float, decisions made in it


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

    def begin(self, keys: jax.Array, task: Any) -> Stream:
        """Streams that begin with a new session, for each of the keys (B,)."""

        def one(key: jax.Array) -> Stream:
            key_reset, key = jax.random.split(key)
            state = self.environment.reset(task, key_reset)
            return Stream(jax.random.key_data(key), state, jnp.zeros(()), jnp.zeros(()))

        return jax.vmap(one)(keys)

    def rollout(
        self, params: Any, rollout_state: Stream, task: Any
    ) -> tuple[Batch, Stream, Metrics]:
        """Play ``stream_length`` further decisions of each stream; metrics are means
        over the sessions that ended in them, NaN where none did."""
        play = jax.vmap(self._play, in_axes=(None, 0, None))
        batch, value, rollout_state, ended = play(params, rollout_state, task)
        over, reward, choices = (x.sum() for x in ended)
        metrics = {
            "reward_mean": reward / over,
            "choices": choices / over,
            "explained_variance": ppo.explained_variance(batch.target, value),
        }
        return ppo.normalised(self.config, batch), rollout_state, metrics

    def loss(
        self, params: Any, experience: Batch, update_index: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """PPO loss of some streams."""
        logits, value = cast(Any, self.network.apply(params, experience.observations))
        return ppo.surrogate(self.config, logits, value, experience, update_index)

    def _play(
        self, params: Any, stream: Stream, task: Any
    ) -> tuple[Batch, jax.Array, Stream, tuple[jax.Array, ...]]:
        """A row of T decisions; (T,) values; the stream from there; and (T,) each: 1.0
        where a session ended, and the reward and the choices of the one that did."""
        environment = self.environment

        def score(state: Any, key: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
            observation = environment.observe(task, state, key)
            return observation, *cast(Any, self.network.apply(params, observation))

        def keys_of(stream: Stream) -> jax.Array:
            return jax.random.split(jax.random.wrap_key_data(stream.key), 5)

        def decide(stream: Stream, _: None) -> tuple[Stream, dict[str, Any]]:
            key_observe, key_action, key_step, key_reset, key = keys_of(stream)
            observation, logits, value = score(stream.state, key_observe)
            action = jax.random.categorical(key_action, logits).astype(jnp.int32)
            step = environment.step(task, stream.state, observation, action, key_step)
            happened, number = step.happened, len(step.chance)

            # The drawn state is valued at the next decision, only the others here.
            others = jnp.zeros(())
            if number > 1:
                elsewhere = (happened + jnp.arange(1, number)) % number
                states = jax.tree.map(lambda leaf: leaf[elsewhere], step.states)
                values = jax.vmap(score, (0, None))(states, key_observe)[2]
                values = jnp.where(step.ended[elsewhere], 0.0, values)
                others = step.chance[elsewhere] @ values
            ended = step.ended[happened]
            reward, choices = stream.reward + step.reward, stream.choices + 1.0
            over = ended.astype(value.dtype)
            after = Stream(
                key=jax.random.key_data(key),
                state=jax.tree.map(
                    lambda fresh, after: jnp.where(ended, fresh, after[happened]),
                    environment.reset(task, key_reset),
                    step.states,
                ),
                reward=(1.0 - over) * reward,
                choices=(1.0 - over) * choices,
            )
            return after, {
                "observation": observation,
                "action": action,
                "log_prob": jax.nn.log_softmax(logits)[action],
                "value": value,
                "reward": step.reward,
                "chance": step.chance[happened],
                "others": others,
                "ended": (over, over * reward, over * choices),
            }

        stream, row = jax.lax.scan(decide, stream, length=self.config.stream_length)
        # A stream is cut where it may: the value of where it goes on follows.
        last = score(stream.state, keys_of(stream)[0])[2]
        value, continues = row["value"], 1.0 - row["ended"][0]
        then = jnp.concatenate([value[1:], last[None]])
        next_value = row["chance"] * continues * then + row["others"]
        played = row["reward"], value, next_value, continues
        advantage = ppo.advantages(self.config, *played)
        batch = Batch(
            observations=row["observation"],
            action=row["action"],
            log_prob=row["log_prob"],
            advantage=advantage,
            target=advantage + value,
        )
        return batch, value, stream, row["ended"]
