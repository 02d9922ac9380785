"""Postures from which a camera sees a board."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.sensors import Board
from jaxcal.checks import Array, array_of, in_words, numbers

_STEPS = 80  # of the inverse kinematics
_VIEW = np.cos(np.radians(25.0))  # of the board from the camera's axis, and its face
_FOCAL = 1.12  # times: focal lengths are known to a tenth, and arms are off
_EDGE = 0.02  # of the picture's width, that the board stays away from its edge
_FILLED = (0.8, 0.25)  # of the picture's width by the board, where no distance is given
_TILT = 45.0  # degrees, where none is given


@dataclasses.dataclass(frozen=True)
class View:
    """What a camera must see of a board for its picture to be of use."""

    camera: Array  # (6,) width, height, fx, fy, cx, cy
    ends: tuple[float, float]  # least and greatest, of the board's middle from it
    tilt: float  # degrees, between the board's face and the way to the camera
    side: float  # 1: seen from where the board's z points, -1 from behind, 0 either


def view_of(
    arm: Chain,
    camera: ArrayLike | None,
    distance: Sequence[float] | None,
    tilt: float | None,
) -> View | None:
    """From (width, height, fx, fy, cx, cy), or a field of view in degrees (2,)."""
    if camera is None:
        for name, value in (("distance", distance), ("tilt", tilt)):
            if value is not None:
                raise ValueError(f"{name} needs camera= and a board, got {value}")
        return None
    if not isinstance(arm.sensor, Board):
        raise ValueError("camera needs an arm with sensor=Board(...)")
    lens = numbers("camera", camera)
    if lens.shape == (2,) and (lens > 0.0).all() and (lens < 180.0).all():
        wide = 2.0 * np.tan(np.radians(lens) / 2.0)
        lens = np.array([*wide, 1.0, 1.0, *(wide / 2.0)])
    if lens.shape != (6,) or not (lens[:4] > 0.0).all():
        raise ValueError(
            "camera must be (width, height, fx, fy, cx, cy) in pixels or a field of "
            f"view in degrees (horizontal, vertical), got {in_words(lens)}"
        )
    tilt = _TILT if tilt is None else tilt
    if not 0.0 < numbers("tilt", tilt) < 90.0:
        raise ValueError(f"tilt must be in (0, 90) degrees, got {tilt}")
    if distance is None:
        points = arm.sensor.outline
        size = 2.0 * np.linalg.norm(points - points.mean(axis=0), axis=1).max()
        if not size > 0.0:
            raise ValueError(
                "distance is missing: (least, greatest) from the camera to the board; "
                "Board has neither corners nor extent"
            )
        distance = [lens[2] * size / (share * lens[0]) for share in _FILLED]
    low, high = array_of("distance", distance, 2).tolist()
    if not 0.0 < low < high:
        raise ValueError(
            f"distance must be (least, greatest), positive, got {distance}"
        )
    return View(lens, (low, high), float(tilt), arm.sensor.side)


def _posed(arm: Chain) -> tuple[Board, Chain]:
    """The board of an arm, and the arm with it seen as poses."""
    board = cast(Board, arm.sensor)
    return board, arm.measured_with(dataclasses.replace(board, corners=None))


def seen_by(arm: Chain, commands: Array) -> tuple[Array, Array, Array]:
    """Commands with the board as it is predicted; places (N, 3) and rotations
    (N, 3, 3) of the board in the camera."""
    joints = commands[:, : arm.num_joints]
    # Of a board seen at zero: its pose in the camera.
    board, posed = _posed(arm)
    pose = posed.predict(np.hstack([joints, np.zeros((len(joints), 6))]))
    if board.corners is None:
        commands = np.hstack([joints, pose])
    turn = Rotation.from_rotvec(pose[:, 3:], degrees=True).as_matrix()
    return commands, pose[:, :3], turn


def in_view(arm: Chain, commands: Array) -> tuple[Array, list[str]]:
    """The board before the camera and turned to it; ``seen`` as it is predicted."""
    commands, place, turn = seen_by(arm, commands)
    face = turn[:, :, 2]
    far = np.linalg.norm(place, axis=1)
    ahead = place[:, 2] / np.where(far > 0.0, far, 1.0) > _VIEW
    turned = np.abs(face[:, 2]) > 0.5  # less than 60 degrees from facing it
    reasons = np.where(turned, "", "see the board at too flat an angle")
    reasons = np.where(ahead, reasons, "do not have the board in front of the camera")
    return commands, reasons.tolist()


def aimed(
    arm: Chain,
    commands: Array,
    low: Array,
    high: Array,
    view: View,
    rng: np.random.Generator,
) -> Array:
    """Commands towards poses of the board in the camera that are drawn."""
    j, count = arm.num_joints, len(commands)
    board, posed = _posed(arm)
    middle = board.outline.mean(axis=0)
    width, height, fx, fy, cx, cy = view.camera
    far = rng.uniform(*view.ends, count)
    aim = rng.uniform(0.25, 0.75, (count, 2)) * [width, height]
    centre = np.column_stack([(aim - [cx, cy]) / [fx, fy], np.ones(count)])
    centre *= (far / np.linalg.norm(centre, axis=1))[:, None]
    # A board that faces the camera, turned about its axis, then tilted.
    side = np.full(count, view.side) if view.side else rng.choice([-1.0, 1.0], count)
    facing = Rotation.from_rotvec((side[:, None] > 0.0) * [np.pi, 0.0, 0.0])
    about_axis = rng.uniform(-np.pi, np.pi, count)[:, None]
    spin = Rotation.from_rotvec(about_axis * [0.0, 0.0, 1.0])
    about = rng.uniform(-np.pi, np.pi, count)
    angle = np.radians(view.tilt) * np.sqrt(rng.random(count)) * 0.95
    lean = np.column_stack([np.cos(about), np.sin(about), 0.0 * about])
    turn = Rotation.from_rotvec(angle[:, None] * lean) * spin * facing
    shift = centre - turn.apply(np.tile(middle, (count, 1)))
    goals = np.hstack([commands[:, :j], shift, turn.as_rotvec(degrees=True)])
    unit = np.array([1.0 / (arm.length or 1.0)] * 3 + [np.radians(1.0)] * 3)
    moved = towards_zero(posed, goals, low, high, 1e-2, unit)
    return np.hstack([moved[:, :j], commands[:, j:]])


def in_picture(arm: Chain, commands: Array, view: View) -> tuple[Array, list[str]]:
    """Commands with what the camera sees of the board, and why it is of no use."""
    sensor = cast(Board, arm.sensor)
    width, height, fx, fy, cx, cy = view.camera
    commands, place, rotation = seen_by(arm, commands)
    spots = sensor.outline @ np.matrix_transpose(rotation) + place[:, None]
    rays = spots[..., :2] / np.maximum(spots[..., 2:], 1e-9)
    inside = spots[..., 2] > 0.0
    u, v = _FOCAL * fx * rays[..., 0], _FOCAL * fy * rays[..., 1]
    edge = _EDGE * width
    inside &= (u > edge - cx) & (u < width - edge - cx) & (v > edge - cy)
    inside &= v < height - edge - cy
    there = spots.mean(axis=1)
    away = np.linalg.norm(there, axis=1)
    face = (rotation[:, :, 2] * -there).sum(axis=1) / np.maximum(away, 1e-9)
    why = np.full(len(spots), "", dtype=object)
    why[np.abs(face) < np.cos(np.radians(view.tilt))] = (
        "see the board at too flat an angle"
    )
    why[(away < view.ends[0]) | (away > view.ends[1])] = "are too near or too far"
    why[~inside.all(axis=1)] = "do not have the whole board in the picture"
    if view.side:
        why[face * view.side <= 0.0] = "see the board from behind"
    return commands, why.tolist()


def towards_zero(
    arm: Chain,
    commands: Array,
    low: Array,
    high: Array,
    limit: float,
    unit: Array | None = None,
) -> Array:
    """Commands after damped steps towards readings of zero, within the limits.

    Of contacts while they are off by more than ``limit``; of poses, in ``unit`` (6,),
    roughly.
    """
    commands, j = commands.copy(), arm.num_joints
    poses, most = unit is not None, 0.1 if unit is None else 0.15
    # Degrees and lengths are made comparable by how far each may go.
    scale = np.minimum(high - low, 360.0)
    for _ in range(_STEPS // 2 if poses else _STEPS):
        off = arm.predict(commands)
        off = off if unit is None else off * unit
        going = np.linalg.norm(off, axis=1) > limit
        if not going.any():
            break
        slopes = arm.command_jacobian(commands[going])[..., :j] * scale
        at = commands[going, :j]
        if unit is None:
            # A joint at its limit that is pushed on beyond it stays where it is.
            wish = -np.einsum("nqj,nq->nj", slopes, off[going])
            held = ((at <= low) & (wish < 0.0)) | ((at >= high) & (wish > 0.0))
            slopes = np.where(held[:, None], 0.0, slopes)
        else:
            slopes = slopes * unit[:, None]
        gram = slopes @ np.matrix_transpose(slopes)
        trace = np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-300
        gram = gram + (1e-3 if poses else 1e-6 * trace) * np.eye(gram.shape[-1])
        step = np.linalg.solve(gram, -off[going][..., None])
        with np.errstate(invalid="ignore"):  # where all joints are held
            step = (np.matrix_transpose(slopes) @ step)[..., 0]
        step = np.nan_to_num(step, nan=0.0, posinf=0.0, neginf=0.0)
        step *= most / np.maximum(np.abs(step).max(axis=1, keepdims=True), most)
        commands[going, :j] = np.clip(at + step * scale, low, high)
    return commands
