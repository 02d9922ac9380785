"""Prey: how a predator's eating depends on how many prey there are.

N prey are set out, and eaten at the rate ``a N^2 / (1 + a h N^2)`` (Holling's type III)
for 24 hours; how many are gone is binomial with the share that the rate says. Constants
of Moffat et al. (2020) and Blau et al. (2022, arXiv:2202.00821): log a and log h are
N(-1.4, 1.35^2), N from 1 to 300, ten measurements. The rate is integrated in closed
form; the published code takes 24 Runge-Kutta steps of an hour, which are inaccurate
where a N is large.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.session import Session

__all__ = ["Prey", "make_prey", "prey"]

_MOST = 300  # prey
_SLIP = 1e-6  # share that is never reached, so that no outcome is impossible


@struct.dataclass
class Prey:
    """A design is N, a whole number; the unknowns are (log a, log h)."""

    log_factorials: jax.Array  # (301,) of 0 to 300: quicker than to compute them
    mean: Any = -1.4
    sd: Any = 1.35
    hours: Any = 24.0

    dim = 2

    @property
    def support(self) -> jax.Array:
        return jnp.arange(_MOST + 1.0)

    def unknowns(self, z: jax.Array) -> jax.Array:
        return self.mean + self.sd * z

    def predict(self, unknowns: jax.Array, design: jax.Array) -> jax.Array:
        """(3,) N, log of the share eaten, log of the share left."""
        a, h = jnp.exp(unknowns)
        # 1 / (a n) - h n grows by one an hour.
        c = a * (self.hours - h * design) + 1.0 / design
        root = jnp.sqrt(c * c + 4.0 * a * h)
        # The positive root of a h n^2 + c n = 1, in the form that does not cancel.
        left = jnp.where(c > 0.0, 2.0 / (c + root), (root - c) / (2.0 * a * h))
        share = jnp.clip(left / design, _SLIP, 1.0 - _SLIP)
        return jnp.stack([design, jnp.log1p(-share), jnp.log(share)])

    def log_prob(self, prediction: jax.Array, outcome: jax.Array) -> jax.Array:
        count, log_eaten, log_left = prediction
        rest = jnp.maximum(count - outcome, 0.0)
        log_factorial = self.log_factorials[
            jnp.stack([count, outcome, rest]).astype(jnp.int32)
        ]
        ways = log_factorial[0] - log_factorial[1] - log_factorial[2]
        found = ways + outcome * log_eaten + rest * log_left
        return jnp.where(outcome <= count, found, -jnp.inf)

    def sample(self, prediction: jax.Array, key: jax.Array) -> jax.Array:
        count, log_eaten, _ = prediction
        each = jax.random.uniform(key, (_MOST,)) < jnp.exp(log_eaten)
        return (each & (jnp.arange(_MOST) < count)).sum().astype(jnp.float32)

    def propose(
        self, unknowns: jax.Array, session: Session, key: jax.Array, count: int
    ) -> jax.Array:
        """Numbers spread evenly, in their logarithm, over all that may be set out."""
        log = jnp.linspace(0.0, jnp.log(_MOST), count)
        return jnp.maximum(jnp.rint(jnp.exp(log)), 1.0)

    def cost(self, session: Session, design: jax.Array) -> jax.Array:
        return jnp.zeros(())


def make_prey() -> Prey:
    """The model."""
    return Prey(jax.scipy.special.gammaln(jnp.arange(_MOST + 1.0) + 1.0))


def prey(
    measurements: int = 10,
    *,
    particles: int = 1000,
    candidates: int = 40,
    contrasts: int = 150,
    moves: int = 4,
) -> ParticleTask:
    """The task.

    Args:
        measurements: of a session.
        particles, candidates, contrasts, moves: see ``ParticleTask.make``.
    """
    return ParticleTask.make(
        make_prey(),
        measurements,
        particles=particles,
        candidates=candidates,
        contrasts=contrasts,
        moves=moves,
    )
