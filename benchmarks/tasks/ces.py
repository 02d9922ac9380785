"""Constant elasticity of substitution (CES): what two baskets are worth to a person.

A basket x of three goods is worth ``U(x) = (sum_i alpha_i x_i^rho)^(1 / rho)``. The
answer to two baskets is a mark: the logistic function of a normal number with mean
``u (U(x) - U(x'))`` and sd ``0.005 u (1 + |x - x'|)``, cut at 2^-22 and 1 - 2^-22. Here
an outcome is that number before the logistic function, cut at the same places: the same
information, without the rounding of marks near 1 in single precision.

Constants of Foster et al. (2019, arXiv:1903.05480) and Blau et al. (2022,
arXiv:2202.00821): rho uniform on [0.01, 1] (their code's; [0, 1] in the text), alpha
uniform on the simplex, goods in [0.01, 100], ten measurements. The text has
log u ~ N(1, 3): sd 3 in the published code, so by default here; sd 3^0.5 where 3 is
read as a variance.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.session import Session
from jaxcal.adaptive.tasks.registry import FREE, Entry

__all__ = ["CES", "ENTRY", "ces"]

_LEAST, _MOST = 0.01, 100.0  # of a good
_CUT = 15.249238  # logit of 1 - 2^-22
_ROOT = (2.0 * jnp.pi) ** 0.5


@struct.dataclass
class CES:
    """A design is two baskets (6,); the unknowns are (rho, alpha (3,), log u)."""

    log_u_sd: Any = 3.0
    noise: Any = 0.005
    walks: bool = struct.field(pytree_node=False, default=False)  # baskets cost a way
    squeezed: bool = struct.field(pytree_node=False, default=False)  # see ces

    dim = 4
    support = None

    def unknowns(self, z: jax.Array) -> jax.Array:
        share = jax.scipy.stats.norm.cdf(z[:3])
        first = 1.0 - jnp.sqrt(1.0 - share[1])
        second = (1.0 - first) * share[2]
        third = jnp.maximum(1.0 - first - second, 0.0)
        log_u = 1.0 + self.log_u_sd * z[3]
        rho = 0.01 + 0.99 * share[0]
        alpha = jnp.stack([first, second, third])
        if self.squeezed:
            rho = 0.01 + 0.98 * jax.nn.sigmoid(rho)
            alpha, log_u = jax.nn.softmax(alpha), jnp.clip(log_u, -10.0, 10.0)
        return jnp.concatenate([rho[None], alpha, log_u[None]])

    def predict(self, unknowns: jax.Array, design: jax.Array) -> jax.Array:
        u = jnp.exp(unknowns[4])
        better = _worth(unknowns, design[:3]) - _worth(unknowns, design[3:])
        squares = [(design[i] - design[i + 3]) ** 2 for i in range(3)]
        apart = jnp.sqrt(squares[0] + squares[1] + squares[2])
        return jnp.stack([u * better, u * self.noise * (1.0 + apart)])

    def log_prob(self, prediction: jax.Array, outcome: jax.Array) -> jax.Array:
        mean, sd = prediction
        error = (outcome - mean) / sd
        inside = -0.5 * error * error - jnp.log(sd * _ROOT)
        side = jnp.sign(outcome)
        outside = _log_phi((side * mean - _CUT) / sd)
        return jnp.where(jnp.abs(outcome) >= _CUT, outside, inside)

    def sample(self, prediction: jax.Array, key: jax.Array) -> jax.Array:
        mean, sd = prediction
        return jnp.clip(mean + sd * jax.random.normal(key), -_CUT, _CUT)

    def propose(
        self, unknowns: jax.Array, session: Session, key: jax.Array, count: int
    ) -> jax.Array:
        """Pairs that a drawn person is near to indifferent about, and single baskets.

        A person's worth of a basket scales with the basket, so the second of two is
        scaled to be worth the first.
        """
        keys = jax.random.split(key, 6)
        who = unknowns[jax.random.randint(keys[0], (count,), 0, len(unknowns))]
        if self.walks:
            return self._about(who, session, keys[1])
        kind = jnp.arange(count)[:, None] % 4
        # One good stands out in some baskets, in others all are alike.
        spread = jax.random.uniform(keys[1], (2, count, 1), maxval=6.0)
        logs = -spread * jax.random.uniform(keys[2], (2, count, 3))
        logs = jnp.where(kind[None] == 0, 0.0, logs)
        one, two = jnp.exp(logs - logs.max(axis=-1, keepdims=True))
        off = jnp.where(kind == 1, 0.1, 0.0) * jax.random.normal(keys[3], (count, 1))
        two = jnp.where(kind == 0, 0.0, _level(who, one, two) * jnp.exp(off))
        both = jnp.concatenate([one, two], axis=-1)
        size = jax.random.uniform(keys[4], (count, 1), minval=-6.0, maxval=0.0)
        both = both / both.max(axis=-1, keepdims=True) * _MOST * jnp.exp(size)
        return jnp.clip(both, _LEAST, _MOST)

    def _about(self, who: jax.Array, session: Session, key: jax.Array) -> jax.Array:
        """Pairs that can be paid for: near where the session is."""
        count = len(who)
        keys = jax.random.split(key, 3)
        if session.place is None:
            return jax.random.uniform(keys[0], (count, 6), minval=_LEAST, maxval=_MOST)
        left = jnp.minimum(session.seconds, 1e3)
        size = jax.random.uniform(keys[0], (count, 1), minval=-5.0, maxval=0.0)
        way = jax.random.normal(keys[1], (count, 6))
        way = way / jnp.sqrt((way**2).sum(axis=-1, keepdims=True))
        place = session.place[None]
        there = jnp.clip(place + left * jnp.exp(size) * way, _LEAST, _MOST)
        one, two = there[:, :3], there[:, 3:]
        # The dearer basket is made level with the other, or neither is.
        level = _level(who, one, two)
        down = jnp.concatenate([one, jnp.minimum(level, two)], axis=-1)
        up = jnp.concatenate([jnp.minimum(_level(who, two, one), one), two], axis=-1)
        kind = jnp.arange(count)[:, None] % 4
        dear = (level < two).all(axis=-1, keepdims=True)
        found = jnp.where(kind == 0, there, jnp.where(dear, down, up))
        way = jnp.clip(found, _LEAST, _MOST) - place
        long = jnp.sqrt((way**2).sum(axis=-1, keepdims=True))
        found = place + way * jnp.minimum(1.0, 0.999 * left / (long + 1e-9))
        return jnp.where(session.made == 0, place, found)

    def cost(self, session: Session, design: jax.Array) -> jax.Array:
        if not self.walks:
            return jnp.zeros(())
        way = jnp.sqrt(((design - session.place) ** 2).sum())
        return jnp.where(session.made == 0, 0.0, way)


def _log_phi(x: jax.Array) -> jax.Array:
    """Log of the normal law below x: a third of the time of jax.scipy's."""
    near = jnp.log(0.5 * jax.scipy.special.erfc(-jnp.maximum(x, -5.0) / 2.0**0.5))
    least = jnp.minimum(x, -5.0)
    inverse = 1.0 / (least * least)
    series = 1.0 + inverse * (-1.0 + 3.0 * inverse)
    far = -0.5 * least * least + jnp.log(series / (-least * _ROOT))
    return jnp.where(x < -5.0, far, near)


def _level(who: jax.Array, one: jax.Array, two: jax.Array) -> jax.Array:
    """(A, 3) the second baskets, scaled until each person is indifferent."""
    worth = jax.vmap(_worth)
    return two * (worth(who, one) / worth(who, two))[:, None]


def _worth(unknowns: jax.Array, basket: jax.Array) -> jax.Array:
    rho = unknowns[0]
    total = jnp.zeros(())
    for good in range(3):  # by log1p and expm1, so that a small rho keeps its digits
        total = total + unknowns[1 + good] * jnp.expm1(rho * jnp.log(basket[good]))
    return jnp.exp(jnp.log1p(jnp.maximum(total, -1.0 + 1e-7)) / rho)


def ces(
    measurements: int = 10,
    *,
    log_u_sd: float = 3.0,
    budget: float | None = None,
    squeezed: bool = False,
    particles: int = 1000,
    candidates: int = 80,
    contrasts: int = 100,
    moves: int = 5,
) -> ParticleTask:
    """The task.

    Args:
        measurements: of a session.
        log_u_sd: of log u; 3, or 3**0.5 where the papers' N(1, 3) is a variance.
        budget: of the Euclidean way from design to design, as in COPEx (2026,
            arXiv:2605.26990): a session then begins at a pair drawn from the box,
            which costs nothing, with one measurement more.
        squeezed: draws of rho and alpha once more through a logistic function and a
            softmax, and log u within 10 of 0, as COPEx's code simulates.
        particles, candidates, contrasts, moves: see ``ParticleTask.make``.
    """
    walks = budget is not None
    return ParticleTask.make(
        CES(log_u_sd=log_u_sd, walks=walks, squeezed=squeezed),
        measurements + walks,
        seconds=float("inf") if budget is None else budget,
        particles=particles,
        candidates=candidates,
        contrasts=contrasts,
        moves=moves,
    )


ENTRY = Entry(
    ces,
    about="what two baskets of goods are worth to a person",
    rules=FREE,
    methods=("random", "gain"),
    episodes=256,
)
