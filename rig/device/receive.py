"""The phone's connections: who is heard, and when one takes the place of another.

One phone is heard in a session: of the addresses allowed, the first that sends a usable
reading. Whoever else connects is refused and reported.
"""

from __future__ import annotations

import contextlib
import http.server
import select
import socket
import threading
import time
from collections.abc import Callable

from rig.config.settings import ImuSettings
from rig.device.stream import MAX_BODY, LineSplitter

RECONNECT_S = 0.2
LOOK_S = 0.05  # between two looks at who is silent and who waits


class Senders:
    """Who may be heard. ``refused`` is told once of each address that may not."""

    def __init__(
        self, allowed: tuple[str, ...], refused: Callable[[str, str], None]
    ) -> None:
        self.phone = ""  # address that is heard, once a reading of it was used
        self._allowed = allowed
        self._told: set[str] = set()
        self._refused = refused

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
        if address not in self._told:
            self._told.add(address)
            self._refused(
                address, f"refused a sender on the IMU port, {address}: {why}"
            )


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
            self._listener = socket.create_server(where, backlog=2)
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


def make_web(
    settings: ImuSettings, take: Callable[[bytes, str], bool]
) -> http.server.HTTPServer:
    """A server of pushed messages; ``take`` gets one with its sender's address, and
    answers whether that is heard."""

    class Handler(http.server.BaseHTTPRequestHandler):
        timeout = 5.0
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdecimal() or int(length) > MAX_BODY:
                self.send_error(413)
                self.close_connection = True
                return
            known = take(self.rfile.read(int(length)), self.client_address[0])
            self.send_response(200 if known else 403)
            self.close_connection = not known
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Keep the terminal for the session."""

    return http.server.ThreadingHTTPServer((settings.host, settings.port), Handler)
