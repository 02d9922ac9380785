"""A sensor: lines of numbers over TCP or UDP, at a steady rate."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable

from rig.config.settings import ReadingsSettings
from rig.readings.attitude import Array
from rig.simulator.faults import FaultInjector


class Sensor:
    """Sends ``numbers()`` at ``rate_hz`` until closed; connects again by itself."""

    def __init__(
        self,
        settings: ReadingsSettings,
        numbers: Callable[[], Array],
        faults: FaultInjector,
        rate_hz: float = 100.0,
    ) -> None:
        self.settings = settings
        self._numbers = numbers
        self._take = faults.take
        self._period = 1.0 / rate_hz
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._port = settings.port
        self._listener: socket.socket | None = None
        self._frozen = b""

    def start(self, port: int) -> int:
        """Send to the port the rig listens on, or listen there; returns the port."""
        self._port = port
        if not self._thread.is_alive():
            if self.settings.transport == "tcp":
                self._listener = socket.create_server(("127.0.0.1", port), backlog=4)
                self._listener.settimeout(0.1)
                self._port = int(self._listener.getsockname()[1])
            self._thread.start()
        return self._port

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        if self._listener:
            self._listener.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            with contextlib.suppress(OSError):
                if self._listener is not None:
                    connection = self._listener.accept()[0]
                elif self.settings.transport == "udp":
                    connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                    connection.connect(("127.0.0.1", self._port))
                else:
                    address = ("127.0.0.1", self._port)
                    connection = socket.create_connection(address, timeout=1.0)
                with connection:
                    self._send(connection)
            self._closing.wait(0.05)

    def _send(self, connection: socket.socket) -> None:
        due = time.monotonic()
        while not self._closing.is_set() and not self._take("imu_disconnect"):
            if not self._take("imu_gap"):
                connection.sendall(self._line())
            due += self._period
            self._closing.wait(max(0.0, due - time.monotonic()))

    def _line(self) -> bytes:
        if not self._frozen or not self._take("imu_frozen"):
            s = self.settings
            factors = s.factors or (1.0,) * len(s.names)
            columns = s.columns or tuple(range(len(s.names)))
            fields = ["0"] * (1 + max(columns))
            for column, value, factor in zip(
                columns, self._numbers(), factors, strict=True
            ):
                fields[column] = f"{value / factor:.9g}"
            self._frozen = (s.separator.join(fields) + "\r\n").encode()
        if self._take("imu_garbage"):
            return b"?\0" + self._frozen
        return self._frozen
