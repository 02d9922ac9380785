"""A task of sequential measurement as a ``brax.envs.base.Env``; this loads brax.

``learning.environments.brax_env.wrap_fresh`` makes the batch and draws a new session
for every episode.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.policy.features import Seen, see
from jaxcal.adaptive.rules import Scored
from jaxcal.learning.environments.brax_env import EpisodeEnv

__all__ = ["SequentialEnv"]


@struct.dataclass
class _Episode:
    """One session."""

    truth: Any
    belief: Any
    session: Any
    options: Any
    seen: Seen
    key: jax.Array  # of what comes next


class SequentialEnv(EpisodeEnv):
    """Sessions of a task.

    Observation: (C (F + 2),) features, log score and validity of the shortlist. Action:
    () int32, a place in the shortlist; an invalid one counts as the first. Reward: nats
    that the measurement is expected to tell. End: time or uses are spent, or
    ``task.horizon`` measurements are made.
    """

    metric = "gain"

    def __init__(self, task: Any, base: Scored, per_group: int = 8) -> None:
        self.task, self._base, self._per_group = task, base, per_group

    def begin(self, key: jax.Array) -> _Episode:
        key_truth, key_begin, key = jax.random.split(key, 3)
        belief, session = self.task.begin(key_begin)
        return self._seen(self.task.draw(key_truth), belief, session, key)

    def observe(self, episode: _Episode) -> jax.Array:
        seen = episode.seen
        parts = seen.features, jnp.maximum(seen.log_score, -10.0), seen.valid
        return jnp.concatenate([part.astype(jnp.float32).ravel() for part in parts])

    def advance(self, episode: _Episode, action: jax.Array) -> tuple[Any, ...]:
        now, task = episode, self.task
        key_gain, key_outcome, key_update, key = jax.random.split(now.key, 4)
        index = now.seen.index[jnp.where(now.seen.valid[action], action, 0)]
        design = jax.tree.map(lambda leaf: leaf[index], now.options.designs)
        # By draws of its own: those of ``seen`` chose it, so theirs is too large.
        gain = now.belief.gain(task, design, key_gain)
        outcome = task.measure(now.truth, design, key_outcome)
        belief = now.belief.update(task, design, outcome, key_update)
        session = task.spend(now.session, design, outcome)
        done = session.over | (session.made >= task.horizon)
        return self._seen(now.truth, belief, session, key), gain, done, gain

    def _seen(self, truth: Any, belief: Any, session: Any, key: jax.Array) -> _Episode:
        key_options, key_seen, key = jax.random.split(key, 3)
        options = self.task.options(belief, session, key_options)
        seen = see(
            self.task, belief, session, options, key_seen, self._base, self._per_group
        )
        return _Episode(truth, belief, session, options, seen, key)

    @property
    def action_size(self) -> int:
        key = jax.random.PRNGKey(0)  # brax's own kind
        return len(jax.eval_shape(self.begin, key).seen.index)
