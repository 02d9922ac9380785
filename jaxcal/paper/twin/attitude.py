"""Rotations in JAX: Euler angles in any of the six orders. One posture; vmap outside.

A matrix R is (3, 3) and takes vectors of the body to the fixed frame. An order such as
``"YXZ"`` is intrinsic, outermost axis first: ``R = Ry(a) Rx(b) Rz(c)``. Angles are kept
by axis, (about x, about y, about z), whatever the order of the turns; so an order never
changes which number is pitch.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

__all__ = ["ORDERS", "angles_of", "rotation_of"]

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


def rotation_of(angles_deg: jax.Array, order: str) -> jax.Array:
    """Rotation of three angles.

    Args:
        angles_deg: (3,) degrees about x, y and z.
        order: one of ``ORDERS``, outermost turn first.

    Returns:
        (3, 3).
    """
    first, second, third = (_about(axis, angles_deg[axis]) for axis in _axes(order))
    return first @ second @ third


def angles_of(matrix: jax.Array, order: str) -> jax.Array:
    """Angles of a rotation: the inverse of ``rotation_of`` for a middle angle < 90.

    Args:
        matrix: (3, 3).
        order: one of ``ORDERS``, outermost turn first.

    Returns:
        (3,) degrees about x, y and z; that of the middle turn lies in [-90, 90].
    """
    i, j, k = _axes(order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    outer = jnp.arctan2(-sign * matrix[j, k], matrix[k, k])
    middle = jnp.arcsin(jnp.clip(sign * matrix[i, k], -1.0, 1.0))
    inner = jnp.arctan2(-sign * matrix[i, j], matrix[i, i])
    turns = {i: outer, j: middle, k: inner}
    return jnp.rad2deg(jnp.stack([turns[axis] for axis in range(3)]))


def _axes(order: str) -> tuple[int, int, int]:
    i, j, k = ("XYZ".index(letter) for letter in order)
    return i, j, k


def _about(axis: int, angle_deg: jax.Array) -> jax.Array:
    angle = jnp.deg2rad(angle_deg)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    rows = [[jnp.zeros_like(angle)] * 3 for _ in range(3)]
    rows[axis][axis] = jnp.ones_like(angle)
    rows[j][j] = rows[k][k] = cos
    rows[k][j], rows[j][k] = sin, -sin
    return jnp.stack([jnp.stack(row) for row in rows])
