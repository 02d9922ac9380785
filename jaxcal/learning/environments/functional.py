"""Episodes for loops of one's own: the interface of gymnax 1.x.

A step that ends an episode returns the first observation of a fresh one. brax and
Gymnasium see the same episodes through ``learning.brax`` and ``learning.gym``.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import build
from jaxcal.learning.environments import selection
from jaxcal.learning.environments.selection import CandidateSource, SelectionConfig

_LARGEST = float(np.finfo(np.float32).max)


@struct.dataclass
class EnvParams:
    """What may be varied without compiling again."""

    max_steps_in_episode: int | jax.Array  # an episode of so many steps is cut off


def renewed(begin: Callable[[jax.Array], Any], done: Any, key: Any, after: Any) -> Any:
    """``begin(key)`` where ``done``, else ``after``: trees of arrays. Under ``vmap``
    nothing begins while none of the batch is done."""

    @jax.custom_batching.custom_vmap
    def chosen(done: Any, key: Any, after: Any) -> Any:
        begin_each = begin
        for _ in done.shape:
            begin_each = jax.vmap(begin_each)

        def where_done(new: jax.Array, old: jax.Array) -> jax.Array:
            axes = range(done.ndim, old.ndim)
            return jnp.where(jnp.expand_dims(done, tuple(axes)), new, old)

        return jax.lax.cond(
            done.any(),
            lambda: jax.tree.map(where_done, begin_each(key), after),
            lambda: after,
        )

    @chosen.def_vmap
    def of_batch(size: int, batched: Any, done: Any, key: Any, after: Any) -> Any:
        def whole(is_batched: Any, leaf: Any) -> Any:
            return leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))

        # Itself, so that it holds under another ``vmap`` too.
        out = chosen(*jax.tree.map(whole, batched, [done, key, after]))
        return out, jax.tree.map(lambda _: True, out)

    return chosen(done, key, after)


class FunctionalEnv(abc.ABC):
    """One episode as pure functions; ``jax.vmap`` makes a batch.

    A state is a dataclass of arrays with a field ``key``, of what comes next in it.
    The methods below ``step`` are those of ``gymnax.environments.Environment``.
    """

    metric: ClassVar[str]  # name of the number that ``advance`` returns last

    @abc.abstractmethod
    def begin(self, key: jax.Array) -> Any:
        """The state of a new episode."""

    @abc.abstractmethod
    def observation(self, state: Any) -> jax.Array:
        """(observation_size,) float32 input of a policy."""

    @abc.abstractmethod
    def available(self, state: Any) -> jax.Array:
        """(num_actions,) bool, what may be chosen."""

    @abc.abstractmethod
    def advance(self, state: Any, action: jax.typing.ArrayLike) -> tuple[Any, ...]:
        """The state after the step, () reward, () bool done, () metric."""

    @abc.abstractmethod
    def steps(self, state: Any) -> jax.Array:
        """() int32, steps made of this episode."""

    @property
    @abc.abstractmethod
    def longest(self) -> int:
        """Steps after which every episode has ended."""

    @abc.abstractmethod
    def network(self) -> nn.Module:
        """(..., observation_size) -> masked logits (..., num_actions), value (...)."""

    @property
    def observation_range(self) -> tuple[Any, Any]:
        """Least and largest number at each place of an observation, finite."""
        whole = np.full(self.observation_size, _LARGEST, np.float32)
        return -whole, whole

    @property
    def num_actions(self) -> int:
        """Actions are () int32 in [0, num_actions)."""
        return int(self._shape(self.available).shape[0])

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return int(self._shape(self.observation).shape[0])

    def _shape(self, function: Any) -> Any:
        key = jax.random.key(0)
        return jax.eval_shape(lambda key: function(self.begin(key)), key)

    def reset_env(self, key: jax.Array, params: Any = None) -> tuple[jax.Array, Any]:
        """Observation and state of a new episode."""
        state = self.begin(key)
        return self.observation(state), state

    @functools.partial(jax.jit, static_argnames="self")
    def reset(self, key: jax.Array, params: Any = None) -> tuple[jax.Array, Any]:
        """Observation and state of a new episode."""
        return self.reset_env(key, params)

    @functools.partial(jax.jit, static_argnames="self")
    def step(
        self,
        key: jax.Array,
        state: Any,
        action: jax.typing.ArrayLike,
        params: EnvParams | None = None,
    ) -> tuple[Any, ...]:
        """One step, and a new episode after the last of one: observation, state, ()
        reward, () bool terminated, () bool truncated, and info: ``action_mask``
        (num_actions,) of the state that is returned, the environment's ``metric`` (),
        ``terminated``, ``truncated``, ``discount`` (0 at a natural end, else 1) and
        ``final_observation``, of the episode that the step was made in."""
        key_step, key_reset = jax.random.split(key)
        stepped = self.step_env(key_step, state, action, params)
        last, after, reward, terminated, info = stepped
        truncated = self.is_truncated(after, params)
        over = terminated | truncated
        obs, state = renewed(self.reset_env, over, key_reset, (last, after))
        info |= {"action_mask": self.available(state), "final_observation": last}
        info |= {"terminated": terminated, "truncated": truncated}
        info["discount"] = 1.0 - terminated.astype(jnp.float32)
        return obs, state, reward, terminated, truncated, info

    # -- as gymnax names them ----------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the environment."""
        return type(self).__name__

    @property
    def default_params(self) -> EnvParams:
        """Parameters that cut nothing off."""
        return EnvParams(self.longest)

    def step_env(
        self,
        key: jax.Array,
        state: Any,
        action: jax.typing.ArrayLike,
        params: EnvParams | None = None,
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Observation, state, reward, terminated and info: no new episode."""
        begun = dataclasses.replace(state, key=key)
        after, reward, terminated, metric = self.advance(begun, action)
        return self.observation(after), after, reward, terminated, {self.metric: metric}

    def observe(
        self, key: Any, state: Any, action: Any = None, params: Any = None
    ) -> jax.Array:
        """``observation`` of a state."""
        return self.observation(state)

    def get_obs(self, state: Any, params: Any = None, key: Any = None) -> jax.Array:
        """``observation`` of a state."""
        return self.observation(state)

    def is_terminated(self, state: Any, params: Any = None) -> jax.Array:
        """() bool, whether the episode has ended by itself."""
        return self.steps(state) >= self.longest

    def is_terminal(self, state: Any, params: Any = None) -> jax.Array:
        """``is_terminated`` of a state."""
        return self.is_terminated(state, params)

    def discount(self, state: Any, params: Any = None) -> jax.Array:
        """() float32, 0 where the episode has ended by itself, else 1."""
        return 1.0 - self.is_terminated(state).astype(jnp.float32)

    def is_truncated(self, state: Any, params: EnvParams | None = None) -> jax.Array:
        """() bool, whether ``params`` cut the episode off."""
        most = self.longest if params is None else params.max_steps_in_episode
        return (self.steps(state) >= most) & (most < self.longest)

    def action_space(self, params: EnvParams | None = None) -> Any:
        """``Discrete``; as all spaces, of gymnax, which must be installed."""
        return _spaces().Discrete(self.num_actions)

    def observation_space(self, params: EnvParams | None = None) -> Any:
        """``Box`` of the finite ``observation_range``."""
        low, high = map(jnp.asarray, self.observation_range)
        return _spaces().Box(low, high, low.shape, jnp.float32)

    def state_space(self, params: EnvParams | None = None) -> Any:
        """``Dict`` of a state's arrays, its key left out."""
        return _space_of(self._shape(lambda state: state))


def _spaces() -> Any:
    try:
        from gymnax.environments import spaces
    except ImportError:
        raise ImportError(
            "gymnax is not installed, and spaces come from it: pip install gymnax"
        ) from None
    return spaces


def _space_of(shape: Any) -> Any:
    if dataclasses.is_dataclass(shape):
        parts = {f.name: getattr(shape, f.name) for f in dataclasses.fields(shape)}
        parts.pop("key", None)
        return _spaces().Dict({name: _space_of(part) for name, part in parts.items()})
    return _spaces().Box(-_LARGEST, _LARGEST, shape.shape, shape.dtype)


class PosturesEnv(FunctionalEnv):
    """Choose K of M postures, observed by ``selection.observe``: the paper's 210.

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

    def observation(self, state: Any) -> jax.Array:
        return selection.observe(state, self.config)

    def available(self, state: Any) -> jax.Array:
        return state.available

    def steps(self, state: Any) -> jax.Array:
        return state.count

    @property
    def longest(self) -> int:
        return self.config.num_selected

    @property
    def observation_range(self) -> tuple[Any, Any]:
        if self._draw is not None:
            return super().observation_range
        # Of candidates in [0, 1]; ``context_features`` has a ridge of 0.01.
        n, k = self.config.num_inputs, self.config.num_selected
        low = np.zeros(self.observation_size, np.float32)
        high = np.ones_like(low)
        least, largest = math.log(0.01), math.log(k + 0.01)
        low[-3:] = least / 1.25, 0.0, (least - largest) / 4.0
        high[-3:] = largest / 1.25, 1.0 + 0.01 / k, 0.0
        slack = 1e-3 * (np.arange(len(low)) >= (n + 1) * self.config.num_candidates)
        return low - np.float32(slack), high + np.float32(slack)

    def advance(self, state: Any, action: jax.typing.ArrayLike) -> tuple[Any, ...]:
        after, reward, done = selection.step(state, action, self.config)
        return after, reward, done, reward / self.config.reward_scale

    def network(self) -> nn.Module:
        return _PosturesNetwork(self.config, self._net)


class _PosturesNetwork(nn.Module):
    env: SelectionConfig
    config: NetworkConfig

    def setup(self) -> None:
        self.network = build(self.config)

    def __call__(self, observation: jax.Array) -> Any:
        network: Any = self.network
        m, n = self.env.num_candidates, self.env.num_inputs
        return network.from_observation(observation, m, n)
