"""Location finding: sources in the plane, from the sum of their signals.

The log of the signal at a point is measured with Gaussian noise of sd 0.5; the signal
is ``b + sum_k 1 / (m + |point - source_k|^2)``. Constants of Foster et al. (2021,
arXiv:2103.02438): b = 0.1, m = 1e-4, two sources, each N(0, I), 30 measurements.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.session import Session
from jaxcal.adaptive.tasks.registry import FREE, Entry

__all__ = ["ENTRY", "LocationFinding", "location_finding"]


@struct.dataclass
class LocationFinding:
    """A design is a point (2,); the unknowns are the sources (K, 2)."""

    background: Any = 0.1
    floor: Any = 1e-4  # squared distance at which a signal saturates
    sigma: Any = 0.5  # of the log of the signal
    sources: int = struct.field(pytree_node=False, default=2)
    uniform: bool = struct.field(pytree_node=False, default=False)  # on [0, 1]^2

    support = None

    @property
    def dim(self) -> int:
        return 2 * self.sources

    def unknowns(self, z: jax.Array) -> jax.Array:
        places = z.reshape(self.sources, 2)
        return jax.scipy.stats.norm.cdf(places) if self.uniform else places

    def predict(self, unknowns: jax.Array, design: jax.Array) -> jax.Array:
        signal = self.background
        for x, y in unknowns:  # one by one: quicker than sums over axes of two
            squared = (x - design[0]) ** 2 + (y - design[1]) ** 2
            signal = signal + 1.0 / (self.floor + squared)
        return jnp.log(signal)

    def log_prob(self, prediction: jax.Array, outcome: jax.Array) -> jax.Array:
        error = (outcome - prediction) / self.sigma
        return -0.5 * error * error - jnp.log(self.sigma * (2.0 * jnp.pi) ** 0.5)

    def sample(self, prediction: jax.Array, key: jax.Array) -> jax.Array:
        return prediction + self.sigma * jax.random.normal(key)

    def propose(
        self, unknowns: jax.Array, session: Session, key: jax.Array, count: int
    ) -> jax.Array:
        """Places of sources that are drawn, and about them by what sets draws apart."""
        flat = unknowns.reshape(-1, 2)
        index = jax.random.randint(key, (3, count), 0, len(flat))
        here, one, other = flat[index]
        size = jnp.linspace(0.0, 1.0, count)[:, None]
        found = here + size * (one - other)
        return jnp.clip(found, 0.0, 1.0) if self.uniform else found

    def cost(self, session: Session, design: jax.Array) -> jax.Array:
        return jnp.zeros(())


def location_finding(
    sources: int = 2,
    *,
    uniform: bool = False,
    measurements: int = 30,
    sigma: float = 0.5,
    particles: int = 600,
    candidates: int = 24,
    contrasts: int = 100,
    moves: int = 3,
) -> ParticleTask:
    """The task.

    Args:
        sources: in the plane.
        uniform: sources and designs on [0, 1]^2, in place of sources N(0, I).
        measurements: of a session.
        sigma: of the log of the signal.
        particles, candidates, contrasts, moves: see ``ParticleTask.make``.
    """
    return ParticleTask.make(
        LocationFinding(sigma=sigma, sources=sources, uniform=uniform),
        measurements,
        particles=particles,
        candidates=candidates,
        contrasts=contrasts,
        moves=moves,
    )


ENTRY = Entry(
    location_finding,
    about="two sources in the plane, from the sum of their signals",
    rules=FREE,
    methods=("random", "gain"),
    episodes=256,
)
