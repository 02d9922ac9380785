"""The readings of recorded postures, as they were sent."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.core.attitude import Array, Frame, euler_to_matrix


def recorded_frame(described: dict[str, Any], zero: dict[str, Any]) -> Frame:
    """The same from the journal: ``config`` of its start, and a zero record."""
    mounting = euler_to_matrix(described["imu"]["mounting_deg"], "ZYX")
    letters = tuple(axis["rotates"] for axis in described["axes"])
    attitude = np.array(zero["attitude"])
    return Frame(attitude, mounting, described["mechanism"]["order"], letters)


def attitudes(record: dict[str, Any]) -> Array:
    """(samples, 3, 3) of the phone in its world, of a posture's or zero's readings."""
    return Rotation.from_quat(record["quaternions"]).as_matrix()


def angles(record: dict[str, Any], frame: Frame) -> Array:
    """(samples, 3) pitch, yaw and roll in degrees of every reading."""
    return frame.angles(attitudes(record))
