"""What the page says, as HTML: pure functions of the state, every text escaped."""

from __future__ import annotations

import html
import math
import shlex
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES
from rig.core.faults import EXIT_RECALIBRATE
from rig.core.stop import UnitStop
from rig.workbench.live.state import ACTIVE, Posture, Record, RunState
from rig.workbench.live.worth import ellipsoid, prediction_std
from rig.workbench.outputs.console import error_text, summary_lines

NONE = (None, None, None)  # of three axes, where nothing is known
SHOWN = 40  # rows of a long queue
STALE_S = 1.0
MARKS = {
    "waiting": "·", "moving": "▶", "settling": "▶", "measuring": "▶", "done": "✓",
    "unreachable": "✕", "withdrawn": "↺",
}  # fmt: skip
PHASES = {
    "zeroing": "Taking the zero",
    "moving": "Moving to {}",
    "settling": "Waiting until {} is quiet",
    "measuring": "Measuring {}",
    "saving": "Saving {}",
    "finishing": "Drives at rest; identifying",
}
ENDED = {
    "end": ("good", "Done"),
    "paused": ("warn", "Paused"),
    "refused": ("bad", "Refused; nothing was moved"),
    "stopped": ("bad", "Stopped on request"),
}


def text(value: Any) -> str:
    """Escaped for HTML."""
    return html.escape(str(value))


def angle(value: float | None, digits: int = 3) -> str:
    """Degrees with a sign, or a dash."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:+.{digits}f}".replace("-", "−")


def headline(state: RunState, running: bool) -> tuple[str, str]:
    """Tone (run, good, warn, bad) and one line: what happens now, or how it ended."""
    ended = state.ended
    if ended is None:
        if not running:
            return "bad", "Ended without a last record: killed, or the power failed"
        if not state.choice and state.mode == "calibrate":
            return "run", "Choosing the postures"
        if state.phase == "opening":
            return "run", "Waiting for drives and phone"
        posture = state.postures.get(state.current or "")
        title = posture.title if posture else "the zero posture"
        words = PHASES.get(state.phase, state.phase)
        if state.phase == "saving" and posture is None:
            return "run", "Saving"
        then = ", then pausing" if state.pausing else ""
        return "run", words.format(title) + then
    if ended["event"] == "end" and ended.get("code") == EXIT_RECALIBRATE:
        return "warn", "Done: recalibrate"
    return ENDED.get(ended["event"], ("bad", "Stopped by a fault"))


def _go_on(state: RunState, folder: str) -> str:
    if state.session:
        return f"To go on: jaxcal-rig resume {folder}"
    typed = state.start.get("arguments") or [state.mode]
    return f"To go on: jaxcal-rig {shlex.join(typed)}"


def trouble(state: RunState, running: bool, folder: str) -> str:
    """Faults and stops in plain words; empty where there is nothing to say."""
    lines: list[str] = []
    if state.damaged:
        lines.append("The journal has lines that cannot be read; some are left out.")
    ended, stop = state.ended, state.stop
    if ended is None and not running and state.start:
        lines.append(
            "The session's process is gone. A move that had begun ran to its end "
            "unless the drive watches its line. Look at the device first."
        )
        lines.append(_go_on(state, folder))
    if ended is not None and ended["event"] != "end":
        lines.append(ended.get("reason", ""))
        if stop is not None:
            lines += [str(UnitStop(**unit)) for unit in stop["units"]]
        if ended["event"] != "refused":
            lines.append(_go_on(state, folder))
    elif ended is None and stop is not None and stop["reason"]:
        lines.append(f"Stopped: {stop['reason']}")
    lines += state.warnings
    for posture in state.postures.values():
        if posture.state == "unreachable":
            lines.append(f"{posture.title} is out of reach: {posture.note}")
        if posture.state == "withdrawn":
            lines.append(f"{posture.title} was withdrawn: {posture.note}")
    return "".join(f"<p>{text(line)}</p>" for line in lines if line)


def numbers(state: RunState, sample: Record, live: bool) -> str:
    """Commanded beside measured, an axis a row."""
    drives = sample.get("drives") or NONE
    asked, found, std = state.target, sample.get("deg"), sample.get("std")
    if not live and state.done:
        last = state.done[-1]
        asked, found, std = last.commanded, last.measured, last.std
    rows = []
    for name, a, d, y, s in zip(
        AXIS_NAMES, asked or NONE, drives, found or NONE, std or NONE, strict=True
    ):
        off = None if a is None or y is None else y - a
        spread = "–" if s is None else f"{s:.3f}"
        cells = (angle(a), angle(d), angle(y), angle(off), spread)
        row = "".join(f"<td>{cell}</td>" for cell in cells)
        rows.append(f"<tr><th class='axis {name}'>{name}</th>{row}</tr>")
    titles = "degrees commanded drive measured difference scatter".split()
    head = "".join(f"<th>{title}</th>" for title in titles)
    return f"<table class='numbers'><tr>{head}</tr>{''.join(rows)}</table>"


def stream(sample: Record, running: bool, now: float) -> str:
    """How the phone's stream is; empty where there is nothing to report."""
    if not running or not sample:
        return ""
    if now - sample["time"] > STALE_S:
        return f"no telemetry for {now - sample['time']:.0f} s"
    if "age" not in sample:
        return "no reading from the phone"
    late = f"phone {sample['rate']:.0f} Hz, newest reading {1e3 * sample['age']:.0f} ms"
    return late + ("" if "deg" in sample else "; angles follow once the zero is taken")


def head(state: RunState, running: bool, folder: str) -> str:
    """The head of the page: which run, what happens now, how far it is."""
    tone, line = headline(state, running)
    done, planned, left = len(state.done), state.planned, state.left_s()
    share = done / planned if planned else 0.0
    said = f"{done} of {planned} postures" if planned else ""
    said += f", about {left:.0f} s left" if left else ""
    simulated = "<em>simulated</em>" if state.start.get("simulated") else ""
    return (
        f"<h1>{text(state.mode)} {simulated}<small>{text(folder)}</small></h1>"
        f"<p class='now {tone}'>{text(line)}</p>"
        f"<div class='bar'><i style='width:{100 * min(1.0, share):.1f}%'></i></div>"
        f"<p class='note'>{text(said)}</p>"
    )


def queue(state: RunState) -> str:
    """The postures: the present one, those to come, then those done, newest first."""
    postures = list(state.postures.values())
    order = {name: number for number, name in enumerate(state.queue)}
    ahead = [p for p in postures if p.state in ("waiting", *ACTIVE)]
    ahead.sort(key=lambda p: (p.state == "waiting", order.get(p.name, len(order))))
    behind = [p for p in postures if p.state not in ("waiting", *ACTIVE)]
    behind.sort(key=lambda p: -p.time)
    shown = ahead[: SHOWN - min(len(behind), SHOWN // 2)]
    shown += behind[: SHOWN - len(shown)]
    cut = ""
    if len(postures) > SHOWN:
        cut = f"<p class='note'>{len(postures)} in all; those around the present</p>"
    rows = "".join(_row(posture) for posture in shown)
    if not rows:
        return "<p class='note'>No postures yet.</p>"
    return f"<ol class='queue'>{rows}</ol>{cut}"


def _row(posture: Posture) -> str:
    asked = " ".join(angle(value, 2) for value in posture.commanded or [])
    found = " ".join(angle(value, 2) for value in posture.measured or [])
    detail = f"commanded {asked}°" if asked else ""
    if found:
        detail += f"<br>measured {found}°"
    return (
        f"<li class='{posture.state}'><span class='mark'>{MARKS[posture.state]}</span>"
        f"<div><b>{text(posture.title)}</b> <span class='state'>{posture.state}</span>"
        f"<div class='why'>{text(posture.note or posture.why)}</div></div>"
        f"<div class='deg'>{detail}</div></li>"
    )


def uncertainty(state: RunState) -> str:
    """How well the slopes are known by now, and what that means for a posture."""
    chosen = [p for p in state.by_role("select") if p.state == "done"]
    if state.mode != "calibrate":
        return ""
    noise = state.noise_deg
    if len(chosen) < 2 or not math.isfinite(noise):
        return "<p class='note'>Nothing is known yet: two postures give a slope.</p>"
    points = [p.commanded or [] for p in chosen]
    std, _ = ellipsoid(points, noise)
    known = std[np.isfinite(std)]
    words = [f"{len(known)} of 3 directions of the commands measured"]
    if len(known) == 3:
        low, high = 1.96 * known.min(), 1.96 * known.max()
        words = [
            f"slopes of A: ±{low:.1g} to ±{high:.1g} deg/deg (95 %, best and worst)"
        ]
    typical, worst = prediction_std(points, state.candidates or points, noise)
    if math.isfinite(worst):
        words.append(
            f"a predicted posture: ±{1.96 * typical:.4f}° typical, "
            f"±{1.96 * worst:.4f}° worst of the candidates (95 %)"
        )
    words.append(
        f"from the scatter of readings alone: {noise:.4f}° in one posture's mean; the "
        "held-out postures decide"
    )
    return "".join(f"<p>{text(word)}</p>" for word in words)


def verdict(state: RunState, summary: dict[str, Any], report: bool) -> str:
    """The result at the end of a run, as on the console; empty before."""
    if state.ended is None or state.ended["event"] != "end":
        return ""
    lines: list[str] = []
    limit = state.setting("session", "verify_limit_deg")
    if "A" in summary:
        lines = summary_lines(summary, limit)
    elif "before" in summary:
        lines = [f"{error_text(summary)}, limit {limit:g}"]
    elif state.mode == "goto" and state.done:
        found = " ".join(angle(v) for v in state.done[-1].measured or [])
        lines = [f"Reached {found} deg"]
    elif state.mode == "collect":
        lines = [f"{len(state.done)} postures recorded"]
    said = "<h2>Result</h2><pre>" + text("\n".join(lines)) + "</pre>"
    if report:
        said += "<p><a href='/report' target='_blank'>Full report</a></p>"
    return said


def happened(state: RunState, clock: Any) -> str:
    """What happened, newest first; ``clock`` writes a time."""
    rows = (
        f"<li><time>{text(clock(when))}</time> {text(line)}</li>"
        for when, line in reversed(state.log)
    )
    return f"<ul class='log'>{''.join(rows)}</ul>"
