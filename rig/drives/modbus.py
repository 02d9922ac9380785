"""Drives of Modbus by their register maps: what a map means, spoken over the bus."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Any

from rig import registers
from rig.drives.bus import Bus, Rejected, words_of
from rig.drives.drive import Drive, Look
from rig.drives.line import BusError
from rig.registers import REGISTERS, Frames, Value

if TYPE_CHECKING:
    from rig.config.axis import Axis
    from rig.config.maps import RegisterMap
    from rig.config.settings import ReadingRegister


class ModbusDrive(Drive):
    line_type = Bus
    axis: Axis
    line: Bus

    def __init__(self, line: Bus, axis: Axis) -> None:
        has = {name for name, table in vars(axis.map).items() if table is not None}
        self.can_reset, self.can_set_zero = "alarm_reset" in has, "set_zero" in has
        self.tells_homed = "homed" in has
        self.counts_from_home = axis.map.home_place is not None  # type: ignore[attr-defined]  # of Modbus
        super().__init__(line, axis)

    @property
    def map(self) -> RegisterMap:
        found: Any = self.axis.map  # or what a stop could read of one
        return found

    @property
    def says_homed(self) -> bool:  # type: ignore[override]  # of the status word
        bits = self.map.homed
        word = self.last.word if self.last else None
        return bits is not None and word is not None and bits.holds(word)

    def ids(self) -> dict[str, int | str]:
        """What the map calls identity; a register that refuses says so."""
        found: dict[str, int | str] = {}
        for name, read in self.map.identity.items():
            try:
                found[name] = self.read(read)
            except Rejected as error:
                found[name] = f"exception {error.code}"
        return found

    def lasting(self, ids: dict[str, int | str]) -> dict[str, int | str]:
        """Without signed registers, which are measurements, such as a temperature."""
        kinds = self.map.identity
        return {n: value for n, value in ids.items() if kinds[n].type.startswith("u")}

    def foreign(self, ids: dict[str, int | str]) -> str:
        for name, (low, high) in self.map.recognise.items():
            value = ids.get(name)
            if isinstance(value, int) and not low <= value <= high:
                return f"{name} is {value}, not in [{low}, {high}]"
        return ""

    def arm(self) -> None:
        self.write(self.map.enable)

    def look(self, retries: int) -> Look:
        if not (self.map.status and self.map.position):  # a stop has read what it could
            raise BusError(
                f"the map {self.map.name} has no readable [status], [position]"
            )
        word = self.read(self.map.status, retries)
        count = self.read(self.map.position, retries)
        return Look(position=count, **self.map.status.flags(word), word=word)

    def position(self) -> int:
        return self.read(self.map.position)

    def standing(self) -> bool:
        flags = self.map.status.flags(self.read(self.map.status))
        return flags["done"] and not flags["moving"]

    def alarm(self) -> str:
        if not (read := self.map.alarm) or not (code := self.read(read)):
            return ""
        name = read.names.get(code)
        return f"alarm 0x{code:X}" + (f" ({name})" if name else "")

    def move(self, count: int, speed: float, accel: float) -> None:
        """Every frame is sent exactly once; speed and ramps as registers hold them."""
        place = count / self.map.position.counts
        per_rev = self.axis.pulses_per_rev
        counts = registers.motion_counts(self.map.units, per_rev, speed, accel)
        self.write(self.map.move, position=place, **counts)

    def stop(self) -> None:
        self.write(self.map.stop)

    def reset(self) -> None:
        self.write(self.map.alarm_reset)

    def hold(self, pulses: int) -> None:
        counts = self.map.position.counts
        self.write(self.map.hold, position=(pulses + self.origin) / counts)

    def held(self) -> int | None:
        read = self.map.target
        with contextlib.suppress(Rejected):
            return self.read(read) if read else None
        return None

    def home(self) -> None:
        self.write(self.map.home)

    def set_zero(self, count: int) -> None:
        self.write(self.map.set_zero, home=count)

    def mirror_limits(self) -> None:
        low, high = (
            min(max(pulses + self.origin, registers.LOWEST), registers.HIGHEST)
            for pulses in (self.axis.min_pulses, self.axis.max_pulses)
        )
        self.write(self.map.limits, min=low, max=high)

    def pulses_per_rev(self) -> int | None:
        if read := self.map.pulses_per_rev:
            with contextlib.suppress(Rejected):  # a model of the family without it
                return self.read(read) or None
        return None

    def watch(self) -> int:
        watch = self.map.comm_timeout
        assert watch is not None  # the map has one, or it is not asked
        place = watch.place_of("timeout") or (watch.write[0].address, "u16")
        return self.read(Value(address=place[0], type=place[1], function=3, bits=0))

    def set_watch(self, counts: int) -> None:
        self.write(self.map.comm_timeout, timeout=counts)

    def watch_counts(self, seconds: float) -> int:
        assert self.map.comm_timeout is not None
        return max(1, math.ceil(seconds * self.map.comm_timeout.per_s - 1e-9))

    def write(self, table: Frames | None, **values: float) -> None:
        """Send the frames of one of the map's tables; none where the map lacks it. What
        moves the drive, or stops it, is sent once; the rest is retried as reads are."""
        once = any(
            table is motion for motion in (self.map.move, self.map.home, self.map.stop)
        )
        tries = 1 if once else 1 + self.line.settings.read_retries
        for tries_left in reversed(range(tries)):
            try:
                for frame in table.write if table else ():
                    words = frame.registers(self.map.word_order, **values)
                    self.line.write(
                        self.axis.unit, frame.address, frame.function, words
                    )
                return
            except BusError as error:
                if not tries_left or error.refused:
                    raise

    def read(self, read: Value, retries: int | None = None) -> int:
        """A value of the map as a whole number, a position in counts."""
        order = self.map.word_order
        value = decoded(self.line, read, self.axis.unit, order, retries)
        if not math.isfinite(value):
            unit = self.axis.unit
            raise BusError(f"unit {unit}: 0x{read.address:04X} has no number, {value}")
        return round(value * getattr(read, "counts", 1))


def decoded(
    bus: Bus,
    read: Value | ReadingRegister,
    unit: int,
    word_order: str,
    retries: int | None = None,
) -> float:
    data = bus.read(unit, read.function, read.address, read.quantity, retries)
    if read.function not in REGISTERS:
        return int.from_bytes(data, "little") & (1 << read.quantity) - 1
    return registers.decode(words_of(data), read.type, word_order)
