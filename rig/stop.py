"""Stopping: every unit, whatever happened, and proof that it stands.

Nothing here touches JAX, the IMU or the plan. A stop goes to each unit by itself, goes
on past units that fail, is repeated (a stop may be sent twice, unlike a move) and is
verified by reading the status back. What was stopped stays stopped: the latch is let go
only by a new process that a human arms.
"""

from __future__ import annotations

import dataclasses
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from rig.bus import BusError
from rig.drives import Drive

__all__ = [
    "Heartbeat",
    "PauseRequested",
    "Signals",
    "StopRequested",
    "Stopper",
    "UnitStop",
    "stop_all",
]

ROUNDS = 3  # times a stop is sent to a unit that does not acknowledge
VERIFY_S = 3.0  # for all units together to come to rest
POLL_S = 0.02


class StopRequested(BaseException):
    """Stop now: second Ctrl-C, SIGTERM, SIGHUP, or a latched stop."""

    def __init__(self, reason: str, exit_code: int) -> None:
        self.exit_code = exit_code
        super().__init__(reason)


class PauseRequested(BaseException):
    """First Ctrl-C: the posture in progress was finished, the run can be resumed."""


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
        return f"{self.axis} (unit {self.unit}): {state}, {rest}" + (
            f" ({self.detail})" if self.detail else ""
        )


def stop_all(drives: list[Drive], verify_s: float = VERIFY_S) -> list[UnitStop]:
    """Quick-stop every drive; never raises, never leaves one out.

    Args:
        drives: the units; one that fails does not keep the others from their stop.
        verify_s: how long to wait for them to come to rest.

    Returns:
        One entry a drive, in order.
    """
    results = [UnitStop(d.axis.name, d.axis.unit) for d in drives]
    for _ in range(ROUNDS):
        for drive, result in zip(drives, results, strict=True):
            if not result.acknowledged:
                _send(drive, result)
        if all(result.acknowledged for result in results):
            break
    end = time.monotonic() + verify_s
    before: list[int | None] = [None] * len(drives)
    while not all(result.standing for result in results):
        for index, (drive, result) in enumerate(zip(drives, results, strict=True)):
            if result.standing:
                continue
            try:
                status = drive.status(retries=0)
            except Exception as error:
                result.detail = str(error)
                continue
            if not result.acknowledged:
                _send(drive, result)
            result.standing = not status.moving and status.position == before[index]
            before[index] = status.position
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
    """The latch. Once stopped for a fault, it lets nothing move again."""

    def __init__(
        self,
        drives: list[Drive],
        report: Callable[[str, list[UnitStop]], None] | None = None,
    ) -> None:
        self.drives = drives
        self.reason = ""
        self.results: list[UnitStop] = []
        self._report = report
        self._lock = threading.RLock()

    @property
    def latched(self) -> bool:
        """Whether a stop has latched."""
        return bool(self.reason)

    def stop(self, reason: str, latch: bool = True) -> list[UnitStop]:
        """Stop every unit now; the first reason is the one that is kept."""
        with self._lock:
            if latch and not self.reason:
                self.reason = reason or "stopped"
            self.results = stop_all(self.drives)
            if self._report is not None:
                self._report(reason, self.results)
            return self.results

    def check(self) -> None:
        """Raise StopRequested where a stop has latched."""
        if self.reason:
            raise StopRequested(f"stopped: {self.reason}", 3)


class Signals:
    """Ctrl-C once: finish the posture and pause; twice, SIGTERM or SIGHUP: stop now.

    While armed, a signal only sets a flag, so that no frame on the bus and no line of
    the journal is cut in two; every loop looks at the flag at least every
    ``bus.timeout_s``. While nothing can move, it ends the program at once.
    """

    def __init__(self, say: Callable[[str], None] = lambda text: None) -> None:
        self.armed = False
        self.pause = False
        self._stop: StopRequested | None = None
        self._say = say
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and not self.pause and self.armed:
            self.pause = True
            self._say("Ctrl-C: finishing this posture, then pausing; again to stop now")
            return
        name = signal.Signals(number).name
        self._stop = self._stop or StopRequested(name, 128 + number)
        if not self.armed:
            raise self._stop

    def request_stop(self, reason: str, exit_code: int) -> None:
        """Ask for a stop from inside the program, as a signal would."""
        self._stop = self._stop or StopRequested(reason, exit_code)

    def check_stop(self) -> None:
        """Raise StopRequested where one has been asked for."""
        if self._stop is not None:
            raise self._stop

    def check_pause(self) -> None:
        """Raise PauseRequested where one has been asked for; between postures."""
        self.check_stop()
        if self.pause:
            raise PauseRequested("paused by Ctrl-C")


class Heartbeat:
    """A thread that stops the drives when the motion loop falls silent.

    It also keeps the line alive for drives that watch their communication while the
    plan computes or writes, when nothing moves.
    """

    def __init__(self, stopper: Stopper, silence_s: float, keep_alive_s: float) -> None:
        self._stopper = stopper
        self._silence_s = silence_s
        self._keep_alive_s = keep_alive_s
        self._moving = False
        self._fed = time.monotonic()
        self._closing = threading.Event()
        self._thread = threading.Thread(
            target=self._watch, name="heartbeat", daemon=True
        )

    def start(self) -> Heartbeat:
        """Begin to watch."""
        self._thread.start()
        return self

    def feed(self, moving: bool) -> None:
        """The motion loop is alive; ``moving``: it must be heard again soon."""
        self._moving = moving
        self._fed = time.monotonic()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _watch(self) -> None:
        while not self._closing.wait(0.05):
            silence = time.monotonic() - self._fed
            if self._moving and silence > self._silence_s:
                self._stopper.stop(f"heartbeat lost for {silence:.1f} s while moving")
                return
            if not self._moving and self._keep_alive_s and silence > self._keep_alive_s:
                for drive in self._stopper.drives:
                    try:
                        drive.status(retries=0)
                    except BusError:
                        continue  # the plan thread finds out by its own reads
                self._fed = time.monotonic()
