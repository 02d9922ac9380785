"""What the robot looks like: boxes and rods without mass, on the links of a scene.

A gimbal for any order of the axes: ring i lies in the plane of its own axis and of the
next one, so both have their bearings on it. The foot's plate hangs in the innermost
ring; the phone is strapped across it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["AXIS_COLOURS", "add_parts", "add_view"]

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
_EYE_M = np.array([0.68, 0.46, 0.88])  # of the camera
_TARGET_M = np.array([0.0, -0.11, 0.0])
_FIELD_DEG = 38.0  # from the upper edge of the picture to the lower
_STEEL: Colour = (0.45, 0.47, 0.50)
_PLATE: Colour = (0.75, 0.77, 0.80)
_PHONE: Colour = (0.10, 0.10, 0.12)
_SCREEN: Colour = (0.35, 0.65, 0.95)


def add_view(spec: Any) -> None:
    """A camera named ``view``, a light and a white sky. The world's y axis is up."""
    import mujoco
    from scipy.spatial.transform import Rotation

    back = (_EYE_M - _TARGET_M) / np.linalg.norm(_EYE_M - _TARGET_M)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    turned = Rotation.from_matrix(np.stack([right, np.cross(back, right), back], 1))
    spec.worldbody.add_camera(
        name="view", pos=_EYE_M, quat=turned.as_quat()[[3, 0, 1, 2]], fovy=_FIELD_DEG
    )
    spec.worldbody.add_light(
        pos=[0.6, 1.5, 0.9], dir=[-0.4, -1.0, -0.6], diffuse=[0.5] * 3
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1.0] * 3,
        rgb2=[1.0] * 3,
        width=32,
        height=32,
    )
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse = [0.4] * 3, [0.3] * 3
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    visual.quality.offsamples, visual.quality.shadowsize = 4, 2048


def add_parts(bodies: Sequence[Any], mechanism_order: str) -> None:
    """Add every part of the robot to its link.

    Args:
        bodies: the world, then the links behind the first, second and third axis
            (``MjsBody``); coordinates are in metres from the ankle.
        mechanism_order: the axes from the base outwards, such as "YXZ".
    """
    axes = [np.eye(3)["XYZ".index(letter)] for letter in mechanism_order]
    _add_stand(bodies[0], axes[0])
    for link in (1, 2):
        _add_ring(bodies[link], link, axes[link - 1], axes[link])
    for link, (axis, letter) in enumerate(zip(axes, mechanism_order, strict=True), 1):
        inner, colour = _RING_RADII_M[link - 1], AXIS_COLOURS[letter]
        reach = inner + 0.012
        for side in (-axis, axis):
            _rod(bodies[link], (inner - 0.035) * side, reach * side, 0.007, colour)
        # The motor, carried by the link before; that of an upright first axis sits on
        # the column below.
        end = -axis if link == 1 and axis[1] > 0.5 else axis
        _rod(bodies[link - 1], reach * end, (inner + 0.045) * end, 0.022, colour)
    _add_foot(bodies[3], axes[2])


def _rod(body: Any, start: Array, end: Array, radius: float, colour: Colour) -> None:
    import mujoco

    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*start, *end],
        size=[radius, 0.0, 0.0],
        rgba=[*colour, 1.0],
    )


def _box(body: Any, low: ArrayLike, high: ArrayLike, colour: Colour) -> None:
    import mujoco

    first, second = np.asarray(low), np.asarray(high)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(first + second) / 2.0,
        size=np.abs(second - first) / 2.0,
        rgba=[*colour, 1.0],
    )


def _add_ring(body: Any, link: int, first: Array, second: Array) -> None:
    """Outside the bearing of the link's own axis, inside that of the next one."""
    wide, narrow = _RING_RADII_M[link - 1] - 0.017, _RING_RADII_M[link] + 0.017
    turns = np.linspace(0.0, 2.0 * np.pi, _RING_RODS + 1)[:, None]
    points = wide * np.cos(turns) * first + narrow * np.sin(turns) * second
    for start, end in itertools.pairwise(points):
        _rod(body, start, end, 0.008, _STEEL)


def _add_stand(world: Any, axis: Array) -> None:
    """A floor plate, and a post under each bearing of the first axis."""
    floor = np.array([0.0, _FLOOR_M, 0.0])
    x, z = _FLOOR_HALF_M
    _box(world, (-x, _FLOOR_M - 0.02, -z), (x, _FLOOR_M, z), _PLATE)
    bearing = (_RING_RADII_M[0] + 0.03) * axis
    if axis[1] > 0.5:  # upright: one column from below, which carries the motor
        _rod(world, floor, -bearing + [0.0, 0.01, 0.0], 0.02, _STEEL)
        return
    for side in (-bearing, bearing):
        _rod(world, side * [1.0, 0.0, 1.0] + floor, side, 0.012, _STEEL)


def _add_foot(body: Any, axis: Array) -> None:
    """The plate with its heel cup, hung from the innermost axis, and the phone."""
    _box(body, (-0.05, -0.06, -0.09), (0.05, -0.05, 0.13), _PLATE)
    _box(body, (-0.05, -0.05, -0.09), (0.05, 0.0, -0.08), _PLATE)
    _box(body, (-0.036, -0.05, 0.0), (0.036, -0.041, 0.12), _PHONE)
    _box(body, (-0.031, -0.041, 0.006), (0.031, -0.0395, 0.114), _SCREEN)
    about = int(np.argmax(axis))
    for side in ((-1.0, 1.0), (1.0,), (-1.0, 1.0))[about]:
        bearing = side * (_RING_RADII_M[2] - 0.035) * axis
        if about == 0:
            _rod(body, np.array([side * 0.05, -0.055, 0.0]), bearing, 0.006, _PLATE)
            continue
        for x in (-0.05, 0.05):
            edge = np.array([x, -0.055, side * 0.085 if about == 2 else 0.0])
            _rod(body, edge, bearing, 0.006, _PLATE)
