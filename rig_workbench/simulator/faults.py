"""Faults on demand: ``kind@when,count=N,axis=NAME,seconds=S,share=P,factor=F``."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Sequence
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
    "stuck_axis": "the motor does not turn although commanded",
    "slipping_axis": "the motor turns, the joint does not",
    "halted": "another controller quick-stops a drive that moves",
    "sto": "the power stage is off for `seconds` (1.05), without an alarm",
    "stop_ignored": "the drive acknowledges its stop and moves on",
    "unit_stop_ignored": "the drive moves on after its own stop; a broadcast stops it",
    "watch_ignored": "the drive ignores its communication timeout",
    "stop_resumes": "`seconds` (1) after a stop the drive moves on to its target",
    "fast_drive": "the drive moves `factor` (20) times as fast as commanded",
    "regeared": "the joint turns `factor` (2) times as far as before",
    "phone_turned": "the phone was turned by 10 deg about the vertical",
    "imu_gap": "the phone is silent for `seconds` (1)",
    "imu_disconnect": "the phone's connection drops and comes back",
    "imu_garbage": "bytes of noise between and inside the phone's lines",
    "imu_nan": "the phone sends NaN",
    "imu_frozen": "the phone repeats one attitude under new stamps",
    "imu_wrong_order": "the phone's angles are in another Euler order",
    "imu_radians": "the phone sends radians",
    "imu_columns": "the phone's lines have one column more",
    "imu_second_sender": "during a gap another computer sends other angles",
    "imu_reorder": "the phone's lines arrive out of order",
}

OF_EVENT = ("delayed_reply", "sto", "stop_resumes")


@dataclasses.dataclass
class FaultSpec:
    kind: str
    phase: str | None = None  # inject when the session first enters this phase
    count: float = float("inf")  # replies or lines left to spoil
    axis: int | None = None  # None: any
    seconds: float | None = None  # length of a gap or delay
    share: float = 0.03  # of frames that are spoilt
    factor: float | None = None  # of a speed or a gearing
    begun: float | None = None  # by the monotonic clock; None: it waits


def parse_fault(text: str, names: Sequence[str] = AXIS_NAMES) -> FaultSpec:
    """Read ``kind[@phase][,count=N][,axis=NAME][,seconds=S][,share=P][,factor=F]``."""
    head, *options = text.split(",")
    kind, _, when = head.partition("@")
    if kind not in KINDS:
        raise ValueError(f"unknown fault {kind!r}; there are {', '.join(KINDS)}")
    fields: dict[str, Any] = {}
    readers: dict[str, Any] = {"count": int, "axis": list(names).index}
    readers |= dict.fromkeys(("seconds", "share", "factor"), float)
    try:
        if when:
            fields["phase"] = PHASES[PHASES.index(when)]
        for option in options:
            name, _, value = option.partition("=")
            fields[name] = readers[name](value)
    except (KeyError, ValueError):
        raise ValueError(
            f"fault {text!r}: after @ write one of {', '.join(PHASES)}; options are "
            f"count=N, seconds=S, share=P, factor=F, axis=NAME of {', '.join(names)}"
        ) from None
    return FaultSpec(kind, **fields)


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
        if not self._specs:
            return None
        now = time.monotonic()
        with self._lock:
            for spec in self._specs:
                hits = axis is None or spec.axis in (None, axis)
                if spec.kind != kind or not hits or spec.begun is None:
                    continue
                # Of these the seconds are those of each event.
                lasts = None if kind in OF_EVENT else spec.seconds
                over = lasts is not None and now > spec.begun + lasts
                if spec.count > 0 and not over:
                    spec.count -= 1
                    return spec
        return None
