"""The phone's stream over a socket, received in one thread into a bounded ring."""

from __future__ import annotations

import contextlib
import http.server
import socket
import threading
import time
from collections import Counter, deque

from rig.config.settings import ImuSettings
from rig.device.stream import MAX_BODY, LineSplitter, Parser, Reading, StreamFault

RING = 8192  # readings kept: over half a minute at 200 Hz
RECONNECT_S = 0.2


class ImuError(RuntimeError):
    """The phone's stream is stale, closed, or not to be trusted."""


class Imu:
    """The attitude of the phone, now and over the last seconds."""

    def __init__(self, settings: ImuSettings) -> None:
        self.settings = settings
        self.port = settings.port
        self.connections = 0
        self._parser = Parser(settings)
        self._ring: deque[Reading] = deque(maxlen=RING)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self._listener: socket.socket | None = None
        self._web: http.server.HTTPServer | None = None
        self._arrived = 0.0
        self._fault = ""

    def open(self) -> Imu:
        """Listen, or begin to connect.

        Raises:
            ImuError: the port cannot be opened.
        """
        s = self.settings
        try:
            if s.format == "sensorlogger":
                self._web = _make_web(self, s.host, s.port)
                self.port = self._web.server_address[1]
                self._start(self._web.serve_forever)
            elif s.transport == "listen":
                self._listener = socket.create_server((s.host, s.port), backlog=2)
                self._listener.settimeout(0.1)
                self.port = self._listener.getsockname()[1]
                self._start(self._listen)
            else:
                self._start(self._connect)
        except OSError as error:
            raise ImuError(
                f"cannot open the IMU port {s.host}:{s.port}: {error.strerror or error}"
            ) from None
        return self

    def close(self) -> None:
        """Close every socket and end the thread."""
        self._closing.set()
        if self._web is not None:
            self._web.shutdown()
            self._web.server_close()
        for thread in self._threads:
            thread.join(2.0)
        if self._listener is not None:
            self._listener.close()

    def __enter__(self) -> Imu:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def counts(self) -> Counter[str]:
        """Records by what became of them."""
        return self._parser.counts

    def latest(self) -> Reading:
        """The newest reading.

        Raises:
            ImuError: none is fresh.
        """
        self.check_fault()
        with self._lock:
            reading = self._ring[-1] if self._ring else None
        if reading is None:
            raise ImuError("the phone has sent no reading yet")
        age = time.monotonic() - reading.time
        if age > self.settings.stale_s:
            hint = "Check its Wi-Fi, and that its app is in front"
            if time.monotonic() - self._arrived < self.settings.stale_s:
                hint = "It arrives late, or its stamps are not those configured"
            raise ImuError(
                f"the phone's last reading is {age:.2f} s old (limit imu.stale_s = "
                f"{self.settings.stale_s:g} s). {hint}"
            )
        return reading

    def since(self, start: float) -> list[Reading]:
        """Readings measured at or after a monotonic time, oldest first."""
        with self._lock:
            found = []
            for reading in reversed(self._ring):
                if reading.time < start:
                    break
                found.append(reading)
        return found[::-1]

    def check_fault(self) -> None:
        """Raise ImuError where the stream was found not to be trusted."""
        if self._fault:
            raise ImuError(self._fault)

    def wait_for_stream(self, timeout_s: float) -> Reading:
        """The first fresh reading.

        Raises:
            ImuError: none came in time.
        """
        end = time.monotonic() + timeout_s
        while True:
            try:
                return self.latest()
            except ImuError:
                self.check_fault()
                if time.monotonic() > end:
                    dropped = {k: v for k, v in self.counts.items() if k != "accepted"}
                    detail = f"; records dropped: {dropped}" if dropped else ""
                    raise ImuError(
                        f"no usable reading from the phone in {timeout_s:g} s on "
                        f"{self.settings.host}:{self.port} ({self.connections} "
                        f"connections{detail}). Start its app, and check the address, "
                        "port and [imu] format"
                    ) from None
            time.sleep(0.01)

    def feed_body(self, body: bytes) -> None:
        """Take one pushed message."""
        with self._lock:
            self._store(self._parser.body(body, time.monotonic()))

    def _start(self, target: object) -> None:
        thread = threading.Thread(target=target, name="imu", daemon=True)  # type: ignore[arg-type] # bound methods without arguments
        self._threads.append(thread)
        thread.start()

    def _store(self, readings: list[Reading]) -> None:
        if readings:
            self._arrived = time.monotonic()
        for reading in readings:
            if not self._ring or reading.time >= self._ring[-1].time:
                self._ring.append(reading)
            elif self._ring[-1].time - reading.time < 1e-3:
                self._ring.append(Reading(self._ring[-1].time, reading.matrix))

    def _listen(self) -> None:
        assert self._listener is not None
        while not self._closing.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            self._receive(connection)

    def _connect(self) -> None:
        s = self.settings
        while not self._closing.is_set():
            try:
                connection = socket.create_connection((s.host, s.port), timeout=1.0)
            except OSError:
                self._closing.wait(RECONNECT_S)
                continue
            self._receive(connection)
            self._closing.wait(RECONNECT_S)

    def _receive(self, connection: socket.socket) -> None:
        """Read one connection until it ends, is silent too long, or faults.

        A phone that lost its Wi-Fi leaves a half-open connection behind and comes back
        on a new one, so a silent connection is given up for the next.
        """
        self.connections += 1
        splitter = LineSplitter()
        connection.settimeout(0.1)
        heard = time.monotonic()
        patience = max(1.0, 2 * self.settings.stale_s)
        with self._lock:
            self._parser.reconnected()
        with contextlib.closing(connection):
            while not self._closing.is_set():
                try:
                    data = connection.recv(4096)
                except TimeoutError:
                    if time.monotonic() - heard > patience:
                        return
                    continue
                except OSError:
                    return
                if not data:
                    return
                heard = time.monotonic()
                lines = splitter.feed(data)
                with self._lock:
                    try:
                        self._store(self._parser.lines(lines, heard))
                    except StreamFault as fault:
                        self._fault = str(fault)
                        return


def _make_web(imu: Imu, host: str, port: int) -> http.server.HTTPServer:
    class Handler(http.server.BaseHTTPRequestHandler):
        timeout = 5.0
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdecimal() or int(length) > MAX_BODY:
                self.send_error(413)
                self.close_connection = True
                return
            imu.feed_body(self.rfile.read(int(length)))
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Keep the terminal for the session."""

    class Server(http.server.ThreadingHTTPServer):
        daemon_threads = True
        request_queue_size = 4

    server = Server((host, port), Handler)
    imu.connections += 1
    return server
