"""Rules that look one measurement ahead: gain, gain per second, gain per price."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.adaptive.session import Options, Session


def best(score: jax.Array, options: Options) -> jax.Array:
    """() int32 index of the allowed option of the largest score (A,)."""
    return jnp.argmax(jnp.where(options.allowed, score, -jnp.inf)).astype(jnp.int32)


def log_score(gains: jax.Array, prices: jax.Array) -> jax.Array:
    """log (gain / price), finite also where one is zero."""
    return jnp.log(gains + 1e-9) - jnp.log(prices + 1e-9)


def groups_of(task: Any, count: int) -> tuple[jax.Array, int]:
    """(A,) the group of each option, and how many groups: one where a task has none."""
    number = getattr(task, "num_groups", 1)
    return task.groups if number > 1 else jnp.zeros(count, jnp.int32), number


def shortlist(
    task: Any, score: jax.Array, options: Options, per_group: int
) -> tuple[jax.Array, jax.Array]:
    """(C,) int32 indices of the allowed options of the largest scores (A,), at most
    ``per_group`` a group, and (C,) bool where one is listed: a group of fewer options
    leaves places void."""
    score = jnp.where(options.allowed, score, -jnp.inf)
    groups, number = groups_of(task, len(score))
    values, index = jax.vmap(
        lambda group: jax.lax.top_k(
            jnp.where(groups == group, score, -jnp.inf), min(per_group, len(score))
        )
    )(jnp.arange(number))
    return index.ravel().astype(jnp.int32), jnp.isfinite(values.ravel())


@struct.dataclass
class Random:
    """An allowed option, uniformly at random."""

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        logits = jnp.where(options.allowed, 0.0, -jnp.inf)
        return jax.random.categorical(key, logits).astype(jnp.int32)


@struct.dataclass
class Gain:
    """The largest expected information gain (EIG), whatever it costs."""

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        return best(belief.gains(task, options, key), options)


@struct.dataclass
class GainRate:
    """The largest expected gain per second."""

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        seconds, _ = task.expected(belief, session, options)
        gains = belief.gains(task, options, key)
        return best(gains / jnp.maximum(seconds, 1e-9), options)


class Rule(abc.ABC):
    """A rule by a price: the largest log (gain / price)."""

    # Constants that can be tuned, by the place in what they are moved by: prices, which
    # are multiplied by ``exp(by)``, and exponents, which are added to. The price's unit
    # is free.
    prices: ClassVar[Mapping[str, int]]
    exponents: ClassVar[Mapping[str, int]] = {}

    @property
    def num_free(self) -> int:
        """Numbers that a tuner tries."""
        return len({*self.prices.values(), *self.exponents.values()})

    def moved(self, by: Any) -> Any:
        """The rule with other constants, ``by`` (num_free,) away."""
        changed = {n: getattr(self, n) * np.exp(by[i]) for n, i in self.prices.items()}
        changed |= {n: getattr(self, n) + by[i] for n, i in self.exponents.items()}
        return dataclasses.replace(self, **changed)  # type: ignore[type-var]  # flax

    @abc.abstractmethod
    def price(
        self, task: Any, session: Session, options: Options, *expected: jax.Array
    ) -> jax.Array:
        """(A,) what the measurements are taken to cost; ``expected``: their gains,
        seconds and uses, (A,) each."""

    def judged(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """(A,) gains in nats and (A,) prices."""
        gains = belief.gains(task, options, key)
        expected = task.expected(belief, session, options)
        return gains, self.price(task, session, options, gains, *expected)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        judged = self.judged(task, belief, session, options, key)
        return best(log_score(*judged), options)


@struct.dataclass
class Shares(Rule):
    """A price in shares of what is left, with constants that serve any task.

    ``1 / n + time s / t + use (u / e) N^a e^b``: a measurement takes s of the t seconds
    and u of the e uses left (no share counts as more than 1), n measurements may still
    be made, and N of those that gain most a second. No unit of time matters. Where time
    is not limited the time of these N stands for t, and ``haste`` for ``time``.
    """

    time: Any = 1.0
    use: Any = 1.0
    a: Any = 0.0
    b: Any = 0.0
    haste: Any = 0.0
    prices: ClassVar[Mapping[str, int]] = {"time": 0, "use": 1, "haste": 0}
    exponents: ClassVar[Mapping[str, int]] = {"a": 2, "b": 3}

    def price(
        self, task: Any, session: Session, options: Options, *expected: jax.Array
    ) -> jax.Array:
        gains, s, u = expected
        e = jnp.maximum(session.uses.astype(gains.dtype), 1.0)
        # Uses that every measurement takes limit the number of measurements.
        always = jnp.where(options.allowed, u, jnp.inf).min()
        n = jnp.maximum(task.horizon - session.made, 1).astype(gains.dtype)
        n = jnp.minimum(n, jnp.maximum(e / jnp.maximum(always, 1e-6), 1.0))
        typical = jnp.maximum(s[best(log_score(gains, s), options)], 1e-9)
        limited = jnp.isfinite(session.seconds)
        t = jnp.where(limited, jnp.maximum(session.seconds, 1e-9), n * typical)
        number = jnp.minimum(n, jnp.maximum(t / typical, 0.1))
        return (
            1.0 / n
            + jnp.where(limited, self.time, self.haste) * jnp.minimum(s / t, 1.0)
            + self.use * jnp.clip((u - always) / e, 0.0, 1.0)
            * number**self.a * e**self.b
        )  # fmt: skip


SHARES = Shares(1.4, 1.8, 0.2, -0.7)
"""Rounded from a search over drawn tasks, as ``python -m benchmarks.sequential.families
--tune`` makes."""


@struct.dataclass
class Priced(Rule):
    """``c0 + c1 seconds + c2 uses``, the same throughout a session."""

    c0: Any = 1.0
    c1: Any = 1.0
    c2: Any = 1.0
    prices: ClassVar[Mapping[str, int]] = {"c0": 0, "c2": 1}

    def price(
        self, task: Any, session: Session, options: Options, *expected: jax.Array
    ) -> jax.Array:
        _, seconds, uses = expected
        return self.c0 + self.c1 * seconds + self.c2 * uses


@struct.dataclass
class StateRule(Rule):
    """A price that follows what is left: e uses and t seconds.

    ``c0 exp(d0 (e - 1)) + c1 seconds + c2 exp(d1 (e - 1) + d2 t / scale) uses``
    """

    c0: Any = 1.0
    c1: Any = 1.0
    c2: Any = 1.0
    d0: Any = 0.0
    d1: Any = 0.0
    d2: Any = 0.0
    scale: Any = 20.0  # seconds
    prices: ClassVar[Mapping[str, int]] = {"c0": 0, "c2": 1}
    exponents: ClassVar[Mapping[str, int]] = {"d0": 2, "d1": 3, "d2": 4}

    def price(
        self, task: Any, session: Session, options: Options, *expected: jax.Array
    ) -> jax.Array:
        _, seconds, uses = expected
        more = session.uses - 1.0
        left = jnp.where(jnp.isfinite(session.seconds), session.seconds, 0.0)
        fixed = self.c0 * jnp.exp(self.d0 * more)
        use = self.c2 * jnp.exp(self.d1 * more + self.d2 * left / self.scale)
        return fixed + self.c1 * seconds + use * uses
