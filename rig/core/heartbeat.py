"""What stops the drives when the session cannot: the latch, and the thread that looks
whether the motion loop is alive and the computer awake."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable
from typing import Any

from rig.config.config import RigConfig
from rig.core import stop
from rig.core.stop import UnitStop
from rig.drives import Drive
from rig.drives.line import BusError
from rig.faults import EXIT_FAULT, Signals, StopRequested

OVERDUE_S = 0.3  # of a stop that was asked for and that no loop has answered
TICK_S = 0.05  # of the heartbeat
SLEPT_S = 1.0  # by which the clock that runs on in a computer's sleep is ahead


class Stopper:
    """The latch: after a stop for a fault only a new process, armed anew, moves."""

    def __init__(self, drives: list[Drive], emit: Callable[..., Any]) -> None:
        self.drives = drives
        self.reason = ""  # of the stop that has latched
        self.results: list[UnitStop] = []
        self.emit = emit
        self._lock = threading.RLock()

    def stop(self, reason: str, latch: bool = True) -> list[UnitStop]:
        """Stop every unit now; the first reason is the one that is kept."""
        if latch and not self.reason:  # before the lock: whoever moves looks at it
            self.reason = reason or "stopped"
        with self._lock:
            self.results = stop.stop_all(self.drives)
            units = [dataclasses.asdict(result) for result in self.results]
            self.emit("stop", reason=reason, units=units)
            return self.results

    def stay(self) -> list[UnitStop]:
        """After a stop for a reason: look whether the drives stay where they stand."""
        with self._lock:
            stand_s = stop.stand_s(self.drives)
            words = stop.stay(self.drives, self.results, stand_s)
            units = [dataclasses.asdict(result) for result in self.results]
            self.emit("stayed", went_on=words, units=units)
            return self.results

    def check(self) -> None:
        """Raise StopRequested where a stop has latched."""
        if self.reason:
            raise StopRequested(self.reason, EXIT_FAULT)


class Heartbeat(threading.Thread):
    """Stops the drives when the motion loop is silent, or does not answer a stop; keeps
    the line alive for drives that watch it while nothing moves."""

    def __init__(self, stopper: Stopper, requests: Signals, config: RigConfig) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._requests = requests
        self._stopper = stopper
        self._silence_s = config.heartbeat_s
        self._keep_alive_s = min(config.comm_timeouts_s.values(), default=math.inf) / 4
        self._moving = False
        self._fed = time.monotonic()
        self._ahead = clock_ahead_s()
        self._closing = threading.Event()

    def feed(self, moving: bool | None = None) -> None:
        """The motion loop is alive; ``moving``: it must be heard again soon."""
        if moving is not None:
            self._moving = moving
        self._fed = time.monotonic()

    def close(self) -> None:
        self._closing.set()
        if self.is_alive():
            self.join(2.0)

    def run(self) -> None:
        while not self._closing.wait(TICK_S):
            if self.beat():
                return

    def beat(self) -> bool:
        """Look once at loop, clock and requests; whether the drives were stopped."""
        self._stopper.drives[0].line.alive()
        silence = time.monotonic() - self._fed
        slept_s, self._ahead = clock_ahead_s() - self._ahead, clock_ahead_s()
        reason, slept = "", f"this computer slept for {slept_s:.0f} s"
        if slept_s > SLEPT_S and not self._moving:
            self._stopper.emit("note", text=slept)
        elif slept_s > SLEPT_S:
            reason = f"{slept} while the device moved unobserved. Switch its power "
            reason += "saving off"
        if not self._stopper.reason and (late := self._requests.overdue(OVERDUE_S)):
            reason = reason or f"{late}, and the session did not answer"
        if self._moving and silence > self._silence_s:
            reason = reason or (
                f"this program paused for {silence:.2f} s while the device moved "
                f"(limit {self._silence_s:.2f} s). Is the computer overloaded or "
                "waiting for its disk?"
            )
        if reason:
            self._stopper.stop(reason)
            return True
        if not self._moving and silence > self._keep_alive_s:
            for drive in self._stopper.drives:
                # The plan's own reads find what is wrong.
                with contextlib.suppress(BusError, StopRequested):
                    drive.status(retries=0)
            self._fed = time.monotonic()
        return False


def clock_ahead_s() -> float:
    """Seconds that this computer has slept since it was started, where it says so."""
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return 0.0 if clock is None else time.clock_gettime(clock) - time.monotonic()
