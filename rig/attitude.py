"""Rotations: Euler angles in any of the six orders, zero reference, means.

A matrix R is (3, 3) and takes vectors of the body to the fixed frame. An order such as
``"ZXY"`` is intrinsic, outermost axis first: ``R = Rz(a) Rx(b) Ry(c)``. A chain of
three joints whose axes stand in that order reads exactly its joint angles in that
order, and no other; a wrong order leaves degrees of error no calibration removes.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
_INDEX = {"X": 0, "Y": 1, "Z": 2}


def _indices(order: str) -> tuple[int, int, int, float]:
    if order not in ORDERS:
        raise ValueError(f"order must be one of {', '.join(ORDERS)}, got {order!r}")
    i, j, k = (_INDEX[letter] for letter in order)
    return i, j, k, 1.0 if (j - i) % 3 == 1 else -1.0


def _about(axis: int, angle: Array) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.zeros((*angle.shape, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1.0
    matrix[..., j, j] = matrix[..., k, k] = cos
    matrix[..., k, j], matrix[..., j, k] = sin, -sin
    return matrix


def euler_to_matrix(angles_deg: ArrayLike, order: str) -> Array:
    """Rotation of three angles.

    Args:
        angles_deg: (..., 3) degrees, in the sequence of ``order``.
        order: one of ``ORDERS``, outermost axis first.

    Returns:
        (..., 3, 3).
    """
    i, j, k, _ = _indices(order)
    angles = np.radians(np.asarray(angles_deg, dtype=np.float64))
    return (
        _about(i, angles[..., 0])
        @ _about(j, angles[..., 1])
        @ _about(k, angles[..., 2])
    )


def matrix_to_euler(matrix: ArrayLike, order: str) -> Array:
    """Angles of a rotation; the middle one lies in [-90, 90], the others in +-180.

    Args:
        matrix: (..., 3, 3).
        order: one of ``ORDERS``, outermost axis first.

    Returns:
        (..., 3) degrees, in the sequence of ``order``.
    """
    i, j, k, sign = _indices(order)
    r = np.asarray(matrix, dtype=np.float64)
    outer = np.arctan2(-sign * r[..., j, k], r[..., k, k])
    middle = np.arcsin(np.clip(sign * r[..., i, k], -1.0, 1.0))
    inner = np.arctan2(-sign * r[..., i, j], r[..., i, i])
    return np.degrees(np.stack([outer, middle, inner], axis=-1))


def quaternion_to_matrix(quaternion: ArrayLike) -> Array:
    """(..., 3, 3) rotation of (..., 4) quaternions x, y, z, w of any nonzero length."""
    q = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def small_rotation(vector_deg: ArrayLike) -> Array:
    """(3, 3) rotation by ``|vector|`` degrees about a (3,) vector."""
    vector = np.radians(np.asarray(vector_deg, dtype=np.float64))
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    axis = vector / angle
    return quaternion_to_matrix([*(axis * np.sin(angle / 2)), np.cos(angle / 2)])


def angle_between_deg(first: ArrayLike, second: ArrayLike) -> float:
    """Angle in degrees of the rotation that takes one (3, 3) attitude to another."""
    turn = np.asarray(first, dtype=np.float64).T @ np.asarray(second, dtype=np.float64)
    sine = 0.5 * np.linalg.norm(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0))))


def mean_rotation(matrices: ArrayLike) -> Array:
    """Rotation nearest to all of (N, 3, 3), N >= 1; indifferent to any 0/360 wrap."""
    u, _, vt = np.linalg.svd(np.asarray(matrices, dtype=np.float64).mean(axis=0))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


@dataclasses.dataclass(frozen=True)
class Frame:
    """From a phone's attitude to the joint angles of the mechanism.

    With W the phone's world, B the base, E the end-effector and P the phone, the stream
    gives ``R_WP = R_WB R_BE R_EP``. At the zero posture ``R_BE = I``, so
    ``R_BE = R_EP (R0^T R) R_EP^T``: heading and placement of the world cancel.
    """

    zero: Array  # (3, 3) R0, attitude of the phone in the zero posture
    mounting: Array  # (3, 3) R_EP, phone to end-effector
    order: str  # axes of the mechanism from the base outwards
    letters: tuple[str, str, str]  # axis letter of pitch, yaw and roll

    def relative(self, matrix: ArrayLike) -> Array:
        """(..., 3, 3) attitude of the end-effector against the zero posture."""
        turned = self.zero.T @ np.asarray(matrix, dtype=np.float64)
        return self.mounting @ turned @ self.mounting.T

    def angles(self, matrix: ArrayLike, order: str | None = None) -> Array:
        """(..., 3) pitch, yaw and roll in degrees of phone attitudes (..., 3, 3)."""
        order = order or self.order
        sequence = matrix_to_euler(self.relative(matrix), order)
        return sequence[..., [order.index(letter) for letter in self.letters]]
