"""Every way that the software has to stop the drives, tried in a slow move.

The axes move together, 3 degrees (or mm) either side of where they stood, less of more
than three, which may add up, or one after another where their line moves them in turn,
and are stopped on the way: by the frame to each unit, by the broadcast where the map
has one, and by the drives' own watch of the line where they have one. Each must stand
short of its target, by its drive and by the phone, and must stay there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from rig.config.axis import Pulses
from rig.core import stop
from rig.core.device import Device, Posture
from rig.core.motion import move
from rig.drives import Drive
from rig.drives.drive import STILL_COUNTS, Status
from rig.faults import MotionFault
from rig.journal import STOP_PROVED
from rig.workbench.command_run import Run

REACH_DEG = 3.0  # either side
ADD_UP = 3.0  # axes: more move less far
SPEED_DEG_S = 5.0
BEGIN, LATE = 0.3, 0.6  # share of the way at which a stop is sent, and the latest
SHORT = 0.1  # share of the way that must be left
TRIES = 4  # each half as fast, where the stop came late
STAND_S = 3.0
SILENCE_S = 0.5  # besides the drives' own timeout
TURNED_DEG = 0.3  # of the phone, while the drives stand


class _ShareReached(Exception):
    """All axes have gone a share of their way."""


def prove_stops(run: Run, device: Device) -> None:
    """Try each way to stop; the device is STOP_PROVED.

    Raises:
        MotionFault: an axis went on, or moved again.
    """
    start = device.positions()
    evidence: dict[str, dict[str, float]] = {}
    reach = REACH_DEG * min(1.0, ADD_UP / len(run.config.axes))
    offsets = [axis.to_pulses(reach) for axis in run.config.axes]
    low = tuple(int(p) for p in np.subtract(start, offsets))
    high = tuple(int(p) for p in np.add(start, offsets))
    timeout_s = max(run.config.comm_timeouts_s.values(), default=0.0)
    ways: dict[str, tuple[Callable[[], None], float]] = {
        "the stop of each unit": (lambda: _stop_units(device), SPEED_DEG_S)
    }
    if device.line.stops_at_once(device.drives):
        ways["the broadcast stop"] = (
            lambda: stop.broadcast(device.drives),
            SPEED_DEG_S,
        )
    if timeout_s:
        left_deg = (1.0 - LATE - SHORT) * 2 * reach
        slow = min(SPEED_DEG_S, left_deg / (timeout_s + SILENCE_S))
        silent = timeout_s + SILENCE_S
        ways["their watch of the line"] = (lambda: _be_silent(device, silent), slow)
    for name, (act, speed) in ways.items():
        for moved in _together(device):
            end = tuple(b if i in moved else a for i, (a, b) in _numbered(low, high))
            gone = _prove(run, device, name, act, speed, low, end)
            evidence[name] = evidence.get(name, {}) | gone
    device.proof.ceiling_deg_s = None
    move(device, Posture("back", start))
    run.emit("stop_proved", sync=True, ways=evidence)
    run.record.reach(STOP_PROVED, run.config, ways=evidence, run=run.folder.name)
    run.say(f"the drives stop, and stay: {', '.join(evidence)}")


def _together(device: Device) -> list[list[int]]:
    """Axes that move at the same time."""
    every = [*range(len(device.drives))]
    return [[i] for i in every] if device.line.in_turn else [every]


def _numbered(low: Pulses, high: Pulses) -> Iterator[tuple[int, tuple[int, int]]]:
    return enumerate(zip(low, high, strict=True))


def _prove(
    run: Run,
    device: Device,
    name: str,
    act: Callable[[], None],
    speed_deg_s: float,
    low: Pulses,
    high: Pulses,
) -> dict[str, float]:
    """Stop a move from low to high; degrees that each axis went on after its stop."""
    for number in range(TRIES):
        device.proof.ceiling_deg_s = None
        move(device, Posture("the start of the stop", low))
        device.proof.ceiling_deg_s = speed_deg_s / 2**number
        places = _go(device, low, high)
        if max(_shares(device, low, high, places)) <= LATE:
            break
        _wait_until_still(device)  # it may end
        device.untrack()
    else:
        raise MotionFault(
            "no move is slow enough to be stopped on its way: bus and computer take "
            "too long between two looks at the drives"
        )
    act()
    statuses = _wait_until_still(device)
    at = [status.position for status in statuses]
    gone = _shares(device, low, high, at)
    names = run.config.axis_names
    going = [names[i] for i, (a, b) in _numbered(low, high) if a != b]
    _require_stopped(run, device, name, statuses, dict(zip(going, gone, strict=True)))
    after_deg = {
        axis.name: round(axis.to_deg(b - a), 3)
        for axis, a, b in zip(run.config.axes, places, at, strict=True)
        if axis.name in going
    }
    run.say(
        f"  {name}: stood after "
        + ", ".join(f"{axis} {abs(deg):.2f}" for axis, deg in after_deg.items())
        + f" {run.config.axis_unit}, and {stop.stand_s(device.drives):g} s later"
    )
    return after_deg


def _require_stopped(
    run: Run,
    device: Device,
    name: str,
    statuses: list[Status],
    shares: dict[str, float],
) -> None:
    """Refuse a stop after which an axis went on, or moved again; alarms are reset.

    Args:
        name: of the stop.
        statuses: of the drives as they stood.
        shares: of the way that each axis that moved had gone by then.
    """
    went_on = [axis for axis, share in shares.items() if share > 1.0 - SHORT]
    attitude = device.attitude(time.monotonic())
    after = _look(device, statuses)
    moved = [
        axis
        for axis, now, then in zip(run.config.axis_names, after, statuses, strict=True)
        if abs(now.position - then.position) > STILL_COUNTS and now.enabled
    ]
    turned = device.geometry.apart(attitude, device.attitude(time.monotonic()))
    _reset_alarms(run, device, name)
    device.untrack()
    if went_on:
        raise MotionFault(
            f"{', '.join(went_on)} went on to the target after {name}: this program "
            "cannot stop it. Correct [stop], broadcast_stop or [comm_timeout] of the "
            "map; until then the emergency stop alone stops the device"
        )
    if moved or turned > TURNED_DEG * device.geometry.scale:
        raise MotionFault(
            f"{', '.join(moved) or 'what is measured'} moved again after {name} "
            f"({device.geometry.told} {turned:.2f} {device.geometry.unit}). Set the "
            "drive so that it does not go on by itself after a stop"
        )


def _go(device: Device, low: Pulses, high: Pulses) -> list[int]:
    """Begin to move; where the drives are once all have gone BEGIN of their way."""

    def look() -> None:
        places = [_last(drive).position for drive in device.drives]
        if min(_shares(device, low, high, places)) >= BEGIN:
            raise _ShareReached

    device.meanwhile = look
    try:
        move(device, Posture("try the stop", high))
    except _ShareReached:
        pass
    finally:
        device.meanwhile = lambda: None
    return [_last(drive).position for drive in device.drives]


def _last(drive: Drive) -> Status:
    assert drive.last is not None  # it moves
    return drive.last


def _shares(
    device: Device, low: Pulses, high: Pulses, at: Sequence[int]
) -> list[float]:
    """Shares of the way that those axes have gone that move."""
    return [(p - a) / (b - a) for a, b, p in zip(low, high, at, strict=True) if a != b]


def _stop_units(device: Device) -> None:
    for drive in device.drives:
        drive.stop()


def _be_silent(device: Device, seconds: float) -> None:
    """Send nothing, while this program is well."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        device.requests.check_stop()
        device.heartbeat.feed(moving=True)
        time.sleep(0.02)
    device.heartbeat.feed(moving=False)


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


def _reset_alarms(run: Run, device: Device, name: str) -> None:
    """Reset alarms of drives that raise one when they stop themselves."""
    for drive in device.drives:
        if not drive.status().fault:
            continue
        resettable = drive.can_reset
        if (
            not resettable
            or drive.bring(drive.reset, lambda status: not status.fault).fault
        ):
            raise MotionFault(
                f"{drive.axis.name} stays in alarm after {name}: {drive.alarm()}. "
                "Reset it, then run `jaxcal-rig axes` again"
            )
        run.say(f"  {drive.axis.name}: its alarm after {name} was reset")
        if not drive.bring(drive.arm, lambda status: status.enabled).enabled:
            raise MotionFault(f"{drive.axis.name} does not enable after {name}")
