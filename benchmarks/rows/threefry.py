"""The hash of ``jax.random.uniform``, unrolled: what random numbers cost at least.

Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As Easy as 1, 2, 3, SC 2011.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

__all__ = ["uniform"]

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def uniform(key: jax.Array, count: int) -> jax.Array:
    """(count,) float32 in [0, 1), those of ``jax.random.uniform(key, (count,))``."""
    words = jax.random.key_data(key)
    keys = (words[0], words[1], words[0] ^ words[1] ^ jnp.uint32(_PARITY))
    x_1 = jax.lax.iota(jnp.uint32, count)
    x_0, x_1 = jnp.zeros_like(x_1) + keys[0], x_1 + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            x_0 = x_0 + x_1
            left = x_1 << jnp.uint32(rotation)
            x_1 = x_0 ^ (left | (x_1 >> jnp.uint32(32 - rotation)))
        x_0 = x_0 + keys[(group + 1) % 3]
        x_1 = x_1 + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    # 23 random bits below the exponent of one: uniform in [1, 2).
    mantissa = ((x_0 ^ x_1) >> jnp.uint32(9)) | jnp.uint32(0x3F800000)
    return jax.lax.bitcast_convert_type(mantissa, jnp.float32) - jnp.float32(1.0)
