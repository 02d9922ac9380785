"""Episodes as ``brax.envs.base.Env``; importing this loads brax.

``done`` is 1 on the last step: an episode ends, it is never cut off, so brax's
``truncation`` stays 0. brax's own ``AutoResetWrapper`` replays the first episode;
``wrap_fresh`` draws a new one every time.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

from jaxcal.learning.environments.functional import FunctionalEnv, PosturesEnv
from jaxcal.learning.environments.selection import CandidateSource, SelectionConfig
from jaxcal.learning.policies.networks import NetworkConfig

__all__ = ["EpisodeEnv", "SelectionEnv", "wrap_fresh"]


class EpisodeEnv(Env):
    """Episodes of ``env`` as a brax environment; brax's wrappers make the batch."""

    backend = "jaxcal"

    def __init__(self, env: FunctionalEnv) -> None:
        self.functional = env

    def reset(self, rng: jax.Array) -> State:
        """A new episode; ``rng`` is a legacy uint32 key, which brax's wrappers need."""
        episode, zero = self.functional.begin(rng), jnp.zeros(())
        return State(
            pipeline_state=episode,
            obs=self.functional.observation(episode),
            reward=zero,
            done=zero,
            metrics={self.functional.metric: zero},
            info={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Take one step."""
        env = self.functional
        after, reward, done, metric = env.advance(state.pipeline_state, action)
        return state.replace(
            pipeline_state=after,
            obs=env.observation(after),
            reward=reward,
            done=done.astype(jnp.float32),
            metrics=state.metrics | {env.metric: metric},
        )

    @property
    def observation_size(self) -> int:
        return self.functional.observation_size

    @property
    def action_size(self) -> int:
        return self.functional.num_actions


class SelectionEnv(EpisodeEnv):
    """Postures; arguments as of ``PosturesEnv``."""

    def __init__(
        self,
        config: SelectionConfig | None = None,
        draw: CandidateSource | None = None,
        net: NetworkConfig | None = None,
    ) -> None:
        super().__init__(PosturesEnv(config, draw, net))


class _FreshReset(Wrapper):
    """After ``done``, a new episode from the key that the old one carried."""

    def step(self, state: State, action: jax.Array) -> State:
        steps = jnp.where(state.done > 0, 0.0, state.info["steps"])
        state.info.update(steps=steps)
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)

        def renewed(state: State) -> State:
            fresh = self.env.reset(state.pipeline_state.key)

            def where_done(new: jax.Array, old: jax.Array) -> jax.Array:
                shape = (*state.done.shape, *(1,) * (old.ndim - state.done.ndim))
                return jnp.where(state.done.reshape(shape) > 0, new, old)

            new, old = ((s.pipeline_state, s.obs) for s in (fresh, state))
            episode, obs = jax.tree.map(where_done, new, old)
            return state.replace(pipeline_state=episode, obs=obs)

        # Episodes of one length end together, so all steps but their last skip this.
        return jax.lax.cond(jnp.any(state.done > 0), renewed, lambda s: s, state)


def wrap_fresh(
    env: Env,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Any = None,
) -> Wrapper:
    """The ``wrap_env_fn`` for brax's trainers: a new episode after every ``done``.

    Args:
        env: one episode.
        episode_length, action_repeat: as brax passes them.
        randomization_fn: must be None; there is no physical system to randomise.
    """
    if randomization_fn is not None:
        raise ValueError("randomization_fn must be None: there is no system to vary")
    return _FreshReset(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))
