"""A source of readings: what motion and measurement ask a phone or a sensor."""

from __future__ import annotations

import abc
import itertools
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.faults import Fault, Report, unheard
from rig.readings.geometry import Array, Reading

RING = 8192  # readings kept: over half a minute at 200 Hz
REJOIN = 5  # readings in a row that agree with each other after a jump
BACKLOG = 128  # connections that wait for an answer; past that a phone waits 1 s


class ReadingError(Fault):
    """Readings are stale, their line is closed, or they are not to be trusted."""


class JumpGate:
    """Tells impossible jumps, until REJOIN readings in a row agree with each other."""

    def __init__(self, apart: Callable[[Array, Array], float], most: float) -> None:
        self._apart, self._most = apart, most
        self._last: Array | None = None
        self._far: list[Array] = []

    def jumps(self, value: Array) -> bool:
        """Whether a reading is not to be used; else the next are compared with it."""
        if self._last is not None and self._apart(self._last, value) > self._most:
            if self._far and self._apart(self._far[-1], value) > self._most:
                self._far.clear()
            self._far.append(value)
            if len(self._far) < REJOIN:
                return True
        self._far, self._last = [], value
        return False


class Source(abc.ABC):
    """Readings, now and over the last seconds, of what is called or calls at ``host``
    and ``port`` of its settings.

    A kind receives on a thread, and gives each accepted reading to ``store``; see
    docs/rig/readings.md.
    """

    whose = "the sensor"
    table = "readings"  # of rig.toml
    start = "switch it on"
    lost = "Check its power and cable"
    sender = ""  # address that is heard, once a reading of it was used
    connections = 0  # a heading may be another one after a new connection
    world: Array = np.eye(3)  # by which attitudes are turned

    def __init__(self, settings: Any, report: Report = unheard) -> None:
        """``report`` gets an event and its fields, on the receiving thread."""
        self.settings, self.stale_s, self.port = (
            settings,
            settings.stale_s,
            settings.port,
        )
        self.report = report
        self.refused: list[str] = []  # addresses that were not let in
        self._lock = threading.Lock()
        self._ring: deque[Reading] = deque(maxlen=RING)
        self._counts: Counter[str] = Counter()
        self._arrived = 0.0
        self._ended = ""  # why nothing is received any more
        self._closing = threading.Event()
        self._listener: socket.socket | None = None  # where this computer is called
        self._thread = threading.Thread(
            target=self._receive, name=self.table, daemon=True
        )

    @abc.abstractmethod
    def receive(self) -> None:
        """Take what comes, on the thread, until it is closing."""

    def _receive(self) -> None:
        try:
            self.receive()
        except Exception as error:
            self._ended = f"{type(error).__name__}: {error}"

    @property
    def where(self) -> str:
        """Where it is heard, in words."""
        return f"{self.settings.host}:{self.port}"

    def open(self) -> Any:
        """Begin to receive; ReadingError where the port cannot be opened."""
        place = (self.settings.host, self.settings.port)
        try:
            if self.settings.transport == "listen":
                self._listener = socket.create_server(place, backlog=BACKLOG)
            elif self.settings.transport == "udp":
                self._listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._listener.bind(place)
        except OSError as error:
            raise ReadingError(
                f"cannot open the port of {self.whose}, {self.where}: "
                f"{error.strerror or error}. End the program that uses it, or change "
                f"{self.table}.host and {self.table}.port"
            ) from None
        if self._listener is not None:
            self.port = int(self._listener.getsockname()[1])
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop receiving and close the port."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        if self._listener is not None:
            self._listener.close()

    def turn(self, world: Array) -> None:
        """Turn all readings, those that were received too; of attitudes alone."""
        raise NotImplementedError("numbers have no world to turn")  # of attitudes alone

    def store(self, readings: list[Reading]) -> bool:
        """Keep what was accepted, under the lock; whether anything was."""
        if readings:
            self._arrived = time.monotonic()
        for reading in readings:
            last = self._ring[-1].time if self._ring else reading.time
            if reading.time > last - 1e-3:
                self._ring.append(Reading(max(last, reading.time), reading.value))
        return bool(readings)

    def __enter__(self) -> Any:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> Reading:
        """The newest reading; ReadingError where none is fresh."""
        with self._lock:
            reading = self._ring[-1] if self._ring else None
        if self._ended:
            raise ReadingError(f"reading from {self.whose} stopped: {self._ended}")
        if reading is None:
            raise ReadingError(f"{self.whose} has sent no reading yet: {self.start}")
        now, limit = time.monotonic(), self.stale_s
        if now - reading.time > limit:
            hint = self.lost
            if now - self._arrived < limit:
                hint = "Its readings are late, or its time stamps are wrong"
            raise ReadingError(
                f"{self.whose}'s last reading is {now - reading.time:.2f} s old (limit "
                f"{self.table}.stale_s = {limit:g} s). {hint}{self.dropped}"
            )
        return reading

    def since(self, start: float) -> list[Reading]:
        """Readings measured at or after a monotonic time, oldest first."""
        with self._lock:
            newest = reversed(self._ring)
            recent = itertools.takewhile(lambda r: r.time >= start, newest)
            return [*recent][::-1]

    @property
    def counts(self) -> dict[str, int]:
        """Records that were accepted, and those dropped by reason."""
        with self._lock:
            return dict(self._counts)

    @property
    def dropped(self) -> str:
        """What was dropped, in words; empty where nothing was."""
        reasons = [f"{n} {why}" for why, n in self.counts.items() if why != "accepted"]
        return f"; records dropped: {', '.join(reasons)}" if reasons else ""

    def wait_for_stream(self, timeout_s: float) -> Reading:
        """The first fresh reading; ReadingError where none came in time."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                return self.latest()
            except ReadingError:
                if self._ended:
                    raise
                if time.monotonic() > end:
                    detail = self.dropped
                    if self.refused:
                        detail += f"; senders refused: {', '.join(self.refused)}"
                    raise ReadingError(
                        f"no usable reading from {self.whose} in {timeout_s:g} s on "
                        f"{self.where} ({self.connections} connections{detail}). "
                        f"{self.start[0].upper()}{self.start[1:]}, and check the "
                        f"address, port and [{self.table}]"
                    ) from None
            time.sleep(0.01)
