"""One run: opens everything, visits postures once each, closes everything stopped.

A run is a fixed sequence of visits with names. A visit that the journal holds already
is taken from there, so resuming is running the same sequence again.
"""

from __future__ import annotations

import datetime
import json
import pathlib
import platform
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.files import write_text
from rig.attitude import Array, Frame
from rig.config.settings import AXIS_NAMES, Pulses, RigConfig
from rig.device.bus import Bus
from rig.device.imu import Imu
from rig.guard.faults import (
    EXIT_FAULT,
    MotionFault,
    NotFollowing,
    Refused,
    Unreachable,
)
from rig.guard.limits import check_plan
from rig.guard.signals import Signals
from rig.guard.stop import Stopper, UnitStop
from rig.outputs.console import numbers
from rig.outputs.journal import Journal, JournalError
from rig.session.measuring import Measurement
from rig.session.motion import Motion

__all__ = ["DRY_RUN", "JOURNAL", "Record", "Run", "new_run_folder"]

JOURNAL = "journal.jsonl"
DRY_RUN = "dry run: nothing was sent to the bus"
STREAM_WAIT_S = 60.0  # time to start the app on the phone
ZERO_FACTOR = 4  # readings of the zero posture, in those of a posture

Record = dict[str, Any]  # of the journal
Say = Callable[[str], None]


def new_run_folder(output: pathlib.Path, mode: str) -> pathlib.Path:
    """Make ``output/mode-date-time``, never an existing one."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    for number in range(100):
        path = output / (f"{mode}-{stamp}" + (f"-{number}" if number else ""))
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise Refused(f"cannot make {path}: {error.strerror or error}") from None
        return path
    raise Refused(f"cannot make a new run under {output}")


class Run:
    """Journal, devices and visits of one run."""

    def __init__(
        self,
        config: RigConfig,
        folder: pathlib.Path,
        mode: str,
        say: Say = print,
        *,
        start: dict[str, Any] | None = None,
        reset_alarms: bool = False,
        on_imu_port: Callable[[int], None] | None = None,
        zero_at: Pulses | None = None,
    ) -> None:
        self.config = config
        self.folder = folder
        self.mode = mode
        self._say = say
        self.phase_listeners: list[Callable[[str], None]] = []
        self.confirm: Callable[[Run], None] = lambda run: None
        self.motion: Motion | None = None
        self.frame: Frame | None = None
        self.zero_pulses: Pulses | None = None
        self.zero_at = zero_at
        self.signals = Signals(self.say)
        self.planned = 0
        self._visited = 0
        self._visit_s: list[float] = []
        self._reset_alarms = reset_alarms
        self._on_imu_port = on_imu_port
        self._bus: Bus | None = None
        self._imu: Imu | None = None
        self._phase_name = ""
        self.journal = Journal(folder / JOURNAL)
        try:
            self._begin(start or {})
        except BaseException:
            self.journal.close()
            raise

    def _begin(self, extra: dict[str, Any]) -> None:
        fingerprint = self.config.fingerprint()
        starts = self.journal.events("start")
        if starts:
            if starts[0]["fingerprint"] != fingerprint:
                raise Refused(
                    f"{self.folder}: the configuration changed since this run began "
                    "(only the addresses of bus and phone may). Start a new run"
                )
            if starts[0]["mode"] != self.mode:
                raise Refused(f"{self.folder} is a {starts[0]['mode']} run")
            self.journal.write("resume", sync=True, **_provenance())
            zeros = self.journal.events("zero")
            if zeros:
                self._set_zero(zeros[-1])
            return
        self.journal.write(
            "start",
            sync=True,
            schema=1,
            mode=self.mode,
            fingerprint=fingerprint,
            config=self.config.described(),
            **_provenance(),
            **extra,
        )

    def say(self, text: str) -> None:
        """Print a line. A terminal that is gone ends the run, but never a stop."""
        try:
            self._say(text)
        except OSError:
            self.signals.request_stop("the terminal is gone", EXIT_FAULT)

    # Memory

    def remember(
        self, event: str, make: Callable[[], dict[str, Any]]
    ) -> dict[str, Any]:
        """The record of an event, made and journalled on first use only."""
        known = self.journal.events(event)
        return known[0] if known else self.journal.write(event, sync=True, **make())

    def posture(self, name: str) -> dict[str, Any] | None:
        """The record of a posture, or None where it has not been measured."""
        return self.postures().get(name)

    def postures(self) -> dict[str, dict[str, Any]]:
        """Every posture measured and not made void since, by name, in order."""
        found: dict[str, dict[str, Any]] = {}
        for record in self.journal.records:
            if record["event"] == "posture":
                found[record["name"]] = record
            elif record["event"] == "void":
                for name in record["names"]:
                    found.pop(name, None)
        return found

    def unreachable(self, name: str) -> bool:
        """Whether a posture was found out of reach."""
        return any(r["name"] == name for r in self.journal.events("unreachable"))

    # Phases

    def phase(self, name: str) -> None:
        """Tell everybody which phase begins."""
        if name != self._phase_name:
            self._phase_name = name
            self.journal.write("phase", phase=name)
        for listener in self.phase_listeners:
            listener(name)

    # Devices

    def ready(self) -> Motion:
        """Open, arm and zero; on a resumed run check the zero posture instead.

        Raises:
            MotionFault, BusError, ImuError: not fit to move.
        """
        if self.motion is not None:
            return self.motion
        config = self.config
        self.confirm(self)
        # On Modbus TCP the gateway keeps the line's silence.
        silence = 0.0 if config.bus.transport == "tcp" else config.silence_s
        self._imu = Imu(config.imu).open()
        self.say(
            f"IMU: waiting for the phone on port {self._imu.port} ({config.imu.format})"
        )
        if self._on_imu_port is not None:
            self._on_imu_port(self._imu.port)
        self._bus = Bus(config.bus, silence)
        self._bus.on_frame = self._log_frame
        self._bus.open()
        self._imu.wait_for_stream(STREAM_WAIT_S)
        stopper = Stopper([], self._report_stop)
        self.signals.armed = True
        self.motion = Motion(
            config, self._bus, self._imu, self.signals, stopper, self._log, self.phase
        )
        self.motion.arm(self._reset_alarms)
        self.say(f"armed: {len(self.motion.drives)} drives on {config.bus.where}")
        if self.frame is None or self.zero_pulses is None or not self.postures():
            self._zero(self.motion)
        else:
            self.motion.observer.zeroed(self.frame, self.zero_pulses)
            self._check_reference(self.motion, self.zero_pulses)
        return self.motion

    def _zero(self, motion: Motion) -> None:
        """Take the zero, also again where nothing was measured against it yet."""
        self.phase("zeroing")
        target = self.zero_at or self.zero_pulses
        if target is None and self.config.session.zero == "drive":
            target = (0, 0, 0)
        if target is not None:
            motion.move_to(target, "zero")
        else:
            target = motion.positions()
        check_plan(self.config, [target])  # it is where a resumed run looks again
        # Every posture is measured against this one, so its noise must be the smaller.
        samples = ZERO_FACTOR * self.config.settle.samples
        measured = motion.observer.measure(target, "zero", samples)
        record = self.journal.write(
            "zero",
            sync=True,
            pulses=list(measured.pulses),
            attitude=_rounded(measured.attitude, 12),
            std_deg=_rounded(measured.std, 6),
            samples=measured.samples,
        )
        self._set_zero(record)
        assert self.frame is not None
        motion.observer.zeroed(self.frame, measured.pulses)
        self.say(f"zero taken at pulses {list(measured.pulses)}")

    def _set_zero(self, record: dict[str, Any]) -> None:
        a, b, c = (int(value) for value in record["pulses"])
        self.zero_pulses = (a, b, c)
        self.frame = Frame(
            np.array(record["attitude"]),
            self.config.imu.mounting,
            self.config.mechanism.order,
            self.config.letters,
        )

    def _check_reference(self, motion: Motion, zero: Pulses) -> None:
        """Before a resumed run goes on: the zero posture must still read zero."""
        motion.move_to(zero, "reference")
        measured = motion.observer.measure(zero, "reference")
        worst = float(np.abs(measured.angles).max())
        limit = self.config.session.reference_tolerance_deg
        self.journal.write(
            "reference", sync=True, angles=_rounded(measured.angles, 9), limit=limit
        )
        if worst > limit:
            raise MotionFault(
                f"the zero posture now reads {worst:.3f} deg away from zero (limit "
                f"{limit:g}): the phone or the device was moved. Start a new run"
            )
        self.say(f"reference posture reads {worst:.3f} deg from zero: going on")

    # Visits

    def visit(self, name: str, pulses: Any, **fields: Any) -> dict[str, Any] | None:
        """Measure a posture, once in the life of the run.

        Returns:
            Its record; None where it is out of reach.

        Raises:
            PauseRequested: between postures, after Ctrl-C.
        """
        known = self.posture(name)
        if known is not None:
            self._visited += 1
            return known
        if self.unreachable(name):
            return None
        motion = self.ready()
        self.signals.check_pause()
        target = (int(pulses[0]), int(pulses[1]), int(pulses[2]))
        begun = time.monotonic()
        try:
            motion.move_to(target, name)
            measured = motion.observer.measure(target, name)
        except NotFollowing as fault:
            if fault.suspects:
                self.journal.write("void", sync=True, names=fault.suspects)
                self.say(
                    f"  withdrawn, to be measured again: {', '.join(fault.suspects)}"
                )
            raise
        except Unreachable as reason:
            motion.stopper.stop(str(reason), latch=False)
            if not all(result.standing for result in motion.stopper.results):
                raise MotionFault(f"{reason}, and not all drives stand") from None
            self.journal.write("unreachable", sync=True, name=name, reason=str(reason))
            self.say(f"  {name} is out of reach: {reason}")
            return None
        record = self._record(name, measured, fields)
        self._visited += 1
        self._visit_s.append(time.monotonic() - begun)
        self._progress(record)
        self.signals.check_pause()
        return record

    def _record(
        self, name: str, measured: Measurement, fields: dict[str, Any]
    ) -> dict[str, Any]:
        self.phase("saving")
        return self.journal.write(
            "posture",
            sync=True,
            name=name,
            pulses=list(measured.pulses),
            feedback=list(measured.feedback),
            commanded_deg=_rounded(self.config.to_deg(measured.pulses), 9),
            measured_deg=_rounded(measured.angles, 9),
            std_deg=_rounded(measured.std, 6),
            samples=measured.samples,
            attitude=_rounded(measured.attitude, 12),
            raw_deg=_rounded(measured.raw, 5),
            **fields,
        )

    def _progress(self, record: dict[str, Any]) -> None:
        left = max(0, self.planned - self._visited)
        eta = left * float(np.mean(self._visit_s[-10:]))
        self.say(
            f"  [{self._visited:>3}/{self.planned}] {record['name']:<12} "
            f"u [{numbers(record['commanded_deg'], 8, 3)}]  "
            f"y [{numbers(record['measured_deg'], 8, 3)}]  {self._visit_s[-1]:5.2f} s, "
            f"about {eta:.0f} s left"
        )

    # Results

    def save_pairs(self) -> None:
        """Write pairs.csv: role, commands, measurements, scatter of every posture."""
        columns = ["name", "role"]
        for what in ("pulses", "u_deg", "y_deg", "std_deg"):
            columns += [f"{what}_{axis}" for axis in AXIS_NAMES]
        lines = [",".join([*columns, "samples"])]
        for r in self.postures().values():
            values = r["pulses"] + r["commanded_deg"] + r["measured_deg"] + r["std_deg"]
            fields = [r["name"], r.get("role", ""), *(repr(v) for v in values)]
            lines.append(",".join([*fields, str(r["samples"])]))
        write_text(self.folder / "pairs.csv", "\n".join(lines) + "\n")

    def save_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json."""
        write_text(self.folder / "summary.json", json.dumps(summary, indent=1))

    # Log and stop

    def _log(self, event: str, **fields: Any) -> None:
        self.journal.write(event, **fields)

    def _log_frame(self, event: str, fields: dict[str, Any]) -> None:
        try:
            self.journal.write(event, **fields)
        except JournalError:
            return  # a full disk must not keep a stop from the bus; "command" raises

    def _report_stop(self, reason: str, results: list[UnitStop]) -> None:
        self.say(f"stop: {reason or 'end of run'}")
        for result in results:
            self.say(f"  {result}")
        self._log_frame(
            "stop", {"reason": reason, "units": [vars(result) for result in results]}
        )

    def stop(self, reason: str, latch: bool = True) -> bool:
        """Stop every unit; whether each acknowledged and stands."""
        motion = self.motion
        if motion is None:
            return True
        results = motion.stopper.stop(reason, latch)
        return all(result.acknowledged and result.standing for result in results)

    def disarm(self) -> None:
        """Nothing more will move: close the bus and the IMU, free the signals."""
        if self.motion is not None:
            self.motion.heartbeat.close()
            self.motion.armed = False
        if self._bus is not None:
            self._bus.close()
        if self._imu is not None:
            self._imu.close()
        self._bus = self._imu = None
        self.motion = None
        self.signals.armed = False

    def close(self) -> None:
        """Let go of everything."""
        self.disarm()
        self.journal.close()


def _provenance() -> dict[str, Any]:
    import jaxcal

    return {
        "jaxcal": jaxcal.__version__,
        "python": platform.python_version(),
        "host": platform.node(),
        "arguments": sys.argv[1:],
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _rounded(values: Array, digits: int) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), digits).tolist()
