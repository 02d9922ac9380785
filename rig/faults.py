"""How a run can end: exit codes, what raises them, and what was asked from outside."""

from __future__ import annotations

import os
import pathlib
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

Report = Callable[..., object]  # of an event and its fields
EXIT_OK = 0
EXIT_RECALIBRATE = 1  # done, but the errors say: calibrate (again)
EXIT_BAD_INPUT = 2
EXIT_FAULT = 3  # stopped by a fault; `resume` goes on
EXIT_PAUSED = 4  # paused by Ctrl-C; `resume` goes on
EXIT_INTERRUPTED = 130
# What ends or suspends a program: a session that moves stops its drives first.
STOPS = (
    signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP,
)  # fmt: skip
PAUSE = signal.SIGUSR1  # of the page: may come twice, and never stops
HANDLED_S = 0.2  # until the main thread has run a handler, unless it hangs


class Refused(ValueError):
    """The request makes no sense for this run; nothing was moved."""


class JournalError(RuntimeError):
    """The journal cannot be written, or is damaged."""


class LimitError(Refused):
    """A target leaves the soft limits; nothing was sent."""


class Fault(RuntimeError):
    """Bus, phone, journal or device failed: stop everything and latch."""

    advice = ""  # what to do, where the text does not say so


class MotionFault(Fault):
    """Something is wrong with the device."""


class NotFollowing(MotionFault):
    """A drive turned and the IMU did not see it."""


class TurnedTooFar(MotionFault):
    """A move turned the phone further than was proved of it."""


class EndedShort(MotionFault):
    """A drive reports its move done but stands short of the target: it was stopped from
    outside, or reached a limit of its own."""

    def __init__(self, text: str, axis: str, pulses: int) -> None:
        self.axis = axis
        self.pulses = pulses  # where it stands
        super().__init__(text)


class Unreachable(RuntimeError):
    """The device is sound but cannot get there: leave this posture out."""


class StopRequested(BaseException):
    """Stop now: second Ctrl-C, SIGTERM, SIGHUP, or a latched stop."""

    def __init__(self, reason: str, exit_code: int) -> None:
        self.exit_code = exit_code
        super().__init__(reason)


class PauseRequested(BaseException):
    """First Ctrl-C: the posture in progress was finished, the run can be resumed."""


def unheard(event: str, **fields: object) -> None:
    """The default ``report``: does nothing."""


def told(error: BaseException) -> str:
    """What went wrong, and what to do."""
    return ". ".join(filter(None, (str(error), getattr(error, "advice", ""))))


def ending(error: BaseException, folder: pathlib.Path) -> tuple[int, str, str]:
    """Exit code, event and reason of a session in a folder that an error ended."""
    match error:
        case PauseRequested():
            return EXIT_PAUSED, "paused", str(error)
        case StopRequested():
            return error.exit_code, "stopped", str(error)
        case KeyboardInterrupt():
            return EXIT_INTERRUPTED, "stopped", "SIGINT"
        case Refused():
            return EXIT_BAD_INPUT, "refused", str(error)
        case Fault() | JournalError():
            return EXIT_FAULT, "fault", told(error)
        case OSError():
            text = f"cannot write to {folder}: {error.strerror or error}"
            return EXIT_FAULT, "fault", text
    return EXIT_FAULT, "fault", f"{type(error).__name__}: {error}"


class Signals:
    """What was asked of a session from outside, looked at before every frame. Ctrl-C
    once: finish the posture and pause. Twice, or any other signal: stop now.

    While armed, a signal only sets a flag, so that no frame and no line of the journal
    is cut in two; else it ends a program that is not ending. Where the main thread,
    which runs handlers, hangs, a second one sets the flag for the heartbeat.
    """

    def __init__(self) -> None:
        self.armed = False
        self.ending = False  # the stop and the last lines of the journal are under way
        self.pause = False
        self._stop: StopRequested | None = None
        self._asked = 0.0
        self._previous: dict[int, Any] = {}
        self._pipe = -1  # that wakes the listener

    def request_stop(self, reason: str, exit_code: int) -> None:
        """Ask for a stop; the first request is the one that is kept."""
        if self._stop is None:
            self._asked = time.monotonic()
            self._stop = StopRequested(reason, exit_code)

    def overdue(self, seconds: float) -> str:
        """The reason of a stop that was asked for so long ago; empty where none was."""
        late = self._stop is not None and time.monotonic() - self._asked > seconds
        return str(self._stop) if late else ""

    def check_stop(self) -> None:
        if self._stop is not None:
            raise self._stop

    def check_pause(self) -> None:
        """Raise PauseRequested where one has been asked for; between postures."""
        self.check_stop()
        if self.pause:
            raise PauseRequested("paused by Ctrl-C")

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            far, self._pipe = os.pipe()
            os.set_blocking(self._pipe, False)
            signal.set_wakeup_fd(self._pipe, warn_on_full_buffer=False)
            threading.Thread(target=self._listen, args=[far], daemon=True).start()
            handlers: dict[int, Any] = dict.fromkeys((*STOPS, PAUSE), self._handle)
            handlers[signal.SIGTTOU] = signal.SIG_IGN  # output from the background
            for number, handler in handlers.items():
                self._previous[number] = signal.signal(number, handler)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}
        if self._pipe >= 0:
            signal.set_wakeup_fd(-1)
            os.close(self._pipe)  # which ends the listener
            self._pipe = -1

    def _listen(self, pipe: int) -> None:
        interrupts = 0
        while numbers := os.read(pipe, 64):
            time.sleep(HANDLED_S)
            for number in numbers:
                interrupts += number == signal.SIGINT
                once = number == signal.SIGINT and interrupts < 2  # a pause
                if number in STOPS and self.armed and not once:
                    self.request_stop(signal.Signals(number).name, 128 + number)
        os.close(pipe)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        first = number == signal.SIGINT and not self.pause and self.armed
        if first or number == PAUSE:
            self.pause = True
            return
        self.request_stop(signal.Signals(number).name, 128 + number)
        if not (self.armed or self.ending):
            self.check_stop()
