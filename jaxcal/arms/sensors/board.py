"""A camera and a board, one on the tip and one that stands still (hand and eye)."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.sensors.sensor import (
    AXES,
    BASE,
    Located,
    Pose,
    Reading,
    Sensor,
    Tip,
    hats,
    rotation_vector_rate,
    turns,
)
from jaxcal.checks import Array, Mask, array_of, numbers, one_of
from jaxcal.models.model import Quantity

_FEW = 3  # views that find where a board stands and its tool
_ONE_AXIS = 0.999  # of the largest singular value: turns about one axis, or none
_STILL = 0.02  # radians, and of the longest way: no turn, no second direction
_WRONG = 0.2  # views so far off, in radians and lengths of the arm, are read wrongly


@dataclasses.dataclass(frozen=True, eq=False)
class Board(Sensor):
    """The board's pose in the camera, or the pixels of its corners.

    Where the arm stands is not shown, so ``base`` is held; ``stand`` is the pose of
    what stands still, ``tool`` of what moves, and both are found without a guess.

    Without ``corners`` a view is six zeros, the board's pose in the camera as predicted
    less seen. Commands have six more columns, that pose: ``seen x``, ``y``, ``z`` and
    its rotation vector ``seen rx``, ``ry``, ``rz`` in degrees (the tvec and rvec of
    OpenCV). Noise 0.1 % of the arm's length, 0.1 degrees, or ``Noise(covariance=...)``
    of the views. With ``corners`` it is their pixels, u and v of each, lens distortion
    taken out; noise 0.3 pixels.

    Attributes:
        moves: "camera" or "board", which is on the tip.
        place: (4, 4) of the other in the measuring frame; found when not given.
        corners: (C, 3) of the board in its own frame, in its plane z = 0.
        camera: in pixels (fx, fy, cx, cy); with the size of its picture, (width,
            height, fx, fy, cx, cy), corners outside of it are refused, and postures are
            planned for it.
        side: 1 where the board's z axis points to cameras that see it, -1 where it
            points away; 0 is not known, views tell.
        extent: width and height of a board without corners from its origin, to plan
            views.
        same_board: in ``Several``, this camera stands and sees the board on the tip
            that the first of them sees.
        intrinsics: of ``corners``, focal lengths and centre are unknowns too, known to
            5 % and 2 % of the focal length; ``camera`` is where they begin.
    """

    moves: str = "camera"
    place: Array | None = None
    corners: Array | None = None
    camera: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    side: float = 0.0
    extent: tuple[float, float] = (0.0, 0.0)
    same_board: bool = False
    intrinsics: bool = False

    kind = "board"
    views = True
    tool = AXES
    stands = True
    _seen: ClassVar[tuple[str, ...]] = tuple(f"seen {axis}" for axis in AXES)

    def __post_init__(self) -> None:
        one_of("moves", self.moves, ("camera", "board"))
        if self.place is not None:
            object.__setattr__(self, "place", array_of("place", self.place, 4, 4))
        if self.corners is not None:
            corners = numbers("corners", self.corners)
            flat = corners.ndim == 2 and corners.shape[1] == 3 and len(corners) > 3
            if not flat or corners[:, 2].any():
                raise ValueError(
                    "corners must be four or more rows (x, y, 0), got shape "
                    f"{corners.shape}"
                )
            object.__setattr__(self, "corners", corners)
        camera = numbers("camera", self.camera)
        used = self.corners is not None or camera.shape == (6,)
        right = camera.shape in ((4,), (6,))
        if not right or (used and not (camera[:-2] > 0.0).all()):
            raise ValueError(
                "camera must be (fx, fy, cx, cy) in pixels where corners are given, or "
                f"(width, height, fx, fy, cx, cy), got {self.camera!r}"
            )
        object.__setattr__(self, "camera", tuple(camera.tolist()))
        if self.intrinsics and self.corners is None:
            raise ValueError("intrinsics needs a board with corners")
        if self.same_board and self.moves != "board":
            raise ValueError('same_board needs a fixed camera: moves="board"')

    @property
    def names(self) -> tuple[str, ...]:
        stand = tuple(f"stand {axis}" for axis in self.tool)
        return (*stand, "fx", "fy", "cx", "cy") if self.intrinsics else stand

    @property
    def units(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("deg",) * 3 + ("pixels",) * (len(self.names) - 6)

    @property
    def lens(self) -> tuple[Array, Array]:
        """Focal lengths (2,) and centre (2,) in pixels."""
        return np.array(self.camera[-4:-2]), np.array(self.camera[-2:])

    @property
    def picture(self) -> Array | None:
        """(2,) width and height of the camera's picture, where they are known."""
        return np.array(self.camera[:2]) if len(self.camera) == 6 else None

    def in_picture(self, spots: Array, margin: float = 0.0) -> Mask:
        """(...) whether pixels (..., 2) without distortion are in the camera's picture,
        or up to ``margin`` pixels outside of it."""
        inside = (spots >= -margin) & (spots <= np.array(self.picture) + margin)
        return np.asarray(inside.all(axis=-1))

    @property
    def outline(self) -> Array:
        """(C, 3) points of the board that a picture must hold."""
        if self.corners is not None:
            return self.corners
        width, height = self.extent
        return np.array([[x, y, 0.0] for x in (0.0, width) for y in (0.0, height)])

    @property
    def mounted(self) -> bool:
        return not self.same_board

    @property
    def zeros(self) -> bool:  # type: ignore[override]  # of a pose
        return self.corners is None

    @property
    def inputs(self) -> tuple[str, ...]:
        return self._seen if self.corners is None else ()

    @property
    def outputs(self) -> tuple[str, ...]:
        if self.corners is None:
            return tuple(f"off {axis}" for axis in self.tool)
        return tuple(f"{a}{i + 1}" for i in range(len(self.corners)) for a in "uv")

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        if self.corners is None:
            return Pose.quantities
        return (Quantity("pixels a corner", points=len(self.corners)),)

    @property
    def nominal(self) -> Array:
        place = np.eye(4) if self.place is None else self.place
        lens = self.camera[-4:] if self.intrinsics else ()
        return np.concatenate([place[:3, 3], np.zeros(3), lens])

    def prior_std(self, length: float) -> Array:
        std = np.full(len(self.names), np.inf)
        std[6:] = np.repeat([0.05, 0.02], 2)[: len(std) - 6] * self.camera[-4]
        return std

    def usual_noise(self, length: float) -> ArrayLike:
        return [1e-3 * length] * 3 + [0.1] * 3 if self.corners is None else 0.3

    def unseen(self, arm: Any) -> tuple[str, ...]:
        return BASE

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        place = np.eye(3) if self.place is None else self.place[:3, :3]
        turn, axes = turns(parameters[3:6])
        stand, turn = turn @ place, np.radians(axes)  # of the stand, by its angles
        count, moved = len(inputs), tip.position - parameters[:3]
        # How the board shifts and turns in the camera, by the tip and by the stand.
        by_tip, by_own = np.zeros((2, count, 6, 6))
        if self.moves == "board":  # its pose in a camera that stands
            eye = np.broadcast_to(stand.T, (count, 3, 3))
            board, where, sign = stand.T @ tip.rotation, moved @ stand, 1.0
            by_own[:, :3, 3:] = eye @ hats(moved) @ turn
        else:  # the pose of a board that stands, in a camera on the tip
            eye = np.matrix_transpose(tip.rotation)
            where, sign = -(eye @ moved[..., None])[..., 0], -1.0
            board = eye @ stand
            by_tip[:, :3, 3:] = -eye @ hats(moved)
        by_tip[:, :3, :3], by_own[:, :3, :3] = sign * eye, -sign * eye
        by_tip[:, 3:, 3:], by_own[:, 3:, 3:] = sign * eye, -sign * (eye @ turn)
        if self.corners is None:
            turns_read = Rotation.from_rotvec(inputs[:, 3:], degrees=True).as_matrix()
            gap = Rotation.from_matrix(board @ np.matrix_transpose(turns_read))
            off = np.asarray(gap.as_rotvec())
            rate = np.degrees(rotation_vector_rate(off))
            for slopes in (by_tip, by_own):
                slopes[:, 3:] = rate @ slopes[:, 3:]
            values = np.hstack([where - inputs[:, :3], np.degrees(off)])
            return Reading(values, by_tip, by_own)
        spokes = self.corners @ np.matrix_transpose(board)  # (N, C, 3)
        points = spokes + where[:, None]
        focal, centre = self.lens
        if self.intrinsics:
            focal, centre = parameters[6:8], parameters[8:]
        deep = np.where(points[..., 2:] != 0.0, points[..., 2:], np.nan)
        rays = points[..., :2] / deep
        pixels = focal * rays + centre
        rate = np.zeros((*points.shape[:2], 2, 3))
        rate[..., [0, 1], [0, 1]] = focal / deep
        rate[..., 2] = -focal * rays / deep
        motion = np.concatenate([rate, -rate @ hats(spokes)], axis=-1)
        motion = motion.reshape(count, -1, 6)
        values = pixels.reshape(count, -1)
        by_own = motion @ by_own
        if self.intrinsics:
            by_lens = np.zeros((*rays.shape, 4))
            by_lens[..., [0, 1], [0, 1]], by_lens[..., [0, 1], [2, 3]] = rays, 1.0
            by_own = np.concatenate([by_own, by_lens.reshape(count, -1, 4)], axis=-1)
        return Reading(values, motion @ by_tip, by_own)

    def located(self, tip: Tip, inputs: Array, measured: Array | None) -> Located:
        """Tool X and place Z of ``A X = Z B`` in closed form (Shah, 2013)."""
        if self.place is not None or (self.corners is not None and measured is None):
            return self, None
        if len(inputs) < _FEW:
            raise ValueError(
                f"place is missing for {len(inputs)} views of a board; {_FEW} views by "
                "one arm with the camera or the board determine it"
            )
        turn, shift = self.seen_poses(inputs, np.asarray(measured))

        def fit(turn: Array, shift: Array) -> tuple[float, Array, Array]:
            if self.moves == "camera":
                turn, shift = _inverse(turn, shift)
            return _hand_and_eye(tip, turn, shift)

        off, place, new = fit(turn, shift)
        if off > _WRONG:
            others = {
                "inverted, or with camera and board exchanged": _inverse(turn, shift),
                "with lengths divided by 1000": (turn, shift / 1000.0),
                "with lengths multiplied by 1000": (turn, shift * 1000.0),
            }
            if self.corners is None:
                vector = Rotation.from_rotvec(inputs[:, 3:])
                euler = Rotation.from_euler("xyz", inputs[:, 3:], degrees=True)
                others["with turns in degrees"] = vector.as_matrix(), shift
                if np.isfinite(off):  # small turns are the same in both
                    how = "with their Euler angles as rotation vectors"
                    others[how] = euler.as_matrix(), shift
            for how, pose in others.items():
                if fit(*pose)[0] < 0.5 * _WRONG:
                    raise ValueError(f"views of the board fit the arm only {how}")
        if not np.isfinite(off):
            raise ValueError(
                "turn the tip about two axes in these views, or move it in two "
                "directions: they do not separate the board from the camera"
            )
        towards = -np.einsum("nij,ni->nj", turn, shift)[:, 2]  # z of the camera, in it
        side = float(np.sign(np.median(towards)))
        return dataclasses.replace(self, place=place, side=side), new

    @property
    def standing(self) -> Board:
        return dataclasses.replace(self, place=None)  # every arm has a tool of its own

    def seen_poses(self, inputs: Array, pixels: Array) -> tuple[Array, Array]:
        """Rotations (N, 3, 3) and places (N, 3) of the board in the camera, as
        ``inputs`` say or, of corners (Zhang, 2000), their pixels."""
        if self.corners is None:
            turn = Rotation.from_rotvec(inputs[:, 3:], degrees=True)
            return turn.as_matrix(), inputs[:, :3]
        flat = np.asarray(self.corners)[:, :2]
        focal, centre = self.lens
        rays = (pixels.reshape(len(pixels), -1, 2) - centre) / focal
        size = np.abs(flat).max()
        one = np.column_stack([flat / size, np.ones(len(flat))])
        rows = np.zeros((len(pixels), 2, len(flat), 9))  # of u, then of v
        rows[:, 0, :, :3] = rows[:, 1, :, 3:6] = one
        rows[..., 6:] = -rays.transpose(0, 2, 1)[..., None] * one
        right = np.linalg.svd(rows.reshape(len(pixels), -1, 9))[2]
        plane = right[:, -1].reshape(-1, 3, 3)
        plane = plane * np.sign(plane[:, 2:, 2:])  # the board is before the camera
        x, y = plane[..., 0] / size, plane[..., 1] / size
        scale = np.sqrt(np.linalg.norm(x, axis=1) * np.linalg.norm(y, axis=1))
        turn = np.stack([x, y, np.cross(x, y) / scale[:, None]], axis=-1)
        left, _, right = np.linalg.svd(turn)
        return left @ right, plane[..., 2] / scale[:, None]


def _hand_and_eye(tip: Tip, turn: Array, shift: Array) -> tuple[float, Array, Array]:
    """How far off the views are, the place Z and the tool X of ``A X = Z B``.

    The median of turns in radians and shifts in lengths of the arm, or in what the
    views spread over if that is less; inf where the views do not determine them. Views
    four times as far off are left out.
    """
    length, spread = tip.length or 1.0, float(np.linalg.norm(shift.std(axis=0)))
    length = min(length, spread or length)
    place, new = np.eye(4), np.eye(4)
    used, off = np.ones(len(turn), dtype=bool), np.full(len(turn), np.inf)
    for _ in range(5):
        arm = tip.rotation[used]
        # R_X = R_A' R_Z R_B, summed over the views, as a matrix on the nine of R_Z.
        mix = np.einsum("nki,nlj->ijkl", arm, turn[used]).reshape(9, 9)
        left, size, right = np.linalg.svd(mix)
        free = np.eye(3)  # directions of the tool's shift that the views show
        if size[1] > _ONE_AXIS * size[0]:
            partial = _about_one_axis(arm, tip.position[used], turn[used], shift[used])
            if partial is None:
                return np.inf, place, new
            stand, free = partial
            tool = _nearest((np.matrix_transpose(arm) @ stand @ turn[used]).sum(axis=0))
        else:
            tool, stand = (_nearest(v.reshape(3, 3)) for v in (left[:, 0], right[0]))
        eye = np.broadcast_to(-np.eye(3), arm.shape)
        rows = np.concatenate([arm @ free, eye], axis=-1).reshape(3 * len(arm), -1)
        right_side = (shift @ stand.T - tip.position)[used].ravel()
        shifts = np.linalg.lstsq(rows, right_side, rcond=None)[0]
        shifts = np.append(free @ shifts[:-3], shifts[-3:])
        new[:3, :3], new[:3, 3] = tool, shifts[:3]
        place[:3, :3], place[:3, 3] = stand, shifts[3:]
        apart = tip.rotation @ shifts[:3] + tip.position - shift @ stand.T - shifts[3:]
        trace = np.einsum("nij,nij->n", tip.rotation @ tool, stand @ turn)
        off = np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))
        off = off + np.linalg.norm(apart, axis=1) / length
        kept = off <= 4.0 * np.median(off)
        if (kept == used).all() or kept.sum() < 3:
            break
        used = kept
    return float(np.median(off)), place, new


def _about_one_axis(
    arm: Array, position: Array, turn: Array, shift: Array
) -> tuple[Array, Array] | None:
    """The stand's rotation where the tip turns about one axis, as a SCARA's, and
    directions (3, 2) in the tip's frame, (3, 0) without a turn, in which views show
    where the tool is.

    How far the tip goes shows what its turns do not. None where it hardly moves.
    """
    vectors = Rotation.from_matrix(arm @ arm[0].T).as_rotvec()
    seen = Rotation.from_matrix(turn @ turn[0].T).as_rotvec()
    moved, ways = position - position.mean(axis=0), shift - shift.mean(axis=0)
    spread = np.linalg.svd(moved, compute_uv=False)
    axis = np.linalg.svd(vectors)[2][0]
    angles = vectors @ axis
    if np.abs(angles).max() < _STILL:
        if spread[1] < _STILL * spread[0]:
            return None
        return _nearest(moved.T @ ways), np.zeros((3, 0))
    from_axis = angles @ seen
    from_axis /= np.linalg.norm(from_axis)
    first = Rotation.align_vectors([axis], [from_axis])[0].as_matrix()
    tip_axis = arm[0].T @ axis
    across = np.linalg.svd(tip_axis[None])[2][1:].T
    # Turned about the axis by an angle whose cosine and sine are two more unknowns.
    there = shift @ first.T
    flat = there - np.outer(there @ axis, axis)
    aside = np.cross(axis, there)
    eye = np.broadcast_to(-np.eye(3), arm.shape)
    rows = [arm @ across, eye, -flat[..., None], -aside[..., None]]
    right = np.outer(there @ axis, axis) - position
    table = np.concatenate(rows, axis=-1).reshape(3 * len(arm), -1)
    solution, _, rank, _ = np.linalg.lstsq(table, right.ravel(), rcond=1e-6)
    if rank < table.shape[1]:
        return None
    angle = np.arctan2(solution[-1], solution[-2])
    return Rotation.from_rotvec(angle * axis).as_matrix() @ first, across


def _inverse(turn: Array, shift: Array) -> tuple[Array, Array]:
    back = np.matrix_transpose(turn)
    return back, -(back @ shift[..., None])[..., 0]


def _nearest(matrix: Array) -> Array:
    """The rotation nearest to a multiple of a matrix, that of either sign."""
    left, _, right = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(left @ right)
