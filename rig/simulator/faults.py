"""Faults on demand: ``kind@when,count=N,axis=NAME,seconds=S,share=P``."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
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
    after_s: float | None = None  # or so long after the simulator started
    count: float = float("inf")  # replies or lines left to spoil
    axis: int | None = None  # None: any
    seconds: float | None = None  # length of a gap or delay
    share: float = 0.03  # of frames that are spoilt


def parse_fault(text: str) -> FaultSpec:
    """Read ``kind[@phase | @SECONDSs][,count=N][,axis=NAME][,seconds=S][,share=P]``."""
    head, *options = text.split(",")
    kind, _, when = head.partition("@")
    if kind not in KINDS:
        raise ValueError(f"unknown fault {kind!r}: have {', '.join(KINDS)}")
    found: dict[str, Any] = {}
    readers: dict[str, Any] = {"count": int, "seconds": float, "share": float}
    readers["axis"] = AXIS_NAMES.index
    try:
        if when in PHASES:
            found["phase"] = when
        elif when:
            found["after_s"] = float(when.removesuffix("s"))
        for option in options:
            name, _, value = option.partition("=")
            found[name] = readers[name](value)
    except (KeyError, ValueError):
        raise ValueError(
            f"fault {text!r}: after @ comes one of {', '.join(PHASES)} or seconds; "
            "options are count=N, seconds=S, share=P, axis=NAME of "
            f"{', '.join(AXIS_NAMES)}"
        ) from None
    return FaultSpec(kind, **found)


class FaultInjector:
    """Which faults are on now; asked by the drives, the line and the phone."""

    def __init__(self, specs: list[FaultSpec] | None = None) -> None:
        self._lock = threading.RLock()
        self._start = time.monotonic()
        self._waiting = list(specs or [])
        self._active: list[tuple[FaultSpec, float]] = []  # and since when
        self._begin(lambda spec: spec.phase is None and spec.after_s is None)

    def add(self, spec: FaultSpec) -> None:
        with self._lock:
            self._active.append((dataclasses.replace(spec), time.monotonic()))

    def clear(self) -> None:
        """Repair everything; nothing more is injected."""
        with self._lock:
            self._waiting.clear()
            self._active.clear()

    def enter(self, phase: str) -> None:
        """The session entered a phase."""
        self._begin(lambda spec: spec.phase == phase)

    def _begin(self, due: Callable[[FaultSpec], bool]) -> None:
        with self._lock:
            for spec in [spec for spec in self._waiting if due(spec)]:
                self._waiting.remove(spec)
                self.add(spec)

    def take(self, kind: str, axis: int | None = None) -> FaultSpec | None:
        """The active fault of a kind that hits this axis; uses one of its count."""
        now = time.monotonic()
        self._begin(lambda s: s.after_s is not None and now >= self._start + s.after_s)
        with self._lock:
            for spec, since in self._active:
                hits = spec.kind == kind and (axis is None or spec.axis in (None, axis))
                # The seconds of a delayed reply are its delay.
                lasts = spec.seconds if kind != "delayed_reply" else None
                over = lasts is not None and now > since + lasts
                if hits and spec.count > 0 and not over:
                    spec.count -= 1
                    return spec
        return None
