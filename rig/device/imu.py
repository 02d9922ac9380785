"""The phone's stream over a socket, received in one thread into a bounded ring."""

from __future__ import annotations

import http.server
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rig.config.settings import ImuSettings
from rig.device.receive import LineReceiver, Senders, make_web
from rig.device.stream import Parser, Reading, StreamFault
from rig.faults import Fault

RING = 8192  # readings kept: over half a minute at 200 Hz


class ImuError(Fault):
    """The phone's stream is stale, closed, or not to be trusted."""


class Imu:
    """The attitude of the phone, now and over the last seconds.

    Args:
        settings: of the phone.
        report: called with the event ``sender_refused``, its ``address`` and
            ``reason``, once for each address, on the receiving thread.
    """

    def __init__(
        self, settings: ImuSettings, report: Callable[..., Any] | None = None
    ) -> None:
        self.settings = settings
        self.port = settings.port
        self._report = report
        self._senders = Senders(settings.allow, self._refused)
        self.connections = 0
        self._parser = Parser(settings)
        self._ring: deque[Reading] = deque(maxlen=RING)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._lines: LineReceiver | None = None
        self._web: http.server.HTTPServer | None = None
        self._arrived = 0.0
        self._fault = ""

    def open(self) -> Imu:
        """Listen, or begin to connect; ImuError where the port cannot be opened."""
        s = self.settings
        receive: Callable[[], None]
        try:
            if s.format == "sensorlogger":
                self._web = make_web(s, self._take_body)
                self.port, receive = (
                    self._web.server_address[1],
                    self._web.serve_forever,
                )
            else:
                self._lines = LineReceiver(
                    s, self._senders, self._begin, self._take_lines
                )
                self.port, receive = self._lines.port, self._lines.run
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
        if self._lines is not None:
            self._lines.stop()
        if self._web is not None:
            self._web.shutdown()
            self._web.server_close()
        if self._thread is not None:
            self._thread.join(2.0)

    @property
    def sender(self) -> str:
        """Address of the phone that is heard; empty while there is none."""
        return self._senders.phone

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

    # On the receiving thread

    def _refused(self, address: str, reason: str) -> None:
        if self._report is None:
            return
        try:
            self._report("sender_refused", address=address, reason=reason)
        except Fault as fault:  # the journal cannot be written
            self._fault = str(fault)

    def _begin(self) -> None:
        self.connections += 1
        with self._lock:
            self._parser.reconnected()

    def _take_lines(self, lines: list[bytes], now: float) -> bool:
        with self._lock:
            try:
                readings = [] if self._fault else self._parser.lines(lines, now)
            except StreamFault as fault:
                self._fault = str(fault)
                return False
            self._store(readings)
        return bool(readings)

    def _take_body(self, body: bytes, address: str) -> bool:
        # A phone that keeps its connection must learn that nobody listens any more.
        if self._closing.is_set() or not self._senders.admits(address):
            return False
        with self._lock:
            self.connections = 1
            readings = self._parser.body(body, time.monotonic())
            self._store(readings)
            foreign = self._parser.foreign
        if foreign:
            self._senders.refuse(address, "another device than before sends from there")
        elif readings:
            self._senders.phone = address
        return not foreign

    def _store(self, readings: list[Reading]) -> None:
        if readings:
            self._arrived = time.monotonic()
        for reading in readings:
            if not self._ring or reading.time >= self._ring[-1].time:
                self._ring.append(reading)
            elif self._ring[-1].time - reading.time < 1e-3:
                self._ring.append(Reading(self._ring[-1].time, reading.matrix))
