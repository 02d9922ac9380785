"""Postures under Gymnasium's interfaces; importing this registers them.

The environments of a batch are one JAX program. ``infos["action_mask"]`` says what may
be chosen next, of one environment ``action_masks()`` too, as sb3-contrib asks for it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from jaxcal.learning.environments.functional import FunctionalEnv, PosturesEnv, renewed
from jaxcal.learning.environments.selection import SelectionConfig

Array = NDArray[Any]


def _spaces(env: FunctionalEnv) -> tuple[spaces.Discrete, spaces.Box]:
    return spaces.Discrete(env.num_actions), spaces.Box(*env.observation_range)


def _begun(state: Any) -> Any:
    if state is None:
        raise gymnasium.error.ResetNeeded("call reset before the first step")
    return state


class JaxSingle(gymnasium.Env):
    """One of any ``FunctionalEnv``."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, env: FunctionalEnv) -> None:
        self.action_space, self.observation_space = _spaces(env)
        self._metric, self._state, self._mask = env.metric, None, None

        def seen(state: Any, *more: Any) -> tuple[Any, ...]:
            return state, env.observation(state), env.available(state), *more

        self._begin = jax.jit(lambda key: seen(env.begin(key)))
        self._advance = jax.jit(lambda state, action: seen(*env.advance(state, action)))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        self._state, observation, self._mask = self._begin(key)
        return np.array(observation), {"action_mask": self.action_masks()}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise ValueError(
                f"action must be a whole number in [0, {self.action_space.n}), got "
                f"{action!r}"
            )
        self._state, observation, self._mask, *rest = self._advance(
            _begun(self._state), int(action)
        )
        reward, done, metric = (leaf.item() for leaf in rest)
        info = {"action_mask": self.action_masks(), self._metric: metric}
        return np.array(observation), reward, done, False, info

    def action_masks(self) -> Array:
        return np.array(_begun(self._mask))


class JaxVector(VectorEnv):
    """A batch of any ``FunctionalEnv``. An episode that ends begins anew in the same
    step ("SameStep"; ``infos["final_obs"]`` and ``infos["final_info"]`` are of its end)
    or in the next one ("NextStep"), whose action counts for nothing."""

    def __init__(
        self,
        env: FunctionalEnv,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        mode = AutoresetMode(autoreset_mode)
        if mode is AutoresetMode.DISABLED:
            raise ValueError(
                "autoreset_mode must be SameStep or NextStep, got Disabled"
            )
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        self.num_envs, self._env = num_envs, env
        self._same_step = mode is AutoresetMode.SAME_STEP
        self.single_action_space, self.single_observation_space = _spaces(env)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._reset = jax.jit(jax.vmap(lambda key: self._shown(env.begin(key))))
        self._step = jax.jit(jax.vmap(self._one))
        self._key, self._state = jax.random.key(0), None
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """``seed`` of all environments, or one of each."""
        if isinstance(seed, Iterable):
            if len(seed) != self.num_envs:
                raise ValueError(
                    f"seed must be one number, or {self.num_envs}, one per "
                    f"environment, got {seed}"
                )
            pairs = [jax.random.split(jax.random.key(number)) for number in seed]
            self._key, keys = pairs[0][0], jnp.stack([pair[1] for pair in pairs])
        else:
            if seed is not None:
                self._key = jax.random.key(seed)
            self._key, key = jax.random.split(self._key)
            keys = jax.random.split(key, self.num_envs)
        self._state, (obs, mask) = self._reset(keys)
        self._ended = np.zeros(self.num_envs, bool)
        return np.asarray(obs), {"action_mask": np.asarray(mask)}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        if np.shape(actions) != (self.num_envs,):
            raise ValueError(
                f"actions must hold one per environment, ({self.num_envs},), got shape "
                f"{np.shape(actions)}"
            )
        choices = np.arange(self.single_action_space.n)
        for i in np.flatnonzero(~np.isin(actions, choices))[:1]:
            raise ValueError(
                f"actions must be whole numbers in [0, {len(choices)}), got "
                f"{actions[i]} in environment {i}"
            )
        self._state, *seen = self._step(
            _begun(self._state), self._ended, jnp.asarray(actions, jnp.int32)
        )
        (obs, mask), (last, last_mask), reward, done, metric = jax.tree.map(
            np.asarray, seen
        )
        self._ended = done
        infos = self._infos(mask, metric)
        if self._same_step and done.any():
            final = self._infos(last_mask, metric)
            infos |= {"final_obs": last, "final_info": final}
            infos |= {"_final_obs": done, "_final_info": done}
        return obs, reward.astype(np.float64), done, np.zeros_like(done), infos

    def _infos(self, mask: Array, metric: Array) -> dict[str, Any]:
        every = np.ones(self.num_envs, bool)
        infos = {"action_mask": mask, self._env.metric: metric}
        return infos | {f"_{name}": every for name in infos}

    def _shown(self, state: Any) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        return state, (self._env.observation(state), self._env.available(state))

    def _one(self, state: Any, ended: jax.Array, action: jax.Array) -> tuple[Any, ...]:
        """The state that goes on; observation and mask, those of the state stepped to;
        reward, done, metric."""
        after, reward, done, metric = self._env.advance(state, action)
        _, last = self._shown(after)
        if not self._same_step:  # where the episode was over, this begins one
            reward, metric = (jnp.where(ended, 0.0, x) for x in (reward, metric))
            done = done & ~ended
        begins = done if self._same_step else ended
        state = renewed(self._env.begin, begins, after.key, after)
        return *self._shown(state), last, reward, done, metric


def _postures(sizes: dict[str, Any], render_mode: str | None) -> PosturesEnv:
    if render_mode not in (None, "rgb_array"):  # which Stable-Baselines3 always asks
        raise ValueError(
            f"render_mode must be None, there is nothing to see, got {render_mode!r}"
        )
    fields = [field.name for field in dataclasses.fields(SelectionConfig)]
    for name in [name for name in sizes if name not in fields]:
        raise ValueError(f"options must be of {', '.join(fields)}, got {name}")
    return PosturesEnv(SelectionConfig(**sizes))


def posture(render_mode: str | None = None, **sizes: Any) -> JaxSingle:
    return JaxSingle(_postures(sizes, render_mode))


def postures(
    num_envs: int = 1,
    autoreset_mode: str | AutoresetMode = "SameStep",
    render_mode: str | None = None,
    **sizes: Any,
) -> JaxVector:
    """The environment ``jaxcal/Postures-v0`` of many, see ``JaxVector``; ``sizes`` are
    fields of ``SelectionConfig``."""
    return JaxVector(_postures(sizes, render_mode), num_envs, autoreset_mode)


gymnasium.register(
    "jaxcal/Postures-v0", entry_point=posture, vector_entry_point=postures
)
