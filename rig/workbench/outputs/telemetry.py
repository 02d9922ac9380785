"""telemetry.jsonl: what phone and drives say while a session runs, for the live page.

A thread takes what others have received already, at most 20 times a second, and appends
a line. It never uses the bus, never makes the session wait, and where it fails it ends
by itself: a session has no need of this file. The file is not fsynced, and no results
are computed from it.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import threading
import time
from collections.abc import Callable
from typing import Any

from rig.config import RigConfig
from rig.core.attitude import Frame
from rig.core.drive import Drive
from rig.core.phone import Imu

TELEMETRY = "telemetry.jsonl"
OLDER = "telemetry.old.jsonl"  # takes what does not fit into TELEMETRY
PERIOD_S = 0.05
MAX_BYTES = 8 << 20  # of each of the two files: together over an hour
MOST_READINGS = 200  # of the window over which scatter is taken


class Telemetry(threading.Thread):
    """Appends to ``telemetry.jsonl`` of a run until closed."""

    def __init__(
        self,
        folder: pathlib.Path,
        config: RigConfig,
        imu: Imu,
        drives: list[Drive],
        frame: Callable[[], Frame | None],
    ) -> None:
        super().__init__(name="telemetry", daemon=True)
        self._folder, self._config = folder, config
        self._imu, self._drives, self._frame = imu, drives, frame
        self._closing = threading.Event()

    def close(self) -> None:
        """Ask the thread to end; it is waited for only briefly."""
        self._closing.set()
        if self.is_alive():
            self.join(0.2)

    def run(self) -> None:
        # Whatever fails here (a full disk, say) must not reach the session.
        with contextlib.suppress(Exception):
            while True:
                self._record()
                if self._closing.wait(PERIOD_S):
                    return

    def _record(self) -> None:
        path = self._folder / TELEMETRY
        with path.open("ab", buffering=0) as file:
            while not self._closing.wait(PERIOD_S):
                line = json.dumps(self.sample(), separators=(",", ":")) + "\n"
                file.write(line.encode())
                if file.tell() > MAX_BYTES:
                    os.replace(path, self._folder / OLDER)
                    return

    def sample(self) -> dict[str, Any]:
        """What is known now.

        Returns:
            ``time``; ``drives`` (3,) degrees as last polled, None where never;
            ``age`` of the newest reading in seconds and ``rate`` of readings in Hz;
            once there is a zero ``deg`` (3,) of the newest reading, and over the
            settle window ``std`` (3,) in degrees.
        """
        now = time.monotonic()
        window = min(1.0, max(0.2, self._config.settle.window_s))
        readings = self._imu.since(now - window)[-MOST_READINGS:]
        polled = [drive.last for drive in self._drives]
        record: dict[str, Any] = {
            "time": round(time.time(), 3),
            "drives": [
                None if last is None else round(drive.axis.to_deg(last.position), 4)
                for drive, last in zip(self._drives, polled, strict=True)
            ],
        }
        if not readings:
            return record
        span = readings[-1].time - readings[0].time
        record["age"] = round(now - readings[-1].time, 3)
        record["rate"] = round((len(readings) - 1) / span, 1) if span > 0 else 0.0
        if (frame := self._frame()) is None:
            return record
        angles = frame.angles([reading.matrix for reading in readings])
        record["deg"] = angles[-1].round(4).tolist()
        if len(readings) > 2:
            record["std"] = angles.std(axis=0, ddof=1).round(5).tolist()
        return record
