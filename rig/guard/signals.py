"""Ctrl-C, SIGTERM and SIGHUP as requests to pause or to stop, checked by every loop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from rig.faults import PauseRequested, StopRequested


class Signals:
    """Ctrl-C once: finish the posture and pause; twice, SIGTERM or SIGHUP: stop now.

    While armed, a signal only sets a flag, so that no frame on the bus and no line of
    the journal is cut in two; the flag is looked at before every frame and in every
    loop. While nothing can move, it ends the program at once, but not a run that is
    ending. Nothing is written here: ``tell`` reports "pausing" from a loop, once.
    """

    def __init__(self, report: Callable[[str], object] = lambda event: None) -> None:
        self.armed = False
        self.ending = False  # the stop and the last lines of the journal are under way
        self.pause = False
        self._stop: StopRequested | None = None
        self._report = report
        self._told = False
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
            return
        self.request_stop(signal.Signals(number).name, 128 + number)
        if not (self.armed or self.ending):
            self.check_stop()

    def request_stop(self, reason: str, exit_code: int) -> None:
        """Ask for a stop; the first request is the one that is kept."""
        self._stop = self._stop or StopRequested(reason, exit_code)

    def tell(self) -> None:
        """Report, once, that a pause was asked for."""
        if self.pause and not self._told:
            self._told = True
            self._report("pausing")

    def check_stop(self) -> None:
        """Raise StopRequested where one has been asked for."""
        if self._stop is not None:
            raise self._stop

    def check_pause(self) -> None:
        """Raise PauseRequested where one has been asked for; between postures."""
        self.check_stop()
        if self.pause:
            raise PauseRequested("paused by Ctrl-C")
