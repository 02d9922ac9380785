"""Numbers of a sensor: lines over TCP, UDP or a serial port, or Modbus registers.

A dial gauge, a digital level, an encoder, a load cell. A reading is accepted only if
its record is whole: as many columns as named, plain decimal numbers, no impossible
jump. Everything else is counted and dropped.
"""

from __future__ import annotations

import contextlib
import re
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.config.settings import BusSettings, ReadingsSettings
from rig.drives.bus import Bus
from rig.drives.modbus import decoded
from rig.faults import Report, unheard
from rig.readings.geometry import Array, Reading
from rig.readings.source import JumpGate, ReadingError, Source
from rig.readings.stream import LineSplitter

NUMBER = re.compile(r"[+-]?[0-9]{1,15}(?:\.[0-9]{0,17})?(?:[eE][+-]?[0-9]{1,2})?")
RECONNECT_S = 0.2
LOOK_S = 0.1  # between two looks at whether to end


class Sensor(Source):
    """Numbers as they come in, on one thread."""

    def __init__(self, settings: ReadingsSettings, report: Report = unheard) -> None:
        super().__init__(settings, report)
        self.settings: ReadingsSettings = settings
        self.connections = 1  # numbers are the same whoever connects again
        self._gate = JumpGate(lambda a, b: np.abs(b - a).max(), settings.most_jump)

    @property
    def where(self) -> str:
        return self.settings.device or super().where

    # On the thread

    def receive(self) -> None:
        if self._listener is not None:
            self._listener.settimeout(LOOK_S)
        ways = {"udp": self._datagrams, "modbus": self._registers}
        way = ways.get(self.settings.transport, self._lines)
        while not self._closing.is_set():
            with contextlib.suppress(OSError, ReadingError):
                way()
            self._closing.wait(RECONNECT_S)

    def _lines(self) -> None:
        """Lines of one connection, until it ends."""
        with contextlib.ExitStack() as stack:
            read, write = self._connected(stack)
            request = self.settings.request.encode().decode("unicode_escape").encode()
            splitter = LineSplitter(torn=not request)
            while not self._closing.is_set():
                if request:
                    write(request)
                data = read()
                if data is None:
                    continue
                if not data:
                    return
                for line in splitter.feed(data):
                    self._take(line)

    def _connected(
        self, stack: contextlib.ExitStack
    ) -> tuple[Callable[[], bytes | None], Callable[[bytes], object]]:
        """How to read what came, None for nothing yet, b"" for the end; and write."""
        s = self.settings
        if s.transport == "serial":
            import serial  # type: ignore[import-untyped]  # no stubs

            port = serial.Serial(
                s.device, s.baudrate, s.bytesize, s.parity, s.stopbits, timeout=LOOK_S
            )
            stack.enter_context(port)
            return lambda: port.read(max(1, port.in_waiting)) or None, port.write
        if self._listener is not None:
            while True:
                try:
                    connection, (address, *_) = self._listener.accept()
                    break
                except TimeoutError:
                    if self._closing.is_set():
                        raise
        else:
            address = s.host
            connection = socket.create_connection((address, s.port), 1.0)
        stack.enter_context(connection)
        connection.settimeout(LOOK_S)
        if not self._hears(address):
            raise ReadingError(address)

        def read() -> bytes | None:
            try:
                return connection.recv(4096)
            except TimeoutError:
                return None

        return read, connection.sendall

    def _datagrams(self) -> None:
        assert self._listener is not None
        while not self._closing.is_set():
            with contextlib.suppress(TimeoutError):
                data, (address, *_) = self._listener.recvfrom(65536)
                lines = re.split(rb"[\r\n]+", data) if self._hears(address) else ()
                for line in filter(None, lines):
                    self._take(line)

    def _registers(self) -> None:
        """Poll the registers."""
        s = self.settings
        given: dict[str, Any] = {"transport": "tcp", "host": s.host, "port": s.port}
        if s.device:
            given = {"transport": "rtu", "device": s.device, "baudrate": s.baudrate}
            given |= {"parity": s.parity, "stopbits": s.stopbits}
        with Bus(BusSettings(**given, timeout_s=max(s.stale_s / 2, 0.05))) as bus:
            while not self._closing.wait(s.period_s):
                asked = time.monotonic()
                values = [decoded(bus, p, p.unit, p.word_order, 1) for p in s.registers]
                self._accept(np.array(values, dtype=np.float64), asked)

    def _hears(self, address: str) -> bool:
        """One sender is heard: the first."""
        self.sender = self.sender or address
        if address != self.sender:
            self._counts["of another sender"] += 1
        return address == self.sender

    def _take(self, line: bytes) -> None:
        s = self.settings
        now, text = time.monotonic(), line.decode("ascii", "replace")
        fields = [field.strip() for field in text.split(s.separator)]
        columns = s.columns or range(len(s.names))
        if len(fields) <= max(columns):
            return self._drop("too short")
        used = [fields[column] for column in columns]
        if not all(NUMBER.fullmatch(field) for field in used):
            return self._drop("not numbers")
        self._accept(np.array(used, dtype=np.float64), now)

    def _accept(self, values: Array, now: float) -> None:
        s = self.settings
        factors = s.factors or (1.0,) * len(s.names)
        values = values * factors
        if not np.isfinite(values).all():
            return self._drop("not numbers")
        if self._gate.jumps(values):
            return self._drop("an impossible jump")
        with self._lock:
            self._counts["accepted"] += 1
            self.store([Reading(now, values)])

    def _drop(self, reason: str) -> None:
        with self._lock:
            self._counts[reason] += 1
