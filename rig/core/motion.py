"""Moving, with every check at every poll."""

from __future__ import annotations

import time

import numpy as np

from rig.config.axis import Pulses
from rig.core.bus import BusError, Rejected
from rig.core.device import Device, approach, check_plan, outside
from rig.core.drive import Drive, Status, refusal
from rig.core.faults import LimitError, MotionFault, Unreachable
from rig.core.stop import STILL_COUNTS


class Motion:
    """Moves of a device under guard."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.config = device.config
        self._moves = 0

    def move_to(self, target: Pulses, label: str) -> None:
        """Move all three axes to absolute pulses, in steps, from the chosen side.

        Raises:
            LimitError: the target leaves the limits; nothing was sent.
            Unreachable: a drive refused the target or ended short of it.
            MotionFault, BusError, ImuError, StopRequested: stop everything.
        """
        if not self.device.armed:
            raise MotionFault("not armed")
        self.device.guard()
        check_plan(self.config, [target])
        self.device.emit("phase", phase="moving")
        for point in approach(self.config, target):
            self._travel(point, label)

    def _travel(self, target: Pulses, label: str) -> None:
        start = self.config.to_deg(self.device.positions())
        way = self.config.to_deg(target) - start
        longest = float(np.abs(way).max())
        steps = max(1, int(np.ceil(longest / self.config.motion.max_step_deg - 1e-9)))
        for step in range(1, steps):
            self._step(self.config.to_pulses(start + way * step / steps), label)
        self._step(target, label)

    def _step(self, target: Pulses, label: str) -> None:
        if faults := list(outside(self.config, target)):
            raise LimitError("; ".join(faults))
        device = self.device
        starts = device.statuses()
        device.heartbeat.feed(moving=True)
        try:
            for drive, start, pulses in zip(device.drives, starts, target, strict=True):
                device.guard(moving=True)
                if start.position == pulses and start.done:
                    continue
                self._moves += 1
                device.emit(
                    "command", number=self._moves, label=label, axis=drive.axis.name,
                    pulses=pulses,
                )  # fmt: skip
                self._send(drive, start, pulses)
            begun = time.monotonic()
            deadline = begun + self._deadline_s(starts, target)
            self._watch(starts, target, begun, deadline)
        finally:
            device.heartbeat.feed(moving=False)

    def _send(self, drive: Drive, start: Status, pulses: int) -> None:
        """Start one drive's move.

        Where the reply is lost the drive is read: it obeys, or it does not and is sent
        the same absolute target again, or that is unknown and everything stops.
        """
        motion, axis = self.config.motion, drive.axis
        tries = 1 + self.config.bus.read_retries
        while True:
            tries -= 1
            try:
                return drive.move(pulses)
            except BusError as error:
                if refusal(error):
                    if isinstance(error, Rejected) and error.code in (2, 3):
                        raise Unreachable(
                            f"{axis.name} refused {pulses}: {error}"
                        ) from None
                    drive.sound()  # an alarm says more than a refusal
                    raise
                tolerance = axis.pulses_within(motion.position_tolerance_deg)
                took = drive.took(pulses, start, tolerance)
                found = {True: "obeyed", False: "not taken", None: "unknown"}[took]
                self.device.emit(
                    "lost_reply", axis=axis.name, pulses=pulses, outcome=found
                )
                if took:
                    return None
                if took is None or not tries:
                    raise
                self.device.guard(moving=True)  # no move once a stop was asked for

    def _deadline_s(self, starts: list[Status], target: Pulses) -> float:
        motion = self.config.motion
        longest = 0.0
        for axis, start, end in zip(self.config.axes, starts, target, strict=True):
            way = abs(axis.to_deg(end - start.position))
            speed, accel = axis.drive_motion
            longest = max(longest, way / speed + speed / accel)
        return motion.deadline_factor * longest + motion.deadline_slack_s

    def _watch(
        self, starts: list[Status], target: Pulses, begun: float, deadline: float
    ) -> None:
        """Poll until all three stand on their targets, or something is wrong."""
        motion = self.config.motion
        last = [(s.position, begun) for s in starts]
        while True:
            self.device.guard(moving=True)
            arrived = 0
            for index, drive in enumerate(self.device.drives):
                axis, goal, start = drive.axis, target[index], starts[index].position
                status = drive.sound()
                tolerance = axis.pulses_within(motion.position_tolerance_deg)
                if abs(status.position - goal) <= tolerance:
                    arrived += status.done and not status.moving
                    continue
                self._check_corridor(drive, start, goal, status.position)
                if abs(status.position - last[index][0]) > STILL_COUNTS:
                    last[index] = (status.position, status.time)
                elif (stood := status.time - last[index][1]) > motion.stall_s:
                    left = abs(axis.to_deg(goal - status.position))
                    moved = abs(status.position - start) > tolerance
                    if status.done and not status.moving and moved:
                        raise Unreachable(
                            f"{axis.name} ended {left:.3f} deg short of its target"
                        )
                    raise MotionFault(
                        f"{axis.name} does not follow: it stands {left:.3f} deg from "
                        f"its target for {stood:.2f} s (limit motion.stall_s = "
                        f"{motion.stall_s:g}). Look for an obstacle, a loose coupling, "
                        "or a drive that is not enabled"
                    )
            if arrived == len(self.device.drives):
                return
            if time.monotonic() > deadline:
                raise MotionFault(
                    f"the move took longer than its deadline, {deadline - begun:.2f} s."
                    " Check the drives' speed, or raise motion.deadline_factor"
                )
            self._check_attitude()
            time.sleep(motion.poll_s)

    def _check_corridor(self, drive: Drive, start: int, goal: int, here: int) -> None:
        axis, allowed = drive.axis, self.config.motion.following_deg
        begin, end, angle = map(axis.to_deg, (start, goal, here))
        if not min(begin, end) - allowed <= angle <= max(begin, end) + allowed:
            raise MotionFault(
                f"{axis.name} is at {angle:.3f} deg on its way from {begin:.3f} to "
                f"{end:.3f}, more than motion.following_deg off it. Check gearing and "
                "direction, and that no other controller moves it"
            )

    def _check_attitude(self) -> None:
        """The IMU is fresh, and inside the envelope of the limits."""
        reading, frame = self.device.imu.latest(), self.device.frame
        if frame is None or not self.device.oriented:
            return
        margin = self.config.motion.envelope_margin_deg
        angles = frame.angles(reading.matrix)
        for axis, angle in zip(self.config.axes, angles, strict=True):
            low, high = axis.min_deg - margin, axis.max_deg + margin
            if not low <= angle <= high:
                raise MotionFault(
                    f"the IMU reads {axis.name} at {angle:.2f} deg, outside its "
                    f"envelope {low:.1f}..{high:.1f}. Check zero, axis order and "
                    "signs, and that the phone is fixed"
                )
