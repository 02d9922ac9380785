"""One run: opens everything, visits postures once each, closes everything stopped.

A run is a fixed sequence of visits with names. A visit that the journal holds already
is taken from there, so resuming is running the same sequence again.
"""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.attitude import Frame
from rig.config.axis import Pulses
from rig.config.config import RigConfig
from rig.device.bus import Bus
from rig.device.imu import Imu
from rig.guard.faults import (
    EXIT_FAULT,
    MotionFault,
    NotFollowing,
    Unreachable,
)
from rig.guard.limits import check_plan
from rig.guard.signals import Signals
from rig.guard.stop import Stopper, UnitStop
from rig.outputs.console import numbers
from rig.outputs.journal import JournalError
from rig.session.folder import Record, RunFolder, rounded
from rig.session.motion import Motion

DRY_RUN = "dry run: nothing was sent to the bus"
STREAM_WAIT_S = 60.0  # time to start the app on the phone
ZERO_FACTOR = 4  # readings of the zero posture, in those of a posture

Say = Callable[[str], None]


class Run(RunFolder):
    """Devices and visits of one run."""

    def __init__(
        self,
        config: RigConfig,
        folder: pathlib.Path,
        mode: str,
        say: Say = print,
        *,
        start: Record | None = None,
        reset_alarms: bool = False,
        on_imu_port: Callable[[int], None] | None = None,
        zero_at: Pulses | None = None,
    ) -> None:
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
        super().__init__(config, folder, mode, start or {})
        for record in self.journal.events("zero")[-1:]:
            self._set_zero(record)

    def say(self, text: str) -> None:
        """Print a line. A terminal that is gone ends the run, but never a stop."""
        try:
            self._say(text)
        except OSError:
            self.signals.request_stop("the terminal is gone", EXIT_FAULT)

    # Phases

    def phase(self, name: str) -> None:
        """Journal which phase begins, and tell the listeners."""
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
            attitude=rounded(measured.attitude, 12),
            std_deg=rounded(measured.std, 6),
            samples=measured.samples,
        )
        self._set_zero(record)
        assert self.frame is not None
        motion.observer.zeroed(self.frame, measured.pulses)
        self.say(f"zero taken at pulses {list(measured.pulses)}")

    def _set_zero(self, record: Record) -> None:
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
            "reference", sync=True, angles=rounded(measured.angles, 9), limit=limit
        )
        if worst > limit:
            raise MotionFault(
                f"the zero posture now reads {worst:.3f} deg away from zero (limit "
                f"{limit:g}): the phone or the device was moved. Start a new run"
            )
        self.say(f"reference posture reads {worst:.3f} deg from zero: going on")

    # Visits

    def visit(self, name: str, pulses: Any, **fields: Any) -> Record | None:
        """Measure a posture, once in the life of the run.

        Returns:
            Its record; None where it is out of reach.

        Raises:
            PauseRequested: between postures, after Ctrl-C.
        """
        known = self.postures().get(name)
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
        self.phase("saving")
        record = self.record_posture(name, measured, fields)
        self._visited += 1
        self._visit_s.append(time.monotonic() - begun)
        self._progress(record)
        self.signals.check_pause()
        return record

    def _progress(self, record: Record) -> None:
        left = max(0, self.planned - self._visited)
        eta = left * float(np.mean(self._visit_s[-10:]))
        self.say(
            f"  [{self._visited:>3}/{self.planned}] {record['name']:<12} "
            f"u [{numbers(record['commanded_deg'], 8, 3)}]  "
            f"y [{numbers(record['measured_deg'], 8, 3)}]  {self._visit_s[-1]:5.2f} s, "
            f"about {eta:.0f} s left"
        )

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

    def stop(self, reason: str, latch: bool = True) -> None:
        """Stop every unit."""
        if self.motion is not None:
            self.motion.stopper.stop(reason, latch)

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
        """Close devices and journal."""
        self.disarm()
        self.journal.close()
