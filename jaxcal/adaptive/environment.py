"""A task of sequential measurement for loops of one's own, as gymnax has them."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.policy.network import (
    NUM_FEATURES,
    Correction,
    Exercise,
    Sessions,
    Shortlist,
    State,
)
from jaxcal.adaptive.rules import SHARES, Rule
from jaxcal.learning.environments.functional import FunctionalEnv


@struct.dataclass
class _Episode(State):
    seen: Shortlist
    key: jax.Array  # of what comes next


class TaskEnv(FunctionalEnv):
    """Sessions of a task.

    Observation: (C (F + 2),) features, log score and validity of the shortlist. Action:
    () int32, a place in the shortlist; an invalid one counts as the first. Reward:
    expected information gain of the measurement, nats. End: time or uses are spent, or
    ``task.horizon`` measurements are made.

    Args:
        task: a ``GridTask`` or a ``ParticleTask``.
        base: the rule with a price that ranks the options and that the network
            corrects; the default's constants serve any task, ``tuning.tune(task,
            StateRule())`` makes those of one.
        per_group: options of each of the task's groups in the shortlist.
    """

    metric = "gain"

    def __init__(self, task: Any, base: Rule = SHARES, per_group: int = 6) -> None:
        if not isinstance(base, Rule):
            raise ValueError(
                "base must be a rule with a price, such as rules.Shares or StateRule, "
                f"got {type(base).__name__}"
            )
        self._given, self._sessions = Exercise(task, base), Sessions(per_group)

    def begin(self, key: jax.Array) -> _Episode:
        key_state, key = jax.random.split(key)
        return self._seen(self._sessions.reset(self._given, key_state), key)

    def steps(self, episode: _Episode) -> jax.Array:
        return episode.session.made

    @property
    def longest(self) -> int:
        return int(self._given.task.horizon)

    def is_terminated(self, episode: _Episode, params: Any = None) -> jax.Array:
        return jnp.asarray(self._given.task.over(episode.session))

    def observation(self, episode: _Episode) -> jax.Array:
        seen = episode.seen
        parts = seen.features, jnp.maximum(seen.log_score, -10.0), seen.valid
        return jnp.concatenate([part.astype(jnp.float32).ravel() for part in parts])

    def advance(
        self, episode: _Episode, action: jax.typing.ArrayLike
    ) -> tuple[Any, ...]:
        seen, action = episode.seen, jnp.asarray(action)
        key_step, key = jax.random.split(episode.key)
        action = jnp.where(seen.valid[action], action, 0)
        step = self._sessions.step(self._given, episode, seen, action, key_step)
        now, done = jax.tree.map(
            lambda leaf: leaf[step.happened], (step.states, step.ended)
        )
        return self._seen(now, key), step.reward, done, step.reward

    def network(self, width: int = 64) -> nn.Module:
        """A policy's network, which begins as the base rule."""
        return _TaskNetwork(self.num_actions, width)

    def _seen(self, state: State, key: jax.Array) -> _Episode:
        key_seen, key = jax.random.split(key)
        seen = self._sessions.observe(self._given, state, key_seen)
        return _Episode(state.truth, state.belief, state.session, seen, key)

    def available(self, episode: _Episode) -> jax.Array:
        return episode.seen.valid


class _TaskNetwork(nn.Module):
    """The network of a policy, whose input is what ``SequentialEnv`` observes."""

    options: int
    width: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> Any:
        c, end = self.options, self.options * NUM_FEATURES
        features = observation[..., :end].reshape(*observation.shape[:-1], c, -1)
        log_score, valid = jnp.split(observation[..., end:], 2, axis=-1)
        seen = Shortlist(None, None, features, log_score, valid > 0.5)
        return Correction(self.width)(seen)
