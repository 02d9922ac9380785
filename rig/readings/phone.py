"""What comes over a socket, and who is heard on its port; a phone's as attitudes."""

from __future__ import annotations

import abc
import asyncio
import contextlib
import dataclasses
import http
import re
import socket
import time
from collections import deque
from typing import Any

import numpy as np

from rig.config.settings import ImuSettings
from rig.faults import Report, unheard
from rig.readings.geometry import Array, Reading
from rig.readings.source import BACKLOG, Source
from rig.readings.stream import MAX_BODY, LineSplitter, StreamParser

RECONNECT_S = 0.2
MOST_OPEN = 64  # connections at a time
PATIENCE_S = 5.0  # with a connection that says nothing
MAX_HEAD = 8192  # bytes of a message before its body
LOOK_S = 0.05  # between two looks at whether to end


@dataclasses.dataclass(eq=False)
class Connection:
    """One that is open."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    address: str
    since: float  # it was made, or is heard
    used: float = 0.0  # a reading of it was last of use
    splitter: LineSplitter = dataclasses.field(default_factory=LineSplitter)


class Stream(Source):
    """Lines of one sender, whoever else connects. One that lost its Wi-Fi comes back on
    another connection, which takes the place of the old once no reading of that was of
    use for ``stale_s``; until then it is refused."""

    allow: tuple[str, ...] = ()  # addresses that may send; none: the first
    refusal = b""  # what a sender that is not heard is told

    def __init__(self, settings: Any, report: Report = unheard) -> None:
        super().__init__(settings, report)
        self._current: Connection | None = None  # that lines are taken of

    def receive(self) -> None:
        if self._listener is not None:
            self._listener.setblocking(False)
        asyncio.run(self._run())

    # On the receiving thread

    @property
    def patience_s(self) -> float:
        """With a connection, for a line or a whole message."""
        return PATIENCE_S

    def begin(self) -> None:
        """Lines come over another connection from now on."""

    @abc.abstractmethod
    def take_lines(self, lines: list[bytes], now: float) -> bool:
        """Lines that came at a monotonic time; whether a reading of them was used."""

    def refuse(self, address: str, why: str) -> None:
        """Tell of a sender that is not heard, once for each address."""
        if address not in self.refused:
            self.refused.append(address)
            text = f"refused a sender on the port of {self.whose}, {address}: {why}"
            self.report("sender_refused", address=address, reason=text)

    def _admits(self, address: str) -> bool:
        if self.allow and address not in self.allow:
            allowed = f"{self.table}.allow ({', '.join(self.allow)})"
            self.refuse(address, f"it is not in {allowed}")
        elif self.sender and address != self.sender:
            self.refuse(address, f"{self.sender} is {self.whose} of this session")
        else:
            return True
        return False

    async def _run(self) -> None:
        ways = {"connect": self._connect, "tcp": self._connect, "udp": self._datagrams}
        way = ways.get(self.settings.transport, self._accept)
        receiving = asyncio.create_task(way(self._listener))  # which ends with this
        while not (self._closing.is_set() or receiving.done()):
            await asyncio.sleep(LOOK_S)
        if receiving.done():
            receiving.result()  # which raises what ended it

    async def _datagrams(self, listener: Any) -> None:
        """Lines of datagrams, each of them whole."""
        loop = asyncio.get_running_loop()
        self.begin()
        with listener:
            while True:
                data, (address, *_) = await loop.sock_recvfrom(listener, 65536)
                lines = [line for line in re.split(rb"[\r\n]+", data) if line]
                if self._admits(address) and lines:
                    if self.take_lines(lines, time.monotonic()):
                        self.sender = address

    async def _connect(self, _: Any) -> None:
        s = self.settings
        while True:
            await self._hear(s.host, host=s.host, port=s.port)
            await asyncio.sleep(RECONNECT_S)

    async def _accept(self, listener: Any) -> None:
        loop, tasks = asyncio.get_running_loop(), set[asyncio.Task[None]]()
        leaving: list[socket.socket] = []
        with listener:
            while True:
                try:
                    made, (address, _) = await loop.sock_accept(listener)
                except OSError:
                    await asyncio.sleep(LOOK_S)
                    continue
                if self._admits(address) and len(tasks) < MOST_OPEN:
                    task = loop.create_task(self._hear(address, sock=made))
                    tasks.add(task)
                    task.add_done_callback(tasks.discard)
                else:  # it is still sending: closed at once, it would not see why
                    with contextlib.suppress(OSError):
                        made.send(self.refusal)
                    leaving = [*(c for c in leaving if c.fileno() >= 0), made]
                    loop.call_later(LOOK_S * (len(leaving) < BACKLOG), made.close)

    async def _hear(self, address: str, **how: Any) -> None:
        """Take what one connection sends, until it ends or says nothing."""
        ended = (OSError, EOFError, ValueError, asyncio.LimitOverrunError)
        with contextlib.suppress(*ended):
            async with asyncio.timeout(PATIENCE_S):
                streams = await asyncio.open_connection(limit=MAX_HEAD, **how)
            connection = Connection(*streams, address, time.monotonic())
            stays = True
            try:
                while stays:  # not wait_for, which may lose the cancelling of a task
                    async with asyncio.timeout(self.patience_s):
                        stays = await self.hear(connection)
            finally:
                connection.writer.close()
                self._current = None if self._current is connection else self._current

    async def hear(self, connection: Connection) -> bool:
        """Take what has come in; whether the connection stays open."""
        data = await connection.reader.read(4096)
        now, current = time.monotonic(), self._current
        stale_s = self.settings.stale_s
        if data and current is not connection:
            if current and now - max(current.since, current.used) <= stale_s:
                if goes_on := current.used > connection.since + stale_s:
                    why = f"{current.address} is connected and sending"
                    self.refuse(connection.address, why)
                return not goes_on  # old once it may be heard, so it is lost
            if current:
                current.writer.close()
            self._current, connection.since = connection, now
            self.begin()
        if self.take_lines(connection.splitter.feed(data), now):
            connection.used, self.sender = now, connection.address
        return bool(data)


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
