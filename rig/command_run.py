"""A command's run: what the operator asked for, what is said, and how it ends."""

from __future__ import annotations

import contextlib
import pathlib
import threading
from collections.abc import Callable, Iterable, Iterator

from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.core.device import Device
from rig.core.record_check import ZeroRecord
from rig.core.session import SessionRun, open_device, take_zero
from rig.faults import EXIT_FAULT, JournalError, Refused, Signals, ending
from rig.journal.device import DeviceRecord
from rig.journal.run_folder import Record
from rig.outputs.messages import event_lines, numbers
from rig.outputs.run_state import RunState
from rig.outputs.telemetry import telemetry
from rig.parts import model_of


class Run(SessionRun):
    """The folder of a run, and the options of its command."""

    signals: Signals
    again = ""  # the command of a run that is not resumed, but begun again
    kept_zero: ZeroRecord | None = None  # that the zero posture must be
    zero_at: Pulses | None = None  # where it is taken; None: where the device stands

    def __init__(
        self,
        config: RigConfig,
        folder: pathlib.Path,
        mode: str,
        say: Callable[[str], None] = print,
        *,
        record: DeviceRecord,
        start: Record | None = None,
        reset_alarms: bool = False,
        signals: Signals | None = None,
    ) -> None:
        self._say = say
        self.confirm: Callable[[Run], None] = lambda run: None  # before ports open
        self.beside = []
        self.record = record
        self.reset_alarms = reset_alarms
        self.model = model_of(config)  # None: affine
        self.predict = None if self.model is None else self.model.predict
        self.signals = signals or Signals()
        super().__init__(config, folder, mode, start or {})

    def say(self, *lines: str) -> None:
        """Print lines. A terminal that is gone ends the run, but never a stop."""
        try:
            for line in lines:
                self._say(line)
        except OSError:
            self.signals.request_stop("the terminal was closed", EXIT_FAULT)

    @property
    def zero_pulses(self) -> Pulses:
        """Where the zero posture was taken; where drives count 0 before it was."""
        zeros = self.journal.events("zero")
        return tuple(zeros[-1]["pulses"]) if zeros else (0,) * len(self.config.axes)

    def lacks(self, names: Iterable[str]) -> bool:
        """Some of these postures are neither measured nor known to be out of reach."""
        lost = {record["name"] for record in self.journal.events("unreachable")}
        return not lost.union(self.postures()).issuperset(names)

    def armed(self) -> contextlib.AbstractContextManager[Device]:
        """The device, armed once the operator has confirmed it."""
        self.confirm(self)
        return open_device(self)

    @contextlib.contextmanager
    def device(self) -> Iterator[Device]:
        """The device, armed and its zero taken, or Refused."""
        if text := self.record.missing(self.config):
            raise Refused(text)
        with self.armed() as device:
            take_zero(device, self.zero_at, self.kept_zero)
            yield device

    @property
    def to_go_on(self) -> str:
        """What goes on after a pause or a fault."""
        if self.again:
            return self.again
        resume = f"jaxcal-rig resume {self.folder}"
        real = self.journal.records[0].get("simulated") is None  # or it begins anew
        lack = self.record.missing(self.config) if real else None
        return f"{lack}. Then {resume}" if lack else resume


def listen(run: Run) -> None:
    """Print what happens in a run; write what phone and drives say to its files."""
    state = RunState()
    for record in run.journal.records:
        state.apply(record)

    def hear(record: Record) -> None:
        state.apply(record)
        lines = event_lines(record)
        if record["event"] == "posture":
            remaining = f", about {state.left_s():.0f} s left" if state.left_s() else ""
            lines = [
                f"  [{len(state.done):>3}/{state.planned}] {record['name']:<12} "
                f"u [{numbers(record['commanded_deg'], 8, 3)}]  "
                f"y [{numbers(record['measured_deg'], 8, 3)}]{remaining}"
            ]
        if threading.current_thread() is threading.main_thread():
            run.say(*lines)
        elif lines:  # a terminal held by Ctrl-S must not hold the phone's thread too
            threading.Thread(target=run.say, args=lines, daemon=True).start()

    run.listeners.append(hear)
    run.beside.append(telemetry)


def run_safely(run: Run, procedure: Callable[[Run], int]) -> int:
    """Run a procedure, whose drives `open_device` stops whatever happens; say how it
    ended, and return the exit code."""
    moved = len(run.journal.events("command"))
    with run.signals:
        try:
            code, event, reason = procedure(run), "end", ""
        except BaseException as error:
            run.signals.ending = True
            code, event, reason = ending(error, run.folder)
            if event == "refused" and len(run.journal.events("command")) > moved:
                code, event = EXIT_FAULT, "fault"
        run.signals.ending = True
        told = {} if event in ("end", "refused") else {"go_on": run.to_go_on}
        try:
            run.emit(event, sync=True, code=code, reason=reason, **told)
        except JournalError as error:
            run.say(f"the run was cut off (its last line is missing): {error}")
        if event != "end":
            run.say(f"{event}: {reason}")
            if told:
                run.say(f"to continue: {told['go_on']}")
        run.journal.close()
    return code
