"""What of the robot's look depends on the order of its axes: stand, rings, bearings.

A gimbal for any order: ring i lies in the plane of its own axis and of the next one, so
both have their bearings on it. The foot's plate (``scene.xml``) hangs in the innermost
ring; the phone is strapped across it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["AXIS_COLOURS", "add_parts"]

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

_RING_RADII_M = (0.21, 0.175, 0.14)  # from the base inwards
_RING_RODS = 36
_FLOOR_M = -0.30
AXIS_COLOURS: dict[str, Colour] = {
    "X": (0.84, 0.37, 0.0),  # pitch
    "Y": (0.0, 0.45, 0.70),  # yaw
    "Z": (0.0, 0.62, 0.45),  # roll
}
_STEEL: Colour = (0.45, 0.47, 0.50)
_PLATE: Colour = (0.75, 0.77, 0.80)


def add_parts(bodies: Sequence[Any], mechanism_order: str) -> None:
    """Add every part of the robot to its link.

    Args:
        bodies: the world, then the links behind the first, second and third axis
            (``MjsBody``); coordinates are in metres from the ankle.
        mechanism_order: the axes from the base outwards, such as "YXZ".
    """
    axes = [np.eye(3)["XYZ".index(letter)] for letter in mechanism_order]
    _add_stand(bodies[0], axes[0])
    for link in (1, 2):  # outside the bearing of its own axis, inside that of the next
        wide, narrow = _RING_RADII_M[link - 1] - 0.017, _RING_RADII_M[link] + 0.017
        turns = np.linspace(0.0, 2.0 * np.pi, _RING_RODS + 1)[:, None]
        points = wide * np.cos(turns) * axes[link - 1]
        points = points + narrow * np.sin(turns) * axes[link]
        for start, end in itertools.pairwise(points):
            _rod(bodies[link], start, end, 0.008, _STEEL)
    for link, (axis, letter) in enumerate(zip(axes, mechanism_order, strict=True), 1):
        inner, colour = _RING_RADII_M[link - 1], AXIS_COLOURS[letter]
        reach = inner + 0.012
        for side in (-axis, axis):
            _rod(bodies[link], (inner - 0.035) * side, reach * side, 0.007, colour)
        # The motor, carried by the link before; that of an upright first axis sits on
        # the column below.
        end = -axis if link == 1 and axis[1] > 0.5 else axis
        _rod(bodies[link - 1], reach * end, (inner + 0.045) * end, 0.022, colour)
    _add_hangers(bodies[3], axes[2])


def _rod(body: Any, start: ArrayLike, end: Array, radius: float, rgb: Colour) -> None:
    import mujoco

    capsule, ends = mujoco.mjtGeom.mjGEOM_CAPSULE, np.append(start, end)
    body.add_geom(type=capsule, fromto=ends, size=[radius, 0, 0], rgba=[*rgb, 1.0])


def _add_stand(world: Any, axis: Array) -> None:
    """A post under each bearing of the first axis."""
    floor = np.array([0.0, _FLOOR_M, 0.0])
    bearing = (_RING_RADII_M[0] + 0.03) * axis
    if axis[1] > 0.5:  # upright: one column from below, which carries the motor
        _rod(world, floor, -bearing + [0.0, 0.01, 0.0], 0.02, _STEEL)
        return
    for side in (-bearing, bearing):
        _rod(world, side * [1.0, 0.0, 1.0] + floor, side, 0.012, _STEEL)


def _add_hangers(body: Any, axis: Array) -> None:
    """Rods from the innermost bearings to the edges of the foot's plate."""
    about = int(np.argmax(axis))
    for side in ((-1.0, 1.0), (1.0,), (-1.0, 1.0))[about]:
        bearing = side * (_RING_RADII_M[2] - 0.035) * axis
        z = side * 0.085 if about == 2 else 0.0
        for x in (side * 0.05,) if about == 0 else (-0.05, 0.05):
            _rod(body, (x, -0.055, z), bearing, 0.006, _PLATE)
