"""Postures as a vector environment of Gymnasium; importing this registers it.

    import gymnasium
    import jaxcal.learning.gym

    envs = gymnasium.make_vec("jaxcal/Postures-v0", num_envs=256, num_candidates=50)

All environments are one JAX program. Observations, rewards and ends are numpy arrays;
``infos["action_mask"]`` says what may be chosen next. An episode that ends begins anew
in the same step; its last observation is in ``infos["final_obs"]``.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from jaxcal.learning.environments.functional import FunctionalEnv, PosturesEnv
from jaxcal.learning.environments.selection import SelectionConfig

__all__ = ["JaxVector", "postures"]

Array = NDArray[Any]


class JaxVector(VectorEnv):
    """A batch of any ``FunctionalEnv``."""

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: FunctionalEnv, num_envs: int = 1) -> None:
        self.num_envs, self._env = num_envs, env
        self.single_action_space = spaces.Discrete(env.num_actions)
        self.single_observation_space = spaces.Box(
            -np.inf, np.inf, (env.observation_size,), np.float32
        )
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._reset = jax.jit(jax.vmap(env.begin))
        self._look = jax.jit(jax.vmap(lambda s: (env.observe(s), env.available(s))))
        self._step = jax.jit(jax.vmap(self._one))
        self._key, self._state = jax.random.key(0), None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """New episodes; without a seed the random numbers go on."""
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, key = jax.random.split(self._key)
        self._state = self._reset(jax.random.split(key, self.num_envs))
        obs, mask = map(np.asarray, self._look(self._state))
        return obs, {"action_mask": mask}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One step of every environment.

        Args:
            actions: (num_envs,) whole numbers.

        Raises:
            ValueError: they are of another shape.
        """
        if np.shape(actions) != (self.num_envs,):
            raise ValueError(
                f"actions must be one for each environment, ({self.num_envs},), got "
                f"shape {np.shape(actions)}"
            )
        self._state, last, reward, done, metric = self._step(
            self._state, jnp.asarray(actions)
        )
        obs, mask = map(np.asarray, self._look(self._state))
        ended = np.asarray(done)
        infos = {"action_mask": mask, self._env.metric: np.asarray(metric)}
        if ended.any():
            infos |= {"final_obs": np.asarray(last), "_final_obs": ended}
        reward = np.asarray(reward, np.float64)
        return obs, reward, ended, np.zeros_like(ended), infos

    def _one(self, state: Any, action: jax.Array) -> tuple[Any, ...]:
        """The state that goes on, the last observation, reward, done, metric."""
        after, reward, done, metric = self._env.advance(state, action)
        fresh = self._env.begin(after.key)
        goes_on = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, after)
        return goes_on, self._env.observe(after), reward, done, metric


def postures(num_envs: int = 1, **sizes: Any) -> JaxVector:
    """The environment ``jaxcal/Postures-v0``.

    Args:
        num_envs: how many.
        sizes: fields of ``SelectionConfig``.

    Raises:
        ValueError: a name that is none of them, or a value that it refuses.
    """
    fields = [field.name for field in dataclasses.fields(SelectionConfig)]
    for name in sizes:
        if name not in fields:
            raise ValueError(f"options must be of {', '.join(fields)}, got {name}")
    return JaxVector(PosturesEnv(SelectionConfig(**sizes)), num_envs)


gymnasium.register("jaxcal/Postures-v0", vector_entry_point=postures)
