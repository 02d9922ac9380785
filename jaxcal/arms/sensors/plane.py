"""A probe at the tip that touches planes: a table, a granite plate, a wall."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.sensors.sensor import Landmarks, Reading, Tip, hats
from jaxcal.checks import Array
from jaxcal.models.model import Quantity


@dataclasses.dataclass(frozen=True, eq=False)
class Plane(Landmarks):
    """One zero a touch: the tip's height above its plane.

    A constant, such as the radius of the probe, belongs to the plane. Where the arm
    stands is not shown, so ``base`` is held. ``places`` are rows (normal x, y, z,
    distance from the origin along it). Noise 0.01 % of the arm's length.
    """

    kind = "plane"
    lengths = True
    mounting = 0.004
    outputs = ("height",)
    zeros = True
    axes = ("tilt1", "tilt2", "offset")
    axis_units = ("deg", "deg", "length")
    needed = 3
    width = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.places is not None:
            size = np.linalg.norm(self.places[:, :3], axis=1)
            if not (size > 0.0).all():
                raise ValueError("planes must have normals other than zero")
            places = np.column_stack(
                [self.places[:, :3] / size[:, None], self.places[:, 3]]
            )
            object.__setattr__(self, "places", places)

    @property
    def nominal(self) -> Array:
        offsets = self._rows()[:, 3]
        return np.column_stack([0.0 * offsets, 0.0 * offsets, offsets]).ravel()

    def _rows(self) -> Array:
        if self.places is None:
            return np.tile([0.0, 0.0, 1.0, 0.0], (self.count, 1))
        return self.places

    def usual_noise(self, length: float) -> ArrayLike:
        return 1e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        unit, by_tilt = self._normals(inputs, parameters)
        points = tip.position
        offset = parameters.reshape(-1, 3)[self.of_rows(inputs), 2]
        by_tip = np.hstack([unit, np.zeros_like(unit)])[:, None]
        by_tilts = (points[:, None] @ by_tilt)[:, 0]
        by_one = np.column_stack([by_tilts, -np.ones(len(points))])[:, None]
        values = ((unit * points).sum(axis=1) - offset)[:, None]
        return Reading(values, by_tip, self.spread(self.of_rows(inputs), by_one))

    def _normals(self, inputs: Array, parameters: Array) -> tuple[Array, Array]:
        """(N, 3) unit normals of the rows' planes, (N, 3, 2) by both tilts."""
        which = self.of_rows(inputs)
        normals = self._rows()[which, :3]
        across = np.radians(np.stack(_across(normals), axis=-1))  # (N, 3, 2)
        long = normals + (across @ parameters.reshape(-1, 3)[which, :2, None])[..., 0]
        size = np.linalg.norm(long, axis=1, keepdims=True)
        unit = long / size
        along = unit[:, None] @ across
        return unit, (across - unit[..., None] * along) / size[..., None]

    def located(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> tuple[Self, Array | None]:
        """Planes through the nominal points of touch."""
        if self.places is not None:
            return self, None
        which, rows = self.of_rows(inputs), self._rows()
        for i in range(self.count):
            points = tip.position[which == i]
            if len(points) < self.needed:
                continue
            middle = points.mean(axis=0)
            normal = np.linalg.svd(points - middle)[2][-1]
            normal = normal * (np.sign(normal[np.abs(normal).argmax()]) or 1.0)
            rows[i] = [*normal, normal @ middle]
        return dataclasses.replace(self, places=rows), None


@dataclasses.dataclass(frozen=True, eq=False)
class Flush(Plane):
    """Three zeros: a flat face at the tip lies flush on its plane.

    Height of the tip above the plane, and how far the face's normal, the tip's z axis
    of either sign, leans from the plane's, in degrees. A turn about it, ``tool rz``, is
    not shown and held, as ``base`` is. Noise 0.01 % of the arm's length, 0.1 degrees.
    """

    kind = "flush"
    lengths = False
    tool = ("x", "y", "z", "rx", "ry")
    outputs = ("height", "lean x", "lean y")  # type: ignore[assignment]  # of three
    quantities = (Quantity("length", slice(1)), Quantity("deg", slice(1, 3)))

    def usual_noise(self, length: float) -> ArrayLike:
        return [1e-4 * length, 0.1, 0.1]

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        height = super().read(tip, inputs, parameters)
        unit, by_tilt = self._normals(inputs, parameters)
        back = np.degrees(np.matrix_transpose(tip.rotation)[:, :2])  # (N, 2, 3)
        by_tip = np.zeros((len(unit), 2, 6))
        by_tip[..., 3:] = back @ hats(unit)
        by_one = np.zeros((len(unit), 2, 3))
        by_one[..., :2] = back @ by_tilt
        by_own = self.spread(self.of_rows(inputs), by_one)
        return Reading(
            np.hstack([height.values, (back @ unit[..., None])[..., 0]]),
            np.concatenate([height.by_tip, by_tip], axis=1),
            np.concatenate([height.by_own, by_own], axis=1),
        )


def _across(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors (..., 3) across unit vectors and each other."""
    least = np.eye(3)[np.abs(normals).argmin(axis=-1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(normals, first)
