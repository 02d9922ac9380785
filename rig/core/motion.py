"""Moving, in pieces that the proof allows, with every check at every poll."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import NamedTuple

from rig.config.axis import Axis, Pulses
from rig.core.device import Device, Posture, approach, check_plan
from rig.core.heartbeat import SLEPT_S, clock_ahead_s
from rig.drives.drive import START_S, STILL_COUNTS, Drive, Status
from rig.drives.line import BusError
from rig.faults import EndedShort, MotionFault, Unreachable
from rig.readings.geometry import Array

DEADLINE_FACTOR, DEADLINE_SLACK_S = 2.0, 2.0  # of a move's computed time, and more
FOLLOWING_DEG = 3.0  # a drive may leave its way by
TOO_FAST = 1.6  # times the speed that is asked for: more is a fault, but of a crawl:
LEAST_TURNS_S, LEAST_DEG_S = 0.05, 5.0  # motor, joint: many drives begin at 2 rpm
SPAN_S = 0.5  # over which a speed is taken, or from the start of the move
TOOK_POLL_S = 0.05  # of a drive that may have taken a move
STALE_S = 0.4  # after which drives are looked at again before they move
LAG_S = 0.1  # of the phone behind a move that is longer than those before


class Arrival(NamedTuple):
    """A device that stands where it was told to go."""

    device: Device
    posture: Posture


def move(device: Device, posture: Posture) -> Arrival:
    """Move all axes to a posture, in pieces, from the chosen side.

    LimitError: outside the limits, nothing was sent. Unreachable: a drive refused the
    target. EndedShort: one ended short of it. MotionFault, BusError, ReadingError,
    StopRequested: stop everything.
    """
    if not device.armed:
        raise MotionFault("not armed")
    device.guard()
    check_plan(device.config, [posture.pulses])
    device.emit("phase", phase="moving")
    for point in approach(device.config, posture.pulses):
        while not _piece(device, point, posture.name):
            pass
    return Arrival(device, posture)


def _piece(device: Device, goal: Pulses, label: str) -> bool:
    """Go as far to a goal as the proof allows, and look; whether it is reached."""
    proof, config = device.proof, device.config
    connection, attitude = _look(device)
    ahead_s, starts = clock_ahead_s(), device.statuses()
    here = tuple(start.position for start in starts)
    device.check_untouched(here)
    way = config.to_deg(goal) - config.to_deg(here)
    steps = math.ceil(float(abs(way).max()) / config.motion.max_step_deg - 1e-9)
    end = goal
    if steps > 1:
        end = config.to_pulses(config.to_deg(here) + way / steps)
    end = proof.begin(device.imu, attitude, here, end)
    for index, drive in enumerate(device.drives):
        drive.axis = proof.paced(index, end[index] - here[index], end[index])
    device.heartbeat.feed(moving=True)
    try:
        late = time.monotonic() - starts[-1].time > STALE_S
        if late or clock_ahead_s() - ahead_s > SLEPT_S:
            return False  # a drive may have been off and on since: look again
        device.untrack()  # until it arrives
        if end != here:
            device.last_move = label, here, end
        for index, (drive, pulses) in enumerate(zip(device.drives, end, strict=True)):
            start = starts[index]
            device.guard(moving=True)
            if start.position == pulses and start.done:
                continue
            device.moves += 1
            device.emit(
                "command", number=device.moves, label=label, axis=drive.axis.name,
                pulses=pulses, start=start.position,
            )  # fmt: skip
            starts[index] = dataclasses.replace(start, asked=time.monotonic())
            _send(device, drive, start, pulses)
        _watch(device, starts, end, connection)
    finally:
        device.heartbeat.feed(moving=False)
    device.arrived = time.monotonic()
    device.rest, device.targets = end, [drive.held() for drive in device.drives]
    if proof.grows(here, end) and connection == device.imu.connections:
        proof.saw(here, end, device.attitude(device.arrived + LAG_S))
    return end == goal


def _look(device: Device) -> tuple[int, Array]:
    """Connection of the phone, and a reading over it since the device arrived."""
    while True:
        connection = device.imu.connections
        attitude = device.attitude(device.arrived)
        if connection == device.imu.connections:
            return connection, attitude


def _send(device: Device, drive: Drive, start: Status, pulses: int) -> None:
    motion, axis = device.config.motion, drive.axis
    tolerance = axis.pulses_within(motion.position_tolerance_deg)
    for tries_left in reversed(range(1 + device.config.bus.read_retries)):
        try:
            return drive.go(pulses)
        except BusError as error:
            if error.out_of_reach:
                raise Unreachable(f"{axis.name} to {pulses} pulses: {error}") from None
            if error.refused:
                drive.sound()  # an alarm says more than a refusal
                raise
            obeys = took(drive, pulses, start, tolerance)
            outcome = {True: "obeyed", False: "not taken", None: "unknown"}[obeys]
            device.emit("lost_reply", axis=axis.name, pulses=pulses, outcome=outcome)
            if obeys:
                return None
            if obeys is None or not tries_left:
                raise
            device.guard(moving=True)  # no move once a stop was asked for


def took(drive: Drive, pulses: int, start: Status, tolerance: int) -> bool | None:
    """Whether the drive obeys a move whose reply was lost; None: unknown.

    A drive that obeys moves, has left ``start`` by more than ``tolerance`` pulses, or
    is at its target. One that does not holds another target, or has stood idle at
    ``start`` for START_S. MotionFault: it is in alarm.
    """
    begun = time.monotonic()
    while True:
        status, held = drive.sound(), drive.held()
        other = held is not None and held - drive.origin != pulses
        idle = status.done and not status.moving
        if idle and abs(status.position - pulses) <= tolerance:
            return True
        if status.moving or abs(status.position - start.position) > tolerance:
            return None if other else True
        if idle and other:
            return False
        if time.monotonic() - begun > START_S:
            return False if idle else None
        time.sleep(TOOK_POLL_S)


def _watch(
    device: Device, starts: list[Status], target: Pulses, connection: int
) -> None:
    """Poll until all stand on their targets, or something is wrong."""
    motion, begun = device.config.motion, time.monotonic()
    here = tuple(start.position for start in starts)
    most_s = _most_s(device, here, target)
    last = [(position, begun) for position in here]
    statuses = [[start] for start in starts]
    while True:
        device.guard(moving=True)
        late = []
        for index, drive in enumerate(device.drives):
            axis, goal, start = drive.axis, target[index], here[index]
            status = drive.sound()
            statuses[index].append(status)
            _check_speed(device, axis, statuses[index])
            tolerance = axis.pulses_within(motion.position_tolerance_deg)
            if abs(status.position - goal) <= tolerance:
                # A short move ends within the tolerance before it has begun.
                half = 2 * abs(status.position - start) >= abs(goal - start)
                begins = not half and status.time - begun < START_S
                if not status.done or status.moving or begins:
                    late.append(axis.name)
                continue
            late.append(axis.name)
            _require_on_way(axis, start, goal, status)
            if abs(status.position - last[index][0]) > STILL_COUNTS:
                last[index] = (status.position, status.time)
                if device.line.in_turn:  # who waits for it does not stall
                    last = [(place, status.time) for place, _ in last]
            elif (stood := status.time - last[index][1]) > motion.stall_s:
                moved = abs(status.position - start) > tolerance
                raise _stalled(axis, goal, status, moved, stood, motion.stall_s)
        if not late:
            return
        if time.monotonic() > begun + most_s:
            raise MotionFault(
                f"{', '.join(late)} does not follow: the move took longer than "
                f"{most_s:.2f} s. Check the drives' speed and load"
            )
        _check_attitude(device, connection)
        time.sleep(motion.poll_s)


def _most_s(device: Device, here: Pulses, target: Pulses) -> float:
    """Seconds that a move may take, by the speeds of the drives."""
    most_s = 0.0
    for drive, a, b in zip(device.drives, here, target, strict=True):
        speed, accel = drive.axis.drive_motion
        needed_s = abs(drive.axis.to_deg(b - a)) / speed + speed / accel
        most_s = most_s + needed_s if device.line.in_turn else max(most_s, needed_s)
    return DEADLINE_FACTOR * most_s + DEADLINE_SLACK_S


def _require_on_way(axis: Axis, start: int, goal: int, status: Status) -> None:
    begin, end, angle = map(axis.to_deg, (start, goal, status.position))
    low, high = min(begin, end) - FOLLOWING_DEG, max(begin, end) + FOLLOWING_DEG
    if not low <= angle <= high:
        raise MotionFault(
            f"{axis.name} is at {angle:.3f} {axis.unit_name} while moving from "
            f"{begin:.3f} to {end:.3f}, more than {FOLLOWING_DEG:g} off. Check "
            "gearing and direction, and that no other controller moves it"
        )


def _stalled(
    axis: Axis, goal: int, status: Status, moved: bool, stood_s: float, stall_s: float
) -> MotionFault:
    end, angle = map(axis.to_deg, (goal, status.position))
    short_by = abs(end - angle)
    if status.done and not status.moving and moved:
        return EndedShort(
            f"{axis.name} stopped {short_by:.3f} {axis.unit_name} short of its "
            f"target, at {angle:.3f}, and its drive reports the move as done. Find "
            "out what stopped it: another controller, an emergency stop that was "
            "released, or a limit of the drive",
            axis.name, status.position,
        )  # fmt: skip
    return MotionFault(
        f"{axis.name} does not follow: it has been {short_by:.3f} {axis.unit_name} "
        f"from its target for {stood_s:.2f} s (limit motion.stall_s = {stall_s:g}). "
        "Look for an obstacle, a loose coupling, a drive that is not enabled, or "
        "something that stopped it"
    )


def _check_speed(device: Device, axis: Axis, seen: list[Status]) -> None:
    # It was where it was at some time after it was asked and before it answered, so
    # that a slow reply makes no speed; nor do counts by which two readings may differ.
    (first, *_, last), asked = seen, axis.drive_motion[0]
    marks = [s for s in seen[1:-1] if last.time - s.asked > SPAN_S]
    speed = 0.0
    for mark in (*marks[-1:], first):
        counts = abs(last.position - mark.position) - STILL_COUNTS
        way = abs(axis.to_deg(max(0, counts)))
        speed = max(speed, way / (last.time - mark.asked))
    slowest = min(LEAST_TURNS_S / axis.turns_per_deg, LEAST_DEG_S)
    if speed > max(TOO_FAST * asked, slowest) and not device.simulated:
        raise MotionFault(
            f"{axis.name} moves at {speed:.3g} {axis.unit_name}/s or faster instead "
            f"of the commanded {asked:.3g}: the drive does not accept its speed. "
            f"Check `units` and `move` of the map {axis.map.name}, pulses_per_rev and "
            "reduction"
        )


def _check_attitude(device: Device, connection: int) -> None:
    """The phone is fresh, turned as far as it may be, inside the limits' envelope."""
    device.meanwhile()
    reading = device.imu.latest()
    if device.imu.connections == connection:  # its heading is another since
        device.proof.watch(reading.value)
    if device.frame is None or not device.oriented or not device.geometry.of_joints:
        return
    margin = device.config.motion.envelope_margin_deg
    angles = device.frame.angles(reading.value)
    for axis, angle in zip(device.config.axes, angles, strict=True):
        low, high = axis.min_deg - margin, axis.max_deg + margin
        if not low <= angle <= high:
            raise MotionFault(
                f"the IMU reads {axis.name} at {angle:.2f} deg, outside the allowed "
                f"{low:.1f}..{high:.1f}. Check the zero posture and that the phone is "
                "fixed, then run `jaxcal-rig setup axes`"
            )
