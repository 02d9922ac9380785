"""Moving, in pieces that the proof allows, with every check at every poll."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

from rig.config.axis import Pulses
from rig.core.bus import BusError, Rejected
from rig.core.device import Device, Posture, approach, check_plan, outside
from rig.core.drive import START_S, Drive, Status, refusal
from rig.core.faults import LimitError, MotionFault, Unreachable
from rig.core.stop import STILL_COUNTS

LAG_S = 0.1  # of the phone behind a move that is longer than those before


class Standing(NamedTuple):
    """A device that stands where it was told to go."""

    device: Device
    posture: Posture


def move(device: Device, posture: Posture) -> Standing:
    """Move all three axes to a posture, in pieces, from the chosen side.

    Raises:
        LimitError: the target leaves the limits; nothing was sent.
        Unreachable: a drive refused the target or ended short of it.
        MotionFault, BusError, ImuError, StopRequested: stop everything.
    """
    if not device.armed:
        raise MotionFault("not armed")
    device.guard()
    check_plan(device.config, [posture.pulses])
    device.emit("phase", phase="moving")
    for point in approach(device.config, posture.pulses):
        while not _piece(device, point, posture.name):
            pass
    return Standing(device, posture)


def _piece(device: Device, goal: Pulses, label: str) -> bool:
    """Go as far to a goal as the proof allows, and look; whether it is reached."""
    proof, config = device.proof, device.config
    connection, attitude = device.imu.connections, device.attitude(device.arrived)
    starts = device.statuses()
    here = starts[0].position, starts[1].position, starts[2].position
    way = config.to_deg(goal) - config.to_deg(here)
    steps = math.ceil(float(abs(way).max()) / config.motion.max_step_deg - 1e-9)
    end = goal
    if steps > 1:
        end = config.to_pulses(config.to_deg(here) + way / steps)
    end = proof.begin(device.imu, attitude, here, end)
    if faults := list(outside(config, end)):
        raise LimitError("; ".join(faults))
    for index, drive in enumerate(device.drives):
        drive.axis = proof.paced(index, end[index] - here[index])
    device.heartbeat.feed(moving=True)
    try:
        for drive, start, pulses in zip(device.drives, starts, end, strict=True):
            device.guard(moving=True)
            if start.position == pulses and start.done:
                continue
            device.moves += 1
            device.emit(
                "command", number=device.moves, label=label, axis=drive.axis.name,
                pulses=pulses,
            )  # fmt: skip
            _send(device, drive, start, pulses)
        begun = time.monotonic()
        deadline = begun + _deadline_s(device, starts, end)
        _watch(device, starts, end, begun, deadline, connection)
    finally:
        device.heartbeat.feed(moving=False)
    device.arrived = time.monotonic()
    if proof.grows(here, end) and connection == device.imu.connections:
        proof.saw(here, end, device.attitude(device.arrived + LAG_S))
    return end == goal


def _send(device: Device, drive: Drive, start: Status, pulses: int) -> None:
    """Start one drive's move.

    Where the reply is lost the drive is read: it obeys, or it does not and is sent
    the same absolute target again, or that is unknown and everything stops.
    """
    motion, axis = device.config.motion, drive.axis
    tries = 1 + device.config.bus.read_retries
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
            device.emit("lost_reply", axis=axis.name, pulses=pulses, outcome=found)
            if took:
                return None
            if took is None or not tries:
                raise
            device.guard(moving=True)  # no move once a stop was asked for


def _deadline_s(device: Device, starts: list[Status], target: Pulses) -> float:
    motion = device.config.motion
    longest = 0.0
    for drive, start, end in zip(device.drives, starts, target, strict=True):
        axis = drive.axis
        way = abs(axis.to_deg(end - start.position))
        speed, accel = axis.drive_motion
        longest = max(longest, way / speed + speed / accel)
    return motion.deadline_factor * longest + motion.deadline_slack_s


def _watch(
    device: Device,
    starts: list[Status],
    target: Pulses,
    begun: float,
    deadline: float,
    connection: int,
) -> None:
    """Poll until all three stand on their targets, or something is wrong."""
    motion = device.config.motion
    last = [(s.position, begun) for s in starts]
    while True:
        device.guard(moving=True)
        arrived = 0
        for index, drive in enumerate(device.drives):
            axis, goal, start = drive.axis, target[index], starts[index].position
            status = drive.sound()
            tolerance = axis.pulses_within(motion.position_tolerance_deg)
            if abs(status.position - goal) <= tolerance:
                # A short move ends within the tolerance before it has begun.
                half = 2 * abs(status.position - start) >= abs(goal - start)
                begins = not half and status.time - begun < START_S
                arrived += status.done and not status.moving and not begins
                continue
            _check_corridor(device, drive, start, goal, status.position)
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
        if arrived == len(device.drives):
            return
        if time.monotonic() > deadline:
            raise MotionFault(
                f"the move took longer than its deadline, {deadline - begun:.2f} s."
                " Check the drives' speed, or raise motion.deadline_factor"
            )
        _check_attitude(device, connection)
        time.sleep(motion.poll_s)


def _check_corridor(
    device: Device, drive: Drive, start: int, goal: int, here: int
) -> None:
    axis, allowed = drive.axis, device.config.motion.following_deg
    begin, end, angle = map(axis.to_deg, (start, goal, here))
    if not min(begin, end) - allowed <= angle <= max(begin, end) + allowed:
        raise MotionFault(
            f"{axis.name} is at {angle:.3f} deg on its way from {begin:.3f} to "
            f"{end:.3f}, more than motion.following_deg off it. Check gearing and "
            "direction, and that no other controller moves it"
        )


def _check_attitude(device: Device, connection: int) -> None:
    """The phone is fresh, turned as far as it may be, inside the limits' envelope."""
    device.meanwhile()
    reading, frame = device.imu.latest(), device.frame
    if device.imu.connections == connection:  # its heading is another since
        device.proof.watch(reading.matrix)
    if frame is None or not device.oriented:
        return
    margin = device.config.motion.envelope_margin_deg
    angles = frame.angles(reading.matrix)
    for axis, angle in zip(device.config.axes, angles, strict=True):
        low, high = axis.min_deg - margin, axis.max_deg + margin
        if not low <= angle <= high:
            raise MotionFault(
                f"the IMU reads {axis.name} at {angle:.2f} deg, outside its "
                f"envelope {low:.1f}..{high:.1f}. Check zero, axis order and "
                "signs, and that the phone is fixed"
            )
