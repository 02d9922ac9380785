"""A drive made from its register map: ramps, quick stop, alarms, comm timeout."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from rig.config.maps import RegisterMap
from rig.config.registers import (
    FLAGS,
    Read,
    Write,
    Writes,
    decode,
    encode,
    registers_of,
)

ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 2, 3, 4
STEP_S = 0.001
COMM_ALARM = 0x85
QUICK_STOP_FACTOR = 5.0


class DriveException(Exception):
    """The drive answers with a Modbus exception."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"exception {code}")


class SimDrive:
    """One unit; positions in pulses."""

    def __init__(
        self,
        register_map: RegisterMap,
        pulses_per_rev: int,
        position: float = 0.0,
        speedup: float = 1.0,
        travel: Sequence[int] | None = None,
        stuck: Callable[[], object] = lambda: False,
    ) -> None:
        self.map = register_map
        self.position = float(position)
        self.velocity = 0.0
        self.target = round(position)
        self.moving = False
        self.done = True
        self.alarm = 0
        self.enabled = True
        self.executions: list[int] = []  # target of each move that was run
        self.stops: list[float] = []
        self.comm_stops = 0
        self._travel = travel  # targets outside are answered with exception 3
        self._pulses_per_rev = pulses_per_rev
        self._stuck = stuck
        self._speedup = speedup
        self._speed = self._accel = 1.0
        self._stopping = False
        self._comm_timeout = 0.0
        self._last_frame = self._now = time.monotonic()
        self._registers = self._known()

    def _known(self) -> dict[int, int]:
        """Every register of the map; the first of the identity is the resolution."""
        m = self.map
        tables = (m.move, m.stop, m.enable, m.alarm_reset, m.comm_timeout, m.limits)
        identity = list(m.identity.values())
        places: list[Read | Write] = [m.status, m.position, *identity]
        places += [m.alarm] if m.alarm else []
        places += [frame for table in tables if table for frame in table.write]
        known = {p.address + i: 0 for p in places for i in range(p.count)}
        for read in identity[:1]:
            known[read.address + read.count - 1] = self._pulses_per_rev & 0xFFFF
        return known

    def advance(self) -> None:
        """Bring position and velocity up to the clock."""
        now = time.monotonic()
        if self.moving and self._comm_timeout:
            lost = self._last_frame + self._comm_timeout
            if now > lost and not self._stopping:
                self._integrate(lost)
                self.comm_stops += 1
                self.alarm = COMM_ALARM
                self._stopping = True
        self._integrate(now)

    def _integrate(self, now: float) -> None:
        while self.moving and self._now < now:
            dt = min(STEP_S, now - self._now)
            self._now += dt
            self._step(dt * self._speedup)
        self._now = max(self._now, now)

    def _step(self, dt: float) -> None:
        if self._stuck():
            self.velocity = 0.0
            if not self._stopping:
                return
        if self._stopping:
            drop = QUICK_STOP_FACTOR * self._accel * dt
            if abs(self.velocity) <= drop:
                self.velocity, self.moving, self._stopping = 0.0, False, False
                self.position = float(round(self.position))
                return
            self.velocity -= math.copysign(drop, self.velocity)
            self.position += self.velocity * dt
            return
        error = self.target - self.position
        wanted = math.copysign(
            min(self._speed, math.sqrt(2.0 * self._accel * abs(error))), error
        )
        change = max(-self._accel * dt, min(self._accel * dt, wanted - self.velocity))
        self.velocity += change
        step = self.velocity * dt
        # The last step ends on the target; only a drive sent back while it runs fast
        # passes it.
        near = abs(error) <= max(abs(step), 0.5)
        if near and abs(self.velocity) <= 20 * self._accel * dt + 1.0:
            self.position, self.velocity = float(self.target), 0.0
            self.moving, self.done = False, True
            return
        self.position += step

    def raise_alarm(self, code: int) -> None:
        """Fault: the drive stops itself and refuses to move until reset."""
        self.advance()
        self.alarm = code
        self.done = False
        self._stopping = self.moving

    def read(self, address: int, count: int) -> list[int]:
        """Holding registers; raises DriveException where there are none."""
        self.advance()
        self._last_frame = time.monotonic()
        m = self.map
        values: list[tuple[Read, int]]
        values = [(m.status, self._status()), (m.position, round(self.position))]
        values += [(m.alarm, self.alarm)] if m.alarm else []
        for place, value in values:
            for i, word in enumerate(encode(value, place.type, m.word_order)):
                self._registers[place.address + i] = word
        try:
            return [self._registers[address + i] for i in range(count)]
        except KeyError:
            raise DriveException(ILLEGAL_ADDRESS) from None

    def _status(self) -> int:
        resting = self.done and not self.moving and not self.alarm
        on = (self.enabled, resting, self.moving, bool(self.alarm))
        named = [getattr(self.map.status, name) for name in FLAGS]
        pairs = [bits for bits, holds in zip(named, on, strict=True) if bits and holds]
        return sum({1 << bit for bits in pairs for bit in bits.set})

    def write(self, address: int, words: list[int]) -> None:
        """Write holding registers, and do what they mean."""
        self.advance()
        self._last_frame = time.monotonic()
        at = {address + i: word for i, word in enumerate(words)}
        if not at.keys() <= self._registers.keys():
            raise DriveException(ILLEGAL_ADDRESS)
        m, before = self.map, self._registers
        self._registers = before | at
        if at.get(m.move.trigger.address) == m.move.trigger.value:
            try:
                self._start()
            except DriveException:
                self._registers = before
                raise
        elif self._begins(m.stop, address, words):
            self.stops.append(time.monotonic())
            self._stopping = self.moving
            self.target = round(self.position)
        elif self._begins(m.alarm_reset, address, words):
            self.alarm = 0
        elif self._begins(m.enable, address, words):
            self.enabled = True
        elif m.comm_timeout and address == m.comm_timeout.write[0].address:
            counts = self._value(m.comm_timeout, "timeout")
            self._comm_timeout = counts / m.comm_timeout.per_s

    def _begins(self, table: Writes | None, address: int, words: list[int]) -> bool:
        first = table.write[0] if table else None
        sent = [word.value for word in first.words] if first else None
        return bool(first and (first.address, sent) == (address, words))

    def _value(self, table: Writes, name: str) -> int:
        """What the registers hold of a named value; 0 where the table has none."""
        place = table.place_of(name)
        if place is None:
            return 0
        address, kind = place
        words = [self._registers[address + i] for i in range(registers_of(kind))]
        return decode(words, kind, self.map.word_order)

    def _start(self) -> None:
        m = self.map
        if self.alarm or not self.enabled:
            raise DriveException(DEVICE_FAILURE)
        target = self._value(m.move, "position")
        if self._travel and not self._travel[0] <= target <= self._travel[1]:
            raise DriveException(ILLEGAL_VALUE)
        units, per_rev = m.units, float(self._pulses_per_rev)
        speed = (self._value(m.move, "speed") or 1) / units.speed_per_unit
        accel = (self._value(m.move, "accel") or 1) / units.accel_per_unit
        if units.accel == "s_per_rev_per_s":
            accel = 1.0 / accel
        self._speed = speed * (per_rev if units.speed == "rev_per_s" else 1.0)
        self._accel = accel * (1.0 if units.accel == "pulse_per_s2" else per_rev)
        self.executions.append(target)
        self.target, self.moving, self.done = target, True, False
        self._stopping = False
