"""Where training candidates come from: ranges, shapes and masks, a pool, given sets.

Each function returns a ``Candidates``: key -> (M, n) candidates and (M,) available. The
compact network is blind to affine maps, so ranges, shear and correlation need no shape
of their own in ``mixture``; what is left is the shape of the cloud and what is masked.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcal.learning.environments import randomness
from jaxcal.learning.environments.selection import (
    Candidates,
    SelectionConfig,
    unit_cube,
)

__all__ = ["SHAPES", "from_pool", "from_sets", "mixture", "uniform"]

SHAPES = ("uniform", "gaussian", "sphere", "clustered", "grid", "cluster_uniform")


def uniform(
    config: SelectionConfig, low: Sequence[float], high: Sequence[float]
) -> Candidates:
    """Candidates uniform between ``low`` and ``high``, n numbers each."""
    lower, upper = np.asarray(low), np.asarray(high)
    if lower.shape != (config.num_inputs,) or upper.shape != (config.num_inputs,):
        raise ValueError(
            f"low and high must hold {config.num_inputs} numbers, "
            f"got {lower.shape} and {upper.shape}"
        )
    if not (lower < upper).all():
        raise ValueError(f"low must be below high on every axis, got {low} and {high}")
    unit = unit_cube(config)

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        points, available = unit(key)
        span = jnp.float32(upper - lower)
        return jnp.float32(lower)[None, :] + points * span[None, :], available

    return draw


def from_pool(
    config: SelectionConfig, pool: ArrayLike, available: ArrayLike | None = None
) -> Candidates:
    """Candidates drawn without replacement from a pool.

    Args:
        config: sizes.
        pool: (N, n) postures, N at least ``num_candidates``.
        available: (N,) bool, those that may be chosen; all when None.
    """
    postures = np.asarray(pool, np.float32)
    if postures.ndim != 2 or postures.shape[1] != config.num_inputs:
        raise ValueError(
            f"pool must have shape (N, {config.num_inputs}), got {postures.shape}"
        )
    free = np.ones(len(postures), bool) if available is None else np.asarray(available)
    keep = np.flatnonzero(free)
    if len(keep) < config.num_candidates:
        raise ValueError(
            f"pool must hold at least {config.num_candidates} postures, the "
            f"num_candidates of an episode, got {len(keep)} available"
        )
    kept = jnp.asarray(postures[keep])

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        index = jax.random.permutation(key, len(keep))[: config.num_candidates]
        return kept[index], jnp.ones(config.num_candidates, bool)

    return draw


def from_sets(
    config: SelectionConfig, sets: ArrayLike, available: ArrayLike | None = None
) -> Candidates:
    """One of the given candidate sets for every episode, each as likely.

    Args:
        config: sizes.
        sets: (B, M, n) candidates.
        available: (B, M) bool; all when None. At least ``num_selected`` in every set.
    """
    points = jnp.asarray(sets, jnp.float32)
    shape = (config.num_candidates, config.num_inputs)
    if points.ndim != 3 or points.shape[1:] != shape:
        raise ValueError(
            f"sets must have shape (B, {shape[0]}, {shape[1]}), got {points.shape}"
        )
    free = (
        np.ones(points.shape[:2], bool) if available is None else np.asarray(available)
    )
    few = np.flatnonzero(free.sum(axis=1) < config.num_selected)
    if few.size:
        raise ValueError(
            f"every set must have {config.num_selected} available candidates, "
            f"got {int(free[few[0]].sum())} in set {few[0]}"
        )
    masks = jnp.asarray(free)

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        index = jax.random.randint(key, (), 0, len(points))
        return points[index], masks[index]

    return draw


def _shape(name: str, key: jax.Array, m: int, n: int) -> jax.Array:
    """(M, n) candidates of one shape, about the size of the unit cube."""
    key_a, key_b, key_c = jax.random.split(key, 3)
    if name == "uniform":
        return randomness.uniform(key_a, (m, n))
    if name == "gaussian":
        return jax.random.normal(key_a, (m, n))
    if name == "sphere":
        points = jax.random.normal(key_a, (m, n))
        return points / jnp.linalg.norm(points, axis=-1, keepdims=True)
    if name in ("clustered", "cluster_uniform"):
        number = n + 2 if name == "clustered" else 2 * (n + 2)
        centres = jax.random.uniform(key_a, (number, n))
        which = jax.random.randint(key_b, (m,), 0, number)
        key_width, key_noise = jax.random.split(key_c)
        width = jax.random.uniform(key_width, (), minval=0.02, maxval=0.15)
        return centres[which] + width * jax.random.normal(key_noise, (m, n))
    if name == "grid":
        # Distinct nodes of a grid fine enough for M, with a little freedom in its size.
        least = 2
        while least**n < m:
            least += 1
        side = jax.random.randint(key_a, (), least, least + 3)
        nodes = jax.random.permutation(key_b, (least + 2) ** n)
        inside = nodes < side**n
        node = nodes[jnp.argsort(~inside, stable=True)[:m]]
        digits = []
        for _ in range(n):
            digits.append(node % side)
            node = node // side
        return jnp.stack(digits, axis=-1) / (side - 1)
    raise ValueError(f"shape must be one of {', '.join(SHAPES)}, got {name!r}")


def mixture(
    config: SelectionConfig, shapes: Sequence[str] = ("uniform",), masked: float = 0.0
) -> Candidates:
    """Candidates of a shape drawn at random for every episode.

    Args:
        config: sizes.
        shapes: names from ``SHAPES``; repeat one to weight it.
        masked: greatest share of candidates made unavailable; the share is uniform
            between 0 and this for every episode. At least ``num_selected + 4`` stay.
    """
    unknown = [name for name in shapes if name not in SHAPES]
    if not shapes or unknown:
        raise ValueError(
            f"shapes must name some of {', '.join(SHAPES)}, got {list(shapes)}"
        )
    if not 0.0 <= masked < 1.0:
        raise ValueError(f"masked must be in [0, 1), got {masked}")
    m, n = config.num_candidates, config.num_inputs
    unique = sorted(set(shapes), key=SHAPES.index)
    table = jnp.asarray([unique.index(name) for name in shapes])

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_which, key_points, key_share, key_mask = jax.random.split(key, 4)
        points = jnp.stack([_shape(name, key_points, m, n) for name in unique])
        which = table[jax.random.randint(key_which, (), 0, len(shapes))]
        if masked == 0.0:
            return points[which].astype(jnp.float32), jnp.ones(m, bool)
        share = masked * jax.random.uniform(key_share)
        rank = jax.random.permutation(key_mask, m)
        keep = jnp.maximum((m * (1.0 - share)).astype(int), config.num_selected + 4)
        return points[which].astype(jnp.float32), rank < keep

    return draw
