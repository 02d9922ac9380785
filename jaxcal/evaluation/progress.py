"""How far a long computation is and when it will end, on standard error."""

from __future__ import annotations

import sys
import time
from typing import TextIO

__all__ = ["Progress"]


class Progress:
    """Reports what takes longer than two seconds; quicker work stays silent.

    On a terminal one line is rewritten; in a log a line comes every ten seconds.
    """

    def __init__(self, stream: TextIO | None = None, quiet: bool = False) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._live = self._stream.isatty()
        self._task = ""
        self._started = 0.0
        self._shown = 0.0
        self._width = 0

    def __call__(self, task: str, done: int, total: int) -> None:
        """Note that ``done`` of ``total`` are finished; ``done`` 0 starts a task."""
        now = time.monotonic()
        if task != self._task or done == 0:
            self.clear()
            self._task, self._started = task, now
            self._shown = now if not self._live else 0.0
            return
        elapsed = now - self._started
        if self._quiet or elapsed < 2.0 or now - self._shown < self._interval:
            return
        self._shown = now
        left = elapsed * (total - done) / max(done, 1)
        text = f"{task}: {done:,} of {total:,}, {_span(left)} left"
        if self._live:
            self._stream.write("\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def clear(self) -> None:
        """Take the line off the terminal."""
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0

    @property
    def _interval(self) -> float:
        return 0.2 if self._live else 10.0


def _span(seconds: float) -> str:
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    return f"{whole // 60} min {whole % 60:02d} s"
