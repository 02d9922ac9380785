"""The policy: a shortlist's features, a learned correction of a rule's score by them,
and sessions as PPO's streams play them."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.rules import Rule, groups_of, log_score, shortlist
from jaxcal.adaptive.session import Options, Session
from jaxcal.learning.core.streams import Step

NUM_FEATURES = 31
_SCALE = 20.0  # seconds
# Initial factor of the rule's log score: an option whose score is a fifth below the
# best one's is sampled a third as often (0.8^5).
_SHARPNESS = 5.0
_STEP = 3.0  # logits per unit of the network's output, so that it learns faster


@struct.dataclass
class Shortlist:
    """A shortlist of C options; a network reads the last three fields."""

    index: Any  # (C,) int32 into the options
    designs: Any  # leaves (C, ...) of those options
    features: jax.Array  # (C, NUM_FEATURES)
    log_score: jax.Array  # (C,) of the base rule, less its maximum
    valid: jax.Array  # (C,) bool


def shortlist_of(
    task: Any,
    belief: Any,
    session: Session,
    options: Options,
    key: jax.Array,
    base: Rule,
    per_group: int,
) -> Shortlist:
    """The best ``per_group`` options of each group by the base rule, and features."""
    seconds, uses = task.expected(belief, session, options)
    gains, price = base.judged(task, belief, session, options, key)
    score = log_score(gains, price)
    index, valid = shortlist(task, score, options, per_group)
    groups, number = groups_of(task, len(gains))
    mine = groups[index]
    below = score[index] - jnp.where(options.allowed, score, -jnp.inf).max()

    time_left = jnp.where(jnp.isfinite(session.seconds), session.seconds, 2 * _SCALE)
    g, s, u = gains[index], seconds[index], uses[index]
    members = groups[None] == jnp.arange(number)[:, None]
    within = jnp.where(members & options.allowed[None], gains[None], 0.0)  # (G, A)
    # Summed over a group's options, the gains measure how much of it is unknown.
    tops, sums = within.max(axis=1), within.sum(axis=1)
    top, total = tops[mine], sums[mine]
    others = jnp.where(jnp.arange(number)[None] == mine[:, None], 0.0, tops[None]).max(
        axis=1
    )
    nearest = jnp.where(members, options.seconds[None], jnp.inf).min(axis=1)
    rate = gains / jnp.maximum(seconds, 1e-6)
    first, second = session.uses <= 1, session.uses <= 2
    spent, free = _left_after(task, belief, len(gains))
    of_option = {
        "log_gain": 0.2 * jnp.log(g + 1e-6),
        "gain": g,
        "uses": u,
        "seconds": s / 5.0,
        "share_of_time": jnp.minimum(s / jnp.maximum(time_left, 1e-3), 3.0),
        "rate": g / jnp.maximum(s, 1e-6),
        "log_score": jnp.maximum(below, -10.0),
        "in_nearest_group": (nearest[mine] <= nearest.min() + 1e-6).astype(g.dtype),
        "where": _along(task, len(gains))[index],
        "uses_at_last": u * first,
        "uses_at_last_two": u * second,
        "uses_squared": u * u,
        "time_after": (time_left - s) / _SCALE,
        "best_of_group": top,
        "best_of_others": others,
        "uses_by_time": u * time_left / _SCALE,
        "gain_per_use": g / (u + 0.05),
        "root_gain": jnp.sqrt(g),
        "entropy_if_used": spent[index] / 3.0,
        "entropy_if_not": free[index] / 3.0,
        "sum_of_group": jnp.log1p(total),
        "sum_of_others": jnp.log1p(jnp.maximum(sums.sum() - total, 0.0)),
    }
    of_session = {
        "time": time_left / _SCALE,
        "last_seconds": jnp.minimum(time_left / 5.0, 1.0),
        "last_use": first,
        "last_two_uses": second,
        "uses_left": jnp.minimum(session.uses, 4) / 4.0,
        "best_gain": gains.max(),
        "best_rate": rate.max(),
        "made": session.made / 10.0,
        "entropy": jnp.nan_to_num(belief.entropy()) / 5.0,
    }
    wide = {name: jnp.full_like(g, value) for name, value in of_session.items()}
    features = jnp.stack([*of_option.values(), *wide.values()], axis=-1)
    return Shortlist(
        index=index,
        designs=jax.tree.map(lambda leaf: leaf[index], options.designs),
        features=jnp.where(valid[:, None], features, 0.0),
        log_score=jnp.where(valid, below, -1e9),
        valid=valid,
    )


def _along(task: Any, count: int) -> jax.Array:
    """(A,) the last column of a task's designs, from 0 to 1; 0 without a table."""
    designs = getattr(task, "designs", None)
    if designs is None:
        return jnp.zeros(count)
    u = designs[:, -1]
    return (u - u.min()) / jnp.maximum(u.max() - u.min(), 1e-9)


def _left_after(task: Any, belief: Any, count: int) -> tuple[jax.Array, jax.Array]:
    """(A,) expected entropy after outcomes that take uses, and after those that do not;
    0 where there are none, and of particles."""
    if not isinstance(task, GridTask):
        return jnp.zeros(count), jnp.zeros(count)
    p, after = belief.predictive(task), belief.entropies_after(task)
    chances = (jnp.where(task.uses > 0, p, 0.0), jnp.where(task.uses > 0, 0.0, p))
    spent, free = ((c * after).sum(-1) / (c.sum(-1) + 1e-9) for c in chances)
    return spent, free


class Correction(nn.Module):
    """Logits (..., C) and a value (...) of shortlists.

    Each option is embedded, the embeddings are pooled by their maximum, and each is
    scored beside the pool. The last layer begins at zero: a policy begins as its rule.
    """

    width: int = 64

    @nn.compact
    def __call__(self, seen: Shortlist) -> tuple[jax.Array, jax.Array]:
        hidden = nn.tanh(nn.Dense(self.width)(seen.features))
        valid = seen.valid[..., None]
        pool = jnp.where(valid, hidden, -1.0).max(axis=-2)
        # A layer over both as two: the pool's product is computed once.
        beside = nn.Dense(self.width, use_bias=False)(pool)[..., None, :]
        late = nn.tanh(nn.Dense(self.width)(hidden) + beside)
        change = nn.Dense(1, kernel_init=nn.initializers.zeros)(late)[..., 0]
        beta = self.param("beta", nn.initializers.constant(_SHARPNESS), ())
        logits = beta * seen.log_score + _STEP * change
        mean = (hidden * valid).sum(axis=-2) / jnp.maximum(valid.sum(axis=-2), 1)
        value = jnp.concatenate([pool, mean], axis=-1)
        for _ in range(2):
            value = nn.tanh(nn.Dense(2 * self.width)(value))
        value = nn.Dense(1)(value)[..., 0]
        return jnp.where(seen.valid, logits, -1e9), value


@struct.dataclass
class PolicyDecider:
    """A trained network as a decider."""

    params: Any
    base: Rule
    per_group: int = struct.field(pytree_node=False, default=6)
    width: int = struct.field(pytree_node=False, default=64)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        given = task, belief, session, options, key
        seen = shortlist_of(*given, self.base, self.per_group)
        logits, _ = Correction(self.width).apply(self.params, seen)
        return seen.index[jnp.argmax(logits)]


def initial(key: jax.Array, per_group: int, num_groups: int, width: int = 64) -> Any:
    """Parameters before training."""
    c = per_group * num_groups
    features, valid = jnp.zeros((c, NUM_FEATURES)), jnp.ones(c, bool)
    blank = Shortlist(None, None, features, jnp.zeros(c), valid)
    return Correction(width).init(key, blank)


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
        made = task.task
        options = made.options(belief, session, key_options)
        given = made, belief, session, options, key_observe
        return shortlist_of(*given, task.base, self.per_group)

    def step(
        self,
        task: Exercise,
        state: State,
        observation: Shortlist,
        action: jax.Array,
        key: jax.Array,
    ) -> Step:
        """Make a measurement; its reward is the information it is expected to give, by
        draws of its own: the design was chosen by those of the shortlist, so their
        estimate is too large."""
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
        gain = belief.gain(made, design, key_gain)
        return Step(gain, states, ended, chance, happened)
