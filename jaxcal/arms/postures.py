"""Postures that can be measured: within the limits, and where the sensor reads."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.sensors import Board, Plane, Socket
from jaxcal.checks import Array, array_of, in_words, numbers, whole_number
from jaxcal.models.model import as_commands

_ROUNDS = 40  # batches of starts
_BATCH = 2_000  # starts at a time, where few are any good
_VAIN = 8  # batches in which nothing is found: there is nothing
_REACHED = 1e-7  # of the arm's length
_APART = 2.0  # degrees (of a slide: percent of its stroke) between two postures
_SUNK = 0.01  # of the arm's length: a socket let into a table is no deeper
_STEPS = 80  # of the inverse kinematics
_VIEW = np.cos(np.radians(25.0))  # of the board from the camera's axis, and its face
_FOCAL = 1.12  # times: focal lengths are known to a tenth, and arms are off
_EDGE = 0.02  # of the picture's width, that the board stays away from its edge
_FILLED = (0.8, 0.25)  # of the picture's width by the board, where no distance is given
_TILT = 45.0  # degrees, where none is given


def postures(arm: Chain, count: int, *, seed: int = 0, **rules: Any) -> Array:
    """Postures that can be measured, to choose from.

    Within the limits (180 degrees where a file has none), two degrees apart at least,
    with the ball in the socket, the probe on the plane or the board in view: inverse
    kinematics from random starts, a redundant arm's self-motions among them.

    Args:
        near: rough places: (S, 3) sockets or (S, 4) planes if the sensor has no places;
            for a sensor that reads everywhere rows (x, y, z, radius) for the tip.
        allowed: function of joints (J,), False where they collide.
        camera: of a board, (width, height, fx, fy, cx, cy) in pixels, or a field of
            view in degrees (horizontal, vertical): every corner is in the picture.
        distance: least and greatest, of the board's middle from that camera; by default
            the board fills 25 to 80 % of the picture.
        tilt: degrees that the board's face may be turned from the camera (45).
        floor: lowest height (z in the measuring frame) of joints and sockets.

    Returns:
        (count, n) commands with the sensor's columns, in an order of little travel.

    Raises:
        ValueError: there are fewer, or a socket cannot be reached; with the reasons.
    """
    return reachable(arm, **rules).drawn(count, seed)


def reachable(arm: Chain, **rules: Any) -> ReachableSet:
    """Where the arm can be measured: ``allowed`` of ``Design.refine``.

    Arguments as of ``postures``, from ``near`` on. Commands that a search tries are
    moved to where the sensor reads.
    """
    return ReachableSet(arm, **rules)


def in_turn(arm: Chain, commands: ArrayLike) -> NDArray[np.int64]:
    """(N,) the commands' rows in an order of little travel, socket after socket."""
    rows, joints = as_commands(arm, commands), arm.num_joints
    order: list[int] = []
    remaining = list(range(len(rows)))
    while remaining:
        last = rows[order[-1]] if order else rows[remaining[0]]
        other = (rows[remaining, joints:] != last[joints:]).any(axis=1)
        other &= rows.shape[1] - joints == 1
        far = np.abs(rows[remaining, :joints] - last[:joints]).max(axis=1)
        order.append(remaining.pop(int(np.lexsort((far, other))[0])))
    return np.array(order)


class ReachableSet:
    """Where an arm can be measured; arguments as of ``postures``."""

    def __init__(
        self,
        arm: Chain,
        *,
        near: ArrayLike | None = None,
        allowed: Callable[[Array], bool] | None = None,
        camera: ArrayLike | None = None,
        distance: Sequence[float] | None = None,
        tilt: float | None = None,
        floor: float | None = None,
    ) -> None:
        if camera is None and getattr(arm.sensor, "picture", None) is not None:
            camera = arm.sensor.camera  # type: ignore[attr-defined]  # of a Board
        self.view = view_of(arm, camera, distance, tilt)
        self.floor = -np.inf if floor is None else float(numbers("floor", floor))
        if arm.sensor.joined:
            raise ValueError("use one sensor at a time: arm.measured_with(sensor)")
        self.near, self.allowed = near, allowed
        self.arm, self.targets = _aimed(arm, near)
        self.turning = np.array(self.arm.command_units) == "deg"
        limits = self.arm.limits
        turned = limits.clip(-180.0, 180.0)
        self.limits = np.where(self.turning[:, None], turned, limits)

    def __call__(self, command: Array) -> bool:
        """Whether the arm can be measured at a command (n,)."""
        moved, there = self.onto(command[None])
        near = np.abs(moved[0] - command) <= 1e-6 * np.maximum(np.abs(command), 1.0)
        return bool(there[0] and near.all())

    def onto(self, commands: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, n) commands moved to where the sensor reads, and (N,) whether it does."""
        commands, j = commands.copy(), self.arm.num_joints
        commands[:, :j] = commands[:, :j].clip(*self.limits.T)
        if (count := self.arm.sensor.num_places) > 1:
            commands[:, j] = np.round(commands[:, j]).clip(0, count - 1)
        moved, reasons = self.reach(commands)
        there = np.array([not reason for reason in reasons], dtype=np.bool_)
        if self.allowed is not None:
            for i in np.flatnonzero(there):
                there[i] = bool(self.allowed(moved[i, :j].copy()))
        return moved, there

    def reach(
        self, commands: Array, rng: np.random.Generator | None = None
    ) -> tuple[Array, list[str]]:
        """Commands moved to where the sensor reads, of a camera to views drawn from
        ``rng``, and why it does not ("" where it does)."""
        arm, reasons = self.arm, [""] * len(commands)
        if self.view is not None:
            if rng is not None:
                commands = self._drawn_views(commands, self.view, rng)
            commands, reasons = in_picture(arm, commands, self.view)
        elif arm.sensor.views:
            commands, reasons = in_view(arm, commands)
        elif arm.sensor.zeros:
            limit = _REACHED * (arm.length or 1.0)
            commands = towards_zero(arm, commands, self.limits, limit)
            reached = np.linalg.norm(arm.predict(commands), axis=1) <= limit
            why = "cannot reach it within the limits"
            reasons = np.where(reached, "", why).tolist()
        elif self.targets is not None:
            points = arm.nominal_tip(commands).position
            far = np.linalg.norm(points[:, None] - self.targets[:, :3], axis=-1)
            close = (far <= self.targets[:, 3]).any(axis=1)
            reasons = np.where(close, "", "are not near").tolist()
        if self.floor > -np.inf:
            heights = arm.skeleton(commands)[..., 2]
            heights[:, -1] += _SUNK * arm.length
            last = heights.shape[1] - (not isinstance(arm.sensor, Socket))
            below = (heights[:, 2:last] < self.floor).any(axis=1)
            for i in np.flatnonzero(below):
                reasons[i] = reasons[i] or "are below the floor"
        return commands, reasons

    def _drawn_views(
        self, commands: Array, view: View, rng: np.random.Generator
    ) -> Array:
        """Commands towards poses of the board in the camera that are drawn."""
        j, count = self.arm.num_joints, len(commands)
        board, posed = _posed(self.arm)
        width, height, fx, fy, cx, cy = view.camera
        far = rng.uniform(*view.ends, count)
        aim = rng.uniform(0.25, 0.75, (count, 2)) * [width, height]
        centre = np.column_stack([(aim - [cx, cy]) / [fx, fy], np.ones(count)])
        centre *= (far / np.linalg.norm(centre, axis=1))[:, None]
        # A board that faces the camera, turned about its axis, then tilted.
        either = not view.side
        side = rng.choice([-1.0, 1.0], count) if either else np.full(count, view.side)
        facing = Rotation.from_rotvec((side[:, None] > 0.0) * [np.pi, 0.0, 0.0])
        about_axis = rng.uniform(-np.pi, np.pi, count)[:, None]
        spin = Rotation.from_rotvec(about_axis * [0.0, 0.0, 1.0])
        about = rng.uniform(-np.pi, np.pi, count)
        angle = np.radians(view.tilt) * np.sqrt(rng.random(count)) * 0.95
        lean = np.column_stack([np.cos(about), np.sin(about), 0.0 * about])
        turn = Rotation.from_rotvec(angle[:, None] * lean) * spin * facing
        shift = centre - turn.apply(board.outline.mean(axis=0))
        goals = np.hstack([commands[:, :j], shift, turn.as_rotvec(degrees=True)])
        length = self.arm.length or 1.0
        unit = np.repeat([1.0 / length, np.radians(1.0)], 3)
        moved = towards_zero(posed, goals, self.limits, 1e-2, unit)
        return np.hstack([moved[:, :j], commands[:, j:]])

    def drawn(self, count: int, seed: int) -> Array:
        """(count, n) commands from random starts, in an order of little travel."""
        whole_number("count", count, 1)
        if not np.isfinite(self.limits).all():
            raise ValueError("limits=... is missing: the limits of sliding joints")
        arm, rng = self.arm, np.random.default_rng(seed)
        low, high = self.limits.T
        # (J,) two of these are as far as postures must be apart.
        unit = np.where(self.turning, 1.0, (high - low) / 100.0)
        kept, tried = np.zeros((0, arm.num_inputs)), 0
        # Of each place why postures tried for it were refused, and whether one was not.
        refused = [Counter[str]() for _ in range(max(arm.sensor.num_places, 1))]
        reached = np.zeros(len(refused), dtype=bool)
        for batch in range(_ROUNDS):
            if batch == _VAIN and not reached.all():
                break
            size = max(2 * (count - len(kept)), 64)
            if len(kept):  # more where few were any good: a board is seldom in view
                size = max(size, min(size * tried // (4 * len(kept)), _BATCH))
            joints = rng.uniform(low, high, (size, arm.num_joints))
            labels = np.zeros((size, len(arm.sensor.inputs)))
            places = (len(kept) + np.arange(size)) % len(refused)
            if len(refused) > 1:
                labels[:, 0] = places
            tried += size
            commands, reasons = self.reach(np.hstack([joints, labels]), rng)
            for command, reason, place in zip(commands, reasons, places, strict=True):
                if len(kept) == count and reached[place]:
                    continue  # enough; of the other places one posture is looked for
                reason = reason or self._refused(command, kept, unit)
                if reason:
                    refused[place][reason] += 1
                    continue
                reached[place] = True
                if len(kept) < count:
                    kept = np.vstack([kept, command])
            if len(kept) == count and reached.all():
                return kept[in_turn(arm, kept)]
        raise ValueError(self._shortfall(count, len(kept), tried, refused, reached))

    def _refused(self, command: Array, kept: Array, unit: Array) -> str:
        """Why a posture is not kept beside those that are, "" if it may be."""
        joints = command[: self.arm.num_joints]
        apart = np.abs((kept[:, : len(joints)] - joints) / unit).max(axis=1)
        if apart.min(initial=np.inf) < _APART:
            return "are too close to another"
        may = self.allowed is None or self.allowed(joints.copy())
        return "" if may else "are not allowed"

    def _shortfall(
        self,
        count: int,
        kept: int,
        tried: int,
        refused: list[Counter[str]],
        reached: NDArray[np.bool_],
    ) -> str:
        """What is missing: a place that no posture reaches, or postures."""
        missed = np.flatnonzero(~reached)
        if len(reached) > 1 and len(missed):
            place, reasons = missed[0], refused[missed[0]]
            places = getattr(self.arm.sensor, "places", None)
            where = "" if places is None else f" at {in_words(places[place])}"
            return (
                f"no posture reaches {self.arm.sensor.kind} {place}{where}: of "
                f"{reasons.total()} postures tried {_counted(reasons)}"
            )
        all_reasons = _counted(sum(refused, Counter()))
        if not kept:
            near = self.near
            target = "what the sensor reads" if near is None else f"near = {near}"
            return (
                f"no posture reaches {target} (of {tried} tried {all_reasons}). Is it "
                "in the unit of the arm's lengths and in the frame of its base?"
            )
        return (
            f"count must be at most {kept} for this arm and sensor, got {count}: of "
            f"{tried} postures tried {all_reasons}"
        )


def _counted(reasons: Counter[str]) -> str:
    return ", ".join(f"{number} {reason}" for reason, number in reasons.most_common())


def _aimed(arm: Chain, near: ArrayLike | None) -> tuple[Chain, Array | None]:
    """The arm with its sensor at ``near``, or points that the tip should be near."""
    sensor = arm.sensor
    places = None if near is None else np.atleast_2d(numbers("near", near))
    if isinstance(sensor, Socket | Plane):
        if places is not None:
            aimed = dataclasses.replace(sensor, count=len(places), places=places)
            return arm.measured_with(aimed), None
        if sensor.places is None:
            raise ValueError(
                f"near is missing: the rough place of each {sensor.kind}, (S, "
                f"{sensor.width}). arm.located(commands) finds it from contacts made "
                "by hand"
            )
        return arm, None
    if isinstance(sensor, Board) and sensor.place is None:
        raise ValueError(
            "place is missing, Board(place=...): the place of the board or camera "
            "is unknown and near does not give it. arm.located(commands, measured) "
            "finds it from three views; on the command line --measured"
        )
    if places is not None and not isinstance(sensor, Board):
        rule = f", rows (x, y, z, radius) for {sensor.kind}"
        places = array_of("near", places, "N", 4, rule=rule)
    return arm, places


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
    flat = np.abs(face) < np.cos(np.radians(view.tilt))
    why[flat] = "see the board at too flat an angle"
    why[(away < view.ends[0]) | (away > view.ends[1])] = "are too near or too far"
    why[~inside.all(axis=1)] = "do not have the whole board in the picture"
    if view.side:
        why[face * view.side <= 0.0] = "see the board from behind"
    return commands, why.tolist()


def towards_zero(
    arm: Chain, commands: Array, limits: Array, limit: float, unit: Array | None = None
) -> Array:
    """Commands after damped steps towards readings of zero, within limits (J, 2).

    Of contacts while they are off by more than ``limit``; of poses, in ``unit`` (6,),
    roughly.
    """
    commands, j, (low, high) = commands.copy(), arm.num_joints, limits.T
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
