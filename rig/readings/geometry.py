"""What readings are: attitudes of a phone, or numbers; and how two of them compare.

Motion, proof and measurement know readings by these functions alone. ``scale`` is what
a degree of a phone's attitude is in the unit of the readings: that much is looked for
and allowed where nothing is proved.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rig.config.config import RigConfig
from rig.readings.attitude import (
    DIGITS,
    Array,
    AttitudeFrame,
    Reading,
    angle_between_deg,
    frame_at,
)

RADIAN = 180.0 / np.pi  # a direction's length, so that a turn of it is in degrees
UNSEEN_DEG = 15.0  # an axis this near to the vertical hardly changes the tilt


@dataclasses.dataclass(frozen=True)
class Offset:
    """Numbers less those at the zero posture."""

    zero: Array  # (m,)

    def angles(self, readings: ArrayLike) -> Array:
        return np.asarray(readings, dtype=np.float64) - self.zero


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
        upright = np.abs((zero @ frame_at(config, zero).mounting.T)[2])
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


@dataclasses.dataclass(frozen=True)
class Up:
    """Where up is in the frame of an arm's tip, less that at the zero posture."""

    zero: Array  # (3, 3)
    mounting: Array

    def of(self, readings: ArrayLike) -> Array:
        """(..., 3) of attitudes (..., 3, 3), RADIAN long."""
        rows = np.asarray(readings, dtype=np.float64)[..., 2, :]
        return RADIAN * rows @ self.mounting.T

    def angles(self, readings: ArrayLike) -> Array:
        return self.of(readings) - self.of(self.zero)


class Upright(Attitudes):
    """Attitudes of a phone on an arm: it tells how far the arm turned it, and its
    accelerometer, which no heading enters, where up is."""

    of_joints = False

    def frame(self, zero: Array) -> Up:
        return Up(zero, frame_at(self._config, zero).mounting)

    def unseen(self, zero: Array) -> list[str]:
        return [] if self._config.phone.heading == "absolute" else ["any turn"]

    def outputs(self, reading: Array, measured: Array) -> Array:
        return self.frame(reading).of(reading)


# What is measured against a zero posture: (..., m), zero at the zero.
Frame = AttitudeFrame | Up | Offset


def _slope(values: Array, minutes: Array) -> Array:
    away = minutes - minutes.mean()
    return away @ values / max(float(away @ away), 1e-12)


def geometry_of(config: RigConfig) -> Geometry:
    """The geometry of a device's readings."""
    if config.readings is None:
        return Upright(config) if config.is_arm else Attitudes(config)
    return Geometry(config.readings.scale, config.readings.unit)
