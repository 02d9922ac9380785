"""What readings are: attitudes of a phone, or numbers; and how two of them compare.

A matrix R is (3, 3) and takes vectors of the body to the fixed frame. An order such as
``"ZXY"`` is intrinsic, outermost axis first: ``R = Rz(a) Rx(b) Ry(c)``. A chain of
three joints whose axes stand in that order reads exactly its joint angles in that
order, and no other; a wrong order leaves degrees of error no calibration removes.

Motion, proof and measurement know readings by a ``Geometry`` alone. Its ``scale`` is
what a degree of a phone's attitude is in the unit of the readings: that much is looked
for and allowed where nothing is proved.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rig.config.config import RigConfig

Array = NDArray[np.float64]
DIGITS = 8  # of a quaternion: 1e-6 degrees
RADIAN = 180.0 / np.pi  # a direction's length, so that a turn of it is in degrees
UNSEEN_DEG = 15.0  # an axis this near to the vertical hardly changes the tilt


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


def mounting_of(config: RigConfig) -> Array:
    """(3, 3) phone to end-effector."""
    return euler_to_matrix(config.phone.mounting_deg, "ZYX")


def frame_at(config: RigConfig, zero: Array) -> AttitudeFrame:
    """The frame in which the (3, 3) attitude ``zero`` of the phone is the zero."""
    order, letters = config.mechanism.order, config.letters
    return AttitudeFrame(zero, mounting_of(config), order, letters)


@dataclasses.dataclass(frozen=True)
class Offset:
    """Numbers, or where up is, less those at the zero posture."""

    zero: Array  # (m,), or (3, 3) of a phone
    of: Callable[[ArrayLike], Array] = np.asarray

    def angles(self, readings: ArrayLike) -> Array:
        return self.of(readings) - self.of(self.zero)


class Geometry:
    """What readings are: (m,) vectors here, whose ways are their differences."""

    told = "the readings changed by"  # how far it moved, in words before the figure
    changed = "changed the readings by"  # the same of an axis that moved it,
    again = "changed them by"  # and once that is said
    of_joints = False  # what is measured are angles of the joints, by the axes' names

    def __init__(self, scale: float, unit: str = "") -> None:
        self.scale, self.unit = scale, unit  # and of the figure

    def apart(self, first: ArrayLike, second: ArrayLike) -> float:
        """How far one reading is from another."""
        return float(np.linalg.norm(np.subtract(second, first)))

    def too_far(self, way: float, most: float) -> str:
        """A sentence that what is read moved further than it may."""
        return (
            f"the readings changed by {way:.3g} in a move that may change them by "
            f"{most:.3g}. Check pulses_per_rev, reduction and lead_mm, and the sensor"
        )

    def way(self, first: Array, second: Array) -> Array:
        """(3,) or (m,) from one reading to another, as the first one sees it."""
        return second - first

    def mean(self, readings: Sequence[Array]) -> Array:
        """The mean of several readings."""
        return np.mean(readings, axis=0)

    def frame(self, zero: Array) -> Frame:
        """What is measured where ``zero`` was read at the zero posture."""
        return Offset(zero)

    def aligned(self, then: Array, now: Array) -> Array:
        """``now`` without what readings do not tell, such as a phone's heading, as near
        to ``then`` as that can be."""
        return now

    def unseen(self, zero: Array) -> list[str]:
        """Names of the axes of which a move at the zero posture cannot be seen."""
        return []

    def outputs(self, reading: Array, measured: Array) -> Array:
        """(m,) what a model predicts, of a reading and what it is against the zero."""
        return reading

    def raw(self, readings: Sequence[Reading]) -> dict[str, Any]:
        """Every single reading, for the journal."""
        return {"readings": [reading.value.tolist() for reading in readings]}

    def drift(self, readings: Array, minutes: Array) -> Array:
        """Rate per minute of readings of one posture, by a straight line."""
        return _slope(readings, minutes)

    def without(self, reading: Array, rate: ArrayLike, minutes: float) -> Array:
        """A reading without what drifted since."""
        return reading - minutes * np.asarray(rate)


class Attitudes(Geometry):
    """(3, 3) matrices, phone to its world; ways are rotation vectors in degrees."""

    told = "the phone turned"
    changed, again = "turned the phone by", "turned it by"
    of_joints = True

    def __init__(self, config: RigConfig) -> None:
        super().__init__(1.0, "deg")
        self._config = config

    apart = staticmethod(angle_between_deg)

    def too_far(self, way: float, most: float) -> str:
        return (
            f"the phone turned {way:.1f} deg in a move that may turn it {most:.1f} "
            "deg. Check pulses_per_rev and reduction, and that the phone is fixed"
        )

    def way(self, first: Array, second: Array) -> Array:
        return Rotation.from_matrix(first.T @ second).as_rotvec(degrees=True)

    def mean(self, readings: Sequence[Array]) -> Array:
        """Rotation nearest to all of (N, 3, 3), N >= 1; indifferent to a 0/360 wrap."""
        return Rotation.from_matrix(readings).mean().as_matrix()

    def frame(self, zero: Array) -> Frame:
        return frame_at(self._config, zero)

    def heading_turn(self, then: Array, now: Array) -> Array:
        """(3, 3) turn about the vertical that takes ``now`` nearest to ``then``; none
        where the heading can be trusted."""
        if self._config.phone.heading == "absolute":
            return np.eye(3)
        _, _, z, w = Rotation.from_matrix(now @ then.T).as_quat()
        quat = [0.0, 0.0, -z, w] if z or w else [0, 0, 0, 1]
        return Rotation.from_quat(quat).as_matrix()

    def aligned(self, then: Array, now: Array) -> Array:
        return self.heading_turn(then, now) @ now

    def unseen(self, zero: Array) -> list[str]:
        config = self._config
        if config.phone.heading == "absolute":
            return []
        upright = np.abs((zero @ mounting_of(config).T)[2])
        least = np.cos(np.radians(UNSEEN_DEG))
        pairs = zip(config.axis_names, config.letters, strict=True)
        return [name for name, letter in pairs if upright["XYZ".index(letter)] > least]

    def outputs(self, reading: Array, measured: Array) -> Array:
        return measured

    def raw(self, readings: Sequence[Reading]) -> dict[str, Any]:
        """``quaternions`` (samples, 4), x y z w; Unix ``stamps`` (samples,)."""
        turns = Rotation.from_matrix([reading.value for reading in readings])
        clock = time.time() - time.monotonic()
        return {
            "quaternions": turns.as_quat(canonical=True).round(DIGITS).tolist(),
            "stamps": [round(reading.time + clock, 4) for reading in readings],
        }

    def drift(self, readings: Array, minutes: Array) -> Array:
        """Drift of the phone's world: a heading that drifts turns that."""
        turned = Rotation.from_matrix(readings @ readings[0].T)
        return _slope(turned.as_rotvec(degrees=True), minutes)

    def without(self, reading: Array, rate: ArrayLike, minutes: float) -> Array:
        back = Rotation.from_rotvec(-minutes * np.asarray(rate), degrees=True)
        return back.as_matrix() @ reading


class Upright(Attitudes):
    """Attitudes of a phone on an arm: it tells how far the arm turned it, and its
    accelerometer, which no heading enters, where up is."""

    of_joints = False

    def frame(self, zero: Array) -> Offset:
        return Offset(zero, self._up)

    def unseen(self, zero: Array) -> list[str]:
        return [] if self._config.phone.heading == "absolute" else ["any turn"]

    def outputs(self, reading: Array, measured: Array) -> Array:
        return self._up(reading)

    def _up(self, readings: ArrayLike) -> Array:
        """(..., 3) where up is in the tip's frame, RADIAN long, of attitudes."""
        rows = np.asarray(readings, dtype=np.float64)[..., 2, :]
        return RADIAN * rows @ mounting_of(self._config).T


# What is measured against a zero posture: (..., m), zero at the zero.
Frame = AttitudeFrame | Offset


def _slope(values: Array, minutes: Array) -> Array:
    away = minutes - minutes.mean()
    return away @ values / max(float(away @ away), 1e-12)


def geometry_of(config: RigConfig) -> Geometry:
    """The geometry of a device's readings."""
    if config.readings is None:
        return Upright(config) if config.is_arm else Attitudes(config)
    return Geometry(config.readings.scale, config.readings.unit)
