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
from scipy.spatial.transform import Rotation

from rig.config.config import RigConfig

Array = NDArray[np.float64]
DIGITS = 8  # of a quaternion: 1e-6 degrees


@dataclasses.dataclass(frozen=True)
class Reading:
    """One accepted reading on the computer's clock."""

    time: float  # monotonic seconds at which it was measured, as far as known
    value: Array  # (3, 3) of an attitude, (m,) of numbers


def euler_to_matrix(angles_deg: ArrayLike, order: str) -> Array:
    """(..., 3, 3) of (..., 3) degrees in the sequence of ``order``, such as "ZYX"."""
    return Rotation.from_euler(order, angles_deg, degrees=True).as_matrix()


def matrix_to_euler(matrix: ArrayLike, order: str) -> Array:
    """(..., 3) degrees of rotations (..., 3, 3): the middle one lies in [-90, 90], the
    others in +-180. Where it is +-90 only the sum or the difference of the others is
    determined, and any two that give it are returned. Written out: scipy's warns there,
    and takes ten times as long for one attitude."""
    i, j, k = ("XYZ".index(letter) for letter in order)
    sign = 1 if (j - i) % 3 == 1 else -1  # whether the axes are right-handed
    turned = np.asarray(matrix, dtype=np.float64)
    first_row, column_i, column_j = turned[..., i, :], turned[..., i], turned[..., j]
    second = np.arctan2(
        first_row[..., k], np.hypot(first_row[..., i], first_row[..., j])
    )
    third = np.arctan2(-first_row[..., j], first_row[..., i])
    # The middle axis after the first turn alone: it is one also where second is +-90.
    sine, cosine = np.sin(third), np.cos(third)
    first = np.arctan2(
        column_i[..., k] * sine + column_j[..., k] * cosine,
        column_i[..., j] * sine + column_j[..., j] * cosine,
    )
    return np.degrees(sign * np.stack([first, second, third], axis=-1)) + 0.0  # no -0


def angle_between_deg(first: ArrayLike, second: ArrayLike) -> float:
    """Angle in degrees of the rotation that takes one (3, 3) attitude to another."""
    turn = np.asarray(first).T @ np.asarray(second)  # for every reading: numpy is quick
    sine = 0.5 * np.linalg.norm(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0))))


@dataclasses.dataclass(frozen=True)
class AttitudeFrame:
    """From a phone's attitude to the joint angles of the mechanism.

    With W the phone's world, B the base, E the end-effector and P the phone, the stream
    gives ``R_WP = R_WB R_BE R_EP``. At the zero posture ``R_BE = I``, so
    ``R_BE = R_EP (R0^T R) R_EP^T``: heading and placement of the world cancel.
    """

    zero: Array  # (3, 3) R0, attitude of the phone in the zero posture
    mounting: Array  # (3, 3) R_EP, phone to end-effector
    order: str  # axes of the mechanism from the base outwards
    letters: tuple[str, ...]  # axis letter of each joint that there is

    def angles(self, matrix: ArrayLike) -> Array:
        """(..., n) joint angles in degrees of phone attitudes (..., 3, 3)."""
        turned = self.zero.T @ np.asarray(matrix, dtype=np.float64)
        sequence = matrix_to_euler(self.mounting @ turned @ self.mounting.T, self.order)
        return sequence[..., [self.order.index(letter) for letter in self.letters]]


def frame_at(config: RigConfig, zero: Array) -> AttitudeFrame:
    """The frame in which the (3, 3) attitude ``zero`` of the phone is the zero."""
    mounting = euler_to_matrix(config.phone.mounting_deg, "ZYX")
    return AttitudeFrame(zero, mounting, config.mechanism.order, config.letters)
