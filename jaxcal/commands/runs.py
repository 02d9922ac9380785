"""What the commands that train and evaluate share: signals, clocks, which kind."""

from __future__ import annotations

import datetime
import signal
from collections.abc import Callable, Sequence
from typing import Any

__all__ = ["clock", "names_task", "stop_on_signals"]


def names_task(argv: Sequence[str]) -> bool:
    """Whether a command line names a task of sequential measurement."""
    return any(word == "--task" or word.startswith("--task=") for word in argv)


def stop_on_signals() -> Callable[[], bool]:
    """Whether Ctrl-C or SIGTERM asked to save and stop; a second Ctrl-C is at once."""
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        print("\nstopping after this update and saving ...", flush=True)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, ask)
    return lambda: bool(asked)


def clock(seconds: float) -> str:
    """h:mm:ss."""
    return str(datetime.timedelta(seconds=round(seconds)))
