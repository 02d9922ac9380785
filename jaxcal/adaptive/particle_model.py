"""Models of particles, the gain of a design and weights in logarithms."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from jaxcal.adaptive.session import Session

FLOOR = -1e6  # least log likelihood, of impossible outcomes


class ParticleModel(Protocol):
    """What is measured: a pytree with these methods, for one z and one design each.

    An outcome is a number. Where it is an array, the model says so by an attribute
    ``outcome_shape``; where its designs are the rows of a table (A, e), by their index,
    it has the table as ``commands``.
    """

    @property
    def dim(self) -> int:
        """Coordinates z."""

    @property
    def support(self) -> jax.Array | None:
        """(Y,) all outcomes where they are few; None where they are continuous."""

    def unknowns(self, z: jax.Array) -> Any:
        """The unknowns, from coordinates (d,)."""

    def predict(self, unknowns: Any, design: Any) -> Any:
        """The parameters of the outcome's distribution."""

    def log_prob(self, prediction: Any, outcome: jax.Array) -> jax.Array:
        """() log probability, or density, of an outcome."""

    def sample(self, prediction: Any, key: jax.Array) -> jax.Array:
        """() an outcome, drawn."""

    def propose(
        self, unknowns: Any, session: Session, key: jax.Array, count: int
    ) -> Any:
        """``count`` candidate designs, given draws of the unknowns, leaves (N, ...); at
        least one must cost at most ``session.seconds``, others are not chosen."""

    def cost(self, session: Session, design: Any) -> jax.Array:
        """() cost of a design, in the unit of ``session.seconds``."""


def outcome_shape(model: ParticleModel) -> tuple[int, ...]:
    """Shape of an outcome; () of a number."""
    return tuple(getattr(model, "outcome_shape", ()))


def systematic(log_weight: jax.Array, count: int, key: jax.Array) -> jax.Array:
    """(count,) int32 indices, each ``count`` times its weight often, to within one."""
    below = jnp.cumsum(jnp.exp(log_weight))
    ticks = (jnp.arange(count) + jax.random.uniform(key)) / count * below[-1]
    index = jnp.searchsorted(below, ticks, side="right")
    return jnp.minimum(index, len(log_weight) - 1).astype(jnp.int32)


def gain_of(
    model: ParticleModel, unknowns: Any, design: Any, keys: jax.Array
) -> jax.Array:
    predictions = jax.vmap(lambda u: model.predict(u, design))(unknowns)
    if model.support is None:
        outcomes = jax.vmap(model.sample)(predictions, keys)
        log_prob = jax.vmap(model.log_prob)(predictions, outcomes)
        all_of = jax.vmap(
            lambda y: jax.vmap(lambda p: model.log_prob(p, y))(predictions)
        )(outcomes)
        # Outcomes are likely under their own particle: clipping prevents overflow.
        ratio = jnp.exp(jnp.minimum(all_of - log_prob[:, None], 80.0))
        gain = -jnp.log(ratio.mean(axis=-1)).mean()
    else:
        log_p = log_prob_of_all(model, predictions)  # (n, Y)
        p = jnp.exp(log_p)
        within = (p * jnp.maximum(log_p, FLOOR)).sum(axis=-1).mean()
        mixed = p.mean(axis=0)
        gain = within - (mixed * jnp.log(mixed + 1e-30)).sum()
    return jnp.maximum(gain, 0.0)


def log_prob_of_all(model: ParticleModel, predictions: Any) -> jax.Array:
    """(n, Y) log probabilities of the outcomes ``model.support``."""
    assert model.support is not None
    by_outcome = jax.vmap(model.log_prob, in_axes=(None, 0))
    return jax.vmap(by_outcome, in_axes=(0, None))(predictions, model.support)


def log_likelihood_of(
    model: ParticleModel, unknowns: Any, design: Any, outcome: jax.Array
) -> jax.Array:
    return jnp.maximum(model.log_prob(model.predict(unknowns, design), outcome), FLOOR)


def log_prior(z: jax.Array) -> jax.Array:
    dim = z.shape[-1]
    return -0.5 * (z * z).sum(axis=-1) - 0.5 * dim * jnp.log(2.0 * jnp.pi)


def effective(log_weight: jax.Array) -> jax.Array:
    """Effective sample size of weights that need not sum to one."""
    weight = jnp.exp(log_weight - log_weight.max())
    return weight.sum() ** 2 / (weight * weight).sum()


def reweighted(log_weight: jax.Array, add: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Weights that sum to one, and the log of what they summed to."""
    total = jax.nn.logsumexp(log_weight + add)
    return log_weight + add - total, total
