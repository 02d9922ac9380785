"""Postures that can be measured: within the limits, and where the sensor reads."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.sensors import Board, Plane, Socket
from jaxcal.arms.views import aimed, in_picture, in_view, towards_zero, view_of
from jaxcal.checks import Array, in_words, numbers, whole_number
from jaxcal.models.model import as_commands

_ROUNDS = 40  # batches of starts
_BATCH = 2_000  # starts at a time, where few are any good
_VAIN = 8  # batches in which nothing is found: there is nothing
_REACHED = 1e-7  # of the arm's length
_APART = 2.0  # degrees (of a slide: percent of its stroke) between two postures
_SUNK = 0.01  # of the arm's length: a socket let into a table is no deeper
_THICK = 0.04  # radius of an arm's links by its length


@dataclasses.dataclass(frozen=True)
class Room:
    """Where an arm may be: simple, spheres along straight lines between its joints."""

    floor: float | None  # height that no joint behind the first is below
    approach: Array | None  # (4,) direction in which the tool comes, degrees about it
    planes: Array  # (P, 4) normal, offset: spheres stay where normal . x > offset
    boxes: Array  # (B, 6) least x, y, z, then greatest: spheres stay outside
    radius: float | None  # of the spheres

    def reasons(self, arm: Chain, commands: Array) -> Array:
        """(N,) why a posture is not possible, "" where it is."""
        points = arm.skeleton(commands)
        why = np.full(len(points), "", dtype=object)
        if len(self.planes) or len(self.boxes):
            why[self._touches(arm, points)] = "are not clear"
        if self.approach is not None:
            way = points[:, -1] - points[:, -2]
            size = np.linalg.norm(way, axis=1, keepdims=True)
            axis = arm.nominal_tip(commands).rotation[:, :, 2]
            far = size > 0.01 * (arm.length or 1.0)
            way = np.where(far, way / (size + 1e-300), axis)
            least = np.cos(np.radians(self.approach[3]))
            why[way @ self.approach[:3] < least] = "approach from another direction"
        if self.floor is not None:
            why[(points[:, 2:-1, 2] < self.floor).any(axis=1)] = "are below the floor"
        return why

    def _touches(self, arm: Chain, points: Array) -> Array:
        """(N,) whether a sphere on a link, but the first and the tip's, touches."""
        radius = self.radius or _THICK * arm.length
        steps = max(2, int(np.ceil(arm.length / max(radius, 1e-9) / 4.0)))
        share = np.linspace(0.0, 1.0, steps)[:, None]
        starts, ways = points[:, 2:-1, None], np.diff(points[:, 2:], axis=1)[:, :, None]
        ways[:, -1] *= 0.7  # the tip's end touches
        balls = (starts + share * ways).reshape(len(points), -1, 3)
        near = np.zeros(balls.shape[:2], dtype=bool)
        for plane in self.planes:
            near |= balls @ plane[:3] - plane[3] < radius
        for box in self.boxes:
            outside = np.maximum(box[:3] - balls, balls - box[3:]).clip(0.0)
            near |= np.linalg.norm(outside, axis=-1) < radius
        return np.asarray(near.any(axis=1))


def _room_of(
    floor: float | None = None,
    approach: ArrayLike | None = None,
    clear: Sequence[ArrayLike] = (),
    radius: float | None = None,
) -> Room | None:
    """Checked; the cone of an approach without its angle is 60 degrees."""
    if radius is not None and not len(clear):
        raise ValueError(f"radius needs clear= (planes or boxes), got {radius}")
    floor = None if floor is None else float(numbers("floor", floor))
    if radius is not None and not numbers("radius", radius) > 0.0:
        raise ValueError(f"radius must be positive, got {radius}")
    if floor is None and approach is None and not len(clear):
        return None
    cone = None
    if approach is not None:
        cone = numbers("approach", approach)
        cone = np.append(cone, 60.0) if cone.shape == (3,) else cone
        size = np.linalg.norm(cone[:3])
        if cone.shape != (4,) or not (size > 0.0 and 0.0 < cone[3] <= 180.0):
            raise ValueError(
                "approach must be a direction (x, y, z) and the largest angle from it "
                f"in degrees, got {in_words(numbers('approach', approach))}"
            )
        cone = np.append(cone[:3] / size, cone[3])
    things: dict[int, list[Array]] = {4: [], 6: []}
    for one in clear:
        row = numbers("clear", one)
        if row.shape not in ((4,), (6,)):
            raise ValueError(
                "clear must hold planes (normal, offset) of 4 numbers and boxes (least "
                f"x, y, z, greatest) of 6, got {in_words(row)}"
            )
        things[len(row)].append(row)
    for row in things[4]:
        row /= np.linalg.norm(row[:3])
    planes, boxes = (np.array(rows).reshape(-1, n) for n, rows in things.items())
    return Room(floor, cone, planes, boxes, radius)


def postures(arm: Chain, count: int, *, seed: int = 0, **rules: Any) -> Array:
    """Postures that can be measured, to choose from.

    Within the limits (180 degrees where a file has none), two degrees apart at least,
    with the ball in the socket, the probe on the plane or the board in view: inverse
    kinematics from random starts, a redundant arm's self-motions among them.

    Args:
        arm: with its sensor.
        count: how many.
        seed: of the random starts.
        near: rough places: (S, 3) sockets or (S, 4) planes if the sensor has no places;
            for a sensor that reads everywhere rows (x, y, z, radius), of which the tip
            must be near one; not for a board.
        allowed: function of joints (J,), False where they collide.
        camera: of a board, (width, height, fx, fy, cx, cy) in pixels, or a field of
            view in degrees (horizontal, vertical): every corner is in the picture, with
            a focal length that is known to a tenth.
        distance: least and greatest, of the board's middle from that camera; by default
            the board fills 25 to 80 % of the picture.
        tilt: degrees that the board's face may be turned from the camera, by default
            45.
        side: "+z", the printed side is where the board's z axis points, or "-z"; by
            default as views showed it, else either.
        floor: lowest height (z in the measuring frame) of joints, and of sockets within
            1 % of the arm's length.
        approach: direction (x, y, z) of the tool's approach, from the last joint to the
            tip, and the largest angle from it in degrees (60).
        clear: planes (normal, offset) whose other side, and boxes (least x, y, z,
            greatest), that the arm does not touch: spheres along straight lines between
            the joints. The first link, the tip and the arm against itself are not
            looked at.
        radius: of these spheres; by default 4 % of the arm's length.

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
        side: str | None = None,
        **room: Any,
    ) -> None:
        if camera is None and getattr(arm.sensor, "picture", None) is not None:
            camera = arm.sensor.camera  # type: ignore[attr-defined]  # of a Board
        self.view = view_of(arm, camera, distance, tilt, side)
        self.room = _room_of(**room)
        if arm.sensor.joined:
            raise ValueError("use one sensor at a time: arm.measured_with(sensor)")
        self.near, self.allowed = near, allowed
        self.arm, self.targets = _aimed(arm, near)
        places = getattr(self.arm.sensor, "places", None)
        floor = self.room.floor if self.room else None
        if floor is not None and isinstance(arm.sensor, Socket) and places is not None:
            for i in np.flatnonzero(places[:, 2] < floor - _SUNK * arm.length)[:1]:
                raise ValueError(
                    f"socket {i} at {in_words(places[i])} is below floor = {floor:g}: "
                    "is the floor's height given in the frame of the base?"
                )
        self.turning = np.array(self.arm.command_units) == "deg"

    @property
    def limits(self) -> Array:
        """(J, 2) of the joints, 180 degrees where there are none."""
        limits = self.arm.limits
        return np.where(self.turning[:, None], limits.clip(-180.0, 180.0), limits)

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
        arm, (low, high) = self.arm, self.limits.T
        reasons = [""] * len(commands)
        if self.view is not None:
            if rng is not None:
                commands = aimed(arm, commands, low, high, self.view, rng)
            commands, reasons = in_picture(arm, commands, self.view)
        elif arm.sensor.views:
            commands, reasons = in_view(arm, commands)
        elif arm.sensor.zeros:
            limit = _REACHED * (arm.length or 1.0)
            commands = towards_zero(arm, commands, low, high, limit)
            reached = np.linalg.norm(arm.predict(commands), axis=1) <= limit
            why = "cannot reach it within the limits"
            reasons = ["" if one else why for one in reached]
        elif self.targets is not None:
            points = arm.nominal_tips(commands)
            far = np.linalg.norm(points[:, None] - self.targets[:, :3], axis=-1)
            close = (far <= self.targets[:, 3]).any(axis=1)
            reasons = ["" if one else "are not near" for one in close]
        if self.room is not None:
            beside = self.room.reasons(arm, commands)
            reasons = [a or b for a, b in zip(reasons, beside, strict=True)]
        return commands, reasons

    def drawn(self, count: int, seed: int) -> Array:
        """(count, n) commands from random starts, in an order of little travel."""
        whole_number("count", count, 1)
        if not np.isfinite(self.limits).all():
            raise ValueError("limits=... is missing: the limits of sliding joints")
        rng = np.random.default_rng(seed)
        collection = _Collection(self, count)
        for batch in range(_ROUNDS):
            if batch == _VAIN and not collection.reached.all():
                break
            commands, places = collection.starts(rng)
            for one in zip(*self.reach(commands, rng), places, strict=True):
                collection.add(*one)
            if len(collection.kept) == count and collection.reached.all():
                return collection.kept[in_turn(self.arm, collection.kept)]
        raise ValueError(collection.shortfall())


class _Collection:
    """Postures that can be measured, and what became of the others that were tried."""

    def __init__(self, where: ReachableSet, count: int) -> None:
        self.where, self.arm, self.count = where, where.arm, count
        self.low, self.high = where.limits.T
        # (J,) two of these are as far as postures must be apart.
        self.unit = np.where(where.turning, 1.0, (self.high - self.low) / 100.0)
        self.kept, self.tried = np.zeros((0, self.arm.num_inputs)), 0
        num_places = max(self.arm.sensor.num_places, 1)
        self.reached = np.zeros(num_places, dtype=int)  # postures at each place
        self.refused: list[Counter[str]] = [Counter() for _ in self.reached]

    def starts(self, rng: np.random.Generator) -> tuple[Array, NDArray[np.intp]]:
        """(N, n) random commands to try next, and (N,) the place that each is for."""
        kept, arm = len(self.kept), self.arm
        size = max(2 * (self.count - kept), 64)
        if kept:  # more where few were any good: a board is seldom in view
            size = max(size, min(size * self.tried // (4 * kept), _BATCH))
        self.tried += size
        joints = rng.uniform(self.low, self.high, (size, arm.num_joints))
        labels = np.zeros((size, len(arm.sensor.inputs)))
        places = (kept + np.arange(size)) % len(self.reached)
        if len(self.reached) > 1:
            labels[:, 0] = places
        return np.hstack([joints, labels]), places

    def add(self, command: Array, reason: str, place: int) -> None:
        """Keep a command for a place, unless there is a ``reason`` against it."""
        joints = command[: self.arm.num_joints]
        if len(self.kept) == self.count and self.reached[place]:
            return  # enough; of the other places one posture is looked for
        if not reason:
            apart = np.abs((self.kept[:, : len(joints)] - joints) / self.unit)
            if len(self.kept) and apart.max(axis=1).min() < _APART:
                reason = "are too close to another"
            elif (may := self.where.allowed) is not None and not may(joints.copy()):
                reason = "are not allowed"
        if reason:
            self.refused[place][reason] += 1
            return
        self.reached[place] += 1
        if len(self.kept) < self.count:
            self.kept = np.vstack([self.kept, command])

    def shortfall(self) -> str:
        """What is missing: a place that no posture reaches, or postures."""
        missed = np.flatnonzero(self.reached == 0)
        if len(self.reached) > 1 and len(missed):
            place, refused = missed[0], self.refused[missed[0]]
            places = getattr(self.arm.sensor, "places", None)
            where = "" if places is None else f" at {in_words(places[place])}"
            return (
                f"no posture reaches {self.arm.sensor.kind} {place}{where}: of "
                f"{refused.total()} postures tried {_counted(refused)}"
            )
        reasons = _counted(sum(self.refused, Counter()))
        if not len(self.kept):
            near = self.where.near
            target = "what the sensor reads" if near is None else f"near = {near}"
            return (
                f"no posture reaches {target} (of {self.tried} tried {reasons}). Is it "
                "in the unit of the arm's lengths and in the frame of its base?"
            )
        return (
            f"count must be at most {len(self.kept)} for this arm and sensor, got "
            f"{self.count}: of {self.tried} postures tried {reasons}"
        )


def _counted(reasons: Counter[str]) -> str:
    return ", ".join(f"{number} {reason}" for reason, number in reasons.most_common())


def _aimed(arm: Chain, near: ArrayLike | None) -> tuple[Chain, Array | None]:
    """The arm with its sensor at ``near``, or points that the tip should be near."""
    sensor = arm.sensor
    places = None if near is None else np.atleast_2d(numbers("near", near))
    if isinstance(sensor, Socket | Plane):
        if places is None and sensor.places is None:
            raise ValueError(
                f"near is missing: the rough place of each {sensor.kind}, (S, "
                f"{sensor.width}). arm.located(commands) finds it from contacts made "
                "by hand"
            )
        if places is not None:
            aimed = dataclasses.replace(sensor, count=len(places), places=places)
            arm = arm.measured_with(aimed)
        return arm, None
    if isinstance(sensor, Board):
        if sensor.place is None:
            raise ValueError(
                "place is missing, Board(place=...): the place of the board or camera "
                "is unknown and near does not give it. arm.located(commands, measured) "
                "finds it from three views; on the command line --measured"
            )
        return arm, None
    if places is not None and places.shape[1] != 4:
        raise ValueError(
            f"near must be rows (x, y, z, radius) for {sensor.kind}, got "
            f"{places.shape[1]} columns"
        )
    return arm, places
