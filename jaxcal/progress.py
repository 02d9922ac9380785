"""Progress of a long computation with the time left, on standard error."""

from __future__ import annotations

import datetime
import sys
import time
from typing import TextIO

_SILENT = 2.0  # seconds below which nothing is shown
_OF_LOG, _OF_TERMINAL = 10.0, 0.1  # seconds between lines; between rewritings of one
_ERASED = "\r\x1b[K"  # to the line's beginning, and empty it


class Progress:
    """Shows tasks that take longer than two seconds.

    On a terminal one line that is rewritten; in a log a line every ten seconds.
    """

    def __init__(self, stream: TextIO | None = None, quiet: bool = False) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._terminal = self._stream.isatty()
        self._task = ""
        self._started = self._next = 0.0
        self._line = False  # one stands on the terminal

    def __call__(self, task: str, done: int, total: int) -> None:
        """Note that ``done`` of ``total`` are finished; ``done`` 0 starts a task."""
        now = time.monotonic()
        if task != self._task or done == 0:
            self.clear()
            self._task, self._started = task, now
            self._next = now + (_SILENT if self._terminal else _OF_LOG)
        elif not self._quiet and now >= self._next:
            self._next = now + (_OF_TERMINAL if self._terminal else _OF_LOG)
            remaining_s = round((now - self._started) * (total - done) / max(done, 1))
            remaining = datetime.timedelta(0, remaining_s)
            text = f"{task}: {done:,} of {total:,}, {remaining} left"
            self._line = self._terminal
            self._stream.write(_ERASED + text if self._terminal else text + "\n")
            self._stream.flush()

    def clear(self) -> None:
        """Take the line off the terminal."""
        if self._line:
            self._stream.write(_ERASED)
            self._stream.flush()
            self._line = False
