"""The phone's stream as attitudes."""

from __future__ import annotations

import http
import time
from collections import deque

import numpy as np

from rig.config.settings import ImuSettings
from rig.faults import Report, unheard
from rig.readings.geometry import Array, Reading
from rig.readings.network import Connection, Stream
from rig.readings.stream import MAX_BODY, StreamParser


class Imu(Stream):
    """The attitude of the phone, (3, 3) to its world: of one, whoever else connects.
    Messages are pushed over any connection of one address, lines over one."""

    whose, table = "the phone", "imu"
    start, lost = "start its app", "Check its Wi-Fi, and that its app is in front"

    def __init__(self, settings: ImuSettings, report: Report = unheard) -> None:
        super().__init__(settings, report)
        self.settings: ImuSettings = settings
        self.allow, self.refusal = settings.allow, _answer(403, False)
        self.world = np.eye(3)
        self.parser = StreamParser(settings)
        self._counts = self.parser.counts

    def turn(self, world: Array) -> None:
        """Turn all readings by (3, 3), those that were received too."""
        with self._lock:
            self.world = world @ self.world
            turned = [Reading(r.time, world @ r.value) for r in self._ring]
            self._ring = deque(turned, maxlen=self._ring.maxlen)

    # On the receiving thread

    def begin(self) -> None:
        self.connections += 1
        with self._lock:
            self.parser.reconnected()

    def take_lines(self, lines: list[bytes], now: float) -> bool:
        with self._lock:
            return self._store(self.parser.lines(lines, now))

    def take_body(self, body: bytes) -> tuple[bool, bool]:
        """A message; whether it was used, and whether it is another device's."""
        with self._lock:
            used = self._store(self.parser.body(body, time.monotonic()))
            self.connections = max(1, self.parser.sessions)
            return used, self.parser.foreign

    def _store(self, readings: list[Reading]) -> bool:
        turned = [Reading(r.time, self.world @ r.value) for r in readings]
        return self.store(turned)

    async def hear(self, connection: Connection) -> bool:
        if self.settings.format != "sensorlogger":
            return await super().hear(connection)
        return await self._message(connection)

    async def _message(self, connection: Connection) -> bool:
        """Answer one message; whether the connection stays open."""
        head = (await connection.reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        first, *lines = head.lower().split("\r\n")
        parts = (line.partition(":") for line in lines)
        fields = {name.strip(): value.strip() for name, _, value in parts}
        length = fields.get("content-length", "")
        admitted, code = False, 413
        if first.startswith("post ") and length.isdecimal() and int(length) <= MAX_BODY:
            if fields.get("expect") == "100-continue":
                connection.writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
            body = await connection.reader.readexactly(int(length))
            if admitted := self._admits(connection.address):
                used, foreign = self.take_body(body)
                if foreign:
                    why = "another device sends from there now"
                    self.refuse(connection.address, why)
                admitted = not foreign
                if used:
                    self.sender = connection.address
            code = 200 if admitted else 403
        stays = admitted and fields.get("connection") != "close"
        connection.writer.write(_answer(code, stays))
        await connection.writer.drain()
        return stays


def _answer(code: int, stays: bool) -> bytes:
    closes = "" if stays else "Connection: close\r\n"
    phrase = http.HTTPStatus(code).phrase
    return f"HTTP/1.1 {code} {phrase}\r\nContent-Length: 0\r\n{closes}\r\n".encode()
