"""What the robot looks like: boxes and rods, used by MuJoCo and by our own drawing.

A gimbal for any order of the axes: ring i lies in the plane of its own axis and of the
next one, so both have their bearings on it. The foot's plate hangs in the innermost
ring; the phone is strapped across it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["AXIS_COLOURS", "EYE_M", "FIELD_DEG", "Part", "parts_of", "view_axes"]

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

_RING_RADII_M = (0.21, 0.175, 0.14)  # from the base inwards
_RING_RODS = 36
_FLOOR_M = -0.30
_FLOOR_HALF_M = (0.27, 0.24)  # along x and z; the posts stand within it
AXIS_COLOURS: dict[str, Colour] = {
    "X": (0.84, 0.37, 0.0),  # pitch
    "Y": (0.0, 0.45, 0.70),  # yaw
    "Z": (0.0, 0.62, 0.45),  # roll
}
EYE_M = np.array([0.68, 0.46, 0.88])  # of whoever looks at it
FIELD_DEG = 38.0  # from the upper edge of the picture to the lower
_TARGET_M = np.array([0.0, -0.11, 0.0])
_STEEL: Colour = (0.45, 0.47, 0.50)
_PLATE: Colour = (0.75, 0.77, 0.80)
_PHONE: Colour = (0.10, 0.10, 0.12)
_SCREEN: Colour = (0.35, 0.65, 0.95)


@dataclasses.dataclass(frozen=True)
class Part:
    """A rod from ``start`` to ``end``, or a box between two opposite corners."""

    link: int  # 0 stands on the floor, 1 to 3 turn with that axis
    kind: str  # rod, box
    start: tuple[float, float, float]  # metres, from the ankle, in the link's frame
    end: tuple[float, float, float]
    radius: float  # metres, of a rod
    colour: Colour


def parts_of(mechanism_order: str) -> list[Part]:
    """Every part of a robot whose axes stand in this order from the base outwards."""
    axes = [np.eye(3)["XYZ".index(letter)] for letter in mechanism_order]
    colours = [AXIS_COLOURS[letter] for letter in mechanism_order]
    parts = _stand(axes[0])
    for link in (1, 2):
        parts += _ring(link, axes[link - 1], axes[link])
    for link in (1, 2, 3):
        inner, outer = _RING_RADII_M[link - 1], _RING_RADII_M[link - 1] + 0.045
        for side in (-1.0, 1.0):
            reach = inner + 0.012
            parts.append(
                _rod(
                    link,
                    side * (inner - 0.035) * axes[link - 1],
                    side * reach * axes[link - 1],
                    0.007,
                    colours[link - 1],
                )
            )
        # The motor, carried by the link before; of an upright first axis on its column.
        end = -axes[0] if link == 1 and abs(axes[0][1]) > 0.5 else axes[link - 1]
        parts.append(
            _rod(link - 1, (inner + 0.012) * end, outer * end, 0.022, colours[link - 1])
        )
    return parts + _foot(axes[2])


def view_axes() -> tuple[Array, Array, Array]:
    """Right, up and backwards of the camera, each (3,), in the world (y is up)."""
    back = (EYE_M - _TARGET_M) / np.linalg.norm(EYE_M - _TARGET_M)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return right, np.cross(back, right), back


def _rod(link: int, start: Array, end: Array, radius: float, colour: Colour) -> Part:
    return Part(link, "rod", _triple(start), _triple(end), radius, colour)


def _box(link: int, low: ArrayLike, high: ArrayLike, colour: Colour) -> Part:
    return Part(link, "box", _triple(low), _triple(high), 0.0, colour)


def _triple(values: ArrayLike) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 6) for v in np.asarray(values))
    return x, y, z


def _ring(link: int, first: Array, second: Array) -> list[Part]:
    """Round the bearing of its own axis outside and that of the next one inside."""
    wide, narrow = _RING_RADII_M[link - 1], _RING_RADII_M[link]
    turns = np.linspace(0.0, 2.0 * np.pi, _RING_RODS + 1)
    way = [
        (wide - 0.017) * np.cos(t) * first + (narrow + 0.017) * np.sin(t) * second
        for t in turns
    ]
    return [_rod(link, way[i], way[i + 1], 0.008, _STEEL) for i in range(_RING_RODS)]


def _stand(axis: Array) -> list[Part]:
    """A floor plate, and a post under each bearing of the first axis."""
    floor = np.array([0.0, _FLOOR_M, 0.0])
    x, z = _FLOOR_HALF_M
    parts = [_box(0, (-x, _FLOOR_M - 0.02, -z), (x, _FLOOR_M, z), _PLATE)]
    reach = _RING_RADII_M[0] + 0.03
    if abs(axis[1]) > 0.5:  # upright: one column from below, the motor hangs there
        return [*parts, _rod(0, floor, -reach * axis + [0, 0.01, 0], 0.02, _STEEL)]
    for side in (-1.0, 1.0):
        bearing = side * reach * axis
        foot = bearing * [1.0, 0.0, 1.0] + floor
        parts.append(_rod(0, foot, bearing, 0.012, _STEEL))
    return parts


def _foot(axis: Array) -> list[Part]:
    """The plate with its heel cup, hung from the innermost axis, and the phone."""
    reach = _RING_RADII_M[2] - 0.035
    parts = [
        _box(3, (-0.05, -0.06, -0.09), (0.05, -0.05, 0.13), _PLATE),
        _box(3, (-0.05, -0.05, -0.09), (0.05, 0.0, -0.08), _PLATE),
        _box(3, (-0.036, -0.05, 0.0), (0.036, -0.041, 0.12), _PHONE),
        _box(3, (-0.031, -0.041, 0.006), (0.031, -0.0395, 0.114), _SCREEN),
    ]
    sides = [(-1.0, 1.0), (1.0,), (-1.0, 1.0)][int(np.argmax(np.abs(axis)))]
    for side in sides:
        bearing = side * reach * axis
        corner = np.array([0.05, -0.055, 0.0]) * [1 if axis[0] == 0 else side, 1, 1]
        if abs(axis[0]) < 0.5:
            for lateral in (-1.0, 1.0):
                edge = corner * [lateral, 1.0, 1.0]
                edge[2] = side * 0.085 if abs(axis[2]) > 0.5 else 0.0
                parts.append(_rod(3, edge, bearing, 0.006, _PLATE))
        else:
            parts.append(_rod(3, corner, bearing, 0.006, _PLATE))
    return parts
