"""Sessions played to their end, thousands at once, and the comparison of deciders."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.adaptive.session import Decider, SequentialTask, jit_by_class
from jaxcal.checks import Array


@struct.dataclass
class Episodes:
    """B sessions of at most T measurements; entries where not ``alive`` are void."""

    truth: Any  # leaves (B, ...)
    begun: Any  # Session, leaves (B, ...): the budget
    designs: Any  # leaves (B, T, ...)
    outcomes: Any  # leaves (B, T, ...)
    gains: jax.Array  # (B, T) nats expected of each measurement when it was chosen
    alive: jax.Array  # (B, T) bool
    entropy_drop: jax.Array  # (B,) nats: entropy of the prior less the posterior's
    log_ratio: jax.Array  # (B,) log posterior less log prior, at the truth

    @property
    def gain(self) -> jax.Array:
        """(B,) nats: sum of expected gains; its mean is that of ``entropy_drop``."""
        return (self.gains * self.alive).sum(axis=-1)


def play(
    task: SequentialTask,
    decider: Decider,
    keys: jax.Array,
    batch: int = 2**31,
    progress: Callable[[int], None] = lambda done: None,
) -> Episodes:
    """Play one session per key (B,), at most ``batch`` and ``task.batch`` at once.

    The truth, the budget and the noise of every measurement depend on the key alone, so
    deciders that are given the same keys can be compared in pairs.
    """
    count = len(keys)
    size = min(getattr(task, "batch", count), batch, count)
    padded = keys[jnp.arange(-(-count // size) * size) % count]
    parts = []
    for at in range(0, len(padded), size):
        progress(at)
        parts.append(_played(task, decider, padded[at : at + size]))
    if len(parts) == 1:
        return parts[0]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)


@jit_by_class
def _played(task: SequentialTask, decider: Decider, keys: jax.Array) -> Episodes:
    def split(keys: jax.Array, number: int) -> jax.Array:
        return jax.vmap(lambda key: jax.random.split(key, number), out_axes=1)(keys)

    key_truth, key_begin, key_steps = split(keys, 3)
    truth = jax.vmap(task.draw)(key_truth)
    prior, begun = jax.vmap(task.begin)(key_begin)
    steps = split(key_steps, task.horizon)

    def choose(truth: Any, belief: Any, session: Any, key: jax.Array) -> Any:
        key_options, key_choice, key_gain, key_outcome, key_update = jax.random.split(
            key, 5
        )
        options = task.options(belief, session, key_options)
        index = decider(task, belief, session, options, key_choice)
        design = jax.tree.map(lambda leaf: leaf[index], options.designs)
        gain = belief.gain(task, design, key_gain)
        outcome = task.measure(truth, design, key_outcome)
        updated = belief.update(task, design, outcome, key_update)
        after = updated, task.spend(session, design, outcome)
        alive = ~task.over(session) & options.allowed.any()
        after = jax.tree.map(
            lambda old, new: jnp.where(alive, new, old), (belief, session), after
        )
        return after, (design, outcome, gain, alive)

    def step(carry: Any, keys: jax.Array) -> tuple[Any, Any]:
        def nothing(carry: Any) -> tuple[Any, Any]:
            return carry, jax.tree.map(
                lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), blank
            )

        def going(carry: Any) -> tuple[Any, Any]:
            belief, session = carry
            return jax.vmap(choose)(truth, belief, session, keys)

        blank = jax.eval_shape(going, carry)[1]
        # Nothing is computed once every session is over.
        ended = jax.vmap(task.over)(carry[1])
        return jax.lax.cond(ended.all(), nothing, going, carry)

    (belief, _), record = jax.lax.scan(step, (prior, begun), steps)
    designs, outcomes, gains, alive = jax.tree.map(
        lambda leaf: jnp.moveaxis(leaf, 0, 1), record
    )
    return Episodes(
        truth=truth,
        begun=begun,
        designs=designs,
        outcomes=outcomes,
        gains=gains,
        alive=alive,
        entropy_drop=jax.vmap(lambda a, b: a.entropy() - b.entropy())(prior, belief),
        log_ratio=jax.vmap(lambda a, b, t: b.log_density(t) - a.log_density(t))(
            prior, belief, truth
        ),
    )


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Deciders on the same sessions: information in nats, with standard errors."""

    names: tuple[str, ...]
    gain: Array  # (D, B) sum of expected gains
    entropy_drop: Array  # (D, B)
    log_ratio: Array  # (D, B) at the truth
    choices: Array  # (D, B) measurements made

    def mean(self, name: str) -> tuple[float, float]:
        """Nats by the sum of expected gains, and the standard error."""
        return _mean(self.gain[self.names.index(name)])

    def paired(self, name: str, base: str) -> tuple[float, float]:
        """Mean difference ``name`` less ``base``, nats, and its standard error."""
        a, b = (self.gain[self.names.index(n)] for n in (name, base))
        return _mean(a - b)


def compare(
    task: SequentialTask,
    deciders: Mapping[str, Decider],
    episodes: int = 4096,
    seed: int = 0,
    batch: int = 1024,
    progress: Callable[[int], None] = lambda done: None,
) -> Comparison:
    """Play every decider on the same ``episodes`` sessions, at least two, of a seed.

    ``batch`` of them are played at once; the result does not depend on it. ``progress``
    is called with the sessions of a decider played so far, from 0.
    """
    keys = jax.random.split(jax.random.key(seed), episodes)
    measured = []
    for decider in deciders.values():
        played = play(task, decider, keys, batch, progress)
        choices = played.alive.sum(axis=1)
        measured.append((played.gain, played.entropy_drop, played.log_ratio, choices))
    whole = (np.stack(v).astype(np.float64) for v in zip(*measured, strict=True))
    return Comparison(tuple(deciders), *whole)


def _mean(values: Any) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))
