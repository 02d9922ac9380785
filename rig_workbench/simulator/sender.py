"""What sends readings to a rig, on a thread of its own: a phone, a sensor."""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
from typing import Any

from rig_workbench.simulator.faults import FaultInjector

AGAIN_S = 0.05  # before it connects again


class Sender:
    """Sends at ``rate_hz`` until closed; connects again by itself."""

    listens = ""  # transport in which it is the one that listens

    def __init__(self, settings: Any, faults: FaultInjector, rate_hz: float) -> None:
        self.settings = settings
        self._take = faults.take
        self._period = 1.0 / rate_hz
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._port = settings.port
        self._listener: socket.socket | None = None

    def start(self, port: int) -> int:
        """Send to the port the rig listens on, or listen there; returns the port."""
        self._port = port
        if not self._thread.is_alive():
            if self.settings.transport == self.listens:
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

    def connected(self) -> socket.socket:
        """A connection to the rig, whoever of the two listens."""
        if self.settings.transport == "udp":
            made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            made.connect(("127.0.0.1", self._port))
            return made
        if self._listener is not None:
            return self._listener.accept()[0]
        return socket.create_connection(("127.0.0.1", self._port), timeout=1.0)

    def _run(self) -> None:
        while not self._closing.is_set():
            with contextlib.suppress(OSError, http.client.HTTPException):
                self.send()
            self._closing.wait(AGAIN_S)

    def send(self) -> None:
        """Connect, and send until the connection ends."""
        raise NotImplementedError("a kind of sender defines this itself")  # abstract
