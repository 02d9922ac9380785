"""A drive, as motion, proof and stop know it: one axis of one line.

A kind of drive writes the abstract methods; what follows from them is here. Counts are
the drive's own; pulses are counts from its origin.
"""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from rig.drives.line import BusError, Line
from rig.faults import LimitError, MotionFault

if TYPE_CHECKING:
    from rig.config.axis import Axis

POLL_S = 0.05
START_S = 0.2  # a drive that has taken a move shows it within this time
STILL_COUNTS = 2  # between two readings of a position that flickers by one count
LOOKS = 4  # for two readings that agree
HOME = 2**30  # a count that no drive shows when it is switched on


@dataclasses.dataclass(frozen=True)
class Look:
    position: int  # counts
    enabled: bool
    done: bool  # its last move has ended
    moving: bool
    fault: bool
    word: int | None = None  # its status word, where it has one


@dataclasses.dataclass(frozen=True)
class Status(Look):
    """What it said, its position in pulses, and when."""

    asked: float = 0.0  # monotonic seconds before it was asked, ...
    time: float = 0.0  # ... and once it had answered


class Drive(abc.ABC):
    line_type: ClassVar[type[Line]]
    can_reset = can_set_zero = False
    counts_from_home = False  # its origin is told from its count: HOME or 0
    tells_homed = says_homed = False  # whether it can say so, and as last read

    def __init__(self, line: Any, axis: Axis) -> None:
        self.line = line
        self.axis = axis
        self.last: Status | None = None  # as last read
        self._origin: int | None = None
        self.forget_origin()

    # Of a kind of drive: what it must know. BusError where there is no valid reply.

    @abc.abstractmethod
    def ids(self) -> dict[str, int | str]:
        """What tells this drive from another, and does not change."""

    @abc.abstractmethod
    def arm(self) -> None:
        """Switch its power stage on, where it is off."""

    @abc.abstractmethod
    def position(self) -> int:
        """The drive's count, by its encoder or of the steps it has made."""

    @abc.abstractmethod
    def move(self, count: int, speed: float, accel: float) -> None:
        """Start an absolute move to a count, no faster than ``speed`` counts a second
        and ``accel`` a second squared, and return. Sent once: whether a move without a
        reply was taken is found out by looking."""

    @abc.abstractmethod
    def standing(self) -> bool:
        """Whether its last move has ended, at its target or not."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Stop as fast as it may, with its torque on; to be sent at any time."""

    @abc.abstractmethod
    def alarm(self) -> str:
        """The fault that it is in, in words; empty where there is none."""

    # What it may know besides

    def enabled(self) -> bool:
        """Whether its power stage is on."""
        return True

    def look(self, retries: int) -> Look:
        """All that ``status`` needs; in one exchange, where the drive can."""
        for tries_left in reversed(range(1 + retries)):
            try:
                standing, alarm = self.standing(), self.alarm()
                return Look(
                    self.position(), self.enabled(), standing, not standing, bool(alarm)
                )
            except BusError as error:
                if error.refused or not tries_left:
                    raise
        raise AssertionError("unreachable")

    def reset(self) -> None:
        """Clear an alarm, where ``can_reset``."""

    def hold(self, pulses: int) -> None:
        """Make a place where it stands the target that it holds, without a move."""

    def held(self) -> int | None:
        """The target that it holds, as a count; None where it cannot be read."""
        return None

    def home(self) -> None:
        """Start its own homing, where its map has one."""

    def set_zero(self, count: int) -> None:
        """Count from ``count`` where it stands, where ``can_set_zero``."""

    def mirror_limits(self) -> None:
        """Write the axis's soft limits into the drive, where its map can."""

    def pulses_per_rev(self) -> int | None:
        """Pulses for one motor turn by the drive's own word; None where it has none."""
        return None

    # Of maps with comm_timeout alone: the register of the line's timeout,
    watch: Callable[[], int]
    set_watch: Callable[[int], None]
    watch_counts: Callable[[float], int]  # for so many seconds, or a little more

    def lasting(self, ids: dict[str, int | str]) -> dict[str, int | str]:
        """The ids of a drive that do not change."""
        return ids

    def foreign(self, ids: dict[str, int | str]) -> str:
        """Why a drive with these ids is not of the map's family; empty where it is."""
        return ""

    # What follows

    @property
    def origin(self) -> int:
        """What the drive itself counts at home, from which all pulses are: HOME where
        it was set so, else 0. It is told from the count as first read and holds from
        then on: a drive that loses its count meanwhile is seen far away."""
        if self._origin is None:
            self.status()
        return self._origin or 0

    def forget_origin(self) -> None:
        """The next reading tells the origin, as one does that was set anew."""
        self._origin = None if self.counts_from_home else 0

    def status(self, retries: int | None = None) -> Status:
        """Read status and position; ``retries`` where not as ``Line.read_tries``."""
        if retries is None:
            retries = self.line.read_tries - 1
        asked = time.monotonic()
        look = self.look(retries)
        if self._origin is None:
            self._origin = HOME if look.position > HOME // 2 else 0
        said = vars(look) | {"position": look.position - self._origin}
        self.last = Status(**said, asked=asked, time=time.monotonic())
        return self.last

    def steady(self, retries: int | None = None) -> Status:
        """Status of a drive that stands: two readings of its position that agree, since
        one may be mangled and look whole; the last where no two do."""
        new = self.last is None
        status = self.status(retries)
        for _ in range(LOOKS):
            before, status = status, self.status(retries)
            if abs(status.position - before.position) <= STILL_COUNTS:
                break
            if new:  # or the mangled one has told the origin
                self.forget_origin()
        return status

    def sound(self) -> Status:
        """Status; MotionFault where the fault bit is set, or the power stage is off."""
        status = self.status()
        if status.fault:
            text = ""
            with contextlib.suppress(BusError):  # the bit alone is reason enough
                text = self.alarm()
            raise MotionFault(
                f"{self.axis.name}: {text or 'fault bit set'}. The drive has stopped "
                "itself. Find the cause in its manual, then continue with "
                "--reset-alarms"
            )
        if not status.enabled:
            raise MotionFault(
                f"the power stage of {self.axis.name} was switched off while armed. "
                "Check for an emergency stop, STO, its supply, and another controller"
            )
        return status

    def go(self, pulses: int) -> None:
        """Start an absolute move; every frame is sent exactly once. LimitError where
        the target leaves the axis's limits, BusError where one is not acknowledged."""
        axis = self.axis
        if not axis.min_pulses <= pulses <= axis.max_pulses:
            raise LimitError(
                f"{axis.name}: {pulses} pulses are outside the limits "
                f"{axis.min_pulses}..{axis.max_pulses}"
            )
        per_deg = abs(axis.pulses_per_deg)
        speed, accel = axis.drive_motion
        self.move(pulses + self.origin, speed * per_deg, accel * per_deg)

    def bring(
        self, act: Callable[[], object], ready: Callable[[Status], bool]
    ) -> Status:
        """Act and poll until the effect shows, at most the map's ready_s. The last look
        begins after that: one before may tell of the time before a spoilt frame."""
        act()
        end = time.monotonic() + self.axis.map.ready_s
        while True:
            last = time.monotonic() > end
            if ready(status := self.status()) or last:
                return status
            time.sleep(POLL_S)
