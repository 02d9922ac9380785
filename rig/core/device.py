"""The device as one object: its drives, its phone, and the guards around them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rig.config.axis import Pulses
from rig.config.config import RigConfig
from rig.core.heartbeat import Heartbeat, Stopper
from rig.core.line_client import line_of
from rig.core.proof import Proof, Turns, slopes, stop_distances
from rig.core.record_check import check_drives
from rig.drives import Drive, Line
from rig.drives.drive import Status
from rig.drives.line import BusError
from rig.faults import LimitError, MotionFault, PauseRequested, Signals
from rig.journal.device import SIGN_CHECKED, DeviceRecord
from rig.journal.run_folder import Record, RunFolder
from rig.readings import make_source
from rig.readings.geometry import Array, Frame, Reading, geometry_of
from rig.readings.source import ReadingError

LOOK_S = 0.002  # between two looks for a reading
TELLS = 0.03  # least of the singular values, of the largest: by so little an axis tells
PATIENCE_S = 60.0  # with a stream that pauses while nothing moves


Check = Callable[[RigConfig, Sequence[Drive], DeviceRecord], None]
Lines = Callable[[RigConfig, Callable[..., Any]], tuple[Line, list[Drive]]]


class Posture(NamedTuple):
    """Where to stand, by name."""

    name: str
    pulses: Pulses


class Reached(Exception):
    """What is looked for ``meanwhile``, in a move, has come: it goes no further."""


def approach(config: RigConfig, target: Pulses) -> list[Pulses]:
    """The way to a target: from below it on every axis, or itself alone."""
    overshoot = config.motion.approach_overshoot_deg
    if not overshoot:
        return [target]
    return [config.to_pulses(config.to_deg(target) - overshoot), target]


def check_plan(config: RigConfig, targets: Iterable[Pulses]) -> None:
    """LimitError lists each target, or point it is approached from, that is outside."""
    faults = [
        f"{axis.name} to {pulses} pulses ({axis.to_deg(pulses):.3f} {axis.unit_name}), "
        f"limits {axis.min_pulses}..{axis.max_pulses} pulses and "
        f"{axis.min_deg:g}..{axis.max_deg:g} {axis.unit_name}"
        for target in targets
        for point in approach(config, target)
        for axis, pulses in zip(config.axes, point, strict=True)
        if not axis.min_pulses <= pulses <= axis.max_pulses
    ]
    if faults:
        raise LimitError("outside the limits, nothing was sent: " + "; ".join(faults))


def timeouts_left(records: list[Record]) -> dict[str, Record]:
    """The ``comm_timeout`` records of a journal that no restoring has followed."""
    left: dict[str, Record] = {}
    for record in records:
        if record["event"] == "comm_timeout":
            left[record["axis"]] = record
        elif record["event"] == "comm_restored" and not record["error"]:
            left.pop(record["axis"], None)
    return left


class SessionRun(RunFolder):
    """The folder of a run, and what its session is opened with."""

    record: DeviceRecord  # of what was proved of the device
    signals: Signals  # to pause or to stop, from outside
    reset_alarms: bool  # of drives that are in alarm
    # (m,) that is measured at (n,) commands, by its model as designed.
    predict: Callable[[Array], Array] | None
    # What runs while the ports are open, such as telemetry.
    beside: list[Callable[[Device], contextlib.AbstractContextManager[None]]]
    # What must hold of the drives before they are armed; Refused.
    check: Check = staticmethod(check_drives)
    lines: Lines = staticmethod(line_of)  # who makes its line and drives
    simulated = False  # nothing real moves: it need not be slow


class Device:
    """Drives and what they are measured with: armed explicitly, then until stopped."""

    def __init__(self, run: SessionRun) -> None:
        self.run, self.emit, self.record = run, run.emit, run.record
        self.config = config = run.config
        self.requests, self.predict = run.signals, run.predict
        self.simulated = run.simulated
        self.line, self.drives = run.lines(config, run.emit)
        self.imu = make_source(config, run.emit)
        self.geometry = geometry_of(config)
        self.stopper = Stopper(self.drives, run.emit)
        turns = Turns.of(self.record)
        checked = not self.record.missing(config, SIGN_CHECKED)
        sure = turns if checked else None
        # Degrees of the phone for a commanded one of each axis.
        gains = sure and np.linalg.norm(sure.deg, axis=0).tolist()
        self.proof = Proof(config.axes, self.geometry, checked, run.simulated, gains)
        self.proof.stops = stop_distances(self.record, config.axes)
        self.shown = False  # each axis has turned the phone as `axes` saw it
        self.last_move: tuple[str, Pulses, Pulses] | None = None  # label, from, to
        self.rest: Pulses | None = None  # where it arrived,
        self.targets: list[int | None] = []  # and the drives' target registers then
        self.armed = self.pausing = False
        self.moves = 0  # frames that moved a drive
        self.arrived = 0.0  # monotonic time of the last arrival
        self.paused_s = 0.0  # that streams have paused, in all
        self.meanwhile: Callable[[], None] = lambda: None  # at every poll of a move
        self.zero: Posture | None = None  # once it is taken,
        self.frame: Frame | None = None  # and what the phone reads against it
        self.heard = 0  # connection of the phone by which the frame holds
        # (n,) commanded at the last posture, and (m,) measured, since the zero.
        self.seen = np.zeros(len(config.axes)), np.zeros(len(config.output_names))
        self._watches: dict[str, int] = {}  # timeouts of the line that were changed
        self.heartbeat = Heartbeat(self.stopper, self.requests, config)
        self.line.check = self._before_exchange

    def arm(self, reset_alarms: bool = False) -> None:
        """Check everything that must hold before anything may move, or raise."""
        self.stopper.check()
        for drive in self.drives:
            self._check_fit(drive, reset_alarms)
            if self.config.motion.mirror_limits:
                drive.mirror_limits()
        # From here on nothing is to move it before the first move.
        self.rest = tuple(drive.last.position for drive in self.drives if drive.last)
        self.imu.latest()
        self._set_watches()
        self.armed = True
        self.heartbeat.start()

    def _check_fit(self, drive: Drive, reset_alarms: bool) -> None:
        axis, before, status = drive.axis, drive.last, drive.status()
        if status.fault and reset_alarms and drive.can_reset:
            status = drive.bring(drive.reset, lambda s: not s.fault)
        slack = axis.pulses_within(self.config.motion.position_tolerance_deg)
        here = status.position
        where = before.position if before and before.enabled else here
        fault = ""
        if status.fault:
            fault = f"is in alarm: {drive.alarm() or 'no code given'}. Find the cause "
            fault += "in the drive's manual, then start with --reset-alarms"
        elif status.moving:
            fault = "is already moving. Stop the other controller, then run "
            fault += "`jaxcal-rig stop`"
        elif not (
            status.enabled or drive.bring(drive.arm, lambda s: s.enabled).enabled
        ):
            fault = "does not enable its power stage. Check its supply, and its enable "
            fault += "and STO inputs"
        elif abs(here - where) > slack:
            fault = f"counted {where} pulses when this session began and {here} now: "
            fault += "the drive was switched off and on, or another controller moves "
            fault += "it. Run `jaxcal-rig setup home`"
        elif not axis.min_pulses - slack <= here <= axis.max_pulses + slack:
            limits = f"{axis.min_pulses}..{axis.max_pulses}"
            fault = f"is at {here} pulses, outside its limits {limits}. Run "
            fault += "`jaxcal-rig setup home`"
        if fault:
            raise MotionFault(f"{axis.name} {fault}")

    def check_untouched(self, here: Pulses) -> None:
        """MotionFault where another moved or stopped a drive since the last arrival."""
        tolerance = self.config.motion.position_tolerance_deg
        for axis, at, was in zip(
            self.config.axes, here, self.rest or here, strict=True
        ):
            if abs(at - was) > axis.pulses_within(tolerance):
                raise MotionFault(
                    f"{axis.name} is at {axis.to_deg(at):.3f} {axis.unit_name}, but "
                    f"was left at {axis.to_deg(was):.3f}: something else moved it"
                )
        for drive, held in zip(self.drives, self.targets, strict=bool(self.targets)):
            if held is not None and drive.held() not in (None, held):
                raise MotionFault(
                    f"the target of {drive.axis.name} was overwritten after it "
                    "arrived: another controller moved or stopped the drives"
                )

    def untrack(self) -> None:
        """A move begins, or was cut short: where the drives stand is no arrival."""
        self.rest, self.targets = None, []

    def guard(self, moving: bool = False) -> None:
        """The loop is alive; raise StopRequested where a stop was asked for."""
        if self.requests.pause and not self.pausing:
            self.pausing = True
            self.emit("pausing")
        self._before_exchange()
        self.heartbeat.feed(moving)

    def _before_exchange(self) -> None:
        """Before every frame: a stop is not kept waiting for the rest of a loop."""
        self.requests.check_stop()
        self.stopper.check()
        self.heartbeat.feed()

    @property
    def oriented(self) -> bool:
        """The phone has the heading that it had when the zero was taken."""
        return self.frame is not None and self.imu.connections == self.heard

    def statuses(self) -> list[Status]:
        """Status of every drive; raises MotionFault on a fault bit."""
        return [drive.sound() for drive in self.drives]

    def attitude(self, since: float = 0.0) -> Array:
        """A reading, (3, 3) of a phone, since a monotonic time; the device stands."""
        while (reading := self.await_stream()).time < since:
            self.guard()
            time.sleep(LOOK_S)
        return reading.value

    def await_stream(self) -> Reading:
        """The newest reading, once it is fresh, while nothing moves. PauseRequested:
        past PATIENCE_S. MotionFault: a drive moves."""
        begun = time.monotonic()
        while True:
            try:
                reading = self.imu.latest()
                break
            except ReadingError as error:
                if time.monotonic() - begun > PATIENCE_S:
                    text = f"{error}. The device did not move meanwhile"
                    raise PauseRequested(text) from None
            self.guard()
            if any(status.moving for status in self.statuses()):
                raise MotionFault("a drive moves while the readings pause")
            time.sleep(self.config.motion.poll_s)
        if (waited_s := time.monotonic() - begun) > LOOK_S:
            self.paused_s += waited_s
            text = f"{self.imu.whose}'s stream paused for {waited_s:.1f} s more"
            self.emit("note", text=f"{text}; the device did not move meanwhile")
        return reading

    def moved(self, change: Array, middle: Array) -> Array | None:
        """(n,) by which the axes moved, of an (m,) change of what is measured: of
        numbers by what `axes` saw, or a model says at the ``middle`` (n,) of the way.
        None where that is not known, or does not tell."""
        if self.geometry.of_joints:
            return change
        if self.predict is not None:
            rates = slopes(self.predict, middle)
        elif turns := Turns.of(self.record):
            rates = turns.deg
        else:
            return None
        size = np.linalg.svd(rates, compute_uv=False)
        if len(rates) < len(self.config.axes) or size[-1] < TELLS * size[0]:
            return None
        moved: Array = np.linalg.pinv(rates).astype(np.float64) @ change
        return moved

    def positions(self) -> Pulses:
        return tuple(drive.status().position for drive in self.drives)

    def close(self) -> None:
        """Nothing more will move: close bus and phone."""
        self.heartbeat.close()
        self.armed = False
        self._restore_watches({r.axis for r in self.stopper.results if r.standing})
        self.line.close()
        self.imu.close()

    def _set_watches(self) -> None:
        """Set the drives' watch of the line, journalled first, so that a later process
        can restore it; MotionFault where that could not be."""
        killed = timeouts_left(self.run.journal.records)  # of a session that was
        for drive in self.drives:
            name = drive.axis.name
            if (timeout_s := self.config.comm_timeouts_s.get(name)) is None:
                continue
            try:
                before = drive.watch()
            except BusError as error:
                if not error.refused:
                    raise
                raise MotionFault(
                    f"{name}: its communication timeout cannot be read, so it could "
                    f"not be restored later: {error}. Correct [comm_timeout] of the "
                    f"map {drive.axis.map.name}, or leave it out"
                ) from None
            counts, record = drive.watch_counts(timeout_s), killed.get(name)
            if record and before == record["counts"]:
                before = record["before"]
            lent = {"axis": name, "before": before, "counts": counts}
            self.emit("comm_timeout", sync=True, **lent)
            self._watches[name] = before
            drive.set_watch(counts)

    def _restore_watches(self, standing: set[str]) -> None:
        """Never raises. A drive that was not seen to stand stops itself."""
        for drive in self.drives:
            name, error = drive.axis.name, "not seen standing"
            if (counts := self._watches.pop(name, None)) is None:
                continue
            if name in standing:
                try:
                    with drive.line.urgent():
                        drive.set_watch(counts)
                    error = ""
                except Exception as caught:
                    error = str(caught)
            self.emit("comm_restored", axis=name, counts=counts, error=error)
