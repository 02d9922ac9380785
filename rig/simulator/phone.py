"""The phone: its attitude in the published formats, at a steady rate."""

from __future__ import annotations

import contextlib
import http.client
import json
import random
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config.settings import ImuSettings
from rig.core.attitude import Array, euler_to_matrix, matrix_to_euler
from rig.simulator.faults import FaultInjector

INTRUSION_S = 0.15  # that another sender is heard, where it is let
BATCH = 5  # readings that Sensor Logger pushes at once


def format_line(
    settings: ImuSettings, matrix: Array, stamp_s: float, order: str
) -> str:
    """One line as the configured app would send it, without its end."""
    columns: tuple[int, ...]
    if settings.quaternion_columns:
        columns, digits = settings.quaternion_columns, 9
        numbers = Rotation.from_matrix(matrix).as_quat()
    else:
        columns, digits = settings.columns, 7
        numbers = matrix_to_euler(matrix, order) * np.array(settings.signs)
        if settings.format == "hyperimu":
            numbers[0] %= 360.0  # the azimuth runs from 0 to 360
        if settings.unit == "rad":
            numbers = np.radians(numbers)
    width = settings.column_count or 1 + max(*columns, settings.stamp_column)
    fields = ["0.0"] * width
    for column, value in zip(columns, numbers, strict=True):
        fields[column] = f"{value:.{digits}f}"
    if settings.stamp_column >= 0:
        fields[settings.stamp_column] = str(round(stamp_s * 1000))
    return settings.separator.join(fields)


class Phone:
    """Sends ``attitude()`` at ``rate_hz`` until closed; connects again by itself."""

    def __init__(
        self,
        settings: ImuSettings,
        attitude: Callable[[], Array],
        faults: FaultInjector,
        rate_hz: float = 100.0,
        seed: int = 0,
    ) -> None:
        self.settings = settings
        self.port = settings.port
        self._attitude = attitude
        self._faults = faults
        self._period = 1.0 / rate_hz
        self._random = random.Random(seed)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._listener: socket.socket | None = None
        self._frozen = np.eye(3)
        self._session = 0  # of the app, counted

    def start(self, port: int) -> int:
        """Send to the port the rig listens on, or listen there; returns the port."""
        self.port = port
        if self._thread.is_alive():
            return port
        if self.settings.transport == "connect":
            self._listener = socket.create_server(("127.0.0.1", port), backlog=1)
            self._listener.settimeout(0.1)
            self.port = int(self._listener.getsockname()[1])
        self._thread.start()
        return self.port

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        if self._listener:
            self._listener.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            with contextlib.suppress(OSError, http.client.HTTPException):
                if self.settings.format == "sensorlogger":
                    self._push()
                elif self._listener is not None:
                    connection, _ = self._listener.accept()
                    self._stream(connection)
                else:
                    address = ("127.0.0.1", self.port)
                    self._stream(socket.create_connection(address, timeout=1.0))
            self._closing.wait(0.05)

    def _stream(self, connection: socket.socket) -> None:
        with contextlib.closing(connection):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(1.0)
            held: bytes | None = None
            next_time = time.monotonic()
            while not self._closing.is_set():
                if self._faults.take("imu_disconnect"):
                    return
                if self._faults.take("imu_second_sender"):
                    connection.close()
                    self._intrude()
                    return
                if not self._faults.take("imu_gap"):
                    data = self._line()
                    if self._faults.take("imu_reorder") and held is None:
                        held = data
                    else:
                        connection.sendall(data + (held or b""))
                        held = None
                next_time += self._period
                self._closing.wait(max(0.0, next_time - time.monotonic()))

    def _intrude(self) -> None:
        """Angles of something else, from another address, for as long as it is let."""
        settings, other = self.settings, euler_to_matrix([40.0, 30.0, 20.0], "ZYX")
        address, source = ("127.0.0.1", self.port), ("127.0.0.2", 0)
        with (
            contextlib.suppress(OSError),
            socket.create_connection(address, 1.0, source) as connection,
        ):
            for _ in range(max(3, round(INTRUSION_S / self._period))):
                line = format_line(settings, other, time.time(), str(settings.order))
                connection.sendall(line.encode() + b"\r\n")
                self._closing.wait(self._period)

    def _line(self) -> bytes:
        s, faults = self.settings, self._faults
        order = str(s.order)
        if faults.take("imu_wrong_order"):
            order = "XYZ" if s.order != "XYZ" else "ZYX"
        matrix = self._attitude()
        if not faults.take("imu_frozen"):
            self._frozen = matrix
        matrix = self._frozen
        if faults.take("imu_radians"):
            s = s.model_copy(update={"unit": "rad"})
        text = format_line(s, matrix, time.time(), order)
        if faults.take("imu_nan"):
            fields = text.split(s.separator)
            fields[(s.quaternion_columns or s.columns)[0]] = "NaN"
            text = s.separator.join(fields)
        if faults.take("imu_columns"):
            text += f"{s.separator}1.0"
        data = text.encode() + b"\r\n"
        if faults.take("imu_garbage"):
            cut = self._random.randrange(len(data))
            noise = self._random.randbytes(self._random.randint(1, 40))
            data = data[:cut] + noise + data[cut:]
        return data

    def _push(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=2.0)
        with contextlib.closing(connection):
            while not self._closing.is_set():
                payload = []
                if self._faults.take("imu_disconnect"):
                    self._session += 1
                    return
                for _ in range(BATCH):
                    q = Rotation.from_matrix(self._attitude()).as_quat()
                    if self._faults.take("imu_nan"):
                        q = q * np.nan
                    values = dict(
                        zip(("qx", "qy", "qz", "qw"), q.tolist(), strict=True)
                    )
                    entry = {"name": "orientation", "time": time.time_ns()}
                    payload.append(entry | {"values": values})
                    self._closing.wait(self._period)
                if self._faults.take("imu_gap"):
                    continue
                named = {"deviceId": "simulated", "sessionId": str(self._session)}
                body = json.dumps(named | {"payload": payload})
                if self._faults.take("imu_garbage"):
                    body = body[: self._random.randrange(len(body))]
                headers = {"Content-Type": "application/json"}
                connection.request("POST", "/", body, headers)
                connection.getresponse().read()
