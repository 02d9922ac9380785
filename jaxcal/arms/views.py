"""Postures from which a camera sees a board."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.arms.sensors import Board
from jaxcal.checks import array_of, in_words, numbers

if TYPE_CHECKING:
    from jaxcal.arms.chain import SerialChain as Chain

Array = NDArray[np.float64]

STEPS = 80  # of the inverse kinematics
_VIEW = np.cos(np.radians(25.0))  # of the board from the camera's axis, and its face
_FOCAL = 1.12  # times: focal lengths are known to a tenth, and arms are off
_EDGE = 0.02  # of the picture's width, that the board stays away from its edge
_FILLED = (0.25, 0.8)  # of the picture's width by the board, where no distance is given
_TILT = 45.0  # degrees, where none is given
_SIDES = {"+z": 1.0, "-z": -1.0}


@dataclasses.dataclass(frozen=True)
class View:
    """What a camera must see of a board for its picture to be of use."""

    camera: Array  # (6,) width, height, fx, fy, cx, cy
    distance: tuple[float, float] | None  # of the board's middle from the camera
    tilt: float  # degrees, between the board's face and the way to the camera
    side: float  # 1: seen from where the board's z points, -1 from behind, 0 either

    @classmethod
    def of(
        cls,
        camera: ArrayLike,
        distance: Sequence[float] | None,
        tilt: float | None,
        side: str | None,
    ) -> View:
        """From (width, height, fx, fy, cx, cy), or a field of view in degrees (2,)."""
        lens = numbers("camera", camera)
        if lens.shape == (2,) and (lens > 0.0).all() and (lens < 180.0).all():
            wide = 2.0 * np.tan(np.radians(lens) / 2.0)
            lens = np.array([*wide, 1.0, 1.0, *(wide / 2.0)])
        if lens.shape != (6,) or not (lens[:4] > 0.0).all():
            raise ValueError(
                "camera must be (width, height, fx, fy, cx, cy) in pixels or a field "
                f"of view in degrees (horizontal, vertical), got {in_words(lens)}"
            )
        tilt = _TILT if tilt is None else tilt
        if not 0.0 < numbers("tilt", tilt) < 90.0:
            raise ValueError(f"tilt must be in (0, 90) degrees, got {tilt}")
        if side is not None and side not in _SIDES:
            raise ValueError(f"side must be '+z' or '-z', got {side!r}")
        ends = None
        if distance is not None:
            low, high = array_of("distance", distance, 2).tolist()
            if not 0.0 < low < high:
                raise ValueError(
                    f"distance must be (least, greatest), positive, got {distance}"
                )
            ends = (low, high)
        return cls(lens, ends, float(tilt), _SIDES.get(side or "", 0.0))


def board_of(arm: Chain) -> Board:
    """The sensor of an arm that sees, or is, a board."""
    return cast(Board, arm.sensor)


def in_view(arm: Chain, commands: Array) -> tuple[Array, list[str]]:
    """The board before the camera and turned to it; ``seen`` as it is predicted."""
    commands = commands.copy()
    j, board = arm.num_joints, board_of(arm)
    posed = arm.measured_with(dataclasses.replace(board, corners=None))
    # Of a board seen at zero: its pose in the camera.
    pose = posed.predict(np.hstack([commands[:, :j], np.zeros((len(commands), 6))]))
    if board.corners is None:
        commands[:, j:] = pose
    from scipy.spatial.transform import Rotation

    face = Rotation.from_rotvec(pose[:, 3:], degrees=True).as_matrix()[:, :, 2]
    far = np.linalg.norm(pose[:, :3], axis=1)
    ahead = pose[:, 2] / np.where(far > 0.0, far, 1.0) > _VIEW
    turned = np.abs(face[:, 2]) > 0.5  # less than 60 degrees from facing it
    reasons = np.where(turned, "", "see the board at too flat an angle")
    reasons = np.where(ahead, reasons, "do not have the board in front of the camera")
    return commands, reasons.tolist()


def pictured(
    arm: Chain, commands: Array, low: Array, high: Array, view: View, rng: Any
) -> tuple[Array, list[str]]:
    """Postures from which the whole board is in the picture, from random views.

    The board's pose in the camera is drawn, joints that give it are looked for from the
    random starts, and what they really see is judged.
    """
    from scipy.spatial.transform import Rotation

    sensor, j, count = board_of(arm), arm.num_joints, len(commands)
    points = sensor.outline
    middle = points.mean(axis=0)
    width, height, fx, fy, cx, cy = view.camera
    ends = distances(sensor, view)
    far = rng.uniform(*ends, count)
    aim = rng.uniform(0.25, 0.75, (count, 2)) * [width, height]
    centre = np.column_stack([(aim - [cx, cy]) / [fx, fy], np.ones(count)])
    centre *= (far / np.linalg.norm(centre, axis=1))[:, None]
    # A board that faces the camera, turned about its axis, then tilted.
    known_side = view.side or sensor.side
    side = np.full(count, known_side) if known_side else rng.choice([-1.0, 1.0], count)
    facing = Rotation.from_rotvec(
        np.where(side[:, None] > 0.0, [np.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    )
    spin = Rotation.from_rotvec(
        rng.uniform(-np.pi, np.pi, count)[:, None] * [0, 0, 1.0]
    )
    about = rng.uniform(-np.pi, np.pi, count)
    angle = np.radians(view.tilt) * np.sqrt(rng.random(count)) * 0.95
    lean = np.column_stack([np.cos(about), np.sin(about), 0.0 * about])
    turn = Rotation.from_rotvec(angle[:, None] * lean) * spin * facing
    shift = centre - turn.apply(np.tile(middle, (count, 1)))
    posed = arm.measured_with(dataclasses.replace(sensor, corners=None))
    goals = np.hstack([commands[:, :j], shift, turn.as_rotvec(degrees=True)])
    commands = np.hstack([_solved(posed, goals, low, high)[:, :j], commands[:, j:]])
    return in_picture(arm, commands, view, ends)


def distances(sensor: Board, view: View) -> tuple[float, float]:
    """Least and greatest from the camera to the board's middle."""
    points = sensor.outline
    size = 2.0 * np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    if view.distance is not None:
        return view.distance
    if not size > 0.0:
        raise ValueError(
            "distance is missing: (least, greatest) from the camera to the board; "
            "Board has neither corners nor extent"
        )
    width, fx = view.camera[0], view.camera[2]
    small, large = _FILLED
    return fx * size / (large * width), fx * size / (small * width)


def in_picture(
    arm: Chain, commands: Array, view: View, ends: tuple[float, float]
) -> tuple[Array, list[str]]:
    """Commands with what the camera sees of the board, and why it is of no use."""
    from scipy.spatial.transform import Rotation

    sensor, j, count = board_of(arm), arm.num_joints, len(commands)
    points, known_side = sensor.outline, view.side or sensor.side
    width, height, fx, fy, cx, cy = view.camera
    posed = arm.measured_with(dataclasses.replace(sensor, corners=None))
    pose = posed.predict(np.hstack([commands[:, :j], np.zeros((count, 6))]))
    if sensor.corners is None:
        commands = np.hstack([commands[:, :j], pose])
    rotation = Rotation.from_rotvec(pose[:, 3:], degrees=True).as_matrix()
    spots = points @ np.matrix_transpose(rotation) + pose[:, None, :3]
    rays = spots[..., :2] / np.maximum(spots[..., 2:], 1e-9)
    inside = spots[..., 2] > 0.0
    if np.array_equal(view.camera, sensor.camera):  # of which the lens is known
        rays, seen = sensor.bent(rays)
        inside &= seen
    u, v = _FOCAL * fx * rays[..., 0], _FOCAL * fy * rays[..., 1]
    edge = _EDGE * width
    inside &= (u > edge - cx) & (u < width - edge - cx) & (v > edge - cy)
    inside &= v < height - edge - cy
    there = spots.mean(axis=1)
    away = np.linalg.norm(there, axis=1)
    face = (rotation[:, :, 2] * -there).sum(axis=1) / np.maximum(away, 1e-9)
    why = np.full(count, "", dtype=object)
    flat = np.abs(face) < np.cos(np.radians(view.tilt))
    why[flat] = "see the board at too flat an angle"
    why[(away < ends[0]) | (away > ends[1])] = "are too near or too far"
    why[~inside.all(axis=1)] = "do not have the whole board in the picture"
    if known_side:
        why[face * known_side <= 0.0] = "see the board from behind"
    return commands, why.tolist()


def _solved(arm: Chain, commands: Array, low: Array, high: Array) -> Array:
    """Commands after damped steps towards readings of zero, in degrees and lengths."""
    j, commands = arm.num_joints, commands.copy()
    scale = np.minimum(high - low, 360.0)
    unit = np.array([1.0 / (arm.length or 1.0)] * 3 + [np.radians(1.0)] * 3)
    for _ in range(STEPS // 2):
        off = arm.predict(commands) * unit
        going = np.linalg.norm(off, axis=1) > 1e-2
        if not going.any():
            break
        slopes = arm.command_jacobian(commands[going])[..., :j] * scale
        slopes = slopes * unit[:, None]
        gram = slopes @ np.matrix_transpose(slopes) + 1e-3 * np.eye(6)
        step = np.linalg.solve(gram, -off[going][..., None])
        step = (np.matrix_transpose(slopes) @ step)[..., 0]
        step *= 0.15 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 0.15)
        at = commands[going, :j] + step * scale
        commands[going, :j] = np.clip(at, low, high)
    return commands
