"""Trackers and motion capture: position, and orientation, of the tool."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.sensors.sensor import AXES, Reading, Sensor, Tip, hats
from jaxcal.checks import Array
from jaxcal.models.model import Quantity


@dataclasses.dataclass(frozen=True, eq=False)
class Position(Sensor):
    """x, y, z of the tip in the measuring frame; noise 0.01 % of the arm's length."""

    kind = "position"
    positions = True
    lengths = True
    outputs = ("x", "y", "z")
    misfit = 3e-4

    def usual_noise(self, length: float) -> ArrayLike:
        return 1e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        count = len(tip.position)
        by_tip = np.broadcast_to(np.eye(3, 6), (count, 3, 6))
        return Reading(tip.position, by_tip, np.zeros((count, 3, 0)))


@dataclasses.dataclass(frozen=True, eq=False)
class Pose(Sensor):
    """Position, and the turn from the nominal orientation as a vector in degrees.

    The vector is in the measuring frame; ``SerialChain.rotation_vectors`` makes it
    from measured rotation matrices. Noise 0.01 % of the arm's length, 0.006 degrees.
    """

    kind = "pose"
    positions = True
    relative = True
    tool = outputs = AXES
    quantities = (Quantity("length", slice(3)), Quantity("deg", slice(3, 6)))

    def usual_noise(self, length: float) -> ArrayLike:
        return [1e-4 * length] * 3 + [float(np.degrees(1e-4))] * 3

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        turn = tip.rotation @ np.matrix_transpose(tip.nominal())
        vector = np.asarray(Rotation.from_matrix(turn).as_rotvec())
        by_tip = np.zeros((len(vector), 6, 6))
        by_tip[:, :3, :3] = np.eye(3)
        by_tip[:, 3:, 3:] = np.degrees(rotation_vector_rate(vector))
        values = np.hstack([tip.position, np.degrees(vector)])
        return Reading(values, by_tip, np.zeros((len(vector), 6, 0)))


def rotation_vector_rate(vector: Array) -> Array:
    """(N, 3, 3) derivative of rotation vectors r (N, 3), radians, by a turn w.

    ``exp(r + dr) = exp(w) exp(r)`` to first order, dr this matrix times w.
    """
    angle = np.linalg.norm(vector, axis=-1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    factor = 1.0 / safe**2 - 1.0 / (2.0 * safe * np.tan(safe / 2.0))
    factor = np.where(small, 1.0 / 12.0, factor)[:, None, None]
    hat = hats(vector)
    return np.eye(3) - 0.5 * hat + factor * (hat @ hat)
