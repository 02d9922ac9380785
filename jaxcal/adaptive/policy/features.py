"""Inputs of a policy: a shortlist of options with their features."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.rules import Rule, groups_of, log_score, shortlist
from jaxcal.adaptive.session import Options, Session

NUM_FEATURES = 31
_SCALE = 20.0  # seconds


@struct.dataclass
class Shortlist:
    """A shortlist of C options."""

    index: jax.Array  # (C,) int32 into the options
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
    """(A,) expected entropy after outcomes that take uses, and after those that do not.

    0 where the belief has no ``entropies_after`` or there are no such outcomes.
    """
    if not hasattr(belief, "entropies_after"):
        return jnp.zeros(count), jnp.zeros(count)
    p, after = belief.predictive(task), belief.entropies_after(task)
    chances = (jnp.where(task.uses > 0, p, 0.0), jnp.where(task.uses > 0, 0.0, p))
    spent, free = ((c * after).sum(-1) / (c.sum(-1) + 1e-9) for c in chances)
    return spent, free
