"""Single keys from a terminal, without waiting for Enter."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from typing import Any

ARROWS = {"\x1b[A": "+", "\x1b[C": "+", "\x1b[B": "-", "\x1b[D": "-"}


class Keyboard:
    """A terminal that gives each key at once; Ctrl-C still is a signal."""

    def __enter__(self) -> Keyboard:
        self._fd = sys.stdin.fileno()
        self._before: list[Any] = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def keys(self, wait_s: float = 0.0) -> list[str]:
        """Keys pressed since the last call; arrows are ``+`` and ``-``."""
        if not select.select([self._fd], [], [], wait_s)[0]:
            return []
        text = os.read(self._fd, 1024).decode(errors="replace")
        for arrow, key in ARROWS.items():
            text = text.replace(arrow, key)
        return list(text)
