"""A task of sequential measurement as a ``brax.envs.base.Env``; this loads brax.

| | |
|---|---|
| observation | (C (F + 2),): features, log score and validity of the shortlist |
| action | () int32, a place in the shortlist; an invalid one counts as the first |
| reward | nats: the expected information gain of the measurement |
| end | time or uses are spent, or ``task.most`` measurements are made |

``learning.environments.brax_env.wrap_fresh`` makes the batch and draws a new session
for every episode. brax's own ``AutoResetWrapper`` replays the first one.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from flax import struct

from jaxcal.adaptive.policy.features import NUM_FEATURES, Seen, see
from jaxcal.adaptive.rules import Scored

__all__ = ["SequentialEnv"]


@struct.dataclass
class _Inside:
    """One session."""

    truth: Any
    belief: Any
    session: Any
    options: Any
    seen: Seen
    key: jax.Array  # of what comes next


class SequentialEnv(Env):
    """One session; brax's wrappers make the batch."""

    def __init__(self, task: Any, base: Scored, per_group: int = 8) -> None:
        self.task, self._base, self._per_group = task, base, per_group

    def reset(self, rng: jax.Array) -> State:
        """A new session; ``rng`` is a legacy uint32 key, which brax's wrappers need."""
        key_truth, key_begin, key = jax.random.split(rng, 3)
        belief, session = self.task.begin(key_begin)
        inside = self._inside(self.task.draw(key_truth), belief, session, key)
        return State(
            pipeline_state=inside,
            obs=_flat(inside.seen),
            reward=jnp.zeros(()),
            done=jnp.zeros(()),
            metrics={"gain": jnp.zeros(())},
            info={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Make one measurement."""
        now, task = state.pipeline_state, self.task
        key_gain, key_outcome, key_update, key = jax.random.split(now.key, 4)
        place = jnp.where(now.seen.valid[action], action, 0)
        index = now.seen.index[place]
        design = jax.tree.map(lambda leaf: leaf[index], now.options.designs)
        # By draws of its own: those of ``seen`` chose it, so theirs is too large.
        gain = now.belief.gain(task, design, key_gain)
        outcome = task.measure(now.truth, design, key_outcome)
        belief = now.belief.update(task, design, outcome, key_update)
        session = task.spend(now.session, design, outcome)
        done = session.over | (session.made >= task.most)
        inside = self._inside(now.truth, belief, session, key)
        return state.replace(
            pipeline_state=inside,
            obs=_flat(inside.seen),
            reward=gain,
            done=done.astype(jnp.float32),
            metrics=state.metrics | {"gain": gain},
        )

    def _inside(self, truth: Any, belief: Any, session: Any, key: jax.Array) -> _Inside:
        key_options, key_seen, key = jax.random.split(key, 3)
        options = self.task.options(belief, session, key_options)
        seen = see(
            self.task, belief, session, options, key_seen, self._base, self._per_group
        )
        return _Inside(truth, belief, session, options, seen, key)

    @property
    def observation_size(self) -> int:
        key = jax.random.PRNGKey(0)  # brax's own kind
        return int(jax.eval_shape(self.reset, key).obs.shape[-1])

    @property
    def action_size(self) -> int:
        return self.observation_size // (NUM_FEATURES + 2)

    @property
    def backend(self) -> str:
        return "jaxcal"


def _flat(seen: Seen) -> jax.Array:
    parts = seen.features, jnp.maximum(seen.log_score, -10.0), seen.valid
    return jnp.concatenate([part.astype(jnp.float32).ravel() for part in parts])
