"""Drives: what a register map means, spoken over the bus."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable

from rig.config.axis import HIGHEST, LOWEST, Axis
from rig.config.maps import Read, Writes, decode
from rig.core.bus import Bus, BusError, Rejected
from rig.core.faults import LimitError, MotionFault

POLL_S = 0.05
PASSING = (5, 6, 8, 10, 11)  # exceptions: acknowledge, busy, CRC; silence at a gateway
START_S = 0.2  # a drive that has taken a move shows it within this time
STILL_COUNTS = 2  # between two readings of a position that flickers by one count
LOOKS = 4  # for two readings that agree
HOME = 2**30  # a count that no drive shows when it is switched on


@dataclasses.dataclass(frozen=True)
class Status:
    """What a drive says about itself."""

    word: int
    position: int  # pulses
    asked: float  # monotonic seconds before it was asked, ...
    time: float  # ... and once it had answered
    enabled: bool
    done: bool
    moving: bool
    fault: bool


def refusal(error: BusError) -> bool:
    """Whether the drive refused, rather than the line failed or a gateway spoke."""
    return isinstance(error, Rejected) and error.code not in PASSING


class Drive:
    """One axis's drive on the bus."""

    def __init__(self, bus: Bus, axis: Axis) -> None:
        self.bus = bus
        self.axis = axis
        self.last: Status | None = None  # as last read
        self._origin: int | None = None
        self.forget_origin()

    @property
    def origin(self) -> int:
        """What the drive itself counts at home: HOME where it was set so, else 0.

        All pulses here are from it. It is told from the count as first read and holds
        from then on: a drive that loses its count meanwhile is seen far away.
        """
        if self._origin is None:
            self.status()
        return self._origin or 0

    def forget_origin(self) -> None:
        """The next reading tells the origin, as one does that was set anew."""
        self._origin = None if self.axis.map.home_place else 0

    def status(self, retries: int | None = None) -> Status:
        """Read status and position.

        Args:
            retries: of each read. Where not given they are twice those configured:
                spoilt frames now and then spoil all of them.
        """
        if retries is None:
            retries = 2 * self.bus.settings.read_retries + 1
        status, asked = self.axis.map.status, time.monotonic()
        word = self.read(status, retries)
        count = self.read(self.axis.map.position, retries)
        if self._origin is None:
            self._origin = HOME if count > HOME // 2 else 0
        position, flags = count - self._origin, status.flags(word)
        self.last = Status(word, position, asked, time.monotonic(), **flags)
        return self.last

    def standing(self, retries: int | None = None) -> Status:
        """Status of a drive that stands: two readings of its position that agree.

        One reading may be mangled and look whole. Where no two agree it is the last.
        """
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
            text = text or "fault bit set"
            raise MotionFault(
                f"{self.axis.name}: {text}. The drive has stopped itself. Find the "
                "cause in its manual, then go on with --reset-alarms"
            )
        if not status.enabled:
            raise MotionFault(
                f"the power stage of {self.axis.name} was switched off while armed. "
                "Look for an emergency stop, STO, its supply or another controller"
            )
        return status

    def alarm(self) -> str:
        """The alarm in words, empty where there is none or no register for it."""
        if not (read := self.axis.map.alarm) or not (code := self.read(read)):
            return ""
        name = read.names.get(code)
        return f"alarm 0x{code:X}" + (f" ({name})" if name else "")

    def move(self, pulses: int) -> None:
        """Start an absolute move; every frame is sent exactly once.

        Raises:
            LimitError: the target leaves the axis's limits.
            BusError: a frame was not acknowledged.
        """
        axis = self.axis
        if not axis.min_pulses <= pulses <= axis.max_pulses:
            raise LimitError(
                f"{axis.name}: {pulses} pulses leave the limits "
                f"{axis.min_pulses}..{axis.max_pulses}"
            )
        count = pulses + self.origin
        self.write(axis.map.move, position=count, **axis.motion_counts())

    def took(self, pulses: int, start: Status, tolerance: int) -> bool | None:
        """Whether the drive obeys a move whose reply was lost; None: unknown.

        A drive that obeys moves, has left ``start`` by more than ``tolerance`` pulses,
        or stands at its target. One that does not holds another target, or has stood
        idle at ``start`` for START_S.

        Raises:
            MotionFault: it is in alarm. BusError: it does not answer.
        """
        begun = time.monotonic()
        while True:
            status = self.sound()
            other = self._target() not in (None, pulses)
            idle = status.done and not status.moving
            if idle and abs(status.position - pulses) <= tolerance:
                return True
            if status.moving or abs(status.position - start.position) > tolerance:
                return None if other else True
            if idle and other:
                return False
            if time.monotonic() - begun > START_S:
                return False if idle else None
            time.sleep(POLL_S)

    def _target(self) -> int | None:
        """The target that the drive holds; None where it cannot be read."""
        held = self.held()
        return None if held is None else held - self.origin

    def mirror_limits(self) -> None:
        """Write the axis's soft limits into the drive, as far as it can count."""
        low, high = (
            min(max(pulses + self.origin, LOWEST), HIGHEST)
            for pulses in (self.axis.min_pulses, self.axis.max_pulses)
        )
        self.write(self.axis.map.limits, min=low, max=high)

    def stop(self) -> None:
        """Quick stop; torque stays on."""
        self.write(self.axis.map.stop)

    def hold(self, pulses: int) -> None:
        """Make a place where it stands the target that it holds, without a move."""
        self.write(self.axis.map.hold, position=pulses + self.origin)

    def held(self) -> int | None:
        """The target register as it reads, None where it cannot be read."""
        read = self.axis.map.target
        with contextlib.suppress(Rejected):
            return self.read(read) if read else None
        return None

    def write(self, table: Writes | None, **values: int) -> None:
        """Send the frames of one of the map's tables; none where the map lacks it.

        What moves the drive, or stops it, is sent once; the rest may be written twice,
        and is retried as reads are.
        """
        m = self.axis.map
        once = any(table is each for each in (m.move, m.home, m.stop))
        tries = 1 if once else 1 + self.bus.settings.read_retries
        for left in reversed(range(tries)):
            try:
                return self._write(table, values)
            except BusError as error:
                if not left or refusal(error):
                    raise

    def bring(self, table: Writes | None, ready: Callable[[Status], bool]) -> Status:
        """Write a table and poll until its effect shows, at most the map's ready_s.

        The last look begins after that time: a look before it may have waited for the
        tries of a spoilt frame, and tells of the time before them.
        """
        self.write(table)
        end = time.monotonic() + self.axis.map.ready_s
        while True:
            last = time.monotonic() > end
            if ready(status := self.status()) or last:
                return status
            time.sleep(POLL_S)

    def _write(self, table: Writes | None, values: dict[str, int]) -> None:
        for frame in table.write if table else ():
            words = frame.registers(self.axis.map.word_order, **values)
            self.bus.write(self.axis.unit, frame.address, frame.function, words)

    def identity(self) -> dict[str, int | str]:
        """Read what the map calls identity; a register that refuses says so."""
        found: dict[str, int | str] = {}
        for name, read in self.axis.map.identity.items():
            try:
                found[name] = self.read(read)
            except Rejected as error:
                found[name] = f"exception {error.code}"
        return found

    def pulses_per_rev(self) -> int | None:
        """Pulses for one motor turn by the drive's own word; None where it has none."""
        if read := self.axis.map.pulses_per_rev:
            with contextlib.suppress(Rejected):  # a model of the family without it
                return self.read(read) or None
        return None

    @property
    def says_homed(self) -> bool:
        """Whether its status, as last read, says that it is homed."""
        bits = self.axis.map.homed
        return bits is not None and self.last is not None and bits.holds(self.last.word)

    def read(self, read: Read, retries: int | None = None) -> int:
        """The value of one or two registers."""
        unit, order = self.axis.unit, self.axis.map.word_order
        words = self.bus.read_words(unit, read.address, read.count, retries)
        return decode(words, read.type, order)
