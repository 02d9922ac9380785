"""Faults on demand: ``kind@when,count=N,axis=NAME,seconds=S,share=P``."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import Any

from rig.config.axis import AXIS_NAMES

PHASES = ("zeroing", "moving", "settling", "measuring", "saving")
KINDS = {
    "lost_reply": "the drive obeys, its reply is lost",
    "lost_write_reply": "the drive obeys a write, its reply is lost",
    "lost_request": "the drive never sees the request",
    "spoilt_frames": "a `share` (0.03) of requests and of replies is mangled",
    "delayed_reply": "the reply comes after `seconds` (0.5)",
    "noise_bytes": "random bytes before the reply",
    "exception_reply": "the drive answers exception 4 and does nothing",
    "dead_drive": "one unit is silent",
    "alarm": "the drive faults and stops itself",
    "stuck_axis": "the motor stands although it is told to move",
    "slipping_axis": "the motor turns, the joint does not",
    "imu_gap": "the phone is silent for `seconds` (1)",
    "imu_disconnect": "the phone's connection drops and comes back",
    "imu_garbage": "bytes of noise between and inside the phone's lines",
    "imu_nan": "the phone sends NaN",
    "imu_frozen": "the phone repeats one attitude under new stamps",
    "imu_wrong_order": "the phone's angles are in another Euler order",
    "imu_radians": "the phone sends radians",
    "imu_columns": "the phone's lines get one column more",
    "imu_second_sender": "in a gap another computer sends other angles",
    "imu_reorder": "the phone's lines come out of order",
}


@dataclasses.dataclass
class FaultSpec:
    kind: str
    phase: str | None = None  # inject when the session first enters this phase
    count: float = float("inf")  # replies or lines left to spoil
    axis: int | None = None  # None: any
    seconds: float | None = None  # length of a gap or delay
    share: float = 0.03  # of frames that are spoilt
    begun: float | None = None  # by the monotonic clock; None: it waits


def parse_fault(text: str) -> FaultSpec:
    """Read ``kind[@phase][,count=N][,axis=NAME][,seconds=S][,share=P]``."""
    head, *options = text.split(",")
    kind, _, when = head.partition("@")
    if kind not in KINDS:
        raise ValueError(f"unknown fault {kind!r}: have {', '.join(KINDS)}")
    found: dict[str, Any] = {}
    readers: dict[str, Any] = {"count": int, "seconds": float, "share": float}
    readers["axis"] = AXIS_NAMES.index
    try:
        if when:
            found["phase"] = PHASES[PHASES.index(when)]
        for option in options:
            name, _, value = option.partition("=")
            found[name] = readers[name](value)
    except (KeyError, ValueError):
        raise ValueError(
            f"fault {text!r}: after @ comes one of {', '.join(PHASES)}; "
            "options are count=N, seconds=S, share=P, axis=NAME of "
            f"{', '.join(AXIS_NAMES)}"
        ) from None
    return FaultSpec(kind, **found)


class FaultInjector:
    """Which faults are on now; asked by the drives, the line and the phone."""

    def __init__(self, specs: list[FaultSpec] | None = None) -> None:
        self._lock = threading.RLock()
        self._specs: list[FaultSpec] = []
        for spec in specs or []:
            self.add(spec, waits=spec.phase is not None)

    def add(self, spec: FaultSpec, waits: bool = False) -> None:
        """Inject it now, or when it is due."""
        begun = None if waits else time.monotonic()
        with self._lock:
            self._specs.append(dataclasses.replace(spec, begun=begun))

    def clear(self) -> None:
        """Repair everything; nothing more is injected."""
        with self._lock:
            self._specs.clear()

    def enter(self, phase: str) -> None:
        """The session entered a phase."""
        with self._lock:
            for spec in self._specs:
                if spec.begun is None and spec.phase == phase:
                    spec.begun = time.monotonic()

    def take(self, kind: str, axis: int | None = None) -> FaultSpec | None:
        """The active fault of a kind that hits this axis; uses one of its count."""
        now = time.monotonic()
        with self._lock:
            for spec in self._specs:
                if spec.kind != kind or (
                    axis is not None and spec.axis not in (None, axis)
                ):
                    continue
                # The seconds of a delayed reply are its delay.
                lasts = spec.seconds if kind != "delayed_reply" else None
                over = spec.begun is None or (
                    lasts is not None and now > spec.begun + lasts
                )
                if spec.count > 0 and not over:
                    spec.count -= 1
                    return spec
        return None
