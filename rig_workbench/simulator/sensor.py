"""A sensor: lines of numbers over TCP or UDP, at a steady rate."""

from __future__ import annotations

import time
from collections.abc import Callable

from rig.config.settings import ReadingsSettings
from rig.readings.attitude import Array
from rig_workbench.simulator.faults import FaultInjector
from rig_workbench.simulator.sender import Sender


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
            for column, value, factor in zip(
                columns, self._numbers(), factors, strict=True
            ):
                fields[column] = f"{value / factor:.9g}"
            self._frozen = (s.separator.join(fields) + "\r\n").encode()
        if self._take("imu_garbage"):
            return b"?\0" + self._frozen
        return self._frozen
