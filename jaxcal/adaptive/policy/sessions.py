"""Sessions of sequential measurement as PPO's streams play them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.policy.features import Shortlist, shortlist_of
from jaxcal.adaptive.rules import Rule
from jaxcal.adaptive.session import Session
from jaxcal.learning.core.streams import Step


@struct.dataclass
class Exercise:
    """Arrays that a stream takes: a task, and the rule that the policy corrects."""

    task: Any
    base: Rule


@struct.dataclass
class State:
    """One session."""

    truth: Any  # of the unknown
    belief: Any
    session: Session


@dataclasses.dataclass(frozen=True)
class Sessions:
    """``learning.core.streams.Environment`` of tasks and beliefs."""

    per_group: int = 6  # options of a group that the network sees

    def reset(self, task: Exercise, key: jax.Array) -> State:
        """A new session, its truth drawn from the prior."""
        key_truth, key_begin = jax.random.split(key)
        return State(task.task.draw(key_truth), *task.task.begin(key_begin))

    def observe(self, task: Exercise, state: State, key: jax.Array) -> Shortlist:
        """The shortlist."""
        key_options, key_observe = jax.random.split(key)
        belief, session = state.belief, state.session
        options = task.task.options(belief, session, key_options)
        return shortlist_of(
            *(task.task, belief, session, options, key_observe),
            task.base,
            self.per_group,
        )

    def step(
        self,
        task: Exercise,
        state: State,
        observation: Shortlist,
        action: jax.Array,
        key: jax.Array,
    ) -> Step:
        """Make a measurement; its reward is the information it is expected to give.

        The gain is estimated from independent draws: the design was chosen by those of
        the shortlist, so their estimate is too large.
        """
        made, belief = task.task, state.belief
        key_outcome, key_update, key_gain = jax.random.split(key, 3)
        design = jax.tree.map(lambda leaf: leaf[action], observation.designs)
        outcome = made.measure(state.truth, design, key_outcome)
        outcomes, chance = outcome[None], jnp.ones(1)
        happened = jnp.int32(0)
        if isinstance(made, GridTask):  # all outcomes are known, and few
            outcomes, chance = belief.outcomes(made, design, key_outcome)
            happened = outcome.astype(jnp.int32)

        def after(outcome: jax.Array) -> tuple[State, jax.Array]:
            then = belief.update(made, design, outcome, key_update)
            session = made.spend(state.session, design, outcome)
            return State(state.truth, then, session), made.over(session)

        states, ended = jax.vmap(after)(outcomes)
        return Step(
            reward=belief.gain(made, design, key_gain),
            states=states,
            ended=ended,
            chance=chance,
            happened=happened,
        )
