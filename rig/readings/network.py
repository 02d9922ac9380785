"""Lines that come over a socket, and who is heard on its port."""

from __future__ import annotations

import abc
import asyncio
import contextlib
import dataclasses
import re
import socket
import time
from typing import Any

from rig.faults import Report, unheard
from rig.readings.source import BACKLOG, Source
from rig.readings.stream import LineSplitter

RECONNECT_S = 0.2
MOST_OPEN = 64  # connections at a time
PATIENCE_S = 5.0  # of a connection for a line, or a whole message
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
                    async with asyncio.timeout(PATIENCE_S):
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
