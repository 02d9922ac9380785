"""One run: opens everything, visits postures once each, closes everything stopped.

A run is a fixed sequence of visits with names. A visit that the journal holds already
is taken from there, so resuming is running the same sequence again.
"""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.core.attitude import Array, Frame, angle_between_deg, frame_at
from rig.core.bus import Bus
from rig.core.device import Device, check_plan, timeouts_left
from rig.core.faults import (
    EXIT_BAD_INPUT,
    EXIT_FAULT,
    EXIT_OK,
    EXIT_PAUSED,
    Fault,
    MotionFault,
    NotFollowing,
    PauseRequested,
    PlanOnly,
    Refused,
    Requests,
    StopRequested,
    Unreachable,
)
from rig.core.lock import BusLock
from rig.core.measure import Observer
from rig.core.motion import Motion
from rig.core.phone import Imu
from rig.core.record import ZEROED, DeviceRecord, check_drives, leave
from rig.core.zero import KeptZero, axes_text, check_zero, heading_turn
from rig.journal import JournalError, Record, RunFolder

STREAM_WAIT_S = 60.0  # time to start the app on the phone
LEAST_TURN_DEG = 0.05  # of the phone's heading: less is its noise
ZERO_FACTOR = 4  # readings of the zero posture, in those of a posture


class Attached(Protocol):
    """What runs beside a session while its ports are open."""

    def close(self) -> None: ...


class Run(RunFolder):
    """Device and visits of one run."""

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
        zero_at: Pulses | None = None,
        kept_zero: KeptZero | None = None,
        dry_run: bool = False,
        signals: Requests | None = None,
    ) -> None:
        self._say = say
        self.confirm: Callable[[Run], None] = lambda run: None  # before ports open
        self.on_imu_port: Callable[[int], object] = lambda port: None
        # Called with run and device once its ports are open; closed before they are.
        self.attachments: list[Callable[[Run, Device], Attached]] = []
        self._attached: list[Attached] = []
        self.device: Device | None = None
        self.frame: Frame | None = None
        self.zero_pulses: Pulses | None = None
        self.record = record
        self.zero_at = zero_at
        self.kept_zero = kept_zero
        self.dry_run = dry_run
        self.signals = signals or Requests()
        self.signals.report = self.emit
        self.planned = 0
        self._visited = 0
        self._visit_s: list[float] = []
        self._reset_alarms = reset_alarms
        super().__init__(config, folder, mode, start or {})
        for zero in self.journal.events("zero")[-1:]:
            self._set_zero(zero)

    def say(self, *lines: str) -> None:
        """Print lines. A terminal that is gone ends the run, but never a stop."""
        try:
            for line in lines:
                self._say(line)
        except OSError:
            self.signals.request_stop("the terminal is gone", EXIT_FAULT)

    # The device

    def ready(self) -> Device:
        """Open, arm and zero, once; on a resumed run check the zero posture instead.

        Raises:
            Refused: the device is not known well enough; no port was opened.
            MotionFault, BusError, ImuError: not fit to move.
            PlanOnly: this is a dry run.
        """
        if self.dry_run:
            raise PlanOnly
        if self.device is not None:
            return self.device
        if text := self.record.missing(self.config):
            raise Refused(text)
        device = self.arm()
        if self.frame is None or self.zero_pulses is None or not self.postures():
            self._zero(device)
        else:
            self.observer.zeroed(self.frame, self.zero_pulses)
            self._check_reference(self.zero_pulses)
        return device

    def check_device(self, device: Device) -> None:
        """Read from the drives what must hold before they are armed."""
        check_drives(self.config, device.drives, self.record)

    def arm(self) -> Device:
        """Open bus and phone and arm; MotionFault, BusError, ImuError: not fit."""
        config = self.config
        self.confirm(self)
        # One that came while something was computed may have been raised in a callback
        # that drops exceptions, as those of a garbage collection are.
        self.signals.check_stop()
        imu = Imu(config.imu, report=self.emit)
        bus = Bus(config.bus, config.silence_s, self.emit)
        left = timeouts_left(self.journal.records)
        self.device = device = Device(config, bus, imu, self.signals, self.emit, left)
        imu.open()
        self.say(f"IMU: waiting for the phone on port {imu.port} ({config.imu.format})")
        self.on_imu_port(imu.port)
        bus.open()
        self.check_device(self.device)
        self._attached = [attach(self, device) for attach in self.attachments]
        imu.wait_for_stream(STREAM_WAIT_S)
        BusLock(config.bus).leave(config)
        self.signals.armed = True
        self.device.arm(self._reset_alarms)
        # Where they stand is not known until they do again.
        homed = [d.axis.name for d in device.drives if d.last and d.homed(d.last.word)]
        self.record.left_at(homed=homed)
        self.motion, self.observer = Motion(self.device), Observer(self.device)
        self.say(f"armed: {len(config.axes)} drives on {config.bus.where}")
        return self.device

    def _zero(self, device: Device) -> None:
        """Take the zero, also again where nothing was measured against it yet."""
        self.emit("phase", phase="zeroing")
        target = self.zero_at or self.zero_pulses
        if target is None and self.config.session.zero == "drive":
            target = (0, 0, 0)
        here, target = target is None, target or device.positions()
        if not here or self.config.motion.approach_overshoot_deg:
            self.motion.move_to(target, "zero")  # from the side of all references
        check_plan(self.config, [target])  # it is where a resumed run looks again
        # Every posture is measured against this one, so its noise must be the smaller.
        samples = ZERO_FACTOR * self.config.settle.samples
        while True:
            count = device.imu.connections
            measured = self.observer.measure(target, "zero", samples)
            if device.imu.connections == count:
                break
        self._compare_zero(target, np.array(measured["attitude"]))
        record = self.emit("zero", sync=True, **measured)
        self.observer.zeroed(self._set_zero(record), target)

    def _compare_zero(self, pulses: Pulses, attitude: Array) -> None:
        """With the calibration's zero posture, or else with the last one taken."""
        config, known = self.config, self.record.state(ZEROED)
        if self.kept_zero is not None:
            self.say(self.kept_zero.check(config, pulses, attitude))
        elif known:
            then = np.array(known["attitude"])
            last = KeptZero("the last session", known["pulses"], then)
            try:
                last.check(config, pulses, attitude)
            except MotionFault as fault:  # a phone mounted anew is calibrated anew
                self.say(f"WARNING: {fault}")
        zero = {"pulses": list(pulses), "attitude": attitude.tolist()}
        self.record.reach(ZEROED, config, **zero)

    def _set_zero(self, record: Record) -> Frame:
        a, b, c = record["pulses"]
        self.zero_pulses = (a, b, c)
        self.frame = frame_at(self.config, np.array(record["attitude"]))
        return self.frame

    def _check_reference(self, zero: Pulses) -> None:
        """Before a resumed run goes on: the zero posture must still read zero."""
        self.motion.move_to(zero, "reference")
        measured = self.observer.measure(zero, "reference")
        angles = measured["measured_deg"]
        worst = max(map(abs, angles))
        limit = self.config.session.reference_tolerance_deg
        self.emit("reference", sync=True, angles=angles, limit=limit)
        if worst > limit:
            raise MotionFault(
                f"the zero posture of this run has moved: {axes_text(angles)} (limit "
                f"{limit:g}): the drives lost their origin, or the phone or the device "
                "was moved. Start a new run"
            )
        self.say(f"reference posture reads {worst:.3f} deg from zero: going on")

    def _reorient(self, device: Device) -> None:
        """Read the zero again where the phone came back on a new connection.

        Its world may have turned about the vertical since; later readings are turned
        back, so that one frame holds for the whole run.

        Raises:
            MotionFault: the zero posture is elsewhere in another way than that.
        """
        while not device.oriented:
            assert self.frame is not None and self.zero_pulses is not None
            count = device.imu.connections
            self.emit("imu_reconnected", sync=True, connection=count)
            device.frame = None  # no comparison with the drives before it is known
            self.motion.move_to(self.zero_pulses, "reference")
            found = self.observer.measure(self.zero_pulses, "reference")
            if device.imu.connections != count:
                continue
            now = np.array(found["attitude"])
            told = check_zero(self.config, self.frame.zero, now, "this run")
            turn = heading_turn(self.config, self.frame.zero, now)
            if (turned := angle_between_deg(np.eye(3), turn)) > LEAST_TURN_DEG:
                device.imu.turn(turn)
            self.observer.zeroed(self.frame, self.zero_pulses)
            self.emit(
                "reoriented", sync=True, turned_deg=round(turned, 4),
                world=device.imu.world.tolist(),
            )  # fmt: skip
            self.say(
                f"the phone came back, its heading turned {turned:.3f} deg: {told}"
            )

    # Visits

    def visit(self, name: str, pulses: Any, **fields: Any) -> Record | None:
        """Measure a posture, once in the life of the run; None where out of reach."""
        known = self.postures().get(name)
        if known is not None:
            self._visited += 1
            return known
        if any(r["name"] == name for r in self.journal.events("unreachable")):
            return None
        device = self.ready()
        self.signals.check_pause()
        pitch, yaw, roll = (int(count) for count in pulses)
        begun = time.monotonic()
        self.emit("visit", name=name, pulses=[pitch, yaw, roll])
        try:
            while True:
                self._reorient(device)
                self.motion.move_to((pitch, yaw, roll), name)
                measured = self.observer.measure((pitch, yaw, roll), name)
                if device.oriented:  # or the phone came back in between
                    break
        except NotFollowing as fault:
            if fault.suspects:
                self.emit("void", sync=True, names=fault.suspects)
            raise
        except Unreachable as reason:
            results = device.stopper.stop(str(reason), latch=False)
            if not all(result.standing for result in results):
                raise MotionFault(f"{reason}, and not all drives stand") from None
            self.emit("unreachable", sync=True, name=name, reason=str(reason))
            return None
        self.emit("phase", phase="saving")
        self._visited += 1
        self._visit_s.append(time.monotonic() - begun)
        record = self.emit("posture", sync=True, name=name, **measured, **fields)
        self.signals.check_pause()
        return record

    @property
    def progress(self) -> tuple[int, int, float, float]:
        """Postures visited and planned, seconds of the last, and about those left."""
        left = max(0, self.planned - self._visited)
        last = self._visit_s[-10:] or [0.0]
        return self._visited, self.planned, last[-1], left * float(np.mean(last))

    # The end

    @property
    def to_go_on(self) -> str:
        """What goes on after a pause or a fault."""
        resume = f"jaxcal-rig resume {self.folder}"
        if self.journal.records[0].get("simulated") is None:  # or it begins anew
            if lack := self.record.missing(self.config):
                return f"{lack}. Then {resume}"
        return resume

    def stop(self, reason: str, latch: bool = True) -> None:
        """Stop every unit; before the device is about to be armed there is no need."""
        if self.device is not None and self.signals.armed:
            self.device.stopper.stop(reason, latch)

    def disarm(self) -> None:
        """Nothing more will move: close the device, free the signals."""
        results = self.device.stopper.results if self.device else []
        if results and all(result.standing for result in results):
            simulated = self.journal.records[0].get("simulated") is not None
            BusLock(self.config.bus).stood(forget=simulated)  # first: `stop` waits
        for attached in self._attached:
            attached.close()
        self._attached = []
        if self.device is not None:
            if self.signals.armed:
                try:
                    with self.device.bus.urgent():  # also after a stop that latched
                        leave(self.device.drives, self.record)
                except OSError as error:
                    self.say(f"{self.record.path} cannot be written: {error}")
            self.device.close()
        self.device = None
        self.signals.armed = False

    def close(self) -> None:
        """Close device and journal."""
        self.disarm()
        self.journal.close()


def run_safely(run: Run, procedure: Callable[[Run], int]) -> int:
    """Run a procedure; whatever happens, the drives are told to stop and it is said.

    Returns:
        The exit code.
    """
    code, event, reason = EXIT_FAULT, "fault", ""
    moved = len(run.journal.events("command"))
    with run.signals:
        try:
            code = procedure(run)
            event = "end"
        except PlanOnly:
            code, event = EXIT_OK, "end"
            run.say("dry run: nothing was sent to the bus")
        except PauseRequested as pause:
            code, event, reason = EXIT_PAUSED, "paused", str(pause)
        except StopRequested as stop:
            code, event, reason = stop.exit_code, "stopped", str(stop)
        except KeyboardInterrupt:
            code, event, reason = 130, "stopped", "SIGINT"
        except Refused as error:
            reason = str(error)
            if len(run.journal.events("command")) == moved:
                code, event = EXIT_BAD_INPUT, "refused"
        except (Fault, JournalError) as error:
            reason = str(error)
        except OSError as error:
            reason = f"cannot write to {run.folder}: {error.strerror or error}"
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
        finally:
            run.signals.ending = True
            run.stop(reason, latch=event not in ("end", "paused"))
            run.disarm()
        try:
            run.emit(event, sync=True, code=code, reason=reason)
        except JournalError as error:
            run.say(f"the journal could not be closed with a last line: {error}")
        if event != "end":
            run.say(f"{event}: {reason}")
            if event != "refused":
                run.say(f"to go on: {run.to_go_on}")
        run.close()
    return code
