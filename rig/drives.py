"""Drives: what a register map means, spoken over the bus."""

from __future__ import annotations

import dataclasses
import time

from rig.bus import Bus, Rejected
from rig.registers import Write, encode
from rig.settings import Axis

__all__ = ["Drive", "Status", "motion_counts"]


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


def motion_counts(axis: Axis, speed_deg_s: float) -> dict[str, int]:
    """Register values of speed and acceleration of a move.

    Raises:
        ValueError: one does not fit its register.
    """
    counts: dict[str, int] = {}
    turns = axis.scale.rev_per_s(speed_deg_s)
    ramp = axis.scale.rev_per_s(axis.accel_deg_s2)
    if axis.map.speed_unit == "pulse_per_s":
        turns *= axis.scale.pulses_per_rev
    counts["speed"] = max(1, round(turns * axis.map.speed_per_unit))
    if axis.map.accel_unit == "s_per_rev_per_s":
        counts["accel"] = max(1, round(axis.map.accel_per_unit / ramp))
    else:
        if axis.map.accel_unit == "pulse_per_s2":
            ramp *= axis.scale.pulses_per_rev
        counts["accel"] = max(1, round(ramp * axis.map.accel_per_unit))
    counts["decel"] = counts["accel"]
    for frame in axis.map.move:
        for name in ("speed", "accel", "decel"):
            found = frame.offset_of(name)
            if found is None:
                continue
            try:
                encode(counts[name], found[1], axis.map.word_order)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
    return counts


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
            done=m.done.holds(word),
            moving=m.moving.holds(word),
            fault=m.fault.holds(word),
            enabled=True if m.enabled is None else m.enabled.holds(word),
            time=time.monotonic(),
        )

    def alarm(self) -> str:
        """The alarm in words, empty where there is none or no register for it."""
        m = self.axis.map
        if m.alarm is None:
            return ""
        code = self.bus.read(self.axis.unit, m.alarm, m.word_order)
        if code == 0:
            return ""
        return f"alarm 0x{code:X}" + (
            f" ({m.alarm_names[code]})" if code in m.alarm_names else ""
        )

    def move(self, pulses: int, speed_deg_s: float | None = None) -> None:
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
        speed = min(speed_deg_s or axis.speed_deg_s, axis.speed_deg_s)
        values = {"position": pulses, **motion_counts(axis, speed)}
        self._write(axis.map.move, values)

    def stop(self) -> None:
        """Quick stop; torque stays on."""
        self._write(self.axis.map.stop, {})

    def enable(self) -> None:
        """Enable the power stage, where the map can."""
        self._write(self.axis.map.enable, {})

    def reset_alarm(self) -> None:
        """Reset an alarm, where the map can."""
        self._write(self.axis.map.alarm_reset, {})

    def set_comm_timeout(self, seconds: float) -> None:
        """Tell the drive to stop by itself when the line is silent for so long."""
        count = max(1, round(seconds * self.axis.map.comm_timeout_per_s))
        self._write(self.axis.map.comm_timeout, {"timeout": count})

    def mirror_limits(self) -> None:
        """Write the soft limits to the drive, where the map can."""
        axis = self.axis
        self._write(axis.map.limits, {"min": axis.min_pulses, "max": axis.max_pulses})

    def identity(self) -> dict[str, int | str]:
        """Read what the map calls identity; a register that refuses says so."""
        m = self.axis.map
        found: dict[str, int | str] = {}
        for name, read in m.identity:
            try:
                found[name] = self.bus.read(self.axis.unit, read, m.word_order)
            except Rejected as error:
                found[name] = f"exception {error.code}"
        return found

    def _write(self, frames: tuple[Write, ...], values: dict[str, int]) -> None:
        for frame in frames:
            words: list[int] = []
            for word in frame.words:
                if isinstance(word, int):
                    words.append(word)
                else:
                    order = self.axis.map.word_order
                    words += encode(values[word[0]], word[1], order)
            self.bus.write(self.axis.unit, frame.address, frame.function, words)
