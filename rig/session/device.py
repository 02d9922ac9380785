"""The device as one object: its drives, its phone, and the guards around them.

The loops of moving and measuring read it and ask ``guard``; they look at the clock and
do nothing else: no JAX, no files but the callback of events.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rig.attitude import Frame
from rig.config.axis import Pulses
from rig.config.config import RigConfig
from rig.device.bus import Bus
from rig.device.drives import Drive, Status
from rig.device.imu import Imu, ImuError
from rig.faults import MotionFault
from rig.guard.signals import Signals
from rig.guard.stop import Stopper
from rig.guard.watchdog import Heartbeat, LineWatch


class Device:
    """Three drives and a phone: armed explicitly, and never moved once stopped."""

    def __init__(
        self,
        config: RigConfig,
        bus: Bus,
        imu: Imu,
        signals: Signals,
        emit: Callable[..., Any],
        timeouts_left: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.config = config
        self.bus = bus
        self.imu = imu
        self.emit = emit
        self.drives = [Drive(bus, axis) for axis in config.axes]
        self.stopper = Stopper(self.drives, emit)
        self.armed = False
        self.frame: Frame | None = None  # once the zero is taken
        self._signals = signals
        timeouts = config.comm_timeouts_s
        self.line_watch = LineWatch(self.drives, timeouts, emit, timeouts_left or {})
        self.heartbeat = Heartbeat(
            self.stopper, config.heartbeat_s, min(timeouts.values(), default=0.0) / 4
        )
        bus.check = self._before_exchange

    def arm(self, reset_alarms: bool = False) -> None:
        """Check everything that must hold before anything may move.

        Raises:
            MotionFault: an alarm, a moving or disabled drive, a position outside the
                limits, no fresh IMU reading.
        """
        self.stopper.check()
        for drive in self.drives:
            self._check_fit(drive, reset_alarms)
            axis = drive.axis
            if self.config.motion.mirror_limits:
                drive.write(axis.map.limits, min=axis.min_pulses, max=axis.max_pulses)
        try:
            self.imu.latest()
        except ImuError as error:
            raise MotionFault(str(error)) from None
        self.line_watch.apply()
        self.armed = True
        self.heartbeat.start()

    def _check_fit(self, drive: Drive, reset_alarms: bool) -> None:
        axis, status = drive.axis, drive.status()
        if status.fault and reset_alarms and axis.map.alarm_reset:
            status = drive.bring(axis.map.alarm_reset, lambda s: not s.fault)
        if status.fault:
            raise MotionFault(
                f"{axis.name} is in alarm: {drive.alarm() or 'no code given'}. Find "
                "the cause, then start again with --reset-alarms"
            )
        if status.moving:
            raise MotionFault(
                f"{axis.name} is already moving. Stop the other controller, then run "
                "`stop`"
            )
        if not status.enabled:
            if not drive.bring(axis.map.enable, lambda s: s.enabled).enabled:
                raise MotionFault(
                    f"{axis.name} does not enable its power stage. Check its "
                    "supply and its enable and STO inputs"
                )
        slack = axis.pulses_within(self.config.motion.position_tolerance_deg)
        if not axis.min_pulses - slack <= status.position <= axis.max_pulses + slack:
            raise MotionFault(
                f"{axis.name} stands at {status.position} pulses, outside its limits "
                f"{axis.min_pulses}..{axis.max_pulses}. Home it first"
            )

    def guard(self, moving: bool = False) -> None:
        """The loop is alive; raise StopRequested where a stop was asked for."""
        self._signals.tell()
        self._before_exchange()
        self.heartbeat.feed(moving)

    def _before_exchange(self) -> None:
        """Before every frame: a stop is not kept waiting for the rest of a loop."""
        self._signals.check_stop()
        self.stopper.check()
        self.heartbeat.feed()

    def statuses(self) -> list[Status]:
        """Of all drives; raises MotionFault on a fault bit."""
        return [drive.sound() for drive in self.drives]

    def positions(self) -> Pulses:
        """Where the drives stand, in pulses."""
        a, b, c = (drive.status().position for drive in self.drives)
        return a, b, c

    def close(self) -> None:
        """Nothing more will move: close bus and phone."""
        self.heartbeat.close()
        self.armed = False
        results = self.stopper.results
        self.line_watch.restore({r.axis for r in results if r.standing})
        self.bus.close()
        self.imu.close()
