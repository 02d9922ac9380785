"""Drives: what a register map means, spoken over the bus."""

from __future__ import annotations

import dataclasses
import time

from rig.config.axis import Axis
from rig.config.registers import Read, Writes, decode, encode
from rig.device.bus import Bus, BusError, Rejected
from rig.faults import MotionFault


@dataclasses.dataclass(frozen=True)
class Status:
    """What a drive says about itself."""

    word: int
    position: int  # pulses
    time: float  # monotonic seconds
    enabled: bool
    done: bool
    moving: bool
    fault: bool


class Drive:
    """One axis's drive on the bus."""

    def __init__(self, bus: Bus, axis: Axis) -> None:
        self.bus = bus
        self.axis = axis
        self.last: Status | None = None  # as last read

    def status(self, retries: int | None = None) -> Status:
        """Read status and position; ``retries`` as configured where not given."""
        status = self.axis.map.status
        word = self._read(status, retries)
        position = self._read(self.axis.map.position, retries)
        flags = status.flags(word)
        self.last = Status(word, position, time.monotonic(), **flags)
        return self.last

    def sound(self) -> Status:
        """Status; MotionFault where the fault bit is set."""
        status = self.status()
        if status.fault:
            text = "fault bit set"
            try:
                text = self.alarm() or text
            except BusError:
                pass  # the fault bit alone is reason enough to stop
            raise MotionFault(f"{self.axis.name}: {text}")
        return status

    def alarm(self) -> str:
        """The alarm in words, empty where there is none or no register for it."""
        read = self.axis.map.alarm
        code = self._read(read) if read else 0
        if not read or not code:
            return ""
        name = read.names.get(code)
        return f"alarm 0x{code:X}" + (f" ({name})" if name else "")

    def move(self, pulses: int) -> None:
        """Start an absolute move; every frame is sent exactly once.

        Raises:
            ValueError: the target leaves the axis's limits.
            BusError: a frame was not acknowledged.
        """
        axis = self.axis
        if not axis.min_pulses <= pulses <= axis.max_pulses:
            raise ValueError(
                f"{axis.name}: {pulses} pulses leave the limits "
                f"{axis.min_pulses}..{axis.max_pulses}"
            )
        self.write(axis.map.move, position=pulses, **axis.motion_counts())

    def stop(self) -> None:
        """Quick stop; torque stays on."""
        self.write(self.axis.map.stop)

    def write(self, table: Writes | None, **values: int) -> None:
        """Send the frames of one of the map's tables; none where the map lacks it."""
        order = self.axis.map.word_order
        for frame in table.write if table else ():
            words: list[int] = []
            for value, kind in frame.words:
                number = values[value] if isinstance(value, str) else value
                words += encode(number, kind, order)
            self.bus.write(self.axis.unit, frame.address, frame.function, words)

    def identity(self) -> dict[str, int | str]:
        """Read what the map calls identity; a register that refuses says so."""
        found: dict[str, int | str] = {}
        for name, read in self.axis.map.identity.items():
            try:
                found[name] = self._read(read)
            except Rejected as error:
                found[name] = f"exception {error.code}"
        return found

    def _read(self, read: Read, retries: int | None = None) -> int:
        unit, order = self.axis.unit, self.axis.map.word_order
        words = self.bus.read_words(unit, read.address, read.count, retries)
        return decode(words, read.type, order)
