"""Drives: what a register map means, spoken over the bus."""

from __future__ import annotations

import dataclasses
import time

from rig.config.axis import Axis
from rig.config.registers import Writes, encode
from rig.device.bus import Bus, Rejected


@dataclasses.dataclass(frozen=True)
class Status:
    """What a drive says about itself."""

    word: int
    position: int  # pulses
    done: bool
    moving: bool
    fault: bool
    enabled: bool
    time: float  # monotonic seconds


class Drive:
    """One axis's drive on the bus."""

    def __init__(self, bus: Bus, axis: Axis) -> None:
        self.bus = bus
        self.axis = axis

    def status(self, retries: int = -1) -> Status:
        """Read status and position."""
        m = self.axis.map
        word = self.bus.read(self.axis.unit, m.status, m.word_order, retries)
        position = self.bus.read(self.axis.unit, m.position, m.word_order, retries)
        return Status(
            word=word,
            position=position,
            done=m.status.done.holds(word),
            moving=m.status.moving.holds(word),
            fault=m.status.fault.holds(word),
            enabled=m.status.enabled is None or m.status.enabled.holds(word),
            time=time.monotonic(),
        )

    def alarm(self) -> str:
        """The alarm in words, empty where there is none or no register for it."""
        m = self.axis.map
        if m.alarm is None:
            return ""
        code = self.bus.read(self.axis.unit, m.alarm, m.word_order)
        name = m.alarm.names.get(code)
        return (f"alarm 0x{code:X}" + (f" ({name})" if name else "")) if code else ""

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
        self._write(axis.map.move, {"position": pulses, **axis.motion_counts()})

    def stop(self) -> None:
        """Quick stop; torque stays on."""
        self._write(self.axis.map.stop)

    def enable(self) -> None:
        """Enable the power stage, where the map can."""
        self._write(self.axis.map.enable)

    def reset_alarm(self) -> None:
        """Reset an alarm, where the map can."""
        self._write(self.axis.map.alarm_reset)

    def set_comm_timeout(self, seconds: float) -> None:
        """Make the drive stop by itself when the line is silent, where the map can."""
        table = self.axis.map.comm_timeout
        if table is not None:
            self._write(table, {"timeout": max(1, round(seconds * table.per_s))})

    def mirror_limits(self) -> None:
        """Write the soft limits to the drive, where the map can."""
        axis = self.axis
        self._write(axis.map.limits, {"min": axis.min_pulses, "max": axis.max_pulses})

    def identity(self) -> dict[str, int | str]:
        """Read what the map calls identity; a register that refuses says so."""
        m = self.axis.map
        found: dict[str, int | str] = {}
        for name, read in m.identity.items():
            try:
                found[name] = self.bus.read(self.axis.unit, read, m.word_order)
            except Rejected as error:
                found[name] = f"exception {error.code}"
        return found

    def _write(
        self, table: Writes | None, values: dict[str, int] | None = None
    ) -> None:
        for frame in table.write if table else ():
            words: list[int] = []
            for word in frame.words:
                if isinstance(word, int):
                    words.append(word)
                else:
                    name, kind = word
                    words += encode(
                        (values or {})[name], kind, self.axis.map.word_order
                    )
            self.bus.write(self.axis.unit, frame.address, frame.function, words)
