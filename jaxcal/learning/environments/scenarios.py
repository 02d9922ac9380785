"""Where training candidates come from: shapes and masks, a pool, given sets.

Each function returns a ``CandidateSource``. The compact network is invariant to affine
maps, so ``mixture`` varies only the shape of the cloud and what is masked.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcal.learning.config import SHAPES
from jaxcal.learning.environments.selection import (
    CandidateSource,
    SelectionConfig,
    uniform,
)

__all__ = ["SHAPES", "given", "mixture"]


def given(
    config: SelectionConfig, sets: ArrayLike, available: ArrayLike | None = None
) -> CandidateSource:
    """A given set, drawn for every episode; of a single set (a pool), M of its rows.

    ``sets`` (B, M, n) with ``available`` (B, M) bool, all when None; or (1, N, n), of
    which every episode draws M that are available, without replacement.
    """
    points = np.asarray(sets, np.float32)
    masks = np.ones(points.shape[:2], bool) if available is None else available
    masks = np.asarray(masks, bool)
    pool, m = len(points) == 1, config.num_candidates
    least, wanted = int(masks.sum(axis=1).min()), m if pool else config.num_selected
    if least < wanted:
        name = "num_candidates" if pool else "num_selected"
        raise ValueError(
            f"every set must have at least {name} = {wanted} available candidates, "
            f"got {least}"
        )
    if pool:
        points, masks = points[masks][None], np.ones((1, least), bool)
    kept, free = jnp.asarray(points), jnp.asarray(masks)

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        if pool:
            index = jax.random.permutation(key, least)[:m]
            return kept[0, index], free[0, index]
        index = jax.random.randint(key, (), 0, len(kept))
        return kept[index], free[index]

    return draw


def _shape(name: str, key: jax.Array, m: int, n: int) -> jax.Array:
    if name == "uniform":
        return uniform(key, (m, n))
    if name == "gaussian":
        return jax.random.normal(key, (m, n))
    key_a, key_b, key_c = jax.random.split(key, 3)
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
    # "grid": M distinct nodes of a grid with ``least`` to ``least + 2`` nodes per axis.
    least = next(side for side in itertools.count(2) if side**n >= m)
    side = jax.random.randint(key_a, (), least, least + 3)
    nodes = jax.random.permutation(key_b, (least + 2) ** n)
    inside = nodes < side**n
    node = nodes[jnp.argsort(~inside, stable=True)[:m]]
    digits = []
    for _ in range(n):
        digits.append(node % side)
        node = node // side
    return jnp.stack(digits, axis=-1) / (side - 1)


def mixture(
    config: SelectionConfig, shapes: Sequence[str] = ("uniform",), masked: float = 0.0
) -> CandidateSource:
    """Candidates of a shape drawn at random for every episode.

    ``shapes`` are from ``SHAPES``, a repeated one weighs more. The share of candidates
    made unavailable is uniform between 0 and ``masked``; at least ``num_selected + 4``
    stay.
    """
    unknown = [name for name in shapes if name not in SHAPES]
    if not shapes or unknown:
        raise ValueError(f"shapes must be from {', '.join(SHAPES)}, got {list(shapes)}")
    if not 0.0 <= masked < 1.0:
        raise ValueError(f"masked must be in [0, 1), got {masked}")
    m, n = config.num_candidates, config.num_inputs
    unique = sorted(set(shapes), key=SHAPES.index)
    table = jnp.asarray([unique.index(name) for name in shapes])

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        if len(unique) == 1 and masked == 0.0:  # nothing else is random
            points = _shape(unique[0], key, m, n).astype(jnp.float32)
            return points, jnp.ones(m, bool)
        key_which, key_points, key_share, key_mask = jax.random.split(key, 4)
        clouds = [_shape(name, key_points, m, n).astype(jnp.float32) for name in unique]
        points = clouds[0]
        if len(clouds) > 1:
            which = table[jax.random.randint(key_which, (), 0, len(shapes))]
            points = jnp.stack(clouds)[which]
        if masked == 0.0:
            return points, jnp.ones(m, bool)
        share = masked * jax.random.uniform(key_share)
        rank = jax.random.permutation(key_mask, m)
        keep = jnp.maximum((m * (1.0 - share)).astype(int), config.num_selected + 4)
        return points, rank < keep

    return draw
