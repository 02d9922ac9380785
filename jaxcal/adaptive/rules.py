"""Rules that look one measurement ahead: gain, gain a second, gain a price."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.session import Options, Session

__all__ = ["Gain", "GainRate", "Priced", "Random", "StateRule", "best"]


def best(score: jax.Array, options: Options) -> jax.Array:
    """() int32 the allowed option of the largest score (A,)."""
    return jnp.argmax(jnp.where(options.allowed, score, -jnp.inf)).astype(jnp.int32)


@struct.dataclass
class Random:
    """Any option that is allowed."""

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
    """The largest expected gain a second."""

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        seconds, _ = task.expected(belief, session, options)
        gains = belief.gains(task, options, key)
        return best(gains / jnp.maximum(seconds, 1e-9), options)


class Scored:
    """A rule by a price: the largest log (gain / price)."""

    def log_score(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        """(A,) log of gain over price, finite."""
        seconds, uses = task.expected(belief, session, options)
        gains = belief.gains(task, options, key)
        price = self.price(session, seconds, uses)
        return jnp.log(gains + 1e-9) - jnp.log(price + 1e-9)

    def price(self, session: Session, seconds: jax.Array, uses: jax.Array) -> jax.Array:
        """(A,) what the measurements are taken to cost."""
        raise NotImplementedError

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        return best(self.log_score(task, belief, session, options, key), options)


@struct.dataclass
class Priced(Scored):
    """``c0 + c1 seconds + c2 uses``, the same throughout a session."""

    c0: Any = 1.0
    c1: Any = 1.0
    c2: Any = 1.0

    def price(self, session: Session, seconds: jax.Array, uses: jax.Array) -> jax.Array:
        return self.c0 + self.c1 * seconds + self.c2 * uses


@struct.dataclass
class StateRule(Scored):
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

    def price(self, session: Session, seconds: jax.Array, uses: jax.Array) -> jax.Array:
        more = session.uses - 1.0
        left = jnp.where(jnp.isfinite(session.seconds), session.seconds, 0.0)
        fixed = self.c0 * jnp.exp(self.d0 * more)
        use = self.c2 * jnp.exp(self.d1 * more + self.d2 * left / self.scale)
        return fixed + self.c1 * seconds + use * uses
