"""The device as one object: its drives, its phone, and the guards around them.

The loops of moving and measuring read it and ask ``guard``; they look at the clock and
do nothing else: no JAX, no files but the callback of events.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from rig.config.axis import Pulses
from rig.config.config import RigConfig
from rig.core.heartbeat import Heartbeat, Stopper
from rig.core.line_client import line_of
from rig.core.proof import Proof, Turns, slopes
from rig.core.stop_distance import stop_distances
from rig.drives import Drive, Line
from rig.drives.drive import Status
from rig.drives.line import BusError
from rig.faults import (
    LimitError,
    MotionFault,
    PauseRequested,
    Requests,
)
from rig.journal.device import SIGN_CHECKED, DeviceRecord
from rig.journal.run_folder import Record, RunFolder
from rig.readings import make_source
from rig.readings.attitude import Array, Reading
from rig.readings.geometry import Frame, geometry_of
from rig.readings.source import ReadingError

LOOK_S = 0.002  # between two looks for a reading
TELLS = 0.03  # least of the singular values, of the largest: by so little an axis tells
PATIENCE_S = 60.0  # with a stream that pauses while nothing moves


Lines = Callable[[RigConfig, Callable[..., Any]], tuple[Line, list[Drive]]]


class Pace(NamedTuple):
    """How fast a drive was in its longest move so far."""

    way_deg: float
    asked_deg_s: float
    seen_deg_s: float  # at least


class Posture(NamedTuple):
    """Where to stand, by name."""

    name: str
    pulses: Pulses


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


class LineWatch:
    """The communication timeout of the drives that have one: lent, and given back.

    What the register held is journalled before it is changed, so that a later process
    can put it back for one that was killed.
    """

    def __init__(self, drives: list[Drive], run: RunFolder) -> None:
        self._timeouts_s = run.config.comm_timeouts_s
        self._drives = [d for d in drives if d.axis.name in self._timeouts_s]
        self._emit = run.emit
        self._left = timeouts_left(run.journal.records)
        self._before: dict[str, int] = {}

    def apply(self) -> None:
        """Set the timeouts.

        Raises:
            MotionFault: a register cannot be read, so it could not be put back.
            BusError: no valid reply.
        """
        for drive in self._drives:
            name = drive.axis.name
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
            counts = drive.watch_counts(self._timeouts_s[name])
            taken = self._left.get(name)
            if (
                taken and before == taken["counts"]
            ):  # a killed session's, not the drive's
                before = taken["before"]
            lent = {"axis": name, "before": before, "counts": counts}
            self._emit("comm_timeout", sync=True, **lent)
            self._before[name] = before
            drive.set_watch(counts)

    def restore(self, standing: set[str]) -> None:
        """Give back what was there, of the axes that stand; never raises.

        A drive that was not seen to stand keeps its timeout: it stops itself.
        """
        for drive in self._drives:
            name, error = drive.axis.name, "not seen standing"
            if (counts := self._before.pop(name, None)) is None:
                continue
            if name in standing:
                try:
                    with drive.line.urgent():
                        drive.set_watch(counts)
                    error = ""
                except Exception as caught:
                    error = str(caught)
            self._emit("comm_restored", axis=name, counts=counts, error=error)


def timeouts_left(records: list[Record]) -> dict[str, Record]:
    """The ``comm_timeout`` records of a journal that no restoring has followed."""
    left: dict[str, Record] = {}
    for record in records:
        if record["event"] == "comm_timeout":
            left[record["axis"]] = record
        elif record["event"] == "comm_restored" and not record["error"]:
            left.pop(record["axis"], None)
    return left


@dataclasses.dataclass
class Observation:
    """What the phone has shown of the axes at the last posture, since the zero."""

    commanded: Array  # (n,) degrees of the axes
    measured: Array  # (m,) of what is measured


class Device:
    """Drives and what they are measured with: armed explicitly, and never moved once
    stopped."""

    def __init__(
        self,
        config: RigConfig,
        run: RunFolder,
        record: DeviceRecord,
        requests: Requests | None = None,
        *,
        simulated: bool = False,
        predict: Callable[[Array], Array] | None = None,
        lines: Lines = line_of,
    ) -> None:
        """``simulated``: it need not be slow where nothing is proved. ``predict``:
        what is measured at (n,) commands by its model as designed, where it has one.
        ``lines``: who makes its line and drives."""
        self.config = config
        self.run = run
        self.record = record
        self.emit = run.emit
        self.line, self.drives = lines(config, run.emit)
        self.imu = make_source(config, run.emit)
        self.geometry = geometry_of(config)
        self.stopper = Stopper(self.drives, run.emit)
        self.requests = requests or Requests()
        self.simulated = simulated
        self.predict = predict
        turns, checked = Turns.of(record), not record.missing(config, SIGN_CHECKED)
        gains = turns.gains if turns and checked else None
        self.proof = Proof(config.axes, self.geometry, checked, simulated, gains)
        self.proof.stops = stop_distances(record, config.axes)
        self.shown = False  # each axis has turned the phone as `axes` saw it
        self.paces: dict[str, Pace] = {}  # by axis
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
        self.seen = Observation(
            np.zeros(len(config.axes)), np.zeros(len(config.output_names))
        )
        self.line_watch = LineWatch(self.drives, run)
        self.heartbeat = Heartbeat(self.stopper, self.requests, config)
        self.line.check = self._before_exchange

    def arm(self, reset_alarms: bool = False) -> None:
        """Check everything that must hold before anything may move.

        Raises:
            MotionFault: an alarm, a moving or disabled drive, a position outside the
                limits. ReadingError: no fresh reading.
        """
        self.stopper.check()
        for drive in self.drives:
            self._check_fit(drive, reset_alarms)
            if self.config.motion.mirror_limits:
                drive.mirror_limits()
        self.imu.latest()
        self.line_watch.apply()
        self.armed = True
        self.heartbeat.start()

    def _check_fit(self, drive: Drive, reset_alarms: bool) -> None:
        axis, before, status = drive.axis, drive.last, drive.status()
        if status.fault and reset_alarms and drive.can_reset:
            status = drive.bring(drive.reset, lambda s: not s.fault)
        if status.fault:
            raise MotionFault(
                f"{axis.name} is in alarm: {drive.alarm() or 'no code given'}. Find "
                "the cause in the drive's manual, then start with --reset-alarms"
            )
        if status.moving:
            raise MotionFault(
                f"{axis.name} is already moving. Stop the other controller, then run "
                "`jaxcal-rig stop`"
            )
        if not (status.enabled or drive.bring(drive.arm, lambda s: s.enabled).enabled):
            raise MotionFault(
                f"{axis.name} does not enable its power stage. Check its supply, and "
                "its enable and STO inputs"
            )
        slack = axis.pulses_within(self.config.motion.position_tolerance_deg)
        where = before.position if before and before.enabled else status.position
        if abs(status.position - where) > slack:
            raise MotionFault(
                f"{axis.name} counted {where} pulses when this session found "
                f"it and {status.position} now, and nothing moved it: the drive was "
                "switched off and on, or another controller moves it. Run "
                "`jaxcal-rig setup home`"
            )
        if not axis.min_pulses - slack <= status.position <= axis.max_pulses + slack:
            raise MotionFault(
                f"{axis.name} is at {status.position} pulses, outside its limits "
                f"{axis.min_pulses}..{axis.max_pulses}. Run `jaxcal-rig setup home`"
            )

    def check_untouched(self, here: Pulses) -> None:
        """Nobody else has moved or stopped a drive since the last arrival.

        Raises:
            MotionFault: its position, or the target that it holds, is another.
        """
        tolerance = self.config.motion.position_tolerance_deg
        for drive, at, was in zip(self.drives, here, self.rest or here, strict=True):
            if abs(at - was) > drive.axis.pulses_within(tolerance):
                raise MotionFault(
                    f"{drive.axis.name} is at {drive.axis.to_deg(at):.3f} "
                    f"{drive.axis.unit_name}, but was left at "
                    f"{drive.axis.to_deg(was):.3f}: something else moved it"
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
        """A reading, (3, 3) of a phone, measured at or after a monotonic time, of a
        device that stands: a stream that pauses is waited for.

        Raises:
            PauseRequested: it does not come back. StopRequested: a stop was asked for.
        """
        while (reading := self.await_stream()).time < since:
            self.guard()
            time.sleep(LOOK_S)
        return reading.value

    def await_stream(self) -> Reading:
        """The newest reading, once it is fresh, while nothing moves.

        A phone that saves power holds its Wi-Fi now and then; ``paused_s`` counts it.

        Raises:
            PauseRequested: not within PATIENCE_S. MotionFault: a drive moves, or is in
                alarm. StopRequested: a stop was asked for.
        """
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
        """(n,) by which the axes moved, of an (m,) change of what is measured.

        Of a phone these are its joint angles; of numbers, what `axes` saw explains
        them by, or a model does at the ``middle`` (n,) of the way. None where that is
        not known, or does not tell.
        """
        if self.geometry.of_joints:
            return change
        turns = Turns.of(self.record)
        rates = None if turns is None else turns.deg
        if self.predict is not None:
            rates = slopes(self.predict, middle)
        if rates is None:
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
        self.line_watch.restore({r.axis for r in self.stopper.results if r.standing})
        self.line.close()
        self.imu.close()
