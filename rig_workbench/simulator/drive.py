"""A drive made from its register map: ramps, quick stop, alarms, comm timeout."""

from __future__ import annotations

import math
import random
import time

from rig.config.axis import Axis
from rig.config.maps import Read, RegisterMap, Write, Writes
from rig.registers import FLAGS, VALUES, decode, encode, registers_of
from rig_workbench.simulator.faults import FaultInjector
from rig_workbench.simulator.truth import Truth

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
    """One unit; positions in pulses of its own counter.

    ``offset`` is what the counter is away from the motor: the drive lost its origin by
    so much, until it is homed.
    """

    def __init__(
        self,
        axis: Axis,
        number: int = 0,
        truth: Truth | None = None,
        faults: FaultInjector | None = None,
        speedup: float = 1.0,
        at_deg: float = 0.0,
    ) -> None:
        assert isinstance(axis.map, RegisterMap)  # others have simulators of their own
        self.map = axis.map
        self.truth = truth or Truth()
        set_to = self.truth.drive_pulses_per_rev
        self.pulses_per_rev = set_to[number] if set_to else axis.pulses_per_rev
        per_turn = axis.pulses_per_deg / axis.pulses_per_rev
        self.pulses_per_deg = per_turn * self.pulses_per_rev  # signed, of the joint
        self.position = float(round(at_deg * self.pulses_per_deg))
        self.executions: list[int] = []  # target of each move that was run
        self.stops: list[float] = []
        self.comm_stops = 0
        self.offset = 0
        self.travel = (-math.inf, math.inf)  # targets outside: exception 3
        self._number, self._faults = number, faults or FaultInjector()
        self._random = random.Random(self.truth.seed + number)
        self._speedup = speedup
        self._speed = self._accel = 1.0
        self._last_frame = self._now = time.monotonic()
        self._switch_on()

    def _switch_on(self) -> None:
        self.target, self.velocity, self.alarm = round(self.position), 0.0, 0
        self.moving = self._stopping = self._homing = self.homed = False
        self.done, self.enabled = True, not self.truth.enable_delay_s
        self._set_to = 0  # what it was told to count at its origin
        self._enables = self._clears = math.inf  # when what was asked for is done
        self._comm_timeout = math.inf
        self._resumes = math.inf  # when it goes on after a stop, as some drives do
        self._resumed = self.target  # and where to
        places: list[Read | Write] = [*self.map.identity.values()]
        for _, value in self.map:
            places += [value] if isinstance(value, Read) else []
            places += value.write if isinstance(value, Writes) else []
        self._registers = {p.address + i: 0 for p in places for i in range(p.count)}
        if read := self.map.pulses_per_rev:
            self._show(read, self.pulses_per_rev % (1 << 16 * read.count))

    def _show(self, place: Read, value: int) -> None:
        for i, word in enumerate(encode(value, place.type, self.map.word_order)):
            self._registers[place.address + i] = word

    def advance(self) -> None:
        """Bring position and velocity up to the clock."""
        now = time.monotonic()
        if now >= self._enables:
            self.enabled, self._enables = True, math.inf
        if now >= self._clears:
            self.alarm, self._clears = 0, math.inf
        if now >= self._resumes and self.enabled and not self.alarm:
            self._resumes = math.inf
            self._move(self._resumed, self._speed, self._accel)
        watched = self.moving or self.truth.idle_watchdog
        lost = self._last_frame + self._comm_timeout
        deaf = self._faults.take("watch_ignored", self._number)
        if watched and now > lost and not (self._stopping or self.alarm or deaf):
            self._integrate(lost)
            self.comm_stops += 1
            self.alarm = COMM_ALARM
            self._stopping = self.moving
        self._integrate(now)

    def _integrate(self, now: float) -> None:
        while self.moving and self._now < now:
            dt = min(STEP_S, now - self._now)
            self._now += dt
            self._step(dt * self._speedup)
        self._now = max(self._now, now)

    def _step(self, dt: float) -> None:
        stuck = self._faults.take("stuck_axis", self._number) is not None
        self.velocity = 0.0 if stuck else self.velocity
        if self._stopping:
            drop = QUICK_STOP_FACTOR * self._accel * dt
            if abs(self.velocity) <= drop:
                self.velocity, self.moving, self._stopping = 0.0, False, False
                self.position = float(round(self.position))
            else:
                self.velocity -= math.copysign(drop, self.velocity)
                self.position += self.velocity * dt
            return
        if stuck:
            return
        error = self.target - self.position
        target = math.copysign(
            min(self._speed, math.sqrt(2.0 * self._accel * abs(error))), error
        )
        most = self._accel * dt
        self.velocity += max(-most, min(most, target - self.velocity))
        step = self.velocity * dt
        # The last step ends on the target, however short it is cut by a look at the
        # drive; only a drive sent back while it runs fast passes it.
        slow = abs(self.velocity) <= 20 * self._accel * STEP_S * self._speedup + 1.0
        if not (slow and abs(error) <= max(abs(step), 0.5)):
            self.position += step
            return
        self.position, self.velocity = float(self.target), 0.0
        self.moving, self.done = False, True
        if self._homing:
            self.find_origin()

    def raise_alarm(self, code: int) -> None:
        """Fault: the drive stops itself and refuses to move until reset."""
        self.advance()
        self.alarm, self.done, self._stopping = code, False, self.moving

    @property
    def travels(self) -> bool:
        """Whether the drive is in the middle of a move."""
        self.advance()
        return self.moving and not self._stopping and abs(self.velocity) > 0.0

    def halt(self) -> None:
        """Fault: another controller stops it; it says that it is done."""
        self.advance()
        self._stopping, self.done = self.moving, True

    def cut(self, seconds: float) -> None:
        """Fault: its power stage is off for a time, without an alarm."""
        self.advance()
        self.velocity, self.moving, self._stopping = 0.0, False, False
        self.enabled, self.done = False, True
        self._enables = time.monotonic() + seconds

    def find_origin(self) -> None:
        """Count from the motor's origin again, as homing ends."""
        self.position -= self.offset
        self.target, self.offset, self._set_to = round(self.position), 0, 0
        self.homed, self._homing = True, False

    def power_cycle(self, lost_deg: float = 0.0) -> None:
        """Off and on again: its counter comes back so many degrees away."""
        self.advance()
        offset = round(lost_deg * self.pulses_per_deg)
        self.offset += offset
        self.position = float(round(self.position) + offset)
        self._switch_on()

    def read(self, address: int, count: int) -> list[int]:
        """Holding registers; raises DriveException where there are none."""
        self.advance()
        self._last_frame = time.monotonic()
        flicker = 0 if self.velocity else self.truth.jitter_counts
        counter = round(self.position) + self._random.randint(-flicker, flicker)
        self._show(self.map.status, self._status())
        self._show(self.map.position, counter)
        if self.map.alarm:
            self._show(self.map.alarm, self.alarm)
        try:
            return [self._registers[address + i] for i in range(count)]
        except KeyError:
            raise DriveException(ILLEGAL_ADDRESS) from None

    def _status(self) -> int:
        resting = self.done and not self.moving and not self.alarm
        on = (self.enabled, resting, self.moving, bool(self.alarm), self.homed)
        named = [getattr(self.map.status, name) for name in FLAGS] + [self.map.homed]
        pairs = [bits for bits, holds in zip(named, on, strict=True) if bits and holds]
        return sum({1 << bit for bits in pairs for bit in bits.set})

    def write(self, address: int, words: list[int], broadcast: bool = False) -> None:
        """Write holding registers, and do what they mean."""
        self.advance()
        self._last_frame = time.monotonic()
        at = {address + i: word for i, word in enumerate(words)}
        if not at.keys() <= self._registers.keys():
            raise DriveException(ILLEGAL_ADDRESS)
        m, before = self.map, self._registers
        self._registers = before | at
        obey = {
            "stop": self._stop, "alarm_reset": self._reset, "enable": self._enable,
            "home": self._home, "set_zero": self._set_zero,
        }  # fmt: skip
        if at.get(m.move.trigger.address) == m.move.trigger.value:
            try:
                self._start()
            except DriveException:
                self._registers = before
                raise
        elif table := next((n for n in obey if self._begins(n, address, words)), None):
            if table != "stop" or not self._ignores_stop(broadcast):
                obey[table]()
            self.advance()
        elif m.comm_timeout and address == m.comm_timeout.write[0].address:
            counts = self._value(m.comm_timeout, "timeout")
            self._comm_timeout = counts / m.comm_timeout.per_s or math.inf

    def _begins(self, table: str, address: int, words: list[int]) -> bool:
        """Whether a frame is the table's first one that says something by itself."""
        writes = getattr(self.map, table)
        for frame in writes.write if writes else ():
            constants = {a: w.value for a, w in frame.places() if w.value not in VALUES}
            if constants:
                sent = {address + i: word for i, word in enumerate(words)}
                same = (frame.address, frame.count) == (address, len(words))
                return same and constants.items() <= sent.items()
        return False

    def _value(self, table: Writes, name: str) -> int:
        """What the registers hold of a named value; 0 where the table has none."""
        place = table.place_of(name)
        if place is None:
            return 0
        address, kind = place
        words = [self._registers[address + i] for i in range(registers_of(kind))]
        return round(decode(words, kind, self.map.word_order))

    def _ignores_stop(self, broadcast: bool) -> bool:
        self.stops.append(time.monotonic())
        kinds = ("stop_ignored", *(("unit_stop_ignored",) if not broadcast else ()))
        return any(self._faults.take(kind, self._number) for kind in kinds)

    def _stop(self) -> None:
        moved, goal, self._resumes = self.moving, self.target, math.inf
        self._stopping, self.target = self.moving, round(self.position)
        if moved and (fault := self._faults.take("stop_resumes", self._number)):
            seconds = 1.0 if fault.seconds is None else fault.seconds
            self._resumes, self._resumed = time.monotonic() + seconds, goal

    def _reset(self) -> None:
        self._clears = time.monotonic() + self.truth.reset_delay_s

    def _enable(self) -> None:
        self._enables = time.monotonic() + self.truth.enable_delay_s

    def _set_zero(self) -> None:
        assert self.map.set_zero is not None  # it was just written
        home = self._value(self.map.set_zero, "home")
        self.offset += home - round(self.position)
        self.position, self.target, self._set_to = float(home), home, home
        self.homed = True

    def _home(self) -> None:
        """Go to where the motor's origin is, and count from there."""
        self._move(self.offset, self.pulses_per_rev, 10.0 * self.pulses_per_rev)
        self._homing = True

    def _start(self) -> None:
        m, per_rev = self.map, float(self.pulses_per_rev)
        speed = (self._value(m.move, "speed") or 1) / m.units.speed_per_unit
        accel = (self._value(m.move, "accel") or 1) / m.units.accel_per_unit
        if m.units.accel == "s_per_rev_per_s":
            accel = 1.0 / accel
        speed *= per_rev if m.units.speed == "rev_per_s" else 1.0
        accel *= 1.0 if m.units.accel == "pulse_per_s2" else per_rev
        target = self._value(m.move, "position")
        if fault := self._faults.take("fast_drive", self._number):
            speed *= fault.factor or 20.0
            accel *= (fault.factor or 20.0) ** 2
        if not self.travel[0] <= target - self._set_to <= self.travel[1]:
            raise DriveException(ILLEGAL_VALUE)
        self._move(target, speed, accel)
        self.executions.append(target)

    def _move(self, target: int, speed: float, accel: float) -> None:
        if self.alarm or not self.enabled:
            raise DriveException(DEVICE_FAILURE)
        self.target, self._speed, self._accel = target, speed, accel
        self.moving, self.done = True, False
        self._stopping = self._homing = False
