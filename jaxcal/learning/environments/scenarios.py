"""Where training candidates come from: shapes of candidate sets, and masks.

The compact network is blind to affine maps, so ranges, shear and correlation need no
scenario of their own; what is left is the shape of the cloud and what is masked.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxcal.learning.environments import randomness
from jaxcal.learning.environments.selection import Candidates, SelectionConfig

__all__ = ["SHAPES", "mixture"]

SHAPES = ("uniform", "gaussian", "sphere", "clustered", "grid", "cluster_uniform")


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
