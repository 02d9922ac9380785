"""Bounds on the information that sessions gained: from below and from above.

The information of a history h about its truth is ``log p(h | truth) - log p(h)``, and
p(h) is an average over the unknown. Contrasts z_1..z_L from a proposal q estimate it:
their average of ``p(h | z) p(z) / q(z)`` bounds the information from above, and with
the truth among the contrasts from below (Foster et al. 2020, 2021).

``spce`` draws contrasts from the prior (sPCE below, sNMC above): it cannot report more
than ``log(L + 1)``. ``sace`` draws them from the posterior, fitted by particles to each
history: its bounds meet. On a grid ``Episodes.entropy_drop`` is exact, without either.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxcal.adaptive.episodes import Episodes
from jaxcal.adaptive.particles import ParticleBelief, ParticleTask
from jaxcal.adaptive.session import jit_by_class
from jaxcal.checks import whole_number

__all__ = ["Bounds", "sace", "spce"]

_CHUNK = 4096  # contrasts at a time
_PRIOR = 0.05  # prior's share of the proposal; it bounds posterior / proposal
_NEAREST = 32  # particles from which each kernel's covariance is estimated


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Nats of B sessions, from below and above, session by session."""

    lower: NDArray[np.float64]  # (B,)
    upper: NDArray[np.float64]  # (B,)
    cap: float  # what the lower bound cannot exceed; inf where there is no cap

    @property
    def mean(self) -> tuple[float, float]:
        """The lower and the upper bound of the expected information."""
        return float(self.lower.mean()), float(self.upper.mean())

    @property
    def error(self) -> tuple[float, float]:
        """The standard errors of :attr:`mean`."""
        root = np.sqrt(len(self.lower))
        return (
            float(self.lower.std(ddof=1) / root),
            float(self.upper.std(ddof=1) / root),
        )


def spce(
    task: ParticleTask, episodes: Episodes, key: jax.Array, contrasts: int = 24 * _CHUNK
) -> Bounds:
    """sPCE from below and sNMC from above, with contrasts from the prior.

    Args:
        task: that was played.
        episodes: B sessions.
        key: of the contrasts, which are drawn anew for each session.
        contrasts: L, a multiple of 4,096 or below it.

    Raises:
        ValueError: it is neither.
    """
    chunk = min(_CHUNK, whole_number("contrasts", contrasts, 1))
    if contrasts % chunk:
        raise ValueError(
            f"contrasts must be below {_CHUNK} or a multiple of it, got {contrasts}"
        )
    found = _spce(task, episodes, key, chunk, contrasts // chunk)
    return _bounds(found, float(np.log(contrasts + 1)))


def sace(
    task: ParticleTask,
    episodes: Episodes,
    key: jax.Array,
    *,
    contrasts: int = 8192,
    particles: int = 8192,
    moves: int = 6,
) -> Bounds:
    """Bounds that meet, with contrasts from each session's posterior.

    Args:
        task: that was played.
        episodes: B sessions.
        key: of particles and contrasts.
        contrasts: L for each session.
        particles: of the fit of the posterior, in place of the task's number.
        moves: Metropolis steps of the particles at each resampling, likewise.
    """
    finer = dataclasses.replace(task, num_particles=particles, num_moves=moves)
    return _bounds(_sace(finer, episodes, key, contrasts), np.inf)


def _bounds(found: tuple[jax.Array, jax.Array], cap: float) -> Bounds:
    lower, upper = (np.asarray(values, np.float64) for values in found)
    return Bounds(lower, upper, cap)


def _observed(task: ParticleTask, episode: Episodes) -> ParticleBelief:
    """A belief with the history of one session; its particles are void (zeros)."""
    belief, _ = jax.eval_shape(task.begin, jax.random.key(0))
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), belief)
    return dataclasses.replace(
        empty,
        designs=episode.designs,
        answers=episode.outcomes,
        made=episode.alive.sum().astype(jnp.int32),
        model=task.model,
    )


@functools.partial(jit_by_class, static_argnums=(3, 4))
def _spce(
    task: ParticleTask, episodes: Episodes, key: jax.Array, chunk: int, chunks: int
) -> tuple[jax.Array, jax.Array]:
    def one(given: Any) -> tuple[jax.Array, jax.Array]:
        episode, key = given
        observed = _observed(task, episode)
        own = observed._history(episode.truth[None])[0]

        def add(total: jax.Array, key: jax.Array) -> tuple[jax.Array, None]:
            z = jax.random.normal(key, (chunk, task.model.dim))
            return jnp.logaddexp(total, jax.nn.logsumexp(observed._history(z))), None

        total, _ = jax.lax.scan(
            add, jnp.asarray(-jnp.inf), jax.random.split(key, chunks)
        )
        count = float(chunk * chunks)
        lower = own - jnp.logaddexp(total, own) + jnp.log(count + 1.0)
        return lower, own - total + jnp.log(count)

    keys = jax.random.split(key, len(episodes.truth))
    return jax.lax.map(one, (episodes, keys))


@functools.partial(jit_by_class, static_argnums=(3,))
def _sace(
    task: ParticleTask, episodes: Episodes, key: jax.Array, contrasts: int
) -> tuple[jax.Array, jax.Array]:
    def one(given: Any) -> tuple[jax.Array, jax.Array]:
        episode, key = given
        key_begin, key_fit, key_draws = jax.random.split(key, 3)
        observed = _observed(task, episode)
        begun, _ = task.begin(key_begin)

        def measured(belief: ParticleBelief, now: Any) -> tuple[ParticleBelief, None]:
            design, outcome, alive, key = now
            after = belief.update(task, design, outcome, key)
            return jax.tree.map(
                lambda old, new: jnp.where(alive, new, old), belief, after
            ), None

        keys = jax.random.split(key_fit, len(episode.alive))
        belief, _ = jax.lax.scan(
            measured, begun, (episode.designs, episode.outcomes, episode.alive, keys)
        )
        key_kernels, key_draws = jax.random.split(key_draws)
        centres, roots = _kernels(belief, key_kernels)
        z = _draw(centres, roots, contrasts, key_draws)

        def joint(z: jax.Array) -> jax.Array:
            prior = -0.5 * (z * z).sum(axis=-1)  # without its constant, as below
            return observed._history(z) + prior - _log_proposal(z, centres, roots)

        own = observed._history(episode.truth[None])[0]
        truth, others = joint(episode.truth[None])[0], joint(z)
        lower = own - _log_mean(jnp.append(others, truth))
        return lower, own - _log_mean(others)

    keys = jax.random.split(key, len(episodes.truth))
    return jax.lax.map(one, (episodes, keys))


def _kernels(belief: ParticleBelief, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A mixture for the posterior: centres (M, d), roots of their covariances.

    Each kernel has the shape of the particles nearest to its centre, so that it follows
    a posterior of several thin parts.
    """
    dim = belief.z.shape[1]
    count = min(256, len(belief.z))
    key_centres, key_all = jax.random.split(key)
    centres = belief.draws(count, key_centres)
    all_of = belief.draws(len(belief.z), key_all)
    scale = all_of.std(axis=0) + 1e-6
    squared = (((centres[:, None] - all_of[None]) / scale[None, None]) ** 2).sum(
        axis=-1
    )
    nearest = all_of[jax.lax.top_k(-squared, _NEAREST)[1]]  # (M, n, d)
    apart = nearest - nearest.mean(axis=1, keepdims=True)
    covariance = jnp.einsum("mni,mnj->mij", apart, apart) / _NEAREST
    least = 1e-6 * jnp.einsum("mii->m", covariance) / dim + 1e-12
    covariance = covariance + least[:, None, None] * jnp.eye(dim)[None]
    return centres, jnp.linalg.cholesky(covariance)


def _draw(
    centres: jax.Array, roots: jax.Array, count: int, key: jax.Array
) -> jax.Array:
    key_which, key_normal, key_prior = jax.random.split(key, 3)
    which = jax.random.randint(key_which, (count,), 0, len(centres))
    normal = jax.random.normal(key_normal, (count, centres.shape[1]))
    near = centres[which] + jnp.einsum("lij,lj->li", roots[which], normal)
    prior = jax.random.uniform(key_prior, (count, 1)) < _PRIOR
    return jnp.where(prior, normal, near)


def _log_proposal(z: jax.Array, centres: jax.Array, roots: jax.Array) -> jax.Array:
    """(L,) log density of the mixture, without the normal law's constant."""
    inverse = jax.vmap(
        lambda root: jax.scipy.linalg.solve_triangular(
            root, jnp.eye(len(root)), lower=True
        )
    )(roots)
    apart = z[:, None] - centres[None]
    normal = jnp.einsum("mij,lmj->lmi", inverse, apart)
    log_det = jnp.log(jnp.abs(jnp.einsum("mii->mi", roots))).sum(axis=-1)
    kernels = _log_mean(-0.5 * (normal * normal).sum(axis=-1) - log_det[None])
    prior = -0.5 * (z * z).sum(axis=-1)
    return jnp.logaddexp(
        kernels + jnp.log1p(-_PRIOR), prior + jnp.log(jnp.asarray(_PRIOR))
    )


def _log_mean(values: jax.Array) -> jax.Array:
    """Log of the mean over the last axis of values that are given by their logs."""
    return jax.nn.logsumexp(values, axis=-1) - jnp.log(float(values.shape[-1]))
