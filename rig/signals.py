"""Signals of the operating system as requests to pause or to stop a session."""

from __future__ import annotations

import os
import signal
import threading
import time
from types import FrameType
from typing import Any

from rig.faults import Requests

# What ends or suspends a program: a session that moves stops its drives first.
STOPS = (
    signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP,
)  # fmt: skip
PAUSE = signal.SIGUSR1  # of the page: may come twice, and never stops
HANDLED_S = 0.2  # until the main thread has run a handler, unless it hangs


class Signals(Requests):
    """Ctrl-C once: finish the posture and pause. Twice, or any other signal: stop now.

    While armed, a signal only sets a flag, so that no frame and no line of the journal
    is cut in two; else it ends a program that is not ending. Where the main thread,
    which runs handlers, hangs, a second one sets the flag for the heartbeat.
    """

    def __init__(self) -> None:
        super().__init__()
        self._previous: dict[int, Any] = {}
        self._pipe = -1  # that wakes the listener

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
