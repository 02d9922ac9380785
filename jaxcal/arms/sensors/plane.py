"""A probe at the tip that touches planes: a table, a granite plate, a wall."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.arms.sensors.sensor import Landmarks, Reading, Tip

__all__ = ["Plane"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Plane(Landmarks):
    """One zero a touch: the tip's height above its plane.

    What is measured is zero; a constant, such as the radius of the probe, belongs to
    the plane. Where the arm stands is not shown, so ``base`` is held. ``places`` are
    rows (normal x, y, z, distance from the origin along it). Noise 0.01 % of the
    arm's length.
    """

    kind = "plane"
    lengths = True
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
                raise ValueError("places of planes must have normals other than zero")
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
        which, points = self.of_rows(inputs), tip.position
        normals = self._rows()[which, :3]
        first, second = _across(normals)
        tilt1, tilt2, offset = parameters.reshape(-1, 3)[which].T
        leaning = (
            np.radians(tilt1)[:, None] * first + np.radians(tilt2)[:, None] * second
        )
        long = normals + leaning
        size = np.linalg.norm(long, axis=1, keepdims=True)
        unit = long / size
        height = (unit * points).sum(axis=1)
        by_tip = np.hstack([unit, np.zeros_like(unit)])[:, None]
        level = (points - height[:, None] * unit) / size  # by the normal
        by_one = np.stack(
            [
                np.radians((level * first).sum(axis=1)),
                np.radians((level * second).sum(axis=1)),
                -np.ones(len(points)),
            ],
            axis=1,
        )[:, None]
        values = (height - offset)[:, None]
        return Reading(values, by_tip, self.spread(which, by_one))

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


def _across(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors (..., 3) across unit vectors and each other."""
    least = np.eye(3)[np.abs(normals).argmin(axis=-1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(normals, first)
