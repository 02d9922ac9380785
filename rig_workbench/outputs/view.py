"""What page and report say of a run: pure functions of its state."""

from __future__ import annotations

import math
import shlex
from typing import Any

from rig.core.stop import UnitStop
from rig.faults import EXIT_RECALIBRATE
from rig.outputs.messages import error_text, event_lines, summary_lines
from rig.outputs.run_state import ACTIVE, SESSIONS, PostureState, Record, RunState
from rig.parts import PLACES

SHOWN = 40  # rows of a long queue
STALE_S = 1.0
PHASES = {
    "opening": "Waiting for drives and phone",
    "showing": "Checking each axis",
    "zeroing": "Taking the zero",
    "moving": "Moving to {}",
    "settling": "Waiting until {} is quiet",
    "measuring": "Measuring {}",
    "saving": "Saving",
    "finishing": "All measurements are made; the drives are at rest",
}
ENDED = {
    "end": ("good", "Done"),
    "paused": ("warn", "Paused"),
    "refused": ("bad", "Refused; nothing was moved"),
    "stopped": ("bad", "Stopped on request"),
    "fault": ("bad", "Stopped by a fault"),
}


def angle(value: float | None, digits: int = 3) -> str:
    """Degrees with a sign, or a dash."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:+.{digits}f}".replace("-", "−")


def headline(state: RunState, running: bool) -> tuple[str, str]:
    """Tone (run, good, warn, bad) and one line: what happens now, or how it ended."""
    ended = state.ended
    if ended is not None:
        if ended["event"] == "end" and ended.get("code") == EXIT_RECALIBRATE:
            return "warn", "Done: recalibrate"
        return ENDED[ended["event"]]
    if not running:
        return "bad", "Ended without a last record: killed, or a power failure"
    if not state.candidates and state.mode == "calibrate":
        return "run", "Choosing the postures"
    posture = state.postures.get(state.current or "")
    line = PHASES.get(state.phase, state.phase)
    line = line.format(posture.title if posture else "the zero posture")
    return "run", line + (", then pausing" if state.pausing else "")


def progress(state: RunState) -> str:
    """Postures done of those planned, and the time that is left, in words."""
    if not state.planned:
        return ""
    left = f", about {state.left_s():.0f} s left" if state.left_s() else ""
    return f"{len(state.done)} of {state.planned} postures{left}"


def trouble(state: RunState, running: bool, folder: str) -> list[str]:
    """Faults and stops in plain words, and what to do."""
    lines, ended, stop = [], state.ended, state.stop
    typed = state.start.get("arguments") or [state.mode]
    typed = [PLACES[typed[0]], *typed] if typed[0] in PLACES else typed
    typed = ["resume", folder] if state.mode in SESSIONS else typed
    go_on = (ended or {}).get("go_on", f"jaxcal-rig {shlex.join(typed)}")
    go_on = f"To continue: {go_on}"
    if state.damaged:
        lines.append("The journal has lines that cannot be read; some are left out.")
    if ended is None and not running and state.start:
        lines += [
            "The session's process has ended. A move that had begun ran to its end, "
            "unless the drive watches its line. Look at the device first.",
            go_on,
        ]
    elif ended is not None and ended["event"] != "end":
        units = stop["units"] if stop else []
        moved = event_lines(state.last_move) if state.last_move else []
        lines += [ended.get("reason", ""), *moved]
        lines += [str(UnitStop(**u)) for u in units]
        lines += [go_on] if ended["event"] != "refused" else []
    elif ended is None and stop is not None and stop["reason"]:
        lines.append(f"Stopped: {stop['reason']}")
    return [line for line in [*lines, *state.warnings] if line]


def numbers(
    now: dict[str, Any], running: bool, names: tuple[list[str], list[str]]
) -> list[tuple[str, ...]]:
    """A row for each name of an axis or measurement: commanded, drive, measured,
    difference (none after a run, whose drives are at rest), scatter."""
    axes, outputs = names
    columns = [
        dict(zip(of, now[what] or [None] * len(of), strict=True))
        for what, of in (
            ("commanded", axes), ("drives", axes), ("measured", outputs),
            ("std", outputs),
        )
    ]  # fmt: skip
    rows: list[tuple[str, ...]] = []
    for name in dict.fromkeys([*axes, *outputs]):
        a, d, y, s = (column.get(name) for column in columns)
        off = y - a if running and a is not None and y is not None else None
        spread = "–" if s is None else f"{s:.3f}"
        rows.append((name, angle(a), angle(d), angle(y), angle(off), spread))
    return rows


def stream(sample: Record, now: float) -> str:
    """How the phone's stream is; empty where there is nothing to report."""
    if not sample:
        return ""
    if now - sample["time"] > STALE_S:
        return f"no telemetry for {now - sample['time']:.0f} s"
    if "age" not in sample:
        return "no reading"
    late = (
        f"readings {sample['rate']:.0f} Hz, newest reading {1e3 * sample['age']:.0f} ms"
    )
    return late + ("" if "deg" in sample else "; angles follow after the zero")


def queue(state: RunState) -> list[PostureState]:
    """The present posture, those to come, then those done, the newest first."""
    postures = state.postures.values()
    ahead = [p for p in postures if p.state in ("waiting", *ACTIVE)]
    ahead.sort(key=lambda p: p.state == "waiting")
    behind = [p for p in postures if p not in ahead]
    behind.sort(key=lambda p: -p.time)
    shown = ahead[: SHOWN - min(len(behind), SHOWN // 2)]
    return shown + behind[: SHOWN - len(shown)]


def verdict(state: RunState, summary: dict[str, Any]) -> list[str]:
    """The result of a run, as on the console; empty before there is one."""
    limit = state.setting("session", "verify_limit_deg", math.nan)
    if "A" in summary or "parameters" in summary:
        return summary_lines(summary, limit)
    if "before" in summary:
        return [f"{error_text(summary, state.unit)}, limit {limit:g}"]
    if state.ended is None or state.ended["event"] != "end":
        return []
    if state.mode == "goto" and state.done:
        unit = "°" if state.unit == "deg" else f" {state.unit}"
        places = " ".join(map(angle, state.done[-1].measured or []))
        return [f"Reached {places}{unit}"]
    return [f"{len(state.done)} postures recorded"] * (state.mode == "collect")
