"""Faults on demand: ``kind@when,count=N,axis=NAME,seconds=S``."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import Any

from rig.config.axis import AXIS_NAMES

PHASES = ("zeroing", "moving", "settling", "measuring", "saving")
BUS_KINDS = {
    "lost_reply": "the drive obeys, its reply is lost",
    "lost_write_reply": "the drive obeys a write, its reply is lost",
    "lost_request": "the drive never sees the request",
    "delayed_reply": "the reply comes after `seconds` (0.5)",
    "noise_bytes": "random bytes before the reply",
    "exception_reply": "the drive answers exception 4 and does nothing",
    "dead_drive": "one unit is silent",
}
KINDS = BUS_KINDS | {
    "alarm": "the drive faults and stops itself",
    "stuck_axis": "the motor stands although it is told to move",
    "slipping_axis": "the motor turns, the joint does not",
    "imu_gap": "the phone is silent for `seconds` (1)",
    "imu_disconnect": "the phone's connection drops and comes back",
    "imu_garbage": "bytes of noise between and inside the phone's lines",
    "imu_nan": "the phone sends NaN",
    "imu_frozen": "the phone repeats one attitude under new stamps",
    "imu_wrong_order": "the phone's angles are in another Euler order",
    "imu_columns": "the phone's lines get one column more",
    "imu_reorder": "the phone's lines come out of order",
}


@dataclasses.dataclass(frozen=True)
class FaultSpec:
    """One fault to inject."""

    kind: str
    phase: str | None = None  # inject when the session first enters this phase
    after_s: float | None = None  # or so long after the simulator started
    count: int | None = None  # replies or lines spoilt; None: until cleared
    axis: int | None = None  # None: any
    seconds: float | None = None  # length of a gap or delay


def parse_fault(text: str) -> FaultSpec:
    """Read ``kind[@phase | @SECONDSs][,count=N][,axis=NAME][,seconds=S]``.

    Raises:
        ValueError: names what is unknown.
    """
    head, *options = text.split(",")
    kind, _, when = head.partition("@")
    if kind not in KINDS:
        raise ValueError(f"unknown fault {kind!r}: have {', '.join(KINDS)}")
    found: dict[str, Any] = {}
    readers: dict[str, Any] = {"count": int, "seconds": float, "axis": AXIS_NAMES.index}
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
            f"options are count=N, seconds=S, axis=NAME of {', '.join(AXIS_NAMES)}"
        ) from None
    return FaultSpec(kind, **found)


class FaultInjector:
    """Which faults are on now; asked by the drives, the line and the phone."""

    def __init__(self, specs: list[FaultSpec] | None = None) -> None:
        self._lock = threading.Lock()
        self._start = time.monotonic()
        self._waiting = list(specs or [])
        self._active: list[list] = []  # [spec, count left or None, since]
        self.fired: list[tuple[str, float]] = []
        for spec in list(self._waiting):
            if spec.phase is None and spec.after_s is None:
                self._activate(spec)

    def add(self, spec: FaultSpec) -> None:
        """Inject now."""
        with self._lock:
            self._activate(spec)

    def clear(self) -> None:
        """Repair everything; nothing more is injected."""
        with self._lock:
            self._waiting.clear()
            self._active.clear()

    def enter(self, phase: str) -> None:
        """The session entered a phase."""
        with self._lock:
            for spec in [s for s in self._waiting if s.phase == phase]:
                self._activate(spec)

    def _activate(self, spec: FaultSpec) -> None:
        if spec in self._waiting:
            self._waiting.remove(spec)
        self._active.append([spec, spec.count, time.monotonic()])
        self.fired.append((spec.kind, time.monotonic()))

    def take(self, kind: str, axis: int | None = None) -> FaultSpec | None:
        """The active fault of a kind that hits this axis; uses one of its count."""
        now = time.monotonic()
        with self._lock:
            for spec in [s for s in self._waiting if s.after_s is not None]:
                if now - self._start >= (spec.after_s or 0.0):
                    self._activate(spec)
            for entry in self._active:
                spec, left, since = entry
                if spec.kind != kind or (
                    axis is not None and spec.axis is not None and spec.axis != axis
                ):
                    continue
                timed = kind not in ("delayed_reply",) and spec.seconds is not None
                if timed and now - since > spec.seconds:
                    continue
                if left is None:
                    return spec
                if left > 0:
                    entry[1] = left - 1
                    return spec
        return None
