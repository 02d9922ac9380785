"""Prey: how a predator's eating depends on how many prey there are.

N prey are set out, and eaten at the rate ``a N^2 / (1 + a h N^2)`` (Holling's type III)
for 24 hours; how many are gone is binomial with the share that the rate says. Constants
of Moffat et al. (2020) and Blau et al. (2022, arXiv:2202.00821): log a and log h are
N(-1.4, 1.35^2), N from 1 to 300, ten measurements. The rate is integrated in closed
form. The published code takes 24 Runge-Kutta steps of an hour (the 3/8 rule), which
overshoot where a N is large: for a tenth of the prior fewer than no prey are left, and
that share is cut to 0. ``as_code`` follows it: another task, of more information.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.session import Session
from jaxcal.adaptive.tasks.registry import FREE, Entry

__all__ = ["ENTRY", "Prey", "make_prey", "prey"]

_MOST = 300  # prey
_SLIP = 1e-6  # share that is never reached, so that no outcome is impossible


@struct.dataclass
class Prey:
    """A design is N, a whole number; the unknowns are (log a, log h)."""

    log_factorials: jax.Array  # (301,) of 0 to 300: quicker than to compute them
    mean: Any = -1.4
    sd: Any = 1.35
    hours: Any = 24.0
    steps: int = struct.field(pytree_node=False, default=0)  # 0: closed form

    dim = 2

    @property
    def support(self) -> jax.Array:
        return jnp.arange(_MOST + 1.0)

    def unknowns(self, z: jax.Array) -> jax.Array:
        return self.mean + self.sd * z

    def predict(self, unknowns: jax.Array, design: jax.Array) -> jax.Array:
        """(3,) N, log of the share eaten, log of the share left."""
        a, h = jnp.exp(unknowns)
        left = self._stepped(a, h, design) if self.steps else self._left(a, h, design)
        share = jnp.clip(left / design, _SLIP, 1.0 - _SLIP)
        return jnp.stack([design, jnp.log1p(-share), jnp.log(share)])

    def _left(self, a: jax.Array, h: jax.Array, design: jax.Array) -> jax.Array:
        """() prey left, in closed form."""
        # 1 / (a n) - h n grows by one an hour.
        c = a * (self.hours - h * design) + 1.0 / design
        root = jnp.sqrt(c * c + 4.0 * a * h)
        # The positive root of a h n^2 + c n = 1, in the form that does not cancel.
        return jnp.where(c > 0.0, 2.0 / (c + root), (root - c) / (2.0 * a * h))

    def _stepped(self, a: jax.Array, h: jax.Array, design: jax.Array) -> jax.Array:
        """() prey left, by Runge-Kutta steps; below 0 where they overshoot."""
        long = self.hours / self.steps

        def rate(left: jax.Array) -> jax.Array:
            eaten = a * left * left
            return -eaten / (1.0 + h * eaten)

        def step(_: int, left: jax.Array) -> jax.Array:
            one = long * rate(left)
            two = long * rate(left + one / 3.0)
            three = long * rate(left + two - one / 3.0)
            four = long * rate(left + one - two + three)
            return left + (one + 3.0 * (two + three) + four) / 8.0

        left: jax.Array = jax.lax.fori_loop(0, self.steps, step, design)
        return left

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


def make_prey(as_code: bool = False) -> Prey:
    """The model."""
    log_factorials = jax.scipy.special.gammaln(jnp.arange(_MOST + 1.0) + 1.0)
    return Prey(log_factorials, steps=24 if as_code else 0)


def prey(
    measurements: int = 10,
    *,
    as_code: bool = False,
    particles: int = 1000,
    candidates: int = 40,
    contrasts: int = 150,
    moves: int = 4,
) -> ParticleTask:
    """The task.

    Args:
        measurements: of a session.
        as_code: integrate as the code of the published figures does.
        particles, candidates, contrasts, moves: see ``ParticleTask.make``.
    """
    return ParticleTask.make(
        make_prey(as_code),
        measurements,
        particles=particles,
        candidates=candidates,
        contrasts=contrasts,
        moves=moves,
    )


ENTRY = Entry(
    prey,
    about="how a predator's eating depends on how many prey there are",
    rules=FREE,
    methods=("random", "gain"),
    episodes=256,
)
