"""The phone's stream over a socket, received in one thread into a bounded ring."""

from __future__ import annotations

import asyncio
import contextlib
import http
import itertools
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.config.settings import ImuSettings
from rig.core.attitude import Array, Reading
from rig.core.faults import Fault
from rig.core.stream import MAX_BODY, LineSplitter, Parser, StreamFault
from rig.journal import JournalError

RECONNECT_S = 0.2
MOST_OPEN = 4  # connections at a time over which messages are pushed
BACKLOG = 128  # connections that wait for an answer; past that a phone waits 1 s
MESSAGE_S = 5.0  # for a whole message
MAX_HEAD = 8192  # bytes before its body
LOOK_S = 0.05  # between two looks at who is silent and who waits


class Senders:
    """Who may be heard; ``refused`` is called once for each address that may not."""

    def __init__(
        self, allowed: tuple[str, ...], refused: Callable[[str, str], None]
    ) -> None:
        self.phone = ""  # address that is heard, once a reading of it was used
        self._allowed = allowed
        self.refused: list[str] = []  # addresses
        self._tell = refused

    def admits(self, address: str) -> bool:
        """It may be heard; otherwise it is refused."""
        if self._allowed and address not in self._allowed:
            known = ", ".join(self._allowed)
            self.refuse(address, f"imu.allow names {known}")
        elif self.phone and address != self.phone:
            self.refuse(address, f"{self.phone} is the phone of this session")
        else:
            return True
        return False

    def refuse(self, address: str, why: str) -> None:
        """Tell of a sender that is not heard, once."""
        if address not in self.refused:
            self.refused.append(address)
            self._tell(address, f"refused a sender on the IMU port, {address}: {why}")


class Connection:
    """One sender on a socket of its own."""

    def __init__(self, made: socket.socket, address: str) -> None:
        self.socket = made
        self.address = address
        self.splitter = LineSplitter()
        self.since = self.heard = time.monotonic()  # made; anything was received
        self.used = 0.0  # a reading of it was last used

    def begin(self) -> None:
        """Hear it from now on; what it sent while it waited is old, so it is lost."""
        now = time.monotonic()
        if now - self.since > 2 * LOOK_S:
            with contextlib.suppress(OSError):
                while self.socket.recv(4096, socket.MSG_DONTWAIT):
                    pass
        self.since = self.heard = now


class LineReceiver:
    """Lines of the phone, which connects to us or is connected to."""

    def __init__(
        self,
        settings: ImuSettings,
        senders: Senders,
        begin: Callable[[], None],
        take: Callable[[list[bytes], float], bool],
    ) -> None:
        """``begin`` is called at each connection, ``take`` with the lines of one and
        the time; it answers whether a reading was used."""
        self.port = settings.port
        self._settings = settings
        self._senders = senders
        self._begin = begin
        self._take = take
        self._closing = threading.Event()
        self._listener: socket.socket | None = None
        if settings.transport == "listen":
            where = (settings.host, settings.port)
            self._listener = socket.create_server(where, backlog=BACKLOG)
            self._listener.settimeout(0.0)
            self.port = self._listener.getsockname()[1]

    def stop(self) -> None:
        """End ``run``, from any thread."""
        self._closing.set()

    def run(self) -> None:
        """Receive until stopped."""
        if self._listener is not None:
            with contextlib.closing(self._listener):
                self._serve(self._listener)
        while not self._closing.is_set():
            with contextlib.suppress(OSError):  # none came in time, or it broke
                where = (self._settings.host, self.port)
                made = socket.create_connection(where, timeout=1.0)
                with contextlib.closing(made):
                    current = Connection(made, where[0])
                    self._begin()
                    while self._read(current, LOOK_S) and not self._silent(current):
                        pass
            self._closing.wait(RECONNECT_S)

    def _serve(self, listener: socket.socket) -> None:
        """Hear one connection; the next waits until that one ends or falls silent.

        A phone that lost its Wi-Fi leaves a half-open connection behind and comes back
        on a new one. A second one while the first still sends is another sender.
        """
        current: Connection | None = None
        waiting: Connection | None = None
        while not self._closing.is_set():
            sockets = [listener] + ([current.socket] if current else [])
            ready, _, _ = select.select(sockets, [], [], LOOK_S)
            if listener in ready and (come := self._accept(listener)):
                if waiting:
                    waiting.socket.close()
                waiting = come
            if current and (
                (current.socket in ready and not self._read(current, 0.0))
                or self._silent(current)
                or (waiting and self._quiet(current))
            ):
                current.socket.close()
                current = None
            if waiting and current is None:
                current, waiting = waiting, None
                current.begin()
                self._begin()
            elif waiting and current and self._goes_on(current, waiting):
                why = f"{current.address} is connected already, and sends"
                self._senders.refuse(waiting.address, why)
                waiting.socket.close()
                waiting = None
        for connection in (current, waiting):
            if connection:
                connection.socket.close()

    def _accept(self, listener: socket.socket) -> Connection | None:
        try:
            made, (address, _) = listener.accept()
        except OSError:
            return None
        if self._senders.admits(address):
            return Connection(made, address)
        made.close()
        return None

    def _silent(self, connection: Connection) -> bool:
        """So long that it is given up."""
        patience = max(1.0, 2 * self._settings.stale_s)
        return time.monotonic() - connection.heard > patience

    def _quiet(self, connection: Connection) -> bool:
        """So long without a usable reading that a connection which waits is next."""
        if not connection.used:
            return time.monotonic() - connection.since > 1.0
        return time.monotonic() - connection.used > self._settings.stale_s

    def _goes_on(self, current: Connection, waiting: Connection) -> bool:
        """The current one has gone on sending since the other came."""
        same = current.address == waiting.address
        return current.used > waiting.since + same * self._settings.stale_s

    def _read(self, connection: Connection, patience_s: float) -> bool:
        """Take what has come in; False at the end of the connection, or of all."""
        connection.socket.settimeout(patience_s)
        try:
            data = connection.socket.recv(4096)
        except (TimeoutError, BlockingIOError):
            return not self._closing.is_set()
        except OSError:
            return False
        connection.heard = time.monotonic()
        if self._take(connection.splitter.feed(data), connection.heard):
            connection.used = connection.heard
            self._senders.phone = connection.address
        return bool(data) and not self._closing.is_set()


class WebReceiver:
    """Messages that a phone pushes over HTTP, on one thread.

    Who may not be heard is refused before a byte of it is read. At most MOST_OPEN
    connections are open, each for MESSAGE_S without a whole message.
    """

    def __init__(
        self,
        settings: ImuSettings,
        senders: Senders,
        take: Callable[[bytes, str], bool],
    ) -> None:
        """``take`` gets a message and its sender's address; it answers whether that is
        heard."""
        self._senders = senders
        self._take = take
        self._closing = threading.Event()
        self._listener = socket.create_server(
            (settings.host, settings.port), backlog=BACKLOG
        )
        self._listener.setblocking(False)
        self.port = self._listener.getsockname()[1]

    def stop(self) -> None:
        """End ``run``, from any thread."""
        self._closing.set()

    def run(self) -> None:
        """Receive until stopped."""
        with contextlib.closing(self._listener):
            asyncio.run(self._serve())

    async def _serve(self) -> None:
        loop, tasks = asyncio.get_running_loop(), set[asyncio.Task[None]]()
        accept: asyncio.Task[Any] | None = None
        while not self._closing.is_set():
            accept = accept or loop.create_task(loop.sock_accept(self._listener))
            if not (await asyncio.wait([accept], timeout=LOOK_S))[0]:
                continue
            with contextlib.suppress(OSError):
                made, (address, _) = accept.result()
                if self._senders.admits(address) and len(tasks) < MOST_OPEN:
                    task = loop.create_task(self._hear(made, address))
                    tasks.add(task)
                    task.add_done_callback(tasks.discard)
                else:
                    with contextlib.closing(made):
                        made.send(_answer(403, False))
            accept = None
        for each in (*tasks, *([accept] if accept else [])):
            each.cancel()

    async def _hear(self, made: socket.socket, address: str) -> None:
        reader, writer = await asyncio.open_connection(sock=made, limit=MAX_HEAD)
        with contextlib.suppress(OSError, EOFError, ValueError):
            try:
                while await asyncio.wait_for(
                    self._message(reader, writer, address), MESSAGE_S
                ):
                    pass
            except (TimeoutError, asyncio.LimitOverrunError):
                pass
            finally:
                writer.close()

    async def _message(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, address: str
    ) -> bool:
        """Answer one message; whether the connection stays open."""
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        first, *lines = head.lower().split("\r\n")
        parts = (line.partition(":") for line in lines)
        fields = {name.strip(): value.strip() for name, _, value in parts}
        length = fields.get("content-length", "")
        known, code = False, 413
        if first.startswith("post ") and length.isdecimal() and int(length) <= MAX_BODY:
            if fields.get("expect") == "100-continue":
                writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
            known = self._take(await reader.readexactly(int(length)), address)
            code = 200 if known else 403
        stays = known and fields.get("connection") != "close"
        writer.write(_answer(code, stays))
        await writer.drain()
        return stays


def _answer(code: int, stays: bool) -> bytes:
    closes = "" if stays else "Connection: close\r\n"
    phrase = http.HTTPStatus(code).phrase
    return f"HTTP/1.1 {code} {phrase}\r\nContent-Length: 0\r\n{closes}\r\n".encode()


RING = 8192  # readings kept: over half a minute at 200 Hz


class ImuError(Fault):
    """The phone's stream is stale, closed, or not to be trusted."""


class Imu:
    """The attitude of the phone, now and over the last seconds.

    Args:
        settings: of the phone.
        report: called with the event ``sender_refused``, its ``address`` and
            ``reason``, once for each address, on the receiving thread.
    """

    def __init__(
        self, settings: ImuSettings, report: Callable[..., Any] | None = None
    ) -> None:
        self.settings = settings
        self.port = settings.port
        self._report = report
        self._senders = Senders(settings.allow, self._refused)
        self.connections = 0
        self._parser = Parser(settings)
        self._ring: deque[Reading] = deque(maxlen=RING)
        self.world = np.eye(3)  # (3, 3) by which readings are turned
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._receiver: LineReceiver | WebReceiver | None = None
        self._arrived = 0.0
        self._fault = ""

    def open(self) -> Imu:
        """Listen, or begin to connect; ImuError where the port cannot be opened."""
        s = self.settings
        try:
            if s.format == "sensorlogger":
                self._receiver = WebReceiver(s, self._senders, self._take_body)
            else:
                self._receiver = LineReceiver(
                    s, self._senders, self._begin, self._take_lines
                )
        except OSError as error:
            raise ImuError(
                f"cannot open the IMU port {s.host}:{s.port}: {error.strerror or error}"
            ) from None
        self.port = self._receiver.port
        self._thread = threading.Thread(
            target=self._receiver.run, name="imu", daemon=True
        )
        self._thread.start()
        return self

    def close(self) -> None:
        """Close every socket and end the thread."""
        self._closing.set()
        if self._receiver is not None:
            self._receiver.stop()
        if self._thread is not None:
            self._thread.join(2.0)

    @property
    def sender(self) -> str:
        """Address of the phone that is heard; empty while there is none."""
        return self._senders.phone

    def __enter__(self) -> Imu:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> Reading:
        """The newest reading; ImuError where none is fresh."""
        self.check_fault()
        with self._lock:
            reading = self._ring[-1] if self._ring else None
        if reading is None:
            raise ImuError("the phone has sent no reading yet")
        now, limit = time.monotonic(), self.settings.stale_s
        if now - reading.time > limit:
            hint = "Check its Wi-Fi, and that its app is in front"
            if now - self._arrived < limit:
                hint = "It arrives late, or its stamps are not those configured"
            raise ImuError(
                f"the phone's last reading is {now - reading.time:.2f} s old (limit "
                f"imu.stale_s = {limit:g} s). {hint}"
            )
        return reading

    def since(self, start: float) -> list[Reading]:
        """Readings measured at or after a monotonic time, oldest first."""
        with self._lock:
            newest = reversed(self._ring)
            recent = itertools.takewhile(lambda r: r.time >= start, newest)
            return [*recent][::-1]

    def turn(self, world: Array) -> None:
        """Turn all readings by (3, 3), those that were received too."""
        with self._lock:
            self.world = world @ self.world
            turned = [Reading(r.time, world @ r.matrix) for r in self._ring]
            self._ring = deque(turned, maxlen=RING)

    @property
    def counts(self) -> dict[str, int]:
        """Records that were accepted, and those dropped by reason."""
        with self._lock:
            return dict(self._parser.counts)

    def check_fault(self) -> None:
        """Raise ImuError where the stream was found not to be trusted."""
        if self._fault:
            raise ImuError(self._fault)

    def wait_for_stream(self, timeout_s: float) -> Reading:
        """The first fresh reading; ImuError where none came in time."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                return self.latest()
            except ImuError:
                self.check_fault()
                if time.monotonic() > end:
                    counts = self._parser.counts
                    dropped = {k: v for k, v in counts.items() if k != "accepted"}
                    detail = f"; records dropped: {dropped}" if dropped else ""
                    if refused := ", ".join(self._senders.refused):
                        detail += f"; refused by imu.allow: {refused}"
                    raise ImuError(
                        f"no usable reading from the phone in {timeout_s:g} s on "
                        f"{self.settings.host}:{self.port} ({self.connections} "
                        f"connections{detail}). Start its app, and check the address, "
                        "port and [imu] format"
                    ) from None
            time.sleep(0.01)

    # On the receiving thread

    def _refused(self, address: str, reason: str) -> None:
        if self._report is None:
            return
        try:
            self._report("sender_refused", address=address, reason=reason)
        except JournalError as fault:  # the journal cannot be written
            self._fault = str(fault)

    def _begin(self) -> None:
        self.connections += 1
        with self._lock:
            self._parser.reconnected()

    def _take_lines(self, lines: list[bytes], now: float) -> bool:
        with self._lock:
            try:
                readings = [] if self._fault else self._parser.lines(lines, now)
            except StreamFault as fault:
                self._fault = str(fault)
                return False
            self._store(readings)
        return bool(readings)

    def _take_body(self, body: bytes, address: str) -> bool:
        # A phone that keeps its connection must learn that nobody listens any more.
        if self._closing.is_set() or not self._senders.admits(address):
            return False
        with self._lock:
            readings = self._parser.body(body, time.monotonic())
            self.connections = max(1, self._parser.sessions)
            self._store(readings)
            foreign = self._parser.foreign
        if foreign:
            self._senders.refuse(address, "another device than before sends from there")
        elif readings:
            self._senders.phone = address
        return not foreign

    def _store(self, readings: list[Reading]) -> None:
        if readings:
            self._arrived = time.monotonic()
        for reading in [Reading(r.time, self.world @ r.matrix) for r in readings]:
            if not self._ring or reading.time >= self._ring[-1].time:
                self._ring.append(reading)
            elif self._ring[-1].time - reading.time < 1e-3:
                self._ring.append(Reading(self._ring[-1].time, reading.matrix))
