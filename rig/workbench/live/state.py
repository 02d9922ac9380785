"""What the page shows of a run, from the records of its journal and nothing else.

``RunState`` takes the records one by one and touches neither files nor clocks, so that
a page that is opened late shows the same as one that was there from the beginning.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

import numpy as np

from rig.config.axis import Scale
from rig.workbench.live.worth import reasons
from rig.workbench.outputs.console import event_lines

Record = dict[str, Any]
Degrees = list[float]  # pitch, yaw, roll
Visit = Literal[
    "waiting", "moving", "settling", "measuring", "done", "unreachable", "withdrawn"
]
ENDS = ("end", "fault", "stopped", "paused", "refused")
KEPT_PHASES = 400  # newest changes of phase: more than the plots show
LOGGED = 200  # newest lines of what happened
SESSIONS = ("calibrate", "collect", "verify", "goto")
LOST = ("unreachable", "withdrawn")
REFERENCES = {"reference:middle", "reference:end"}  # visits of a calibration
ACTIVE = ("moving", "settling", "measuring")


@dataclasses.dataclass
class Posture:
    """One visit of the queue."""

    name: str
    commanded: Degrees | None = None
    state: Visit = "waiting"
    why: str = ""  # this one
    note: str = ""  # why it was left out or withdrawn
    measured: Degrees | None = None
    std: Degrees | None = None  # of single readings, degrees
    samples: int = 0
    time: float = 0.0  # of the end of its measurement

    @property
    def role(self) -> str:
        return self.name.partition(":")[0]

    @property
    def title(self) -> str:
        """The name in words."""
        title, _ = ROLES.get(self.role, (self.name, ""))
        return title.format(self.name.partition(":")[2])


ROLES = {  # of a posture: its title, and why it is visited
    "select": ("posture {}", ""),
    "before": ("target {}, raw", "held out: the error without calibration"),
    "after": ("target {}, compensated", "held out: the error with calibration"),
    "reference": ("zero posture, {}", "the zero again: drift of phone or device"),
    "collect": ("posture {}", "drawn at random"),
    "goto": ("desired posture", "asked for with --to"),
}


@dataclasses.dataclass
class RunState:
    """Everything that the journal says about a run so far."""

    start: Record = dataclasses.field(default_factory=dict)
    sessions: int = 0  # that worked on this run: the first, and each that resumed it
    pid: int | None = None
    host: str = ""
    phase: str = "opening"
    pausing: bool = False  # a pause was asked for: one more SIGINT is a stop
    phases: list[tuple[float, str]] = dataclasses.field(default_factory=list)
    current: str | None = None  # name of the posture being visited
    target: Degrees | None = None  # commanded last
    queue: list[str] = dataclasses.field(default_factory=list)  # left to visit
    postures: dict[str, Posture] = dataclasses.field(default_factory=dict)
    candidates: list[Degrees] = dataclasses.field(default_factory=list)
    choice: Record = dataclasses.field(default_factory=dict)
    zero: Record | None = None
    drift: list[tuple[float, Degrees]] = dataclasses.field(default_factory=list)
    stop: Record | None = None
    ended: Record | None = None
    warnings: list[str] = dataclasses.field(default_factory=list)
    log: list[tuple[float, str]] = dataclasses.field(default_factory=list)
    time: float = 0.0  # of the newest record
    damaged: bool = False  # a record is missing in between

    _seq: int = -1

    # What the records say

    def apply(self, record: Record) -> None:
        """Take the next record."""
        event, now = record.get("event", ""), float(record.get("time", self.time))
        self.damaged |= record.get("seq", 0) != self._seq + 1
        self._seq, self.time = record.get("seq", 0), now
        match event:
            case "start" | "resume":
                self._begin(record)
            case "plan" | "replan":
                self.choice = record["choice"]
                if event == "plan":
                    self.candidates = [self.to_deg(p) for p in record["candidates"]]
                self._plan([f"select:{index}" for index in self.choice["indices"]])
            case "held_out":
                for number, (raw, compensated) in enumerate(record["pairs"]):
                    self._posture(f"before:{number}", raw)
                    self._posture(f"after:{number}", compensated)
            case "collection":
                names = [f"collect:{i}" for i in range(len(record["pulses"]))]
                for name, pulses in zip(names, record["pulses"], strict=True):
                    self._posture(name, pulses)
                self._plan(names)
            case "queue":
                self._plan(record["names"])
            case "pausing":
                self.pausing = True
            case "phase":
                self._enter(record["phase"], now)
            case "visit":
                self.current = record["name"]
                self.target = self.to_deg(record["pulses"])
                self._posture(record["name"], record["pulses"]).state = "moving"
            case "zero":
                self.zero, self.target = record, record["commanded_deg"]
                self.drift = [(now, [0.0, 0.0, 0.0])]
            case "reference":
                self.drift.append((now, record["angles"]))
            case "posture":
                self._measured(record, now)
            case "stand":
                self._stood(record, now)
            case "unreachable":
                self._drop(record["name"], "unreachable", record["reason"])
            case "void":
                for name in record["names"]:
                    self._drop(name, "withdrawn", "recorded while an axis slipped")
            case "stop":
                self.stop = record
            case "sender_refused" | "comm_restored":
                self.warnings += [line.strip() for line in event_lines(record)]
            case _ if event in ENDS:
                self._interrupt()
                self.ended, self.phase = record, event
        if line := self._line(record):
            self.log = [*self.log, (now, line)][-LOGGED:]

    def _begin(self, record: Record) -> None:
        if record["event"] == "start":
            self.start = record
        self.sessions += 1
        self.pid, self.host = record.get("pid"), record.get("host", "")
        self._interrupt()
        self.ended = self.stop = None
        self.pausing = False
        self.phase, self.warnings = "opening", []

    def _interrupt(self) -> None:
        """The posture under way is not measured: it waits again."""
        if self.current is not None and self.postures[self.current].state in ACTIVE:
            self.postures[self.current].state = "waiting"
        self.current = None

    def _enter(self, phase: str, now: float) -> None:
        self.phase = phase
        self.phases = [*self.phases, (now, phase)][-KEPT_PHASES:]
        if self.current is not None and phase in ACTIVE:
            self.postures[self.current].state = phase  # type: ignore[assignment]
            # one of ACTIVE, which are states

    def _measured(self, record: Record, now: float) -> None:
        posture = self._posture(record["name"], record["pulses"])
        posture.state, posture.note, posture.time = "done", "", now
        posture.measured, posture.std = record["measured_deg"], record["std_deg"]
        posture.samples = record["samples"]
        if posture.role == "reference":
            self.drift.append((now, record["measured_deg"]))
        self.current = None
        self._leave_queue(record["name"])

    def _stood(self, record: Record, now: float) -> None:
        """A place of a commissioning step; it has no zero to measure against."""
        posture = self._posture(record["name"], record["pulses"])
        posture.state, posture.time = "done", now
        posture.std, posture.samples = record["std_deg"], record["samples"]
        self.target = posture.commanded

    def _leave_queue(self, name: str) -> None:
        if name in self.queue:
            self.queue.remove(name)

    def _drop(self, name: str, state: Visit, note: str) -> None:
        posture = self._posture(name)
        posture.state, posture.note, posture.time = state, note, self.time
        posture.measured = posture.std = None
        self._leave_queue(name)
        if self.current == name:
            self.current = None

    def _posture(self, name: str, pulses: Any = None) -> Posture:
        posture = self.postures.setdefault(name, Posture(name))
        if pulses is not None:
            posture.commanded = self.to_deg(pulses)
        posture.why = posture.why or ROLES.get(posture.role, ("", ""))[1]
        return posture

    def _plan(self, names: list[str]) -> None:
        """What is left, in the order of visits; what was left before is forgotten."""
        for name in self.queue:
            if self.postures[name].state == "waiting" and name not in names:
                del self.postures[name]
        self.queue = []
        for name in names:
            role, _, number = name.partition(":")
            posture = self._posture(name)
            if role == "select" and self.candidates:
                posture.commanded = self.candidates[int(number)]
            if posture.state in ("waiting", "withdrawn"):
                posture.state = "waiting"
                self.queue.append(name)
        for name in self.queue:  # behind what was visited, in the order of visits
            self.postures[name] = self.postures.pop(name)
        selected = [p for p in self.by_role("select") if p.commanded is not None]
        for posture, why in zip(
            selected, reasons([p.commanded or [] for p in selected]), strict=True
        ):
            posture.why = why

    def _line(self, record: Record) -> str:
        """What is worth a line of the log."""
        match record.get("event"):
            case "start":
                return f"{record.get('mode', 'run')} begun"
            case "resume":
                return "gone on with after an interruption"
            case "replan":
                return "the remaining postures were chosen again"
            case event if event in ENDS and record.get("reason"):
                return f"{event}: {record['reason']}"
        return "; ".join(line.strip() for line in event_lines(record))

    # What follows from it

    def to_deg(self, pulses: Any) -> Degrees:
        """Degrees of (3,) pulses, by the scales in the journal's configuration."""
        scales = [Scale(**axis["scale"]) for axis in self.start["config"]["axes"]]
        pairs = zip(scales, pulses, strict=True)
        return [round(scale.to_deg(count), 6) for scale, count in pairs]

    @property
    def mode(self) -> str:
        return str(self.start.get("mode", ""))

    @property
    def session(self) -> bool:
        """Postures are measured against a zero; a commissioning step has none."""
        return self.mode in SESSIONS

    def setting(self, table: str, key: str, default: Any = math.nan) -> Any:
        """A value of the run's configuration."""
        return self.start.get("config", {}).get(table, {}).get(key, default)

    def by_role(self, *roles: str) -> list[Posture]:
        """Postures that stand (not those out of reach or withdrawn), as visited."""
        return [
            posture
            for posture in self.postures.values()
            if posture.role in roles and posture.state not in LOST
        ]

    @property
    def done(self) -> list[Posture]:
        """What was measured, in the order of measurement."""
        found = [p for p in self.postures.values() if p.state == "done"]
        return sorted(found, key=lambda posture: posture.time)

    @property
    def planned(self) -> int:
        """Visits of the whole run, as far as is known."""
        known = sum(p.state not in LOST for p in self.postures.values())
        if self.mode != "calibrate" or self.ended is not None:
            return known
        pairs = self.setting("session", "verify_postures", 0)
        known += 0 if self.by_role("before") else 2 * pairs
        return known + len(REFERENCES - self.postures.keys())

    @property
    def noise_deg(self) -> float:
        """Standard deviation of one posture's mean, from the scatter of readings."""
        squares = [
            s * s / max(1, p.samples)
            for p in self.done
            for s in (p.std or [])
            if p.role in ("select", "collect")
        ]
        return math.sqrt(float(np.mean(squares))) if squares else math.nan

    def left_s(self) -> float | None:
        """Seconds to the end, from the pace so far."""
        times = [posture.time for posture in self.done]
        if len(times) < 2 or self.ended is not None:
            return None
        pace = (times[-1] - times[0]) / (len(times) - 1)
        return pace * max(0, self.planned - len(times))
