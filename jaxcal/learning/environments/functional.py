"""Episodes for loops of one's own: ``reset`` and ``step`` as gymnax has them.

    env = PosturesEnv()
    obs, state = jax.vmap(env.reset)(keys)
    obs, state, reward, done, info = jax.vmap(env.step)(keys, state, actions)

A step that ends an episode returns the first observation of a fresh one;
``info["action_mask"]`` says what may be chosen next. brax and Gymnasium see the same
episodes through ``learning.brax`` and ``learning.gym``.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxcal.learning.environments import selection
from jaxcal.learning.environments.selection import CandidateSource, SelectionConfig
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import NetworkConfig

__all__ = ["FunctionalEnv", "PosturesEnv"]


class FunctionalEnv(abc.ABC):
    """One episode as pure functions; ``jax.vmap`` makes a batch.

    A state is a dataclass of arrays with a field ``key``, of what comes next in it.
    """

    metric: ClassVar[str]  # name of the number that ``advance`` returns last

    @abc.abstractmethod
    def begin(self, key: jax.Array) -> Any:
        """The state of a new episode."""

    @abc.abstractmethod
    def observe(self, state: Any) -> jax.Array:
        """(observation_size,) float32 input of a policy."""

    @abc.abstractmethod
    def available(self, state: Any) -> jax.Array:
        """(num_actions,) bool, what may be chosen."""

    @abc.abstractmethod
    def advance(self, state: Any, action: jax.Array) -> tuple[Any, ...]:
        """The state after the step, () reward, () bool done, () metric."""

    @abc.abstractmethod
    def network(self) -> nn.Module:
        """(..., observation_size) -> masked logits (..., num_actions), value (...)."""

    @property
    def num_actions(self) -> int:
        """Actions are () int32 in [0, num_actions)."""
        return int(self._shape(self.available).shape[0])

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return int(self._shape(self.observe).shape[0])

    def _shape(self, function: Any) -> Any:
        key = jax.random.key(0)
        return jax.eval_shape(lambda key: function(self.begin(key)), key)

    def reset(self, key: jax.Array) -> tuple[jax.Array, Any]:
        """Observation and state of a new episode."""
        state = self.begin(key)
        return self.observe(state), state

    def step(
        self, key: jax.Array, state: Any, action: jax.Array
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Observation, state, () reward, () bool done and info; a new episode after
        the last step of one.

        ``info``: ``action_mask`` (num_actions,) of the state that is returned, and the
        environment's ``metric`` ().
        """
        key_step, key_reset = jax.random.split(key)
        begun = dataclasses.replace(state, key=key_step)
        after, reward, done, metric = self.advance(begun, action)
        state = jax.tree.map(
            lambda new, old: jnp.where(done, new, old), self.begin(key_reset), after
        )
        info = {"action_mask": self.available(state), self.metric: metric}
        return self.observe(state), state, reward, done, info


class PosturesEnv(FunctionalEnv):
    """Choose K of M postures.

    Observation: (n M + M + 2 n + 4,) of ``selection.observe``, the paper's 210. Reward
    and end: as ``selection.step``. Metric ``log_det``: the unscaled reward.

    Args:
        config: sizes and reward; 4 of 50 when None.
        draw: where candidates come from; uniform in [0, 1] when None.
        net: kind and width of ``network``, one that is read from the observation.
    """

    metric = "log_det"

    def __init__(
        self,
        config: SelectionConfig | None = None,
        draw: CandidateSource | None = None,
        net: NetworkConfig | None = None,
    ) -> None:
        self.config = SelectionConfig() if config is None else config
        self._draw = draw
        self._net = NetworkConfig("paper", 64) if net is None else net

    def begin(self, key: jax.Array) -> Any:
        return selection.reset(key, self.config, self._draw)

    def observe(self, state: Any) -> jax.Array:
        return selection.observe(state, self.config)

    def available(self, state: Any) -> jax.Array:
        mask: jax.Array = state.available
        return mask

    def advance(self, state: Any, action: jax.Array) -> tuple[Any, ...]:
        after, reward, done = selection.step(state, action, self.config)
        return after, reward, done, reward / self.config.reward_scale

    def network(self) -> nn.Module:
        return _PosturesNetwork(self.config, self._net)


class _PosturesNetwork(nn.Module):
    """A network of postures whose input is the paper's observation."""

    env: SelectionConfig
    config: NetworkConfig

    def setup(self) -> None:
        self.network = build(self.config)

    def __call__(self, observation: jax.Array) -> Any:
        network: Any = self.network
        m, n = self.env.num_candidates, self.env.num_inputs
        return network.from_observation(observation, m, n)
