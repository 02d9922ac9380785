"""Progress of a long computation with the time left, on standard error."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from tqdm import tqdm

__all__ = ["Progress"]

_SILENT = 2.0  # seconds below which nothing is shown
_INTERVAL = 10.0  # seconds between lines where the output is not a terminal


class Progress:
    """Shows tasks that take longer than two seconds.

    On a terminal a tqdm bar; in a log a plain line every ten seconds.
    """

    def __init__(self, stream: TextIO | None = None, quiet: bool = False) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._task = ""
        self._started = self._shown = 0.0
        self._bar: tqdm | None = None

    def __call__(self, task: str, done: int, total: int) -> None:
        """Note that ``done`` of ``total`` are finished; ``done`` 0 starts a task."""
        now = time.monotonic()
        if task != self._task or done == 0:
            self.clear()
            self._task, self._started, self._shown = task, now, now
            if self._stream.isatty() and not self._quiet:
                self._bar = tqdm(
                    desc=task,
                    total=total,
                    file=self._stream,
                    delay=_SILENT,
                    leave=False,
                )
            return
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        elif not self._quiet and now - self._shown >= _INTERVAL:
            self._shown = now
            left = (now - self._started) * (total - done) / max(done, 1)
            text = tqdm.format_interval(left)
            self._stream.write(f"{task}: {done:,} of {total:,}, {text} left\n")
            self._stream.flush()

    def clear(self) -> None:
        """Take the bar off the terminal."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
