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
IGNORED = (signal.SIGTTOU,)  # output from the background must not suspend it
HANDLED_S = 0.2  # until the main thread has run a handler, unless it hangs


class Signals(Requests):
    """Ctrl-C once: finish the posture and pause. Twice, or any other signal: stop now.

    While armed, a signal only sets a flag, so that no frame and no line of the journal
    is cut in two. While nothing can move it ends the program at once, but not a run
    that is ending. Python runs handlers on the main thread. Where that hangs, on a disk
    say, a second thread sets the flag, and the heartbeat stops the drives.
    """

    def __init__(self) -> None:
        super().__init__()
        self._previous: dict[int, Any] = {}
        self._pipe: tuple[int, int] | None = None

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            self._pipe = os.pipe()
            os.set_blocking(self._pipe[1], False)
            signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
            listener = threading.Thread(target=self._listen, args=[self._pipe[0]])
            listener.daemon = True
            listener.start()
            for number in (*STOPS, PAUSE):
                self._previous[number] = signal.signal(number, self._handle)
            for number in IGNORED:
                self._previous[number] = signal.signal(number, signal.SIG_IGN)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}
        if self._pipe is not None:
            signal.set_wakeup_fd(-1)
            os.close(self._pipe[1])  # which ends the listener
            self._pipe = None

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
