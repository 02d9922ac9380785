"""What sends readings to a rig, on a thread: a phone as its apps do, a sensor."""

from __future__ import annotations

import contextlib
import http.client
import json
import random
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config.settings import ImuSettings, ReadingsSettings
from rig.readings.geometry import Array, euler_to_matrix, matrix_to_euler
from rig_workbench.simulator.faults import FaultInjector

AGAIN_S = 0.05  # before it connects again
INTRUSION_S = 0.15  # that another sender is heard, where it is let
BATCH = 5  # readings that Sensor Logger pushes at once
HEADER = b"loggingTime(txt)" + b"".join(b",motionQuaternion%c(R)" % c for c in b"XYZW")
QUATERNION = ("qx", "qy", "qz", "qw")
SAMPLED = "2026-11-27 19:05:11.000 +0000"


def format_line(
    settings: ImuSettings, matrix: Array, stamp_s: float, order: str
) -> str:
    """One line as the configured app would send it, without its end."""
    if settings.format in ("json", "sensorlog"):
        numbers = Rotation.from_matrix(matrix).as_quat(canonical=True)
        if settings.format == "sensorlog":
            return ",".join([SAMPLED, *(f"{value:.9f}" for value in numbers)])
        told = {"timestamp": round(1e9 * stamp_s), "value": numbers.tolist()}
        return json.dumps({"rotationVector": told})
    columns: tuple[int, ...] = settings.quaternion_columns or settings.columns
    if settings.quaternion_columns:
        numbers, digits = Rotation.from_matrix(matrix).as_quat(), 9
    else:
        numbers, digits = matrix_to_euler(matrix, order) * np.array(settings.signs), 7
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


class Phone(Sender):
    """Sends ``attitude()`` as the app of a phone does."""

    listens = "connect"

    def __init__(
        self,
        settings: ImuSettings,
        attitude: Callable[[], Array],
        faults: FaultInjector,
        rate_hz: float = 100.0,
        seed: int = 0,
    ) -> None:
        super().__init__(settings, faults, rate_hz)
        self._attitude = attitude
        self._random = random.Random(seed)
        self._frozen = np.eye(3)
        self._session = 0  # of the app, counted

    def send(self) -> None:
        if self.settings.format == "sensorlogger":
            self._push()
        else:
            self._stream(self.connected())

    def _stream(self, connection: socket.socket) -> None:
        held = b""
        next_time = time.monotonic()
        with connection:
            if self.settings.transport != "udp":
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(1.0)
            if self.settings.format == "sensorlog":
                connection.sendall(HEADER + b"\r\n")
            while not self._closing.is_set() and not self._take("imu_disconnect"):
                if self._take("imu_second_sender"):
                    connection.close()
                    return self._intrude()
                if not self._take("imu_gap"):
                    data = self._line()
                    if self._take("imu_reorder") and not held:
                        held = data
                    else:
                        connection.sendall(data + held)
                        held = b""
                next_time += self._period
                self._closing.wait(max(0.0, next_time - time.monotonic()))

    def _intrude(self) -> None:
        """Angles of something else, from another address, for as long as it is let."""
        settings, other = self.settings, euler_to_matrix([40.0, 30.0, 20.0], "ZYX")
        address, source = ("127.0.0.1", self._port), ("127.0.0.2", 0)
        with socket.create_connection(address, 1.0, source) as connection:
            for _ in range(max(3, round(INTRUSION_S / self._period))):
                line = format_line(settings, other, time.time(), str(settings.order))
                connection.sendall(line.encode() + b"\r\n")
                self._closing.wait(self._period)

    def _line(self) -> bytes:
        s, order = self.settings, str(self.settings.order)
        if self._take("imu_wrong_order"):
            order = "XYZ" if order != "XYZ" else "ZYX"
        if not self._take("imu_frozen"):
            self._frozen = self._attitude()
        if self._take("imu_radians"):
            s = s.model_copy(update={"unit": "rad"})
        fields = format_line(s, self._frozen, time.time(), order).split(s.separator)
        by_column = s.format not in ("json", "sensorlog")
        if by_column and self._take("imu_nan"):
            fields[(s.quaternion_columns or s.columns)[0]] = "NaN"
        if by_column and self._take("imu_columns"):
            fields.append("1.0")
        return self._garbled(s.separator.join(fields).encode() + b"\r\n")

    def _garbled(self, data: bytes) -> bytes:
        if not self._take("imu_garbage"):
            return data
        cut = self._random.randrange(len(data))
        noise = self._random.randbytes(self._random.randint(1, 40))
        return data[:cut] + noise + data[cut:]

    def _push(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=2.0)
        with contextlib.closing(connection):
            while not self._closing.is_set():
                if self._take("imu_disconnect"):
                    self._session += 1
                    return
                payload = []
                for _ in range(BATCH):
                    q = Rotation.from_matrix(self._attitude()).as_quat()
                    q = q * np.nan if self._take("imu_nan") else q
                    values = dict(zip(QUATERNION, q.tolist(), strict=True))
                    stamped = {"name": "orientation", "time": time.time_ns()}
                    payload.append(stamped | {"values": values})
                    self._closing.wait(self._period)
                if self._take("imu_gap"):
                    continue
                named = {"deviceId": "simulated", "sessionId": str(self._session)}
                body = json.dumps(named | {"payload": payload}).encode()
                headers = {"Content-Type": "application/json"}
                connection.request("POST", "/", self._garbled(body), headers)
                connection.getresponse().read()


class SimSensor(Sender):
    """Sends lines of ``numbers()``."""

    listens = "tcp"

    def __init__(
        self,
        settings: ReadingsSettings,
        numbers: Callable[[], Array],
        faults: FaultInjector,
        rate_hz: float = 100.0,
    ) -> None:
        super().__init__(settings, faults, rate_hz)
        self._numbers = numbers
        self._frozen = b""

    def send(self) -> None:
        due = time.monotonic()
        with self.connected() as connection:
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
            values = np.divide(self._numbers(), factors)
            for column, value in zip(columns, values, strict=True):
                fields[column] = f"{value:.9g}"
            self._frozen = (s.separator.join(fields) + "\r\n").encode()
        if self._take("imu_garbage"):
            return b"?\0" + self._frozen
        return self._frozen
