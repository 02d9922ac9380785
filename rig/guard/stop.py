"""Stopping: every unit, whatever happened, and proof that it stands.

Nothing here touches JAX, the IMU or the plan. A stop goes to each unit by itself, goes
on past units that fail, is repeated (a stop may be sent twice, unlike a move) and is
verified by reading the status back. After a fault the latch stays on: only a new
process, armed by a person, moves again.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

from rig.device.drives import Drive
from rig.faults import EXIT_FAULT, StopRequested

ROUNDS = 3  # times a stop is sent to a unit that does not acknowledge
VERIFY_S = 3.0  # for all units together to come to rest
POLL_S = 0.02


@dataclasses.dataclass
class UnitStop:
    """What became of the stop of one unit."""

    axis: str
    unit: int
    acknowledged: bool = False  # the drive answered the stop
    standing: bool = False  # its status says so, and its position holds still
    detail: str = ""

    def __str__(self) -> str:
        state = "acknowledged" if self.acknowledged else "NOT acknowledged"
        rest = "standing" if self.standing else "NOT seen standing"
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.axis} (unit {self.unit}): {state}, {rest}{detail}"


def stop_all(drives: list[Drive]) -> list[UnitStop]:
    """Quick-stop every drive, and wait for them to come to rest.

    Never raises, never leaves one out: one that fails does not keep the others from
    their stop.
    """
    results = [UnitStop(d.axis.name, d.axis.unit) for d in drives]
    pairs = list(zip(drives, results, strict=True))
    for _ in range(ROUNDS):
        for drive, result in pairs:
            if not result.acknowledged:
                _send(drive, result)
    end = time.monotonic() + VERIFY_S
    before: dict[str, int] = {}
    while not all(result.standing for result in results):
        for drive, result in pairs:
            if result.standing:
                continue
            try:
                status = drive.status(retries=0)
            except Exception as error:
                result.detail = str(error)
                continue
            if not result.acknowledged:
                _send(drive, result)
            still = status.position == before.get(result.axis)
            result.standing = still and not status.moving
            before[result.axis] = status.position
            if result.standing and result.acknowledged:
                result.detail = "alarm" if status.fault else ""
        if time.monotonic() > end:
            break
        time.sleep(POLL_S)
    return results


def _send(drive: Drive, result: UnitStop) -> None:
    try:
        drive.stop()
        result.acknowledged = True
        result.detail = ""
    except Exception as error:
        result.detail = str(error)


class Stopper:
    """The latch: after a stop for a fault nothing moves again."""

    def __init__(
        self,
        drives: list[Drive],
        emit: Callable[..., Any] = lambda event, **fields: None,
    ) -> None:
        self.drives = drives
        self.reason = ""  # of the stop that has latched
        self.results: list[UnitStop] = []
        self._emit = emit
        self._lock = threading.RLock()

    def stop(self, reason: str, latch: bool = True) -> list[UnitStop]:
        """Stop every unit now; the first reason is the one that is kept."""
        with self._lock:
            if latch and not self.reason:
                self.reason = reason or "stopped"
            self.results = stop_all(self.drives)
            units = [dataclasses.asdict(result) for result in self.results]
            self._emit("stop", reason=reason, units=units)
            return self.results

    def check(self) -> None:
        """Raise StopRequested where a stop has latched."""
        if self.reason:
            raise StopRequested(f"stopped: {self.reason}", EXIT_FAULT)
