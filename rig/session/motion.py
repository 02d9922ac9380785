"""Arming and moving, with every check at every poll.

The loops here read drives and IMU, look at the clock and the signals, and do nothing
else: no JAX, no files but the journal's callback.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.config.axis import Axis, Pulses
from rig.config.config import RigConfig
from rig.device.bus import Bus, BusError, Rejected
from rig.device.drives import Drive, Status
from rig.device.imu import Imu, ImuError
from rig.guard.faults import LimitError, MotionFault, Unreachable
from rig.guard.limits import approach_point, check_plan, outside
from rig.guard.signals import Signals
from rig.guard.stop import Stopper
from rig.guard.watchdog import Heartbeat
from rig.session.measuring import Observer


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
        self.armed = False
        self._log = log
        self._phase = phase
        self._moves = 0
        watched = [a.comm_timeout_s for a in config.axes if a.comm_timeout_s]
        self.heartbeat = Heartbeat(
            stopper, config.motion.heartbeat_s, min(watched) / 4 if watched else 0.0
        )
        self.observer = Observer(
            config, imu, lambda: self._guard(moving=False), self._statuses, phase
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
            self._check_fit(drive, reset_alarms)
            axis = drive.axis
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

    def _check_fit(self, drive: Drive, reset_alarms: bool) -> None:
        axis, status = drive.axis, drive.status()
        if status.fault and reset_alarms and axis.map.alarm_reset:
            drive.reset_alarm()
            status = drive.status()
        if status.fault:
            raise MotionFault(
                f"{axis.name} is in alarm: {drive.alarm() or 'no code given'}. Find "
                "the cause, then start again with --reset-alarms"
            )
        if status.moving:
            raise MotionFault(
                f"{axis.name} is already moving. Stop the other controller, then run "
                "`stop`"
            )
        if not status.enabled:
            drive.enable()
            if not drive.status().enabled:
                raise MotionFault(
                    f"{axis.name} does not enable its power stage. Check its "
                    "supply and its enable and STO inputs"
                )
        slack = self._tolerance(axis)
        if not axis.min_pulses - slack <= status.position <= axis.max_pulses + slack:
            raise MotionFault(
                f"{axis.name} stands at {status.position} pulses, outside its limits "
                f"{axis.min_pulses}..{axis.max_pulses}. Home it first"
            )

    def positions(self) -> Pulses:
        """Where the drives stand, in pulses."""
        a, b, c = (drive.status().position for drive in self.drives)
        return a, b, c

    def _tolerance(self, axis: Axis) -> int:
        return axis.pulses_within(self.config.motion.position_tolerance_deg)

    # Moving

    def move_to(self, target: Pulses, label: str) -> None:
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

    def _travel(self, target: Pulses, label: str) -> None:
        start = self.config.to_deg(self.positions())
        way = self.config.to_deg(target) - start
        longest = float(np.abs(way).max())
        steps = max(1, int(np.ceil(longest / self.config.motion.max_step_deg - 1e-9)))
        for step in range(1, steps + 1):
            point = target
            if step < steps:
                point = self.config.to_pulses(start + way * step / steps)
            self._step(point, label)

    def _step(self, target: Pulses, label: str) -> None:
        faults = outside(self.config, target)
        if faults:
            raise LimitError("; ".join(faults))
        starts = self._statuses()
        begun = time.monotonic()
        deadline = begun + self._deadline_s([s.position for s in starts], target)
        self.heartbeat.feed(moving=True)
        try:
            for drive, start, pulses in zip(self.drives, starts, target, strict=True):
                self._guard()
                if start.position == pulses and start.done:
                    continue
                self._moves += 1
                name, number = drive.axis.name, self._moves
                self._log(
                    "command", number=number, label=label, axis=name, pulses=pulses
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

    def _deadline_s(self, starts: list[int], target: Pulses) -> float:
        motion = self.config.motion
        longest = 0.0
        for axis, start, end in zip(self.config.axes, starts, target, strict=True):
            way = abs(axis.to_deg(end - start))
            ramp = axis.speed_deg_s / axis.accel_deg_s2
            longest = max(longest, way / axis.speed_deg_s + ramp)
        return motion.deadline_factor * longest + motion.deadline_slack_s

    def _watch(
        self,
        starts: list[Status],
        target: Pulses,
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
                tolerance = self._tolerance(axis)
                if abs(status.position - target[index]) <= tolerance:
                    arrived += status.done and not status.moving
                    continue
                self._corridor(drive, starts[index].position, target[index], status)
                if abs(status.position - last[index][0]) > 1:
                    last[index] = (status.position, status.time)
                elif status.time - last[index][1] > motion.stall_s:
                    left = abs(axis.to_deg(target[index] - status.position))
                    moved = abs(status.position - starts[index].position) > tolerance
                    if status.done and not status.moving and moved:
                        raise Unreachable(
                            f"{axis.name} ended {left:.3f} deg short of its target"
                        )
                    raise MotionFault(
                        f"{axis.name} does not follow: it stands {left:.3f} deg from "
                        f"its target for {status.time - last[index][1]:.2f} s (limit "
                        f"motion.stall_s = {motion.stall_s:g}). Look for an obstacle, "
                        "a loose coupling, or a drive that is not enabled"
                    )
            if arrived == len(self.drives):
                return
            if time.monotonic() > deadline:
                raise MotionFault(
                    f"the move took longer than its deadline, {deadline - begun:.2f} s."
                    " Check the drives' speed, or raise motion.deadline_factor"
                )
            self._check_attitude()
            time.sleep(motion.poll_s)

    def _corridor(self, drive: Drive, start: int, end: int, status: Status) -> None:
        axis = drive.axis
        slack = self.config.motion.following_deg * abs(axis.pulses_per_deg)
        low, high = min(start, end) - slack, max(start, end) + slack
        if not low <= status.position <= high:
            here, begin, goal = map(axis.to_deg, (status.position, start, end))
            raise MotionFault(
                f"{axis.name} is at {here:.3f} deg on its way from {begin:.3f} to "
                f"{goal:.3f}, more than motion.following_deg off it. Check gearing and "
                "direction, and that no other controller moves it"
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

    def _guard(self, moving: bool = True) -> None:
        self.signals.check_stop()
        self.stopper.check()
        self.heartbeat.feed(moving)

    def _statuses(self) -> list[Status]:
        return [self._status(drive) for drive in self.drives]

    def _check_attitude(self) -> None:
        """The IMU is fresh, inside the envelope, and where the drives say."""
        reading = self.imu.latest()
        frame = self.observer.frame
        if frame is None:
            return
        motion = self.config.motion
        angles = frame.angles(reading.matrix)
        for axis, angle in zip(self.config.axes, angles, strict=True):
            low = axis.min_deg - motion.envelope_margin_deg
            high = axis.max_deg + motion.envelope_margin_deg
            if not low <= angle <= high:
                raise MotionFault(
                    f"the IMU reads {axis.name} at {angle:.2f} deg, outside its "
                    f"envelope {low:.1f}..{high:.1f}. Check zero, axis order and "
                    "signs, and that the phone is fixed"
                )
