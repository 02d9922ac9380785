"""The selection environment as a ``brax.envs.base.Env``; importing this loads brax.

| | |
|---|---|
| observation | (n M + M + 2 n + 4,): ``environment.observe``, the paper's 210 |
| action | () int32, an available candidate |
| reward, end | as ``jaxcal.learning.environments.selection`` |

``done`` is 1 on the last choice: an episode ends, it is never cut off, so brax's
``truncation`` stays 0. brax's own ``AutoResetWrapper`` replays the first candidate set
for ever; ``wrap_fresh`` draws a new one for every episode.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.selection import Candidates, SelectionConfig

__all__ = ["SelectionEnv", "wrap_fresh"]


class SelectionEnv(Env):
    """One episode; brax's wrappers make the batch."""

    def __init__(
        self, config: SelectionConfig | None = None, draw: Candidates | None = None
    ) -> None:
        self.config = SelectionConfig() if config is None else config
        self._draw = draw

    def reset(self, rng: jax.Array) -> State:
        """A new episode; ``rng`` is a legacy uint32 key, which brax's wrappers need."""
        state = environment.reset(rng, self.config, self._draw)
        return State(
            pipeline_state=state,
            obs=environment.observe(state, self.config),
            reward=jnp.zeros(()),
            done=jnp.zeros(()),
            metrics={"log_det": jnp.zeros(())},
            info={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Choose one posture; the metric ``log_det`` is paid with the reward."""
        after, reward, done = environment.step(
            state.pipeline_state, action, self.config
        )
        paid = {"log_det": reward / self.config.reward_scale}
        return state.replace(
            pipeline_state=after,
            obs=environment.observe(after, self.config),
            reward=reward,
            done=done.astype(jnp.float32),
            metrics=state.metrics | paid,
        )

    @property
    def observation_size(self) -> int:
        return self.config.observation_size

    @property
    def action_size(self) -> int:
        return self.config.num_candidates

    @property
    def backend(self) -> str:
        return "jaxcal"


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

        # All environments of a batch end together, so three steps of four skip this.
        return jax.lax.cond(jnp.any(state.done > 0), renewed, lambda s: s, state)


def wrap_fresh(
    env: Env,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Any = None,
) -> Wrapper:
    """What to pass to brax's trainers as ``wrap_env_fn``.

    Args:
        env: one episode.
        episode_length, action_repeat: as brax passes them.
        randomization_fn: must be None; there is no physical system to randomise.
    """
    if randomization_fn is not None:
        raise ValueError("randomization_fn must be None: there is no system to vary")
    return _FreshReset(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))
