"""Numbers of a sensor: lines over TCP, UDP or a serial port, or Modbus registers.

A dial gauge, a digital level, an encoder, a load cell. A reading is accepted only if
its record is whole: as many columns as named, plain decimal numbers, no impossible
jump. Everything else is counted and dropped.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from typing import Any

import numpy as np

from rig.config.settings import BusSettings, ReadingsSettings
from rig.drives.bus import Bus
from rig.drives.modbus import decoded
from rig.faults import Report, unheard
from rig.readings.geometry import Array, Reading
from rig.readings.phone import PATIENCE_S, RECONNECT_S, Connection, Stream
from rig.readings.source import JumpGate, ReadingError
from rig.readings.stream import LineSplitter

NUMBER = re.compile(r"[+-]?[0-9]{1,15}(?:\.[0-9]{0,17})?(?:[eE][+-]?[0-9]{1,2})?")
LOOK_S = 0.1  # for a reply to a request, or between two looks at whether to end


class Sensor(Stream):
    """Numbers as they come in, on one thread."""

    def __init__(self, settings: ReadingsSettings, report: Report = unheard) -> None:
        super().__init__(settings, report)
        self.settings: ReadingsSettings = settings
        self.connections = 1  # numbers are the same whoever connects again
        self._gate = JumpGate(lambda a, b: np.abs(b - a).max(), settings.most_jump)
        request = settings.request.encode()  # as it is sent
        self._request = request.decode("unicode_escape").encode()

    @property
    def where(self) -> str:
        return self.settings.device or super().where

    # On the thread

    @property
    def patience_s(self) -> float:
        return max(PATIENCE_S, 2.0 * self.stale_s)  # a slow sensor says little

    def receive(self) -> None:
        ways = {"serial": self._serial, "modbus": self._registers}
        if (way := ways.get(self.settings.transport)) is None:
            return super().receive()
        while not self._closing.is_set():
            with contextlib.suppress(OSError, ReadingError):
                way()
            self._closing.wait(RECONNECT_S)

    async def hear(self, connection: Connection) -> bool:
        if not self._request:
            return await super().hear(connection)
        connection.splitter.torn = False
        connection.writer.write(self._request)
        with contextlib.suppress(TimeoutError):  # it is asked again
            async with asyncio.timeout(LOOK_S):
                return await super().hear(connection)
        return True

    def _serial(self) -> None:
        """Lines of a serial port, until it is gone."""
        import serial  # type: ignore[import-untyped]  # no stubs

        s, splitter = self.settings, LineSplitter(torn=not self._request)
        with serial.Serial(
            s.device, s.baudrate, s.bytesize, s.parity, s.stopbits, timeout=LOOK_S
        ) as port:
            while not self._closing.is_set():
                port.write(self._request)
                data = port.read(max(1, port.in_waiting))
                self.take_lines(splitter.feed(data), time.monotonic())

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
                self._keep(np.array(values, dtype=np.float64), asked)

    def take_lines(self, lines: list[bytes], now: float) -> bool:
        return any([self._take(line, now) for line in lines])

    def _take(self, line: bytes, now: float) -> bool:
        s, text = self.settings, line.decode("ascii", "replace")
        fields = [field.strip() for field in text.split(s.separator)]
        columns = s.columns or range(len(s.names))
        if len(fields) <= max(columns):
            return self._drop("too short")
        used = [fields[column] for column in columns]
        if not all(NUMBER.fullmatch(field) for field in used):
            return self._drop("not numbers")
        return self._keep(np.array(used, dtype=np.float64), now)

    def _keep(self, values: Array, now: float) -> bool:
        s = self.settings
        factors = s.factors or (1.0,) * len(s.names)
        values = values * factors
        if not np.isfinite(values).all():
            return self._drop("not numbers")
        if self._gate.jumps(values):
            return self._drop("an impossible jump")
        with self._lock:
            self._counts["accepted"] += 1
            return self.store([Reading(now, values)])

    def _drop(self, reason: str) -> bool:
        with self._lock:
            self._counts[reason] += 1
        return False
