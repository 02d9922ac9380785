"""How a command can end."""

from __future__ import annotations

__all__ = [
    "EXIT_BAD_INPUT",
    "EXIT_FAULT",
    "EXIT_OK",
    "EXIT_PAUSED",
    "EXIT_RECALIBRATE",
    "Refused",
]

EXIT_OK = 0
EXIT_RECALIBRATE = 1  # done, but the errors say: calibrate (again)
EXIT_BAD_INPUT = 2
EXIT_FAULT = 3  # stopped by a fault; `resume` goes on
EXIT_PAUSED = 4  # paused by Ctrl-C; `resume` goes on


class Refused(ValueError):
    """The request makes no sense for this run; nothing was moved."""
