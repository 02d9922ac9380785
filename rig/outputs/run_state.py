"""What console, page and report show of a run, from the records of its journal."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from rig.config.axis import Scale
from rig.config.config import names_of, units_of
from rig.journal.run_folder import Record
from rig.outputs.messages import ENDS, event_lines

Degrees = list[float]  # in the order of the axes, or of what is measured
LOGGED = 200  # newest lines of what happened
SESSIONS = ("calibrate", "collect", "verify", "goto")  # the others are commissioning
LOST = ("unreachable", "withdrawn")
ACTIVE = ("moving", "settling", "measuring")
TITLES = {  # of a posture, by its role
    "select": "posture {}",
    "before": "target {}, raw",
    "after": "target {}, compensated",
    "held": "target {}",
    "reference": "zero posture, {}",
    "collect": "posture {}",
    "goto": "desired posture",
}


def roles_of(held: Sequence[Any]) -> tuple[str, ...]:
    """Roles of the visits of a held-out target: raw and compensated, or one."""
    return ("before", "after") if len(held) == 2 else ("held",)


@dataclasses.dataclass
class PostureState:
    """One visit."""

    name: str  # "role:number"
    commanded: Degrees | None = None
    state: str = "waiting"  # or one of ACTIVE and LOST, or "done"
    note: str = ""  # why it was left out or withdrawn
    measured: Degrees | None = None
    std: Degrees | None = None  # of single readings
    time: float = 0.0  # of the end of its measurement

    @property
    def role(self) -> str:
        return self.name.partition(":")[0]

    @property
    def title(self) -> str:
        return TITLES.get(self.role, self.name).format(self.name.partition(":")[2])


@dataclasses.dataclass
class RunState:
    """Everything that the journal says about a run so far."""

    start: Record = dataclasses.field(default_factory=dict)
    pid: int | None = None
    host: str = ""
    phase: str = "opening"
    pausing: bool = False  # a pause was asked for
    current: str | None = None  # name of the posture being visited
    target: Degrees | None = None  # commanded last
    postures: dict[str, PostureState] = dataclasses.field(default_factory=dict)
    candidates: list[Degrees] = dataclasses.field(default_factory=list)
    drift: list[tuple[float, Degrees]] = dataclasses.field(default_factory=list)
    stop: Record | None = None
    last_move: Record | None = None  # at a fault: from where to where, and what is seen
    ended: Record | None = None
    warnings: list[str] = dataclasses.field(default_factory=list)
    log: list[tuple[float, str]] = dataclasses.field(default_factory=list)
    time: float = 0.0  # of the newest record
    damaged: bool = False  # a record is missing in between
    _seq: int = -1

    def apply(self, record: Record) -> None:
        """Take the next record. One that was edited by hand, say, is left out."""
        try:
            self._apply(record)
        except (KeyError, ValueError, TypeError, IndexError):
            self.damaged = True

    def _apply(self, record: Record) -> None:
        event, now = record.get("event", ""), float(record.get("time", self.time))
        self.damaged |= record.get("seq", 0) != self._seq + 1
        self._seq, self.time = record.get("seq", 0), now
        match event:
            case "start" | "resume":
                self.start = record if event == "start" else self.start
                self.pid, self.host = record.get("pid"), record.get("host", "")
                self._interrupt()
                self.ended = self.stop = self.last_move = None
                self.phase, self.pausing, self.warnings = "opening", False, []
            case "plan" | "replan":
                self._plan(record)
            case "held_out":
                for number, pair in enumerate(record["pairs"]):
                    for role, pulses in zip(roles_of(pair), pair, strict=True):
                        self._posture(f"{role}:{number}", pulses)
            case "collection":
                for number, pulses in enumerate(record["pulses"]):
                    self._posture(f"collect:{number}", pulses)
            case "queue":
                for name in record["names"]:
                    posture = self.postures.pop(name, None) or PostureState(name)
                    if posture.state in LOST:
                        posture.state, posture.note = "waiting", ""
                    self.postures[name] = posture
            case "pausing":
                self.pausing = True
            case "phase":
                self.phase = record["phase"]
                if self.current is not None and self.phase in ACTIVE:
                    self.postures[self.current].state = self.phase
            case "visit":
                self.current = record["name"]
                posture = self._posture(record["name"], record["pulses"])
                posture.state, self.target = "moving", posture.commanded
            case "zero":
                self.target = record["commanded_deg"]
                self.drift = [(now, [0.0] * len(self.names[1]))]
            case "reference":
                self.drift.append((now, record["angles"]))
            case "posture" | "stand":  # a stand, of commissioning, is against no zero
                self._measured(record, now)
            case "unreachable":
                self._lose([record["name"]], event, record["reason"], now)
            case "void":
                note = "an axis slipped, perhaps before this measurement"
                self._lose(record["names"], "withdrawn", note, now)
            case "stop":
                self.stop = record
            case "stayed" if self.stop:
                self.stop = self.stop | {"units": record["units"]}
            case "last_move":
                self.last_move = record
            case "sender_refused" | "comm_restored":
                self.warnings += [line.strip() for line in event_lines(record)]
            case _ if event in ENDS:
                self._interrupt()
                self.ended, self.phase = record, event
        lines = event_lines(record)
        if event in ENDS and record["reason"]:
            lines = [f"{event}: {record['reason']}"]
        if lines:
            line = "; ".join(line.strip() for line in lines)
            self.log = [*self.log, (now, line)][-LOGGED:]

    def _plan(self, record: Record) -> None:
        """Postures that were selected take the place of those that still wait."""
        points = [self.to_deg(p) for p in record.get("candidates", [])]
        self.candidates = points or self.candidates
        for name, visited in [*self.postures.items()]:
            if visited.role == "select" and visited.state == "waiting":
                del self.postures[name]
        for index in record["choice"]["indices"]:
            self._posture(f"select:{index}").commanded = self.candidates[index]

    def _measured(self, record: Record, now: float) -> None:
        """A posture is done."""
        posture = self._posture(record["name"], record["pulses"])
        posture.state, posture.note, posture.time = "done", "", now
        posture.measured = record.get("measured_deg")
        posture.std = record["std_deg"]
        self.current, self.target = None, posture.commanded
        if posture.role == "reference":
            self.drift.append((now, record["measured_deg"]))

    def _lose(self, names: Sequence[str], state: str, note: str, now: float) -> None:
        """Postures are left out or withdrawn, and whatever was measured there."""
        for name in names:
            commanded = self._posture(name).commanded
            self.postures[name] = PostureState(name, commanded, state, note, time=now)
            self.current = None if self.current == name else self.current

    def _interrupt(self) -> None:
        """The posture under way is not measured: it waits again."""
        if self.current is not None and self.postures[self.current].state in ACTIVE:
            self.postures[self.current].state = "waiting"
        self.current = None

    def _posture(self, name: str, pulses: Any = None) -> PostureState:
        posture = self.postures.setdefault(name, PostureState(name))
        if pulses is not None:
            posture.commanded = self.to_deg(pulses)
        return posture

    def to_deg(self, pulses: Any) -> Degrees:
        """Degrees of (n,) pulses, by the scales in the journal's configuration."""
        scales = [Scale.of(axis) for axis in self.start["config"]["axes"]]
        pairs = zip(scales, pulses, strict=True)
        return [round(scale.to_deg(count), 6) for scale, count in pairs]

    def present(self, sample: Record, running: bool) -> dict[str, Degrees | None]:
        """commanded, drives, measured and std: by telemetry, or as measured last."""
        if not running and self.done:
            last = self.done[-1]
            asked, found, std = last.commanded, last.measured, last.std
        else:
            asked, found, std = self.target, sample.get("deg"), sample.get("std")
        drives = sample.get("drives")
        return {"commanded": asked, "drives": drives, "measured": found, "std": std}

    @property
    def names(self) -> tuple[list[str], list[str]]:
        """Names of the axes, and of what is measured."""
        return names_of(self.start.get("config", {}))

    @property
    def axis_unit(self) -> str:
        """Unit of the commands."""
        return units_of(self.start.get("config", {}))[0]

    @property
    def unit(self) -> str:
        """Unit of what is measured."""
        return units_of(self.start.get("config", {}))[1]

    @property
    def mode(self) -> str:
        return str(self.start.get("mode", ""))

    def setting(self, table: str, key: str, default: Any) -> Any:
        return self.start.get("config", {}).get(table, {}).get(key, default)

    @property
    def done(self) -> list[PostureState]:
        """What was measured, in the order of measurement."""
        found = [p for p in self.postures.values() if p.state == "done"]
        return sorted(found, key=lambda posture: posture.time)

    @property
    def planned(self) -> int:
        """Visits of the whole run, as far as is known."""
        roles = [p.role for p in self.postures.values() if p.state not in LOST]
        if self.mode != "calibrate" or self.ended is not None:
            return len(roles)
        targets = self.setting("session", "verify_postures", 0)
        visits = targets * (1 if self.start.get("config", {}).get("model") else 2)
        if "before" in roles or "held" in roles:
            visits = 0
        return len(roles) + visits + 2 - roles.count("reference")

    def left_s(self) -> float:
        """Seconds to the end, from the pace so far; 0 where it is not known."""
        times = [posture.time for posture in self.done]
        if len(times) < 2 or self.ended is not None:
            return 0.0
        pace = (times[-1] - times[0]) / (len(times) - 1)
        return pace * max(0, self.planned - len(times))
