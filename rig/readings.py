"""The raw data of a record: the quaternion and the stamp of every reading.

All else a record says of the phone is derived from them, so a wrong order, sign or
mounting that is found later needs no new recording. Runs of version 1 kept the angles
of every reading (``raw_deg``); their attitudes follow from those.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.attitude import Array, Frame, euler_to_matrix, mean_rotation
from rig.config.config import RigConfig
from rig.device.stream import Reading

DIGITS = 8  # of a quaternion: 1e-6 degrees


def raw_fields(readings: Sequence[Reading]) -> dict[str, Any]:
    """``quaternions`` (samples, 4), x y z w, and ``stamps`` (samples,), Unix time."""
    turns = Rotation.from_matrix([reading.matrix for reading in readings])
    clock = time.time() - time.monotonic()
    return {
        "quaternions": turns.as_quat(canonical=True).round(DIGITS).tolist(),
        "stamps": [round(reading.time + clock, 4) for reading in readings],
    }


def frame_at(config: RigConfig, zero: Array) -> Frame:
    """The frame in which the (3, 3) attitude ``zero`` of the phone is the zero."""
    mounting = euler_to_matrix(config.imu.mounting_deg, "ZYX")
    return Frame(zero, mounting, config.mechanism.order, config.letters)


def recorded_frame(described: dict[str, Any], zero: dict[str, Any]) -> Frame:
    """The same from the journal: ``config`` of its start, and a zero record."""
    mounting = euler_to_matrix(described["imu"]["mounting_deg"], "ZYX")
    a, b, c = (axis["letter"] for axis in described["axes"])
    attitude = np.array(zero["attitude"])
    return Frame(attitude, mounting, described["mechanism_order"], (a, b, c))


def attitudes(record: dict[str, Any], frame: Frame) -> Array:
    """(samples, 3, 3) of the phone in its world, of a posture's or zero's readings.

    Args:
        record: of any version.
        frame: in which it was measured; only version 1 needs it.
    """
    if "quaternions" in record:
        return Rotation.from_quat(record["quaternions"]).as_matrix()
    turned = frame.matrix(record["raw_deg"])  # right but for a fixed turn of the world
    return np.array(record["attitude"]) @ mean_rotation(turned).T @ turned


def angles(record: dict[str, Any], frame: Frame) -> Array:
    """(samples, 3) pitch, yaw and roll in degrees of every reading."""
    return frame.angles(attitudes(record, frame))
