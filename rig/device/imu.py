"""The phone's stream over a socket, received in one thread into a bounded ring."""

from __future__ import annotations

import contextlib
import http.server
import itertools
import socket
import threading
import time
from collections import deque
from collections.abc import Callable

from rig.config.settings import ImuSettings
from rig.device.stream import MAX_BODY, LineSplitter, Parser, Reading, StreamFault
from rig.faults import Fault

RING = 8192  # readings kept: over half a minute at 200 Hz
RECONNECT_S = 0.2


class ImuError(Fault):
    """The phone's stream is stale, closed, or not to be trusted."""


class Imu:
    """The attitude of the phone, now and over the last seconds."""

    def __init__(self, settings: ImuSettings) -> None:
        self.settings = settings
        self.port = settings.port
        self.connections = 0
        self.sender = ""  # address of the phone, once it sent
        self._parser = Parser(settings)
        self._ring: deque[Reading] = deque(maxlen=RING)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._listener: socket.socket | None = None
        self._web: http.server.HTTPServer | None = None
        self._arrived = 0.0
        self._fault = ""

    def open(self) -> Imu:
        """Listen, or begin to connect; ImuError where the port cannot be opened."""
        s, receive = self.settings, self._receive_lines
        try:
            if s.format == "sensorlogger":
                self._web = _make_web(self._take_body, s.host, s.port)
                self.port = self._web.server_address[1]
                receive = self._web.serve_forever
            elif s.transport == "listen":
                self._listener = socket.create_server((s.host, s.port), backlog=2)
                self._listener.settimeout(0.1)
                self.port = self._listener.getsockname()[1]
        except OSError as error:
            raise ImuError(
                f"cannot open the IMU port {s.host}:{s.port}: {error.strerror or error}"
            ) from None
        self._thread = threading.Thread(target=receive, name="imu", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        """Close every socket and end the thread."""
        self._closing.set()
        if self._web is not None:
            self._web.shutdown()
            self._web.server_close()
        if self._thread is not None:
            self._thread.join(2.0)
        if self._listener is not None:
            self._listener.close()

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
                    raise ImuError(
                        f"no usable reading from the phone in {timeout_s:g} s on "
                        f"{self.settings.host}:{self.port} ({self.connections} "
                        f"connections{detail}). Start its app, and check the address, "
                        "port and [imu] format"
                    ) from None
            time.sleep(0.01)

    def _take_body(self, body: bytes, sender: str) -> None:
        with self._lock:
            self.connections, self.sender = 1, sender
            self._store(self._parser.body(body, time.monotonic()))

    def _store(self, readings: list[Reading]) -> None:
        if readings:
            self._arrived = time.monotonic()
        for reading in readings:
            if not self._ring or reading.time >= self._ring[-1].time:
                self._ring.append(reading)
            elif self._ring[-1].time - reading.time < 1e-3:
                self._ring.append(Reading(self._ring[-1].time, reading.matrix))

    def _receive_lines(self) -> None:
        """Connection after connection, until closed or at a fault of the stream."""
        s = self.settings
        while not self._closing.is_set() and not self._fault:
            with contextlib.suppress(OSError):  # none came in time, or it broke
                if self._listener is not None:
                    connection, _ = self._listener.accept()
                else:
                    connection = socket.create_connection((s.host, s.port), timeout=1.0)
                with contextlib.closing(connection):
                    self._receive(connection)
            if self._listener is None:
                self._closing.wait(RECONNECT_S)

    def _receive(self, connection: socket.socket) -> None:
        """Read one connection until it ends, is silent too long, or faults.

        A phone that lost its Wi-Fi leaves a half-open connection behind and comes back
        on a new one, so a silent connection is given up for the next.
        """
        self.connections += 1
        self.sender = connection.getpeername()[0]
        splitter = LineSplitter()
        connection.settimeout(0.1)
        heard = time.monotonic()
        patience = max(1.0, 2 * self.settings.stale_s)
        with self._lock:
            self._parser.reconnected()
        while not self._closing.is_set():
            try:
                data = connection.recv(4096)
            except TimeoutError:
                if time.monotonic() - heard > patience:
                    return
                continue
            if not data:
                return
            heard = time.monotonic()
            with self._lock:
                try:
                    self._store(self._parser.lines(splitter.feed(data), heard))
                except StreamFault as fault:
                    self._fault = str(fault)
                    return


def _make_web(
    take: Callable[[bytes, str], None], host: str, port: int
) -> http.server.HTTPServer:
    class Handler(http.server.BaseHTTPRequestHandler):
        timeout = 5.0
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdecimal() or int(length) > MAX_BODY:
                self.send_error(413)
                self.close_connection = True
                return
            take(self.rfile.read(int(length)), self.client_address[0])
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Keep the terminal for the session."""

    return http.server.ThreadingHTTPServer((host, port), Handler)
