"""Hyperbolic discounting: how a person values money later, from choices.

The person is offered R now or 100 after D days and takes the later sum with probability
``eps + (1 - 2 eps) Phi((V_later - R) / alpha)``, ``V_later = 100 / (1 + k D)``.
Constants of Foster et al. (2021, arXiv:2103.02438) after Vincent and Rainforth (2017):
log k ~ N(-4.25, 1.5^2), alpha half normal of sd 2, eps = 0.01, 20 choices. Their code
(``hyperbolic_temporal_discount.py``) differs from their text: it has ``erf`` without
the root of two, so the choice is root two times as steep, and alpha starts at 1e-3.
``as_code`` follows the code.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.session import Session
from jaxcal.adaptive.tasks.registry import FREE, Entry

__all__ = ["ENTRY", "Hyperbolic", "hyperbolic"]

_LATER = 100.0  # money


@struct.dataclass
class Hyperbolic:
    """A design is (log D, R); the unknowns are (log k, alpha); 1 is the later sum."""

    epsilon: Any = 0.01
    least_alpha: Any = 1e-3
    steepness: Any = 2.0**0.5  # of Phi; root two where erf lacks its own

    dim = 2

    @property
    def support(self) -> jax.Array:
        return jnp.arange(2.0)

    def unknowns(self, z: jax.Array) -> jax.Array:
        # Half normal from a whole normal law, one to one.
        share = 0.5 * jax.scipy.stats.norm.cdf(-z[1])
        alpha = -2.0 * jax.scipy.special.ndtri(share)
        return jnp.stack([-4.25 + 1.5 * z[0], self.least_alpha + alpha])

    def predict(self, unknowns: jax.Array, design: jax.Array) -> jax.Array:
        later = _LATER / (1.0 + jnp.exp(unknowns[0] + design[0]))
        better = (later - design[1]) / unknowns[1]
        phi = jax.scipy.stats.norm.cdf(self.steepness * better)
        return self.epsilon + (1.0 - 2.0 * self.epsilon) * phi

    def log_prob(self, prediction: jax.Array, outcome: jax.Array) -> jax.Array:
        return jnp.log(jnp.where(outcome > 0.5, prediction, 1.0 - prediction))

    def sample(self, prediction: jax.Array, key: jax.Array) -> jax.Array:
        return (jax.random.uniform(key) < prediction).astype(jnp.float32)

    def propose(
        self, unknowns: jax.Array, session: Session, key: jax.Array, count: int
    ) -> jax.Array:
        """A delay at random, and about what a drawn person finds it worth."""
        key_who, key_delay, key_money = jax.random.split(key, 3)
        who = jax.random.randint(key_who, (count,), 0, len(unknowns))
        log_k, alpha = unknowns[who].T
        # Worth 2 to 98 of 100, so that some parameters make either answer likely.
        odds = jax.random.uniform(key_delay, (count,), minval=-4.0, maxval=4.0)
        log_delay = odds - log_k
        worth = _LATER / (1.0 + jnp.exp(odds))
        off = jnp.minimum(alpha, 20.0) * jax.random.normal(key_money, (count,))
        off = jnp.where(jnp.arange(count) % 2 == 0, off, 0.0)
        return jnp.stack([log_delay, jnp.clip(worth + off, 0.0, _LATER)], axis=-1)

    def cost(self, session: Session, design: jax.Array) -> jax.Array:
        return jnp.zeros(())


def hyperbolic(
    measurements: int = 20,
    *,
    as_code: bool = True,
    particles: int = 1000,
    candidates: int = 64,
    contrasts: int = 250,
    moves: int = 4,
) -> ParticleTask:
    """The task.

    Args:
        measurements: of a session.
        as_code: as the code of the published figures has it, not as the text has it.
        particles, candidates, contrasts, moves: see ``ParticleTask.make``.
    """
    model = Hyperbolic() if as_code else Hyperbolic(least_alpha=1e-6, steepness=1.0)
    return ParticleTask.make(
        model,
        measurements,
        particles=particles,
        candidates=candidates,
        contrasts=contrasts,
        moves=moves,
    )


ENTRY = Entry(
    hyperbolic,
    about="how a person values money later",
    rules=FREE,
    methods=("random", "gain"),
    episodes=512,
)
