"""Every way that the software has to stop the drives, tried in a slow move.

The axes move together, or one by one where their line moves them in turn. How far they
went on, there and in a faster move, says how fast an axis may be near a limit.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rig.command_run import Run
from rig.config.axis import Pulses
from rig.core import stop
from rig.core.device import Device, Posture, Reached
from rig.core.motion import move
from rig.core.proof import FASTER, StopDistance, stop_distances
from rig.drives import Drive
from rig.drives.drive import STILL_COUNTS, Status
from rig.faults import MotionFault
from rig.journal.device import STOP_PROVED

REACH_DEG = 3.0  # either side
ADD_UP = 3.0  # axes: more move less far
SPEED_DEG_S = 5.0
FAST_DEG_S = 15.0  # of the second stop, at most
BEGIN, LATE = 0.3, 0.6  # share of the way at which a stop is sent, and the latest
SHORT = 0.1  # share of the way that must be left
TRIES = 4  # each half as fast, where the stop came late
STAND_S = 3.0
REPEATS, UNSURE, UNSURE_S = 3, 1.5, 0.001  # of a stop whose times are uncertain
SILENCE_S = 0.5  # besides the drives' own timeout
TURNED_DEG = 0.3  # of the phone, while the drives stand

BY_UNITS = "the stop of each unit"

Times = list[tuple[float, float]]
Act = Callable[[Device], Times]
Ends = tuple[Pulses, Pulses]  # of a move


class StopTrial(NamedTuple):
    """What a stop did, by axis."""

    after_deg: dict[str, float]  # that it went on from where it was last seen
    speeds: dict[str, float]  # deg/s
    distances: dict[str, float]  # degrees from where it was when its stop was sent
    unsure_s: float = 0.0  # of the times of that: how long the exchanges took


def prove_stops(run: Run, device: Device) -> None:
    """Try each way to stop: STOP_PROVED. MotionFault: an axis went on, or again."""
    start, axes, trials = device.positions(), run.config.axes, _Trials(run, device)
    evidence: dict[str, dict[str, float]] = {}
    distances: dict[str, dict[str, Any]] = {}
    offsets = [axis.to_pulses(trials.way_deg / 2) for axis in axes]
    low = tuple(p - offset for p, offset in zip(start, offsets, strict=True))
    high = tuple(p + offset for p, offset in zip(start, offsets, strict=True))
    silent_s = max(run.config.comm_timeouts_s.values(), default=0.0) + SILENCE_S
    ways: dict[str, tuple[Act, float]] = {BY_UNITS: (_stop_units, SPEED_DEG_S)}
    if device.line.stops_at_once(device.drives):
        ways["the broadcast stop"] = (_broadcast, SPEED_DEG_S)
    if silent_s > SILENCE_S:
        slow = min(SPEED_DEG_S, (1.0 - LATE - SHORT) * trials.way_deg / silent_s)
        be_silent = functools.partial(_be_silent, seconds=silent_s)
        ways["their watch of the line"] = (be_silent, slow)
    every = [*range(len(axes))]
    together = [[i] for i in every] if device.line.in_turn else [every]
    for name, (act, speed) in ways.items():
        for moved in together:
            end = tuple(high[i] if i in moved else low[i] for i in every)
            tried = trials.prove(name, act, speed, (low, end))
            evidence[name] = evidence.get(name, {}) | tried.after_deg
            if name == BY_UNITS:
                distances |= trials.distances(tried, (low, end))
    device.proof.ceiling_deg_s = None
    move(device, Posture("back", start))
    more = {"ways": evidence, "distances": distances}
    run.emit("stop_proved", sync=True, **more)
    run.record.reach(STOP_PROVED, run.config, **more, run=run.folder.name)
    device.proof.stops = stop_distances(run.record, axes)
    run.say(f"the drives stop and do not move on: {', '.join(evidence)}")


class _Trials:
    """Stops of one device, tried one after another."""

    def __init__(self, run: Run, device: Device) -> None:
        self.run, self.device, self.axes = run, device, run.config.axes
        self.way_deg = 2 * REACH_DEG * min(1.0, ADD_UP / len(self.axes))

    def distances(self, first: StopTrial, ends: Ends) -> dict[str, dict[str, Any]]:
        """Speeds of two stops and how far axes went on, for ``StopDistance.of``."""
        tries, way, fast = [first], self.way_deg, FAST_DEG_S
        timed = [axis for axis in self.axes if axis.name in first.speeds]
        for axis in timed:
            speed, accel = axis.drive_motion
            gone = max(abs(first.after_deg[axis.name]), 1e-3)
            rest = (1.0 - LATE - SHORT) * way / gone
            reached = (BEGIN * way * accel) ** 0.5  # within less than BEGIN of its way
            fast = min(fast, speed, reached, first.speeds[axis.name] * rest**0.5)
        if fast > FASTER * (slow := max(first.speeds.values())):
            self.device.proof.stop_proved = True
            try:
                quick = self._surest([], fast, ends)
                if quick.speeds:
                    tries = [self._surest([first], slow, ends), quick]
            finally:
                self.device.proof.stop_proved = False
        points = {}
        for axis in timed:
            speed, accel = axis.drive_motion
            point: dict[str, Any] = {
                "speeds": [round(trial.speeds[axis.name], 4) for trial in tries],
                "distances": [round(trial.distances[axis.name], 4) for trial in tries],
                "accel": round(accel, 4),
            }
            points[axis.name] = point
            distance, unit = StopDistance.of(**point), axis.unit_name
            slowest = distance.fastest(axis, 0.0)
            self.run.say(
                f"  {axis.name}: stopping distance {distance.at(speed):.2g} {unit} at "
                f"{speed:.4g} {unit}/s"
                + f"; moves that end at a limit run at {slowest:.3g} {unit}/s, moves "
                "that end further inside run faster" * (slowest < speed)
            )
        return points

    def _surest(self, trials: list[StopTrial], speed: float, ends: Ends) -> StopTrial:
        """The trial of a speed whose times are surest, again on a busy computer."""
        name = f"{BY_UNITS}, at {speed:.3g} {self.run.config.axis_unit}/s"
        sure_s = UNSURE * max(map(_least_s, self.device.drives)) + UNSURE_S
        while len(trials) < REPEATS and all(t.unsure_s > sure_s for t in trials):
            trials.append(self.prove(name, _stop_units, speed, ends, look=False))
        return min(trials, key=lambda trial: trial.unsure_s)

    def prove(
        self, name: str, act: Act, speed_deg_s: float, ends: Ends, look: bool = True
    ) -> StopTrial:
        """Stop a move between ends; ``look`` whether all stay where they stand."""
        device, config, low = self.device, self.run.config, ends[0]
        for number in range(TRIES):
            device.proof.ceiling_deg_s = None
            move(device, Posture("the start of the stop", low))
            device.proof.ceiling_deg_s = speed_deg_s / 2**number
            places = _go(device, ends)
            if max(_shares(ends, places)) <= LATE:
                break
            _wait_until_still(device)  # it may end
            device.untrack()
        else:
            raise MotionFault(
                "no move is slow enough to be stopped before its end: bus and computer "
                "take too long between two polls of the drives"
            )
        last = [_last(drive) for drive in device.drives]
        told = [drive.axis.drive_motion[0] for drive in device.drives]
        sent = act(device)
        statuses = _wait_until_still(device)
        at = [status.position for status in statuses]
        gone, rows = _shares(ends, at), zip(config.axis_names, *ends, strict=True)
        going = [axis for axis, a, b in rows if a != b]
        self._require_stopped(name, statuses, dict(zip(going, gone, strict=True)), look)
        after_deg = {
            axis.name: round(axis.to_deg(b - a), 3)
            for axis, a, b in zip(self.axes, places, at, strict=True)
            if axis.name in going
        }
        self.run.say(
            f"  {name}: stood after "
            + ", ".join(f"{axis} {abs(deg):.2f}" for axis, deg in after_deg.items())
            + f" {config.axis_unit}"
            + f", and {stop.stand_s(device.drives):g} s later" * look
        )
        speeds: dict[str, float] = {}
        distances: dict[str, float] = {}
        unsure_s = 0.0
        trials = zip(self.axes, low, last, told, sent, strict=False)
        for axis, begun, before, asked_deg_s, (sent_s, heard_s) in trials:
            # Its target, not its stop, may be where it stands.
            if axis.name in after_deg and max(gone) <= 1.0 - SHORT:
                seen_s = (before.asked + 3.0 * before.time) / 4.0  # status, position
                way = abs(axis.to_deg(before.position - begun))
                speed = min(asked_deg_s, (2.0 * axis.drive_motion[1] * way) ** 0.5)
                meanwhile = speed * max(0.0, (sent_s + heard_s) / 2.0 - seen_s)
                went_on = abs(after_deg[axis.name]) - meanwhile
                speeds[axis.name], distances[axis.name] = speed, max(0.0, went_on)
                took_s = before.time - before.asked + heard_s - sent_s
                unsure_s = max(unsure_s, took_s)
        return StopTrial(after_deg, speeds, distances, unsure_s if speeds else math.inf)

    def _require_stopped(
        self, name: str, statuses: list[Status], shares: dict[str, float], look: bool
    ) -> None:
        """Reset alarms; ``look``: MotionFault where an axis went on, or moved again."""
        device, geometry = self.device, self.device.geometry
        if not look:
            self._reset_alarms(name)
            return device.untrack()
        went_on = [axis for axis, share in shares.items() if share > 1.0 - SHORT]
        attitude = device.attitude(time.monotonic())
        pairs = zip(device.drives, _look(device, statuses), statuses, strict=True)
        moved = [
            drive.axis.name
            for drive, now, then in pairs
            if abs(now.position - then.position) > STILL_COUNTS and now.enabled
        ]
        turned = geometry.apart(attitude, device.attitude(time.monotonic()))
        self._reset_alarms(name)
        device.untrack()
        if went_on:
            raise MotionFault(
                f"{', '.join(went_on)} moved on to the target after {name}: this "
                "program cannot stop it. Correct [stop], broadcast_stop or "
                "[comm_timeout] of the map; until then only the emergency stop stops "
                "the device"
            )
        if moved or turned > TURNED_DEG * geometry.scale:
            raise MotionFault(
                f"{', '.join(moved) or 'the measured part'} moved again after {name} "
                f"({geometry.told} {turned:.2f} {geometry.unit}). Set the drive so "
                "that it does not move on after a stop"
            )

    def _reset_alarms(self, name: str) -> None:
        """Reset alarms of drives that raise one when they stop themselves."""
        for drive in self.device.drives:
            axis = drive.axis.name
            if not drive.status().fault:
                continue
            reset = drive.can_reset and drive.bring(drive.reset, lambda s: not s.fault)
            if not reset or reset.fault:
                raise MotionFault(
                    f"{axis} stays in alarm after {name}: {drive.alarm()}. "
                    "Reset it, then run `jaxcal-rig setup axes` again"
                )
            self.run.say(f"  {axis}: its alarm after {name} was reset")
            if not drive.bring(drive.arm, lambda status: status.enabled).enabled:
                raise MotionFault(f"{axis} does not enable after {name}")


def _least_s(drive: Drive) -> float:
    """Seconds that a look at a drive takes at least, its stop besides."""
    looks = [drive.status() for _ in range(REPEATS)]
    return 1.5 * min(look.time - look.asked for look in looks)


def _go(device: Device, ends: Ends) -> list[int]:
    """Begin to move; where the drives are once all have gone BEGIN of their way."""

    def look() -> None:
        places = [_last(drive).position for drive in device.drives]
        if min(_shares(ends, places)) >= BEGIN:
            raise Reached

    device.meanwhile = look
    try:
        with contextlib.suppress(Reached):
            move(device, Posture("try the stop", ends[1]))
    finally:
        device.meanwhile = lambda: None
    return [_last(drive).position for drive in device.drives]


def _last(drive: Drive) -> Status:
    assert drive.last is not None  # it moves
    return drive.last


def _shares(ends: Ends, at: Sequence[int]) -> list[float]:
    """Shares of the way that those axes have gone that move."""
    return [(p - a) / (b - a) for a, b, p in zip(*ends, at, strict=True) if a != b]


def _stop_units(device: Device) -> Times:
    """When each was sent its stop, and has answered, by the monotonic clock."""
    times = [time.monotonic()]
    for drive in device.drives:
        drive.stop()
        times.append(time.monotonic())
    return [*itertools.pairwise(times)]


def _broadcast(device: Device) -> Times:
    device.line.stop_at_once(device.drives)
    return []


def _be_silent(device: Device, seconds: float) -> Times:
    """Send nothing, while this program is well."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        device.requests.check_stop()
        device.heartbeat.feed(moving=True)
        time.sleep(0.02)
    device.heartbeat.feed(moving=False)
    return []


def _wait_until_still(device: Device) -> list[Status]:
    """Statuses of all drives once they stand, or STAND_S later."""
    end = time.monotonic() + STAND_S
    before = [drive.status() for drive in device.drives]
    while True:
        device.guard()
        time.sleep(stop.POLL_S)
        now = [drive.status() for drive in device.drives]
        still = all(
            not b.moving and abs(b.position - a.position) <= STILL_COUNTS
            for a, b in zip(before, now, strict=True)
        )
        if still or time.monotonic() > end:
            return now
        before = now


def _look(device: Device, statuses: list[Status]) -> list[Status]:
    """Look at drives that stand, after the time within which one might go on."""
    for drive, status in zip(device.drives, statuses, strict=True):
        drive.hold(status.position)
    end = time.monotonic() + stop.stand_s(device.drives)
    while time.monotonic() < end:
        device.guard()
        now = [drive.steady() for drive in device.drives]
        if any(status.moving for status in now):
            return _wait_until_still(device)
        time.sleep(stop.LOOK_S)
    return [drive.steady() for drive in device.drives]
