"""telemetry.jsonl: what phone and drives say while a session runs, for the live page.

A thread appends what others have received already, at most 20 times a second. It never
uses the bus, never makes the session wait, and ends where it fails.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

from rig.core.device import Device

TELEMETRY = "telemetry.jsonl"
OLDER = "telemetry.old.jsonl"  # takes what does not fit into TELEMETRY
PERIOD_S = 0.05
MAX_BYTES = 8 << 20  # of each of the two files: together over an hour
MOST_READINGS = 200  # of the window over which scatter is taken


@contextlib.contextmanager
def telemetry(device: Device) -> Iterator[None]:
    """Append to ``telemetry.jsonl`` of the device's run; waited for only briefly."""
    closing = threading.Event()
    thread = threading.Thread(
        target=_record, args=(device, closing), name="telemetry", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        closing.set()
        thread.join(0.2)


def _record(device: Device, closing: threading.Event) -> None:
    path = device.run.folder / TELEMETRY
    # Whatever fails here (a full disk, say) must not reach the session.
    with contextlib.suppress(Exception):
        while not closing.wait(PERIOD_S):
            with path.open("ab", buffering=0) as file:
                line = json.dumps(sample(device), separators=(",", ":")) + "\n"
                file.write(line.encode())
                full = file.tell() > MAX_BYTES
            if full:
                os.replace(path, path.with_name(OLDER))


def sample(device: Device) -> dict[str, Any]:
    """What is known now: time; drives, (n,) degrees as last polled, None where never;
    age in seconds and rate in Hz of readings; with a zero deg (m,) and std (m,)."""
    now = time.monotonic()
    window = min(1.0, max(0.2, device.config.settle.window_s))
    readings = device.imu.since(now - window)[-MOST_READINGS:]
    record: dict[str, Any] = {
        "time": round(time.time(), 3),
        "drives": [
            None if drive.last is None
            else round(drive.axis.to_deg(drive.last.position), 4)
            for drive in device.drives
        ],
    }  # fmt: skip
    if readings:
        span = readings[-1].time - readings[0].time
        record["age"] = round(now - readings[-1].time, 3)
        record["rate"] = round((len(readings) - 1) / span, 1) if span > 0 else 0.0
    if readings and device.frame is not None:
        angles = device.frame.angles([reading.value for reading in readings])
        record["deg"] = angles[-1].round(4).tolist()
        if len(readings) > 2:
            record["std"] = angles.std(axis=0, ddof=1).round(5).tolist()
    return record
