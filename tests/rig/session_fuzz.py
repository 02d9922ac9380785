"""Sessions in which things go wrong at random, on a clock that the test owns.

``python tests/rig/session_fuzz.py --sessions 10000`` plays as many; a session follows
from its number alone, so ``--first 17 --sessions 1`` plays one again and shows it.

Drives, phone, line, computer and operator are machines of their own, each with faults.
Nothing sleeps: who waits moves the clock. What is checked was written from the promise,
not from the code: no drive leaves its limits or is faster than it was asked, none moves
after it answered a stop, every end says what stands, every recorded posture is true,
and once all is repaired the same run ends with every posture recorded once.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import functools
import heapq
import itertools
import math
import os
import pathlib
import random
import re
import struct
import sys
import tempfile
import time
import types
from collections.abc import Callable, Sequence
from unittest import mock

import harness
import numpy as np

from rig.command_run import run_safely
from rig.config.axis import Axis
from rig.core import device as devices
from rig.core import heartbeat, motion, stop
from rig.core.session import visit
from rig.drives import bus, make_drives
from rig.drives.wire import Wire, crc16
from rig.faults import EXIT_OK, Fault, Signals
from rig.journal import run_folder
from rig.readings import phone as phones
from rig_workbench.simulator import Truth
from rig_workbench.simulator.drive import SimDrive
from rig_workbench.simulator.faults import FaultInjector, FaultSpec
from rig_workbench.simulator.phone import format_line
from rig_workbench.simulator.server import ModbusServer
from rig_workbench.simulator.simulator import Plant

POSTURES = 3
RATE_HZ = 50.0
BEAT_S = 0.05
MOST_S = 900.0  # of the world's time, for one session
NOISE_DEG = 0.005
KNOWN = re.compile(r"[A-Za-z]+(Error|Exception|Warning): ")  # of a fault of ours

WIRE = ("lost_request", "lost_reply", "late", "doubled", "renumbered", "torn",
        "wrong_unit", "flipped", "stray")  # fmt: skip
DRIVE = (
    "reset",
    "reset_lost",
    "halted",
    "alarm",
    "unpowered",
    "stop_ignored",
    "ramp",
    "jogged",
)
PHONE = ("gap", "reconnect", "garbage", "burst", "backwards")
COMPUTER = ("slept", "hung", "full_disk", "killed")
OPERATOR = ("pause", "stop")


class Killed(BaseException):
    """The session's process is gone: nothing that it would still do happens."""


class Broken(AssertionError):
    """A promise that was not kept."""


class Clock(types.SimpleNamespace):
    """What a module sees as ``time``."""

    def __init__(self, world: World, *, sleeps: bool) -> None:
        """``sleeps``: of a computer, which may sleep while the world goes on."""
        self.CLOCK_BOOTTIME = 7
        self._world, self._sleeps = world, sleeps

    def monotonic(self) -> float:
        return self._world.now - (self._world.slept_s if self._sleeps else 0.0)

    perf_counter = monotonic

    def time(self) -> float:
        return 1.7e9 + self.monotonic()

    def time_ns(self) -> int:
        return round(1e9 * self.time())

    def clock_gettime(self, clock: int) -> float:
        return self._world.now

    def sleep(self, seconds: float) -> None:
        self._world.advance(seconds, beats=True)

    def __getattr__(self, name: str) -> object:
        return getattr(time, name)


class FuzzDrive(SimDrive):
    """A drive that may take long to stop."""

    slow = 1.0

    def _stop(self) -> None:
        super()._stop()
        self._accel *= self.slow


class World:
    """Everything outside the session."""

    phone_fault = ""

    def __init__(self, number: int) -> None:
        self.random = random.Random(number)
        self.now, self.slept_s, self.events = 100.0, 0.0, []
        self._order = itertools.count()
        self.faults: list[str] = []  # that happened, for the one who looks
        self.broken: list[str] = []  # promises; a session takes what is raised in it
        self.dead = self.disk_full = self.asleep = False
        self.hearts: list[heartbeat.Heartbeat] = []
        self.run: harness.Run | None = None
        self.stopped: dict[int, float] = {}  # unit: when its stop was answered
        self._beats = self._beating = False  # whether the line is free for the heart
        self.asleep = self.ended = False
        self.booting: dict[FuzzDrive, float] = {}  # silent until then
        self.jogged: dict[FuzzDrive, float] = {}  # when another moved it
        self.asked: dict[int, float] = {}  # unit: when it was last asked
        self.last_looks: dict[int, float] = {}  # the same, at the end of a stop
        self.wire_share = 0.0
        self._answers_stop: set[int] = set()

    def furnish(self, transport: str) -> None:
        """Drives, mechanism and phone, once the clocks are the world's."""
        config = harness.fast_config()
        line = config.bus.model_copy(update={"transport": transport})
        self.config = config.model_copy(update={"bus": line})
        self.injector = FaultInjector()
        truth = Truth(noise_deg=0.0, seed=self.random.randrange(1 << 30))
        self.drives = [
            FuzzDrive(axis, i, truth, self.injector, 1.0, float(truth.jig_deg[i]))
            for i, axis in enumerate(self.config.axes)
        ]
        self.plant = Plant(self.config, truth, self.drives, self.injector)
        units = [axis.unit for axis in self.config.axes]
        self.server = ModbusServer(
            dict(zip(units, self.drives, strict=True)), self.injector
        )
        self.by_unit = dict(zip(units, self.drives, strict=True))
        self.imu: phones.Imu | None = None
        self.quiet_until = self.next_line = self.next_beat = 0.0
        self.held: list[bytes] = []

    # Time

    def at(self, seconds: float, what: Callable[[], None]) -> None:
        """Let something happen so many seconds from now."""
        heapq.heappush(self.events, (self.now + seconds, next(self._order), what))

    def advance(self, seconds: float, beats: bool = False) -> None:
        """The world goes on for so long, or until the session is killed in it."""
        end, self._beats = self.now + at_least(seconds), beats
        while True:
            due = self.events[0][0] if self.events else end
            self.now = max(self.now, min(end, due, self.next_line, self.now + 0.01))
            self._look()
            if self.next_line <= self.now:
                self._send_line()
            if beats and self.next_beat <= self.now and not self._beating:
                self.next_beat, self._beating = self.now + BEAT_S, True
                try:
                    self._beat()
                finally:
                    self._beating, self._beats = False, beats
            while self.events and self.events[0][0] <= self.now:
                heapq.heappop(self.events)[2]()
            if self.now >= end:
                return

    def breaks(self, text: str) -> None:
        """A promise is not kept; told after the session, which may take what is raised
        in it for a fault of the device."""
        self.faults.append(f"{self.now - 100.0:.3f} BROKEN {text}")
        self.broken.append(text)

    def _beat(self) -> None:
        for heart in [*self.hearts]:
            if heart._stopper.drives[0].line._lock._is_owned():
                continue  # a thread of its own would wait for the line
            if heart._closing.is_set() or heart.beat():
                self.hearts = [other for other in self.hearts if other is not heart]

    def _look(self) -> None:
        """The drives keep what was promised of them."""
        for axis, drive in zip(self.config.axes, self.drives, strict=True):
            drive.advance()
            angle = (drive.position - drive.offset) / drive.pulses_per_deg
            if not axis.min_deg - 1.0 <= angle <= axis.max_deg + 1.0:
                self.breaks(f"{axis.name} is at {angle:.2f} degrees")
            speed = abs(drive.velocity) / abs(drive.pulses_per_deg)
            most = min(axis.speed_deg_s, drive._speed / abs(drive.pulses_per_deg))
            if speed > 2.0 * most and not self.just_jogged(drive):
                self.breaks(f"{axis.name} moves at {speed:.1f} degrees/s")
        if self.now > 100.0 + MOST_S:
            raise Broken("the session does not end")

    # Phone

    def _send_line(self) -> None:
        self.next_line = self.now + 1.0 / RATE_HZ
        if self.imu is None or self.dead or self.asleep or self.now < self.quiet_until:
            return
        matrix = self.plant.attitude()
        noise = np.array([self.random.gauss(0.0, NOISE_DEG) for _ in range(3)])
        matrix = matrix @ small_turn(noise)
        settings = self.config.imu
        line = format_line(settings, matrix, self.now, str(settings.order)).encode()
        lines, self.held = [*self.held, line], []
        kind = self.phone_fault
        if kind == "burst" and self.random.random() < 0.7:
            self.held = lines  # they come together with a later one
            return
        if kind == "backwards":
            lines = lines[::-1]
        if kind == "garbage" and self.random.random() < 0.5:
            lines = [mutated(self.random, x) for x in lines]
        self.imu.take_lines(lines, self.now - self.slept_s)

    # Faults

    def plan(self) -> None:
        """Draw what goes wrong in this session."""
        draw = self.random
        self.wire_share = draw.choice([0.0, 0.0, 0.002, 0.01, 0.05])
        for _ in range(draw.choice([0, 1, 2, 3, 4])):
            kind = draw.choice([*DRIVE, *PHONE, *COMPUTER, *OPERATOR])
            self.at(draw.uniform(0.2, 6.0), lambda k=kind: self.happen(k))

    def happen(self, kind: str) -> None:
        """One fault, now."""
        draw, run = self.random, self.run
        if self.dead:
            return
        self.faults.append(f"{self.now - 100.0:.3f} {kind}")
        axis = draw.randrange(len(self.drives))
        drive = self.drives[axis]
        if kind in ("reset", "reset_lost"):  # off, and on again after a while
            lost = draw.choice([-1, 1]) * draw.uniform(3.0, 8.0)
            drive.power_cycle(lost if kind == "reset_lost" else 0.0)
            self.booting[drive] = self.now + draw.uniform(0.5, 3.0)
        elif kind == "halted":
            drive.halt()
        elif kind == "jogged":  # by another controller
            self._jog(self.config.axes[axis], drive)
        elif kind == "alarm":
            drive.raise_alarm(0x30)
        elif kind == "unpowered":
            drive.cut(draw.uniform(0.2, 3.0))
        elif kind == "stop_ignored":
            self.injector.add(
                FaultSpec("stop_ignored", count=draw.choice([1, 3, 99]), axis=axis)
            )
        elif kind == "ramp":
            drive.slow = draw.uniform(0.05, 0.5)
        elif kind == "gap":
            self.quiet_until = self.now + draw.choice([0.3, 0.8, 2.0, 8.0, 100.0])
        elif kind == "reconnect":
            self.quiet_until = self.now + draw.uniform(0.0, 1.5)
            self.at(self.quiet_until - self.now, self.reconnect)
        elif kind in PHONE:
            self.phone_fault = kind
            self.at(draw.uniform(0.1, 4.0), lambda: setattr(self, "phone_fault", ""))
        elif kind == "slept" and not self.asleep:
            seconds, begun = draw.choice([0.5, 5.0, 60.0]), self.now
            self.asleep = True
            self.advance(seconds)
            self.asleep, self.slept_s = False, self.slept_s + self.now - begun
        elif kind == "hung":
            self.advance(draw.uniform(0.2, 6.0), beats=self._beats)
        elif kind == "full_disk":
            self.disk_full = True
        elif kind == "killed":
            self.dead = True
            raise Killed
        elif kind == "pause" and run:
            run.signals.pause = True
        elif kind == "stop" and run:
            run.signals.request_stop("SIGTERM", 143)

    def _jog(self, axis: Axis, drive: FuzzDrive) -> None:
        drive.advance()
        if drive.alarm or not drive.enabled or self.ended:
            return  # what others do afterwards says nothing about a session's end
        angle = (drive.position - drive.offset) / drive.pulses_per_deg
        angle += self.random.choice([-1, 1]) * self.random.uniform(1.0, 10.0)
        angle = min(max(angle, axis.min_deg), axis.max_deg)
        target = round(angle * drive.pulses_per_deg) + drive.offset
        speed = 20.0 * abs(drive.pulses_per_deg)
        stops = drive.velocity**2 / (20.0 * speed)
        ahead = (drive.position + math.copysign(stops, drive.velocity)) - drive.offset
        if not axis.min_deg < ahead / drive.pulses_per_deg < axis.max_deg:
            return  # what it leaves the limits by would be another's doing
        drive._move(target, speed, 10.0 * speed)
        self.jogged[drive] = self.now

    def just_jogged(self, drive: FuzzDrive) -> bool:
        """Whether another moved it since a session can have looked."""
        return self.now - self.jogged.get(drive, -1e9) < 0.5

    def reconnect(self) -> None:
        if self.imu is not None and not self.dead:
            self.imu.begin()

    def repair(self) -> None:
        """All that is broken is whole again; who reads the clock is told the time."""
        self.events.clear()
        self.injector.clear()
        self.disk_full = self.dead = self.asleep = self.ended = False
        self.booting.clear()
        self.wire_share, self.quiet_until, self.phone_fault = 0.0, 0.0, ""
        self.held, self.hearts, self.stopped = [], [], {}
        self.imu = self.run = None
        for drive in self.drives:
            drive.slow = 1.0
            drive.advance()
        self.advance(4.0)
        for drive in self.drives:
            drive.alarm, drive.enabled = 0, True
            if drive.offset:
                drive.find_origin()

    # The line

    def request(self, wire: FuzzWire, frame: bytes) -> None:
        """A frame comes to the units; the reply, if there is one, some time later."""
        numbered = self.config.bus.transport == "tcp"
        body = frame[6:] if numbered else frame[:-2]
        unit, pdu, draw = body[0], body[1:], self.random
        self.asked[unit] = self.now
        fault = draw.choice(WIRE) if draw.random() < self.wire_share else ""
        if fault:
            self.faults.append(
                f"{self.now - 100.0:.3f} {fault} unit {unit} {pdu.hex()}"
            )
        if fault == "lost_request":
            return
        if unit == 0:
            for drive in self.drives:
                if drive.map.broadcast_stop and self.now >= self.booting.get(
                    drive, 0.0
                ):
                    self._execute(0, drive, pdu)
            return
        if unit not in self.by_unit or self.now < self.booting.get(
            self.by_unit[unit], 0.0
        ):
            return
        reply = bytes([unit]) + self._execute(unit, self.by_unit[unit], pdu)
        if fault == "wrong_unit":
            reply = bytes([unit + 1 + draw.randrange(100)]) + reply[1:]
        number = frame[:2]
        if fault == "renumbered":
            number = draw.randbytes(2)
        sent = number + struct.pack(">HH", 0, len(reply)) + reply
        if not numbered:
            sent = reply + crc16(reply)
            if fault == "flipped":
                place = draw.randrange(len(sent))
                sent = (
                    sent[:place]
                    + bytes([sent[place] ^ 1 << draw.randrange(8)])
                    + sent[place + 1 :]
                )
        delay = draw.uniform(0.001, 0.008)
        timeout_s = self.config.bus.timeout_s
        if fault == "late":
            delay = timeout_s * draw.uniform(1.05, 5.0)
        if fault == "stray":
            sent = (
                draw.choice([b"\0", b"\xff", draw.randbytes(draw.randint(1, 4))]) + sent
            )
        if fault == "torn":
            cut = draw.randrange(len(sent))
            wire.due(self.now + delay, sent[:cut])
            if draw.random() < 0.5:
                wire.due(
                    self.now + delay + draw.uniform(0.0, 2.0 * timeout_s), sent[cut:]
                )
            return
        if fault != "lost_reply":
            wire.due(self.now + delay, sent)
            if unit in self._answers_stop and not fault:
                at = self.now + delay
                self.at(delay, lambda: self.stopped.setdefault(unit, at))
        if fault == "doubled":
            wire.due(self.now + delay + draw.uniform(0.0, 0.3), sent)

    def _execute(self, unit: int, drive: FuzzDrive, pdu: bytes) -> bytes:
        moves, stops = len(drive.executions), len(drive.stops)
        reply = self.server._execute(drive, pdu, broadcast=not unit)
        self._answers_stop = {unit} if unit and len(drive.stops) > stops else set()
        if len(drive.executions) > moves and unit in self.stopped:
            self.breaks(
                f"unit {unit} was moved after it had answered a stop: {pdu.hex()}"
            )
        return reply


class FuzzWire(Wire):
    """A connection into the world."""

    world: World

    def open(self) -> None:
        if self.world.dead:
            raise OSError(errno.EPIPE, "the process is gone")
        if self.socket is None:
            self._came, self._asked = b"", b""
            self._unanswered.clear()
            self.socket, self._inbox = self, []

    def close(self) -> None:
        self.socket, self._inbox = None, []

    def sendall(self, frame: bytes) -> None:
        if self.world.dead:
            raise OSError(errno.EPIPE, "the process is gone")
        self.world.request(self, frame)

    def due(self, when: float, data: bytes) -> None:
        """Bytes that come at a time."""
        if self.socket is not None and data:
            heapq.heappush(self._inbox, (when, data))

    def _read(self, seconds: float) -> bytes:
        end = self.world.now + at_least(seconds)
        while True:
            data = b""
            while self._inbox and self._inbox[0][0] <= self.world.now:
                data += heapq.heappop(self._inbox)[1]
            if data or self.world.now >= end:
                return data
            due = self._inbox[0][0] if self._inbox else end
            self.world.advance(min(end, due) - self.world.now)


def opened_in(world: World, imu: phones.Imu) -> phones.Imu:
    """A phone that connects when the session opens its port."""
    world.imu, imu.sender = imu, "127.0.0.1"
    imu.begin()
    return imu


class NoSignals(Signals):
    """Requests, without the operating system's signals."""

    def __enter__(self) -> NoSignals:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def small_turn(angles: np.ndarray) -> np.ndarray:
    """(3, 3) of small angles in degrees."""
    x, y, z = np.radians(angles)
    return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])


def mutated(draw: random.Random, line: bytes) -> bytes:
    """A line with a byte flipped, cut, or noise in its place."""
    kind = draw.randrange(3)
    if kind == 0:
        place = draw.randrange(len(line))
        return line[:place] + bytes([line[place] ^ 0x80]) + line[place + 1 :]
    return line[: draw.randrange(len(line))] if kind == 1 else draw.randbytes(12)


@contextlib.contextmanager
def played_in(world: World):
    """The modules of the rig on the world's clocks, with its wires and its phone."""
    with contextlib.ExitStack() as stack:
        for name, module in [*sys.modules.items()]:
            if name.startswith("rig") and getattr(module, "time", None) is time:
                clock = Clock(world, sleeps=not name.startswith("rig_workbench"))
                stack.enter_context(mock.patch.object(module, "time", clock))
        wire = type("ThisWire", (FuzzWire,), {"world": world})
        verify_s, stand_s, too_fast = harness.AS_OF_A_DEVICE
        for place, name, value in (
            (bus, "Wire", wire),
            (phones.Imu, "open", lambda imu: opened_in(world, imu)),
            (phones.Imu, "close", lambda imu: setattr(world, "imu", None)),
            (stop, "VERIFY_S", verify_s),
            (stop, "stand_s", stand_s),
            (motion, "TOO_FAST", too_fast),
            (devices, "PATIENCE_S", 60.0),
            (heartbeat.Heartbeat, "start", lambda heart: world.hearts.append(heart)),
        ):
            stack.enter_context(mock.patch.object(place, name, value))
        write = run_folder.Journal.write

        def written(journal, event, **fields):
            if world.dead:
                return {"event": event}
            if world.disk_full:
                raise run_folder.JournalError("cannot write: No space left on device")
            return write(journal, event, **fields)

        stack.enter_context(mock.patch.object(run_folder.Journal, "write", written))
        yield


def require_true(world: World, record: dict) -> None:
    """A recorded posture is where the drives are, and what the phone sees there."""
    for axis, drive, pulses in zip(
        world.config.axes, world.drives, record["pulses"], strict=True
    ):
        drive.advance()
        off = abs(drive.position - drive.offset - pulses) / abs(drive.pulses_per_deg)
        tolerance = world.config.motion.position_tolerance_deg + 0.01
        if off > tolerance and not world.just_jogged(drive):
            world.breaks(f"{record['name']}: {axis.name} is {off:.2f} degrees away")
    seen = np.array(record["attitude"])
    turned = world.plant.attitude().T @ seen  # of the phone as mounted
    angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)))
    if angle > 0.3 and not any(map(world.just_jogged, world.drives)):
        world.breaks(f"{record['name']}: the phone is recorded {angle:.2f} degrees off")


def require_stopped(world: World, event: dict, before: list[int]) -> None:
    """Who is said to stand stands, and who is said to have answered was asked."""
    for unit, drive, stops in zip(event["units"], world.drives, before, strict=True):
        drive.advance()
        if unit["standing"] and drive.velocity and not world.just_jogged(drive):
            world.breaks(f"{unit['axis']} is said to stand, and moves")
        if unit["acknowledged"] and len(drive.stops) == stops:
            world.breaks(f"{unit['axis']} is said to have answered, and was not asked")


def one_session(world: World, folder: pathlib.Path, targets: list) -> int | None:
    """A session, or what goes on with it; its exit code, None if it was killed."""
    said: list[str] = []
    record = harness.commissioned(world.config, folder, world)  # type: ignore[arg-type]
    if not record.left()[0]:  # as the end of `home` and `axes` leaves them
        pairs = zip(world.config.axis_names, world.drives, strict=True)
        record.left_at({name: round(drive.position) for name, drive in pairs})
    run = harness.Run(
        world.config, folder, "calibrate", said.append, record=record,
        start={"simulated": None, "inputs": {}, "maps_from": "."}, reset_alarms=True,
        signals=NoSignals(),
    )  # fmt: skip
    run.lines = harness.line_here
    world.run = run
    results: list[stop.UnitStop] = []

    before = [len(drive.stops) for drive in world.drives]

    def hear(event: dict) -> None:
        if event["event"] == "posture":
            require_true(world, event)
        elif event["event"] == "stop":
            world.ended, world.last_looks = True, dict(world.asked)
            require_stopped(world, event, before)

    def procedure(run: harness.Run) -> int:
        with run.device() as device:
            results.append(device)  # type: ignore[arg-type]
            for name, pulses in targets:
                visit(device, devices.Posture(name, pulses), role="select", index=0)
        return EXIT_OK

    run.listeners.append(hear)
    try:
        code = run_safely(run, procedure)
    except Killed:
        run.journal.close()
        return None
    if world.dead:
        return None
    require_told(world, [x.stopper for x in results], said)
    return code


def require_told(world: World, stoppers: list, said: list[str]) -> None:
    """What was said to stand stands, and stays."""
    text = "\n".join(said)
    if KNOWN.search(text):
        world.breaks(f"a session ended with an error of its own: {text}")
    standing = {r.unit for s in stoppers for r in s.results if r.standing}
    told = {r.unit for s in stoppers for r in s.results}
    if stoppers and told != {*world.by_unit}:
        world.breaks(f"the end tells of units {sorted(told)} only")
    places = {unit: world.by_unit[unit].position for unit in standing}
    world.wire_share, world.phone_fault = 0.0, ""
    events, world.events = world.events, []  # what others do to drives is not its end
    world.advance(1.0)
    world.events = events
    for unit, place in places.items():
        drive, looked = world.by_unit[unit], world.last_looks.get(unit, math.inf)
        if world.jogged.get(drive, -math.inf) > looked:
            continue  # by another, between the last look and the word of it
        if abs(drive.position - place) > 2.0:
            world.breaks(f"unit {unit} was said to stand, and moved on")


def play(
    number: int, folder: pathlib.Path, faults: Sequence[tuple[str, float]] = ()
) -> World:
    """A session with faults, and the same run until it is done.

    ``faults`` are kinds and seconds from the start, of the first session alone, in
    place of what is drawn.
    """
    world = World(number)
    with played_in(world):
        world.furnish(world.random.choice(["tcp", "rtu_tcp"]))
        jig = np.array([d.position / d.pulses_per_deg for d in world.drives])
        targets = [
            (
                f"select:{i}",
                world.config.to_pulses(
                    jig + np.array([world.random.uniform(-9.0, 9.0) for _ in jig])
                ),
            )
            for i in range(POSTURES)
        ]
        for attempt in range(4):
            if attempt < 2 and not faults:
                world.plan()
            for kind, seconds in faults if not attempt else ():
                world.at(seconds, functools.partial(world.happen, kind))
            code = one_session(world, folder, targets)
            world.faults.append(f"{world.now - 100.0:.3f} -- ended with {code}")
            if code is None:  # the line's own process stops the drives
                world.dead, world.wire_share = False, 0.0
                world.injector.clear()
                with contextlib.suppress(Fault, Killed):  # by another of its kills
                    _, drives = make_drives(world.config.bus, world.config.axes)
                    stop.stop_all(drives)
            world.repair()
            world.wire_share = 0.0
            if code == EXIT_OK:
                break
        require_whole(world, folder, targets)
    return world


def require_whole(world: World, folder: pathlib.Path, targets: list) -> None:
    """Every posture is in the journal, once."""
    records = run_folder.read_journal(folder / run_folder.JOURNAL)
    measured = run_folder.measured_postures(records)
    lost = {r["name"] for r in records if r["event"] == "unreachable"}
    names = [r["name"] for r in records if r["event"] == "posture"]
    voided = [n for r in records if r["event"] == "void" for n in r["names"]]
    for name, _ in targets:
        if name not in measured and name not in lost:
            world.breaks(f"{name} is not recorded after all was repaired")
        if names.count(name) > 1 + voided.count(name):
            world.breaks(f"{name} is recorded {names.count(name)} times")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument(
        "--fault", nargs=2, action="append", default=[],
        metavar=("KIND", "SECONDS"), help="instead of what is drawn",
    )  # fmt: skip
    options = parser.parse_args(argv)
    faults = [(kind, float(seconds)) for kind, seconds in options.fault]
    begun, broken = time.perf_counter(), 0
    for number in range(options.first, options.first + options.sessions):
        with tempfile.TemporaryDirectory(dir=shared_memory()) as folder:
            try:
                world = play(number, pathlib.Path(folder), faults)
            except Broken as error:
                broken += 1
                print(f"session {number}: {error}", flush=True)
                continue
            if world.broken:
                broken += 1
                print(
                    f"session {number}: {world.broken[0]} (of {len(world.broken)})",
                    flush=True,
                )
            if options.sessions == 1:
                print("\n".join(world.faults))
    seconds = time.perf_counter() - begun
    print(f"{options.sessions} sessions in {seconds:.0f} s, {broken} broke a promise")
    return int(broken > 0)


def at_least(seconds: float) -> float:
    """A wait that a clock shows: below its last digit one would never end."""
    return seconds and max(seconds, 1e-6)


def shared_memory() -> str | None:
    """A folder that is no disk, where there is one."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


if __name__ == "__main__":
    sys.exit(main())
