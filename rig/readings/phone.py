"""The phone's stream over a socket, as readings of its attitude."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from rig.config.settings import ImuSettings
from rig.readings.attitude import Array, Reading
from rig.readings.receiver import Receiver
from rig.readings.source import Source
from rig.readings.stream import StreamParser


class Imu(Source):
    """The attitude of the phone, (3, 3) to its world."""

    whose, table = "the phone", "imu"
    start, lost = "start its app", "Check its Wi-Fi, and that its app is in front"

    def __init__(
        self,
        settings: ImuSettings,
        report: Callable[..., object] = lambda event, **fields: None,
    ) -> None:
        """``report`` gets an event and its fields, on the receiving thread."""
        super().__init__(settings.stale_s, report)
        self.settings: ImuSettings = settings
        self.connections = 0
        self.world = np.eye(3)
        self._parser = StreamParser(settings)
        self._counts = self._parser.counts
        self._receiver: Receiver | None = None

    def open(self) -> Imu:
        """Listen, or begin to connect; ReadingError where the port cannot be opened."""
        try:
            self._receiver = Receiver(self)
        except OSError as error:
            raise self.closed(error) from None
        return self

    def close(self) -> None:
        if self._receiver is not None:
            self._receiver.close()

    @property
    def port(self) -> int:
        return self._receiver.port if self._receiver else self.settings.port

    @property
    def sender(self) -> str:  # type: ignore[override]  # known by the receiver
        """Address of the phone that is heard; empty while there is none."""
        return self._receiver.phone if self._receiver else ""

    @property
    def where(self) -> str:
        return f"{self.settings.host}:{self.port}"

    @property
    def first(self) -> str:
        """The first record that was used, as it came; empty before that."""
        return self._parser.first

    @property
    def taken_for(self) -> str:
        """What its fields are taken for, in words."""
        return self._parser.taken_for

    @property
    def refused(self) -> list[str]:
        return self._receiver.refused if self._receiver else []

    def turn(self, world: Array) -> None:
        """Turn all readings by (3, 3), those that were received too."""
        with self._lock:
            self.world = world @ self.world
            turned = [Reading(r.time, world @ r.value) for r in self._ring]
            self._ring = deque(turned, maxlen=self._ring.maxlen)

    # On the receiving thread

    def begin(self) -> None:
        """Lines come over another connection from now on."""
        self.connections += 1
        with self._lock:
            self._parser.reconnected()

    def take_lines(self, lines: list[bytes], now: float) -> bool:
        """Lines that came at a monotonic time; whether a reading of them was used."""
        with self._lock:
            return self._store(self._parser.lines(lines, now))

    def take_body(self, body: bytes) -> tuple[bool, bool]:
        """A message; whether it was used, and whether it is another device's."""
        with self._lock:
            used = self._store(self._parser.body(body, time.monotonic()))
            self.connections = max(1, self._parser.sessions)
            return used, self._parser.foreign

    def _store(self, readings: list[Reading]) -> bool:
        turned = [Reading(r.time, self.world @ r.value) for r in readings]
        return self.store(turned)
