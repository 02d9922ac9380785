"""Stopping: every unit by itself, whatever happened, and proof that it stands. A stop
is repeated (unlike a move) and verified by reading the status back."""

from __future__ import annotations

import contextlib
import dataclasses
import time

from rig.drives.drive import STILL_COUNTS, Drive

ROUNDS = 3  # times a stop is sent to a unit that does not acknowledge
VERIFY_S = 3.0  # for all units together to come to rest
MOST_TIMES = 4  # as long, where replies come so slowly that few were seen
ENOUGH = 4  # looks at a unit that tell whether it stands
POLL_S = 0.02
LOOK_S = 0.1  # between two looks at drives that stand
WENT_ON_S = 0.5  # a drive that took longer to stand is said to have gone on


@dataclasses.dataclass
class UnitStop:
    """What became of the stop of one unit."""

    axis: str
    unit: int
    acknowledged: bool = False  # the drive answered the stop
    standing: bool = False  # its status says so, and its position holds still
    detail: str = ""
    position: int | None = None  # pulses, as last read
    stayed: bool = False  # and it stood for longer than it takes to go on by itself
    unsent: bool = False  # no connection took its stop

    def __str__(self) -> str:
        state = "NO STOP COULD BE SENT" if self.unsent else "NOT acknowledged"
        state = "acknowledged" if self.acknowledged else state
        rest = "standing" if self.stayed else "at rest"
        rest = rest if self.standing else "NOT seen standing"
        detail = f" ({self.detail})" if self.detail else ""
        todo = "" if self.standing else ": use the emergency stop"
        return f"{self.axis} (unit {self.unit}): {state}, {rest}{detail}{todo}"


Pairs = list[tuple[Drive, UnitStop]]


def stop_all(drives: list[Drive]) -> list[UnitStop]:
    """Quick-stop every drive of one bus, and wait for them to come to rest.

    The first round waits a short time for each reply, so that a dead unit delays the
    others little; the next as long as configured. Never raises, never leaves one out.
    """
    results = [UnitStop(d.axis.name, d.axis.unit, unsent=True) for d in drives]
    if not drives:
        return results
    line, pairs = drives[0].line, list(zip(drives, results, strict=True))
    with line.urgent():
        with line.urgent(line.quick_s):
            with contextlib.suppress(Exception):  # an extra: each gets its own as well
                line.stop_at_once(drives)
            _send(pairs)
        for _ in range(ROUNDS - 1):
            _send(pairs)
        _verify(pairs)
    return results


def _responsive_first(pairs: Pairs) -> Pairs:
    return sorted(pairs, key=lambda pair: pair[0].axis.unit in pair[0].line.silent)


def _send(pairs: Pairs) -> None:
    """Stop those that have not acknowledged one."""
    for drive, result in _responsive_first(pairs):
        if not result.acknowledged:
            try:
                drive.stop()
                result.acknowledged, result.unsent, result.detail = True, False, ""
            except Exception as error:
                result.unsent &= getattr(error, "lost", False)
                result.detail = str(error)


def _verify(pairs: Pairs) -> None:
    """Poll until each stands, longer while one without a motion is still to be looked
    at or a slow line has shown too little; one that answers again is told to stop once
    more."""
    begun = time.monotonic()
    before: dict[int, int] = {}
    moved_s = dict.fromkeys((result.unit for _, result in pairs), 0.0)  # seen to
    looks = dict.fromkeys((result.unit for _, result in pairs), 0)
    quick = False
    while moving := [pair for pair in pairs if not pair[1].standing]:
        settling = False
        quick = not quick  # every second look has time for a slow unit's reply
        for drive, result in _responsive_first(moving):
            line = drive.line
            result.acknowledged &= not line.doubts(result.unit)
            silent = drive.axis.unit in line.silent
            wait_s = line.quick_s if quick and silent else None
            try:
                with line.urgent(wait_s):
                    status = drive.status(retries=0)
            except Exception as error:
                result.detail = str(error)
                continue
            settling |= not status.moving
            looks[result.unit] += 1
            _send([(drive, result)])
            last = before.get(result.unit)
            still = last is not None and abs(status.position - last) <= STILL_COUNTS
            result.standing = still and not status.moving
            if status.moving or not (still or last is None):
                moved_s[result.unit] = time.monotonic() - begun
            before[result.unit] = result.position = status.position
            if result.standing and result.acknowledged:
                gone_s = moved_s[result.unit]
                went_on = f"it moved on for {gone_s:.1f} s" * (gone_s > WENT_ON_S)
                result.detail = "alarm" if status.fault else went_on
        slow = any(
            0 < looks[result.unit] < ENOUGH or result.unit in drive.line.late
            for drive, result in moving
        )
        times = MOST_TIMES if slow else 1 + settling
        if time.monotonic() > begun + VERIFY_S * times:
            return
        time.sleep(POLL_S)


def stay(drives: list[Drive], results: list[UnitStop], seconds: float) -> list[str]:
    """What goes on by itself after a stop, in words; it is stopped, as ``results`` say.
    Where the map can, its place becomes its target. To sink unpowered is no restart."""
    pairs = list(zip(drives, results, strict=True))
    words: list[str] = []
    for _ in range(ROUNDS):
        standing = [pair for pair in pairs if pair[1].standing]
        for drive, result in standing:
            with contextlib.suppress(Exception), drive.line.urgent():
                drive.hold(result.position or 0)
        again, stood = _restarted(standing, time.monotonic() + seconds)
        if not again:
            for result in stood:
                result.stayed = True
            break
        words += [f"{result.axis} moved on after its stop" for result in again]
        for new, result in zip(stop_all(drives), results, strict=True):
            vars(result).update(vars(new))
    return words


def _restarted(pairs: Pairs, end: float) -> tuple[list[UnitStop], list[UnitStop]]:
    """Drives that stood and move again; else those seen to stand until the end."""
    stood: list[UnitStop] = []
    while time.monotonic() < end:
        time.sleep(LOOK_S)
        moved: list[UnitStop] = []
        stood = []
        for drive, result in pairs:
            with contextlib.suppress(Exception), drive.line.urgent():
                status = drive.steady()
                powered = status.enabled and not status.fault
                way = abs(status.position - (result.position or 0))
                went_on = powered and (status.moving or way > STILL_COUNTS)
                (moved if went_on else stood).append(result)
        if moved:
            return moved, []
    return [], stood


def stand_s(drives: list[Drive]) -> float:
    """How long drives that stand are looked at."""
    return max(drive.axis.map.restart_s for drive in drives)
