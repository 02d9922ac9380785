"""Moving, settling and measuring, with every check at every poll.

The loops here read drives and IMU, look at the clock and the signals, and do nothing
else: no JAX, no files but the journal's callback.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.attitude import Array, Frame, mean_rotation
from rig.drives import Bus, BusError, Drive, Rejected, Status
from rig.imu import Imu, ImuError
from rig.limits import LimitError, approach_point, check_plan, outside
from rig.settings import AXIS_NAMES, RigConfig
from rig.stop import Heartbeat, Signals, Stopper
from rig.stream import Reading

__all__ = ["Measurement", "Motion", "MotionFault", "NotFollowing", "Unreachable"]

FOLLOW_MIN_DEG = 3.0  # a commanded change this large must be seen by the IMU
FOLLOW_SHARE = 0.1  # at least this share of it
FOLLOW_LEADING = 0.3  # of axes that move at least this share of the largest move


class MotionFault(RuntimeError):
    """Something is wrong with the device: stop everything and latch."""


class NotFollowing(MotionFault):
    """A drive turned and the IMU did not see it.

    ``suspects`` are the postures recorded since the axis was last seen to follow: the
    coupling may have slipped before any of them.
    """

    def __init__(self, text: str, suspects: list[str]) -> None:
        self.suspects = suspects
        super().__init__(text)


class Unreachable(RuntimeError):
    """The device is sound but cannot get there: leave this posture out."""


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One settled posture."""

    pulses: tuple[int, int, int]  # commanded
    feedback: tuple[int, int, int]  # the drives' own positions
    attitude: Array  # (3, 3) mean attitude of the phone
    angles: Array  # (3,) degrees: pitch, yaw, roll of the end-effector
    std: Array  # (3,) degrees, of single readings
    samples: int
    raw: Array  # (samples, 3) degrees


class Motion:
    """The device, moved under guard: only when armed, and never once stopped."""

    def __init__(
        self,
        config: RigConfig,
        bus: Bus,
        imu: Imu,
        signals: Signals,
        stopper: Stopper,
        log: Callable[..., Any],
        phase: Callable[[str], None],
    ) -> None:
        self.config = config
        self.bus = bus
        self.imu = imu
        self.signals = signals
        self.stopper = stopper
        self.drives = [Drive(bus, axis) for axis in config.axes]
        stopper.drives = self.drives
        self.frame: Frame | None = None
        self.armed = False
        self._log = log
        self._phase = phase
        self._moves = 0
        self._seen: tuple[Array, Array] | None = None  # (commanded, measured) last
        self._unproven: list[list[str]] = [[], [], []]  # postures, an axis
        watched = [a.comm_timeout_s for a in config.axes if a.comm_timeout_s]
        self.heartbeat = Heartbeat(
            stopper, config.motion.heartbeat_s, min(watched) / 4 if watched else 0.0
        )

    # Arming

    def arm(self, reset_alarms: bool = False) -> None:
        """Check everything that must hold before anything may move.

        Raises:
            MotionFault: an alarm, a moving or disabled drive, a position outside the
                limits, no fresh IMU reading.
        """
        self.stopper.check()
        for drive in self.drives:
            axis = drive.axis
            status = drive.status()
            if status.fault and reset_alarms and axis.map.alarm_reset:
                drive.reset_alarm()
                status = drive.status()
            if status.fault:
                raise MotionFault(
                    f"{axis.name} is in alarm: {drive.alarm() or 'no code given'}; "
                    "find the cause, then reset it (--reset-alarms)"
                )
            if status.moving:
                raise MotionFault(f"{axis.name} is moving already: who moves it?")
            if not status.enabled:
                drive.enable()
                if not drive.status().enabled:
                    raise MotionFault(f"{axis.name} cannot be enabled")
            tolerance = self._tolerance(axis.name)
            if not (
                axis.min_pulses - tolerance
                <= status.position
                <= axis.max_pulses + tolerance
            ):
                raise MotionFault(
                    f"{axis.name} stands at {status.position} pulses, outside its "
                    f"limits {axis.min_pulses}..{axis.max_pulses}: home it first"
                )
            if axis.comm_timeout_s is not None:
                drive.set_comm_timeout(axis.comm_timeout_s)
            if self.config.motion.mirror_limits:
                drive.mirror_limits()
        try:
            self.imu.latest()
        except ImuError as error:
            raise MotionFault(str(error)) from None
        self.armed = True
        self.heartbeat.start()

    def zeroed(self, frame: Frame, pulses: tuple[int, int, int]) -> None:
        """Measure against this zero posture from now on."""
        self.frame = frame
        self._seen = (self.config.to_deg(pulses), np.zeros(3))

    def positions(self) -> tuple[int, int, int]:
        """Where the drives stand, in pulses."""
        a, b, c = (drive.status().position for drive in self.drives)
        return a, b, c

    def _tolerance(self, name: str) -> int:
        axis = self.config.axes[AXIS_NAMES.index(name)]
        wide = self.config.motion.position_tolerance_deg * abs(
            axis.scale.pulses_per_deg
        )
        return max(1, round(wide))

    # Moving

    def move_to(self, target: tuple[int, int, int], label: str) -> None:
        """Move all three axes to absolute pulses, in steps, from the chosen side.

        Raises:
            LimitError: the target leaves the limits; nothing was sent.
            Unreachable: a drive refused the target or ended short of it.
            MotionFault, BusError, ImuError, StopRequested: stop everything.
        """
        if not self.armed:
            raise MotionFault("not armed")
        self.stopper.check()
        check_plan(self.config, [target])
        self._phase("moving")
        via = approach_point(self.config, target)
        if via != target:
            self._travel(via, label)
        self._travel(target, label)

    def _travel(self, target: tuple[int, int, int], label: str) -> None:
        start = self.config.to_deg(self.positions())
        way = self.config.to_deg(target) - start
        longest = float(np.abs(way).max())
        steps = max(1, int(np.ceil(longest / self.config.motion.max_step_deg - 1e-9)))
        for step in range(1, steps + 1):
            point = target
            if step < steps:
                point = self.config.to_pulses(start + way * step / steps)
            self._step(point, label)

    def _step(self, target: tuple[int, int, int], label: str) -> None:
        faults = outside(self.config, target)
        if faults:
            raise LimitError("; ".join(faults))
        starts = [self._status(drive) for drive in self.drives]
        begun = time.monotonic()
        deadline = begun + self._deadline_s([s.position for s in starts], target)
        self.heartbeat.feed(moving=True)
        try:
            for drive, start, pulses in zip(self.drives, starts, target, strict=True):
                self._guard()
                if abs(start.position - pulses) <= 0 and start.done:
                    continue
                self._moves += 1
                self._log(
                    "command",
                    number=self._moves,
                    label=label,
                    axis=drive.axis.name,
                    pulses=pulses,
                )
                self._send(drive, pulses)
            self._watch(starts, target, begun, deadline)
        finally:
            self.heartbeat.feed(moving=False)

    def _send(self, drive: Drive, pulses: int) -> None:
        try:
            drive.move(pulses)
        except Rejected as error:
            if error.code in (2, 3):
                raise Unreachable(
                    f"{drive.axis.name} refused {pulses}: {error}"
                ) from None
            self._status(drive)  # an alarm says more than a refusal
            raise

    def _deadline_s(self, starts: list[int], target: tuple[int, int, int]) -> float:
        motion = self.config.motion
        longest = 0.0
        for axis, start, end in zip(self.config.axes, starts, target, strict=True):
            way = abs(axis.scale.to_deg(end - start))
            ramp = axis.speed_deg_s / axis.accel_deg_s2
            longest = max(longest, way / axis.speed_deg_s + ramp)
        return motion.deadline_factor * longest + motion.deadline_slack_s

    def _watch(
        self,
        starts: list[Status],
        target: tuple[int, int, int],
        begun: float,
        deadline: float,
    ) -> None:
        """Poll until all three stand on their targets, or something is wrong."""
        motion = self.config.motion
        last = [(s.position, begun) for s in starts]
        while True:
            self._guard()
            arrived = 0
            for index, drive in enumerate(self.drives):
                axis = drive.axis
                status = self._status(drive)
                tolerance = self._tolerance(axis.name)
                if abs(status.position - target[index]) <= tolerance:
                    arrived += status.done and not status.moving
                    continue
                self._corridor(drive, starts[index].position, target[index], status)
                if abs(status.position - last[index][0]) > 1:
                    last[index] = (status.position, status.time)
                elif status.time - last[index][1] > motion.stall_s:
                    way = axis.scale.to_deg(target[index] - status.position)
                    moved = abs(status.position - starts[index].position) > tolerance
                    if status.done and not status.moving and moved:
                        raise Unreachable(
                            f"{axis.name} ended {abs(way):.3f} deg short of its target"
                        )
                    raise MotionFault(
                        f"{axis.name} does not follow: standing for "
                        f"{status.time - last[index][1]:.2f} s, {abs(way):.3f} deg "
                        "from its target"
                    )
            if arrived == len(self.drives):
                return
            if time.monotonic() > deadline:
                raise MotionFault(
                    f"the move missed its deadline of {deadline - begun:.2f} s"
                )
            self._check_attitude()
            time.sleep(motion.poll_s)

    def _corridor(self, drive: Drive, start: int, end: int, status: Status) -> None:
        axis = drive.axis
        slack = self.config.motion.following_deg * abs(axis.scale.pulses_per_deg)
        low, high = min(start, end) - slack, max(start, end) + slack
        if not low <= status.position <= high:
            here, begin, goal = map(axis.scale.to_deg, (status.position, start, end))
            raise MotionFault(
                f"{axis.name} is at {here:.3f} deg on its way from {begin:.3f} to "
                f"{goal:.3f}"
            )

    def _status(self, drive: Drive) -> Status:
        status = drive.status()
        if status.fault:
            text = "fault bit set"
            try:
                text = drive.alarm() or text
            except BusError:
                pass  # the fault bit alone is reason enough to stop
            raise MotionFault(f"{drive.axis.name}: {text}")
        return status

    def _guard(self) -> None:
        self.signals.check_stop()
        self.stopper.check()
        self.heartbeat.feed(moving=True)

    def _check_attitude(self) -> None:
        """The IMU is fresh, inside the envelope, and where the drives say."""
        reading = self.imu.latest()
        if self.frame is None:
            return
        motion = self.config.motion
        angles = self.frame.angles(reading.matrix)
        for axis, angle in zip(self.config.axes, angles, strict=True):
            low = axis.min_deg - motion.envelope_margin_deg
            high = axis.max_deg + motion.envelope_margin_deg
            if not low <= angle <= high:
                raise MotionFault(
                    f"the IMU reads {axis.name} at {angle:.2f} deg, outside its "
                    f"envelope {low:.1f}..{high:.1f}"
                )

    # Settling and measuring

    def measure(
        self,
        target: tuple[int, int, int],
        label: str = "",
        samples: int | None = None,
    ) -> Measurement:
        """Wait until the device has settled, then average fresh readings.

        Args:
            target: pulses commanded.
            label: name of the posture.
            samples: readings to average; as configured when not given.

        Raises:
            MotionFault: it does not settle in time, or the IMU disagrees with the
                drives. ImuError, BusError, StopRequested: stop everything.
        """
        settle = self.config.settle
        begun = time.monotonic()
        deadline = begun + settle.timeout_s
        self._phase("settling")
        since = begun
        reason = "no reading"
        while True:
            statuses, since, reason = self._settled(since, deadline, reason)
            self._phase("measuring")
            readings = self._collect(deadline, samples or settle.samples)
            if readings is None:
                since, reason = time.monotonic(), "the stream paused while measuring"
                self._phase("settling")
                continue
            frame = self._frame_for(readings)
            raw = frame.angles(np.array([r.matrix for r in readings]))
            std = raw.std(axis=0, ddof=1) if len(raw) > 1 else np.zeros(3)
            if (std > settle.std_deg).any():
                since, reason = time.monotonic(), _unquiet("deviation", std, "deg")
                self._phase("settling")
                continue
            break
        attitude = mean_rotation([r.matrix for r in readings])
        feedback = tuple(status.position for status in statuses)
        result = Measurement(
            pulses=target,
            feedback=(feedback[0], feedback[1], feedback[2]),
            attitude=attitude,
            angles=frame.angles(attitude),
            std=std,
            samples=len(readings),
            raw=raw,
        )
        self._check_agreement(result, label)
        return result

    def _frame_for(self, readings: list[Reading]) -> Frame:
        if self.frame is not None:
            return self.frame
        config = self.config
        return Frame(
            readings[0].matrix, config.imu.mounting, config.mechanism_order,
            config.letters,
        )  # fmt: skip

    def _settled(
        self, since: float, deadline: float, reason: str
    ) -> tuple[list[Status], float, str]:
        settle, poll = self.config.settle, self.config.motion.poll_s
        while True:
            self._guard_standing()
            statuses = [self._status(drive) for drive in self.drives]
            now = time.monotonic()
            if any(status.moving for status in statuses):
                since, reason = now, "a drive is moving"
            self.imu.check_fault()
            readings = self.imu.since(max(since, now - settle.window_s))
            span = readings[-1].time - readings[0].time if readings else 0.0
            if len(readings) < settle.min_samples or span < 0.8 * settle.window_s:
                reason = f"{len(readings)} readings over {span:.2f} s of the window"
            elif now - readings[-1].time > self.config.imu.stale_s:
                reason = "the phone's readings are stale"
            else:
                quiet, reason = self._quiet(readings)
                if quiet:
                    return statuses, since, reason
            if now > deadline:
                raise MotionFault(f"did not settle in {settle.timeout_s:g} s: {reason}")
            time.sleep(poll)

    def _quiet(self, readings: list[Reading]) -> tuple[bool, str]:
        settle = self.config.settle
        frame = self._frame_for(readings)
        angles = frame.angles(np.array([reading.matrix for reading in readings]))
        times = np.array([reading.time for reading in readings])
        std = angles.std(axis=0, ddof=1)
        if (std > settle.std_deg).any():
            return False, _unquiet("deviation", std, "deg")
        times = times - times.mean()
        slope = np.abs(times @ (angles - angles.mean(axis=0)) / (times @ times))
        if (slope > settle.slope_deg_s).any():
            return False, _unquiet("slope", slope, "deg/s")
        return True, ""

    def _collect(self, deadline: float, wanted: int) -> list[Reading] | None:
        """Fresh readings as wanted, or None where the stream paused or time is up."""
        start = time.monotonic()
        polled = start
        while True:
            self._guard_standing()
            self.imu.check_fault()
            readings = self.imu.since(start)
            if len(readings) >= wanted:
                return readings[:wanted]
            now = time.monotonic()
            newest = readings[-1].time if readings else start
            if now - newest > self.config.imu.stale_s or now > deadline:
                return None
            if now - polled > self.config.motion.poll_s:
                polled = now
                if any(self._status(drive).moving for drive in self.drives):
                    raise MotionFault("a drive moves while the posture is measured")
            time.sleep(0.002)

    def _guard_standing(self) -> None:
        self.signals.check_stop()
        self.stopper.check()
        self.heartbeat.feed(moving=False)

    def _check_agreement(self, measurement: Measurement, label: str) -> None:
        """The joints are where the drives say, roughly, and moved when they moved."""
        config = self.config
        commanded = config.to_deg(measurement.pulses)
        for axis, pulses, feedback in zip(
            config.axes, measurement.pulses, measurement.feedback, strict=True
        ):
            if abs(pulses - feedback) > self._tolerance(axis.name):
                raise MotionFault(f"{axis.name} left its target while settling")
        if self.frame is None:
            return
        apart = np.abs(measurement.angles - commanded)
        if (apart > config.motion.max_disagreement_deg).any():
            worst = int(np.argmax(apart))
            raise MotionFault(
                f"the IMU reads {AXIS_NAMES[worst]} {apart[worst]:.1f} deg away from "
                "the command: wrong zero, axis order or signs?"
            )
        if self._seen is not None:
            asked = np.abs(commanded - self._seen[0])
            seen = np.abs(measurement.angles - self._seen[1])
            leading = max(FOLLOW_MIN_DEG, FOLLOW_LEADING * float(asked.max()))
            for index, name in enumerate(AXIS_NAMES):
                if asked[index] < leading:
                    self._unproven[index].append(label)
                elif seen[index] < FOLLOW_SHARE * asked[index]:
                    raise NotFollowing(
                        f"the drive of {name} turned {asked[index]:.1f} deg, the IMU "
                        f"saw {seen[index]:.2f}: a slipped coupling, a frozen stream, "
                        "or axes mixed up",
                        self._unproven[index],
                    )
                else:
                    self._unproven[index] = []
        self._seen = (commanded, measurement.angles)


def _unquiet(what: str, values: Array, unit: str) -> str:
    worst = int(np.argmax(values))
    return f"{what} of {AXIS_NAMES[worst]} is {values[worst]:.3f} {unit}"
