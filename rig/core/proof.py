"""What the moves so far have proved of a device, and how far and fast the next may go.

What is not proved limits pulses and the drive's own speed, never degrees. The first
move of an unproved axis turns its motor by FIRST_MOTOR_DEG, as slowly as its registers
go. Each next is at most GROWTH times as long, and no longer than turns the phone as far
as it may, by what a pulse was seen to turn. Nothing seen, or in a unit that is not
proved, allows UNSEEN_MOTOR_DEG and no more. A checked axis (SIGN_CHECKED) begins a
session with FIRST_DEG of its joint, and grows while the phone turns as `axes` saw.

`motion` asks before every frame that moves, and looks after it; there is no other way.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import RigConfig
from rig.config.axis import Axis, Pulses
from rig.config.settings import ImuSettings, ReadingsSettings
from rig.faults import MotionFault, TurnedTooFar
from rig.journal.device import SIGN_CHECKED, STOP_PROVED, DeviceRecord
from rig.readings.geometry import Array, Geometry, matrix_to_euler
from rig.readings.source import Source

FIRST_MOTOR_DEG = 0.36
UNSEEN_MOTOR_DEG = 36.0
FIRST_DEG = 0.25  # of a checked joint, in its first move of a session
GROWTH = 4.0  # play of a third of a move can hide it
LOOK_S = 0.5  # time that a move takes at least, of which little is known
SLOW_DEG_S = 5.0  # of the joint, once the phone has shown what a pulse turns
NOISE_DEG = 0.1  # of the phone, just after a move
ALLOWED_DEG = 9.0  # that the phone may turn from where an unproved device began
TOO_FAR = 2.0  # times what checked axes are moved, and MARGIN_DEG: more is a fault
MARGIN_DEG = 1.0
SAME = 4 / 3, 0.3  # factor and margin of one axis alone, where `axes` saw its turn
SEEN_SHARE = 0.1  # of a checked axis's move must be seen, or the moves do not grow
BLIND = "Check for a loose coupling, exchanged units, a stream that does not change or "
BLIND += "a reduction that is far too small"
NO_UNIT = "No angle of the phone exceeds 6.3, so imu.unit (radians or degrees) is not "
NO_UNIT += "proved: turn the base, or the phone's heading, by some degrees"
STEP_DEG = 0.5  # of a derivative of a model
RADIANS = 180.0 / math.pi
LARGEST_RAD = 2.0 * math.pi + 0.1  # no larger number is an angle in radians
UNKNOWN_S = 1.0  # from a stop of which nothing is known to its drive's obeying
FASTER = 1.25  # times the slower speed: less tells nothing of the ramp
MARGIN = 1.2  # times the ramp that was measured
LEAST_ROOM_DEG = 0.1  # a target on the limit itself is gone to


class StopDistance(NamedTuple):
    """The stopping distance of an axis, ``d(v) = v t + k v^2``, in degrees or mm.

    A drive obeys ``t`` after its stop was sent and brakes by ``a``, ``k = 1 / (2 a)``;
    `axes` measures both, at two speeds. Else it brakes by the ramp ``b`` of its move at
    its target. Stopped at ``u`` it ends beyond that by at most
    ``u t + u^2 (k - 1 / (2 b))``; the largest has to fit before the soft limit.
    """

    delay_s: float
    per_square: float  # degrees for (deg/s)^2: 1 / (2 a)
    accel: float  # deg/s^2 of the moves that were stopped

    @classmethod
    def of(
        cls, speeds: list[float], distances: list[float], accel: float
    ) -> StopDistance:
        """From stops at one or two speeds; of one all is ascribed to the ramp."""
        points = sorted(zip(speeds, distances, strict=True))
        (v1, d1), (v2, d2) = points[0], points[-1]
        delay, square = 0.0, max(d / v**2 for v, d in points)
        if v2 >= FASTER * v1:
            square = min(square, max(0.0, (d2 / v2 - d1 / v1) / (v2 - v1)))
            delay = max(0.0, *(d / v - square * v for v, d in points))
        return cls(delay, square, accel)

    def at(self, speed: float) -> float:
        """Degrees from where the stop was sent to where it stands."""
        return speed * self.delay_s + speed**2 * self.per_square

    def fastest(self, axis: Axis, room: float) -> float:
        """Speed of a move that ends so far before a limit, whenever it is stopped. A
        quick stop may brake by the move's ramp: where that is gentler now, so is it."""
        speed, accel = axis.drive_motion
        square = MARGIN * self.per_square * max(1.0, self.accel / accel)
        excess, room = square - 0.5 / accel, max(room, LEAST_ROOM_DEG)
        root = self.delay_s**2 + 4.0 * excess * room
        if root < 0.0 or self.delay_s + math.sqrt(root) <= 0.0:
            return speed  # it never goes so far beyond its target
        return min(speed, 2.0 * room / (self.delay_s + math.sqrt(root)))


def stop_distances(record: DeviceRecord, axes: tuple[Axis, ...]) -> dict[str, Any]:
    """Axis to StopDistance, by the record; what it does not say may take UNKNOWN_S."""
    if (evidence := record.state(STOP_PROVED)) is None:
        return {}
    distances = {}
    for axis in axes:
        _, accel = axis.drive_motion
        fit = evidence.get("distances", {}).get(axis.name)
        unknown = StopDistance(UNKNOWN_S, 0.5 / accel, accel)
        distances[axis.name] = StopDistance.of(**fit) if fit else unknown
    return distances


class Turns(NamedTuple):
    """Turns of the phone, in its own frame, for a commanded degree of each axis."""

    pulses: Array  # (n,) where they were measured
    deg: Array  # (3, n) columns, rotation vectors in degrees

    @classmethod
    def of(cls, record: DeviceRecord) -> Turns | None:
        """The columns that `axes` saw; None where the record does not say."""
        told = (record.state(SIGN_CHECKED) or {}).get("turns")
        return told and cls(np.array(told["pulses"]), np.array(told["deg"]))

    def at(self, config: RigConfig, pulses: Pulses) -> Array:
        """The columns at other pulses: a joint's axis turns with those it carries."""
        turns, away = self.deg.copy(), config.to_deg(np.subtract(pulses, self.pulses))
        for place, joint in enumerate(config.chain):  # of numbers none
            for inner in config.chain[place + 1 :]:
                turn = Rotation.from_rotvec(self.deg[:, inner] * away[inner], True)
                turns[:, joint] = turn.inv().apply(turns[:, joint])
        return turns


def slopes(predict: Callable[[Array], Array], at_deg: Array) -> Array:
    """(m, n) change of what a model predicts for a degree of each axis."""
    steps = STEP_DEG * np.eye(len(at_deg))
    columns = [predict(at_deg + step) - predict(at_deg - step) for step in steps]
    return np.column_stack(columns) / (2.0 * STEP_DEG)


def unit_proved(imu: ImuSettings | ReadingsSettings, attitude: Array) -> bool:
    """Whether a phone's (3, 3) attitude can only have come in the configured unit: a
    number over 2 pi is no angle in radians, and degrees read as radians show in the
    first move, 57.3 times. Numbers have their unit, quaternions none."""
    if isinstance(imu, ReadingsSettings) or imu.by_quaternion or imu.unit == "rad":
        return True
    sent = matrix_to_euler(attitude, str(imu.order))
    return bool(np.abs(sent).max() > LARGEST_RAD)


@dataclasses.dataclass
class Reach:
    """What one axis may be sent, in pulses, by the moves so far."""

    axis: Axis
    factor: float = 1.0  # RADIANS where the phone's unit is not proved
    checked: bool = False
    gain: float | None = None  # degrees of the phone for one, as `axes` saw
    scale: float = 1.0  # of a degree, in the unit of the readings
    longest: float = 0.0  # pulses, of the moves so far
    deg_per_pulse: float = 0.0  # that the phone turned at most in that move
    seen: bool = False  # the phone has turned, in a unit that is proved

    def __post_init__(self) -> None:
        if self.checked:
            per_deg, self.seen = abs(self.axis.pulses_per_deg), True
            self.deg_per_pulse = (self.gain or 1.0) / per_deg
            self.longest = FIRST_DEG * per_deg / GROWTH

    def pulses(self, wanted: float, most_deg: float = math.inf) -> int:
        """Pulses, at least 1, of the next of evenly growing moves to a wanted count."""
        if not self.longest:
            first = self.axis.motor_pulses(FIRST_MOTOR_DEG)
            return max(1, math.floor(min(abs(wanted), first)))
        goal = abs(wanted)
        if self.deg_per_pulse:
            goal = min(goal, most_deg / self.deg_per_pulse)
        ratio = goal / self.longest
        if ratio <= 1.0:
            return max(1, math.floor(goal))
        steps = max(1, math.ceil(math.log(ratio) / math.log(GROWTH) - 1e-9))
        return max(1, math.floor(self.longest * ratio ** (1.0 / steps)))

    def saw(self, pulses: float, turned_deg: float, noise_deg: float) -> None:
        """A move by so many pulses turned the phone so far, give or take the noise."""
        if abs(pulses) < self.longest:
            return
        if self.checked:  # its gearing is known; play may hide a short move
            if turned_deg >= SEEN_SHARE * abs(pulses) * self.deg_per_pulse:
                self.longest = abs(pulses)
            return
        self.seen |= self.factor == 1.0 and turned_deg > noise_deg
        self.longest = abs(pulses)
        # Of a unit that is not proved only what surely turned counts 57 times.
        sign = 1.0 if self.factor == 1.0 else -1.0
        most = self.factor * max(0.0, turned_deg + sign * noise_deg)
        self.deg_per_pulse = most / self.longest

    def unseen(self, begun: int, here: int, goal: int) -> int:
        """Pulses that may be gone without the phone's word; MotionFault: they were."""
        axis = self.axis
        most = max(1, int(axis.motor_pulses(UNSEEN_MOTOR_DEG)))
        gone = abs(here - begun)
        if abs(goal - begun) <= max(most, gone):
            return abs(goal - here)
        if gone < most:
            return most - gone
        raise MotionFault(
            f"the motor of {axis.name} (unit {axis.unit}) was turned by "
            f"{gone / axis.motor_pulses(1.0):.3g} deg and may not turn further without "
            f"a measured motion. {BLIND if self.factor == 1 else NO_UNIT}"
        )

    def paced(self, pulses: float) -> Axis:
        """The axis at the speed of a move by so many pulses."""
        if self.checked:
            return self.axis
        per_s = max(1.0, abs(pulses), self.longest * bool(self.deg_per_pulse)) / LOOK_S
        if self.deg_per_pulse:
            per_s = min(per_s, self.scale * SLOW_DEG_S / self.deg_per_pulse)
        return slowed(self.axis, per_s / abs(self.axis.pulses_per_deg))


class Proof:
    """What is proved of the axes of a device that is armed."""

    def __init__(
        self,
        axes: Sequence[Axis],
        geometry: Geometry,
        checked: bool,
        simulated: bool = False,
        gains: Sequence[float] | None = None,
    ) -> None:
        self.axes, self._geometry = axes, geometry
        self._scale = geometry.scale
        told: Sequence[float | None] = gains or [None] * len(axes)
        self._gained = gains is not None or self._scale == 1.0
        self.reaches = [
            Reach(axis, checked=checked, gain=gain, scale=self._scale)
            for axis, gain in zip(axes, told, strict=True)
        ]
        self._paced = not simulated  # what is not real need not be slow
        self.ceiling_deg_s: float | None = None  # of the speed of every axis
        self.stop_proved = False  # once, so that it may be tried at the ceiling
        self.stops: dict[str, StopDistance] = {}  # of the axes of which it is known
        self._near: tuple[Array, float] | None = None
        self._start: Pulses | None = None  # where the unproved axes began
        self._unit_seen = False  # whether the phone's is proved was looked at
        self._before = np.eye(3)  # (3, 3) attitude where the present piece began
        # Attitude where the piece before it began, degrees of the joints since, and in
        # this piece: a phone that lags has not shown the whole of the last one yet.
        self._last: tuple[Array, float, float] | None = None
        self._heading = 0, self._before  # connection and world by which these hold

    def renew(self, index: int, unit_is_proved: bool = True) -> Reach:
        """Nothing is proved of an axis any more: it is to be checked."""
        factor = 1.0 if unit_is_proved else RADIANS
        self.reaches[index] = Reach(self.axes[index], factor, scale=self._scale)
        self._start, self._unit_seen = None, True
        return self.reaches[index]

    def stay_near(self, attitude: Array, allowed_deg: float = ALLOWED_DEG) -> None:
        """The phone may turn so far away from this attitude; more is a fault."""
        self._near = attitude, allowed_deg * self._scale
        self._start = None

    def begin(self, imu: Source, attitude: Array, here: Pulses, goal: Pulses) -> Pulses:
        """The end of the next piece of the way from here to a goal. MotionFault: an
        axis was moved as far as may be, and nothing was seen."""
        unproved = [reach for reach in self.reaches if not reach.checked]
        if unproved and self._near is None:
            self.stay_near(attitude)
        if not self._unit_seen:
            self._unit_seen = True
            unit_known = unit_proved(imu.settings, attitude)
            for reach in unproved if not unit_known else ():
                reach.factor = RADIANS
        self._start = self._start or here
        most = math.inf if self._near is None else self._near[1]
        share = 1.0
        for reach, begun, a, b in zip(
            self.reaches, self._start, here, goal, strict=True
        ):
            if a != b:
                longest = reach.pulses(b - a, most)
                if not reach.seen:
                    longest = min(longest, reach.unseen(begun, a, b))
                # A pulse more, or a last one would be a move of its own.
                share = min(share, (longest + 1) / abs(b - a))
        if share < 1.0:
            pairs = zip(here, goal, strict=True)
            goal = tuple(a + round((b - a) * share) for a, b in pairs)
        way = sum(
            abs(reach.axis.to_deg(b - a)) * (reach.gain or 1.0)
            for reach, a, b in zip(self.reaches, here, goal, strict=True)
        )
        same = imu.connections == self._heading[0] and imu.world is self._heading[1]
        if unproved or not self._gained:
            self._last = None
        elif self._last and same:  # or its heading is another one
            self._last = self._before, self._last[2] + way, way
        else:
            self._last = attitude, way, way
        self._before, self._heading = attitude, (imu.connections, imu.world)
        return goal

    def paced(self, index: int, pulses: int, end: int | None = None) -> Axis:
        """An axis at the speed at which it may move by so many pulses, to ``end``."""
        reach = self.reaches[index]
        swift = self.stop_proved and self.ceiling_deg_s is not None
        slow = self._paced and not swift
        axis = reach.paced(pulses) if slow else reach.axis
        stop = self.stops.get(axis.name) if self._paced else None
        if stop and pulses and end is not None:
            limit = axis.max_pulses if pulses > 0 else axis.min_pulses
            room = axis.to_deg(limit - end) * math.copysign(1.0, axis.to_deg(pulses))
            if (speed := stop.fastest(axis, room)) < axis.speed_deg_s:
                axis = slowed(axis, speed)
        return slowed(axis, self.ceiling_deg_s) if self.ceiling_deg_s else axis

    def grows(self, here: Pulses, end: Pulses) -> bool:
        """A move is longer than those before: the phone must be looked at after it."""
        ways = np.abs(np.subtract(end, here))
        return any(w > r.longest for w, r in zip(ways, self.reaches, strict=True))

    def watch(self, attitude: Array) -> None:
        """At every poll of a move; MotionFault where the phone turns too far in it."""
        limits = [self._near] if self._near else []
        if self._last:
            since, way, _ = self._last
            limits.append((since, TOO_FAR * way + MARGIN_DEG * self._scale))
        for since, most in limits:
            turned = self._geometry.apart(since, attitude)
            if turned > most:
                raise TurnedTooFar(self._geometry.too_far(turned, most))

    def saw(self, here: Pulses, end: Pulses, attitude: Array) -> None:
        """The phone once the move from here has ended."""
        self.watch(attitude)
        turned = self._geometry.apart(self._before, attitude)
        alone = [i for i in range(len(here)) if here[i] != end[i]]
        if len(alone) == 1:
            self._compare(alone[0], abs(end[alone[0]] - here[alone[0]]), turned)
        for reach, a, b in zip(self.reaches, here, end, strict=True):
            if a != b:
                reach.saw(abs(b - a), turned, NOISE_DEG * self._scale)

    def _compare(self, index: int, pulses: int, turned_deg: float) -> None:
        """A move of one checked axis turned the phone no further than `axes` saw."""
        reach, (most, margin), geometry = self.reaches[index], SAME, self._geometry
        expected = pulses * reach.deg_per_pulse
        allowed = most * expected + margin * self._scale
        if reach.checked and reach.gain and turned_deg > allowed:
            raise TurnedTooFar(
                f"{reach.axis.name} {geometry.changed} {turned_deg:.2f} "
                f"{geometry.unit} in a move for which `axes` measured {geometry.again} "
                f"{expected:.2f}: its drive, setting or gearbox was exchanged. Correct "
                "it, then run `jaxcal-rig setup axes`"
            )


def slowed(axis: Axis, speed_deg_s: float | None = None) -> Axis:
    """An axis no faster than that (SLOW_DEG_S), as far as its drive's registers go."""
    speed = min(SLOW_DEG_S if speed_deg_s is None else speed_deg_s, axis.speed_deg_s)
    while speed < axis.speed_deg_s:
        slow = axis.model_copy(update={"speed_deg_s": speed})
        try:
            slow.motion_counts()
            return slow
        except ValueError:  # slower than the drive's register can say
            speed *= 1.5
    return axis
