"""How a run can end: exit codes, and what raises them."""

from __future__ import annotations

import pathlib

from rig.journal.errors import JournalError
from rig.journal.errors import Refused as Refused

EXIT_OK = 0
EXIT_RECALIBRATE = 1  # done, but the errors say: calibrate (again)
EXIT_BAD_INPUT = 2
EXIT_FAULT = 3  # stopped by a fault; `resume` goes on
EXIT_PAUSED = 4  # paused by Ctrl-C; `resume` goes on
EXIT_INTERRUPTED = 130


class LimitError(Refused):
    """A target leaves the soft limits; nothing was sent."""


class Fault(RuntimeError):
    """Bus, phone, journal or device failed: stop everything and latch."""


class MotionFault(Fault):
    """Something is wrong with the device."""


class NotFollowing(MotionFault):
    """A drive turned and the IMU did not see it.

    ``suspects`` are the postures recorded since the axis was last seen to follow: the
    coupling may have slipped before any of them.
    """

    def __init__(self, text: str, suspects: list[str]) -> None:
        self.suspects = suspects
        super().__init__(text)


class Unreachable(RuntimeError):
    """The device is sound but cannot get there: leave this posture out."""


class StopRequested(BaseException):
    """Stop now: second Ctrl-C, SIGTERM, SIGHUP, or a latched stop."""

    def __init__(self, reason: str, exit_code: int) -> None:
        self.exit_code = exit_code
        super().__init__(reason)


class PauseRequested(BaseException):
    """First Ctrl-C: the posture in progress was finished, the run can be resumed."""


class PlanOnly(BaseException):
    """A dry run has come to the point where it would move."""


def ending(error: BaseException, folder: pathlib.Path) -> tuple[int, str, str]:
    """Exit code, event and reason of a session in a folder that an error ended."""
    match error:
        case PlanOnly():
            return EXIT_OK, "end", ""
        case PauseRequested():
            return EXIT_PAUSED, "paused", str(error)
        case StopRequested():
            return error.exit_code, "stopped", str(error)
        case KeyboardInterrupt():
            return EXIT_INTERRUPTED, "stopped", "SIGINT"
        case Refused():
            return EXIT_BAD_INPUT, "refused", str(error)
        case Fault() | JournalError():
            return EXIT_FAULT, "fault", str(error)
        case OSError():
            text = f"cannot write to {folder}: {error.strerror or error}"
            return EXIT_FAULT, "fault", text
    return EXIT_FAULT, "fault", f"{type(error).__name__}: {error}"
