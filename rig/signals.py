"""Ctrl-C, SIGTERM and SIGHUP as requests to pause or to stop a session."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

from rig.core.stop import Requests


class Signals(Requests):
    """Ctrl-C once: finish the posture and pause; twice, SIGTERM or SIGHUP: stop now.

    While armed, a signal only sets a flag, so that no frame on the bus and no line of
    the journal is cut in two. While nothing can move, it ends the program at once, but
    not a run that is ending. Nothing is written here.
    """

    def __init__(self) -> None:
        super().__init__()
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
