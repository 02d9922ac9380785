"""A peer that keeps every byte it is sent, to compare with frames in manuals."""

import socket
import threading

from harness import changed, fast_config

from rig.config.maps import load_map
from rig.config.settings import BusSettings


class Recorder:
    """A TCP peer that keeps what it is sent and answers from a script."""

    def __init__(self, answer):
        self.received = b""
        self._answer = answer
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._connections = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._connections.append(connection)
            threading.Thread(
                target=self._serve, args=(connection,), daemon=True
            ).start()

    def _serve(self, connection):
        try:
            while data := connection.recv(4096):
                self.received += data
                reply = self._answer(data)
                if reply:
                    connection.sendall(reply)
        except OSError:
            return

    def close(self):
        self._listener.close()
        for connection in self._connections:
            connection.close()


def rtu_over_tcp(port, retries=2, timeout_s=0.1):
    return BusSettings(
        transport="rtu_tcp", host="127.0.0.1", port=port, timeout_s=timeout_s,
        read_retries=retries,
    )  # fmt: skip


def axis_with(name, unit=7, **changes):
    axis = fast_config().axes[0]
    return changed(axis, map=load_map(name), unit=unit, **changes)
