"""The armed device of a moving step, under the guards of a session and slower."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

from rig.config import RigConfig
from rig.config.axis import Axis
from rig.core.attitude import Array, angle_between_deg
from rig.core.device import Device
from rig.core.faults import MotionFault
from rig.core.motion import Motion
from rig.core.record import DeviceRecord, check_record
from rig.core.session import Run
from rig.journal import new_run_folder
from rig.signals import Signals
from rig.workbench.commission.unproved import slowed
from rig.workbench.outputs.console import listen

ALLOWED_DEG = 9.0  # that the phone may turn away from where it began


class SmallMotion(Motion):
    """Moves that stop where the phone turns further than they may turn it.

    The gearing is not proved yet: a drive may turn its joint a hundred times as far as
    it is told, and neither its own counts nor the limits show that.
    """

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.allowed_deg = 0.0
        self.meanwhile: Callable[[], None] | None = None  # called at every poll
        self._origin: Array | None = None  # (3, 3)

    def stay_near(self, attitude: Array, allowed_deg: float = ALLOWED_DEG) -> None:
        """The phone may turn so far away from this attitude."""
        self._origin, self.allowed_deg = attitude, allowed_deg

    def pace(self, index: int, axis: Axis) -> None:
        """Move an axis at the speed of this one from now on."""
        axes = list(self.config.axes)
        axes[index] = axis
        self.config = self.config.model_copy(update={"axes": tuple(axes)})
        self.device.drives[index].axis = axis

    def _check_attitude(self) -> None:
        if self.meanwhile is not None:
            self.meanwhile()
        super()._check_attitude()
        if self._origin is None:
            return
        turned = angle_between_deg(self._origin, self.device.imu.latest().matrix)
        if turned > self.allowed_deg:
            raise MotionFault(
                f"the phone turned {turned:.1f} deg in a move that may turn it "
                f"{self.allowed_deg:.1f}. Check pulses_per_rev and reduction, and that "
                "the phone is fixed"
            )


class Bench(Run):
    """A run that commissions. It has a folder and a journal; it is not resumed."""

    small: SmallMotion  # once armed

    def __init__(
        self,
        config: RigConfig,
        step: str,
        record: DeviceRecord,
        say: Callable[[str], None],
        *,
        plain: RigConfig | None = None,
        folder: pathlib.Path | None = None,
        again: str = "",
        homed: bool = True,
        full_speed: bool = False,
        start: dict[str, Any] | None = None,
        reset_alarms: bool = False,
    ) -> None:
        self.plain = plain or config  # as it stands in the file
        self.again = again
        self.homed = homed
        folder = folder or new_run_folder(pathlib.Path(config.output), step)
        self.full_speed = full_speed
        moved = config
        if not full_speed:
            axes = tuple(slowed(axis) for axis in config.axes)
            moved = config.model_copy(update={"axes": axes})
        # Every way to a place is straight, so that play is seen and not made a bias.
        motion = config.motion.model_copy(update={"approach_overshoot_deg": 0.0})
        moved = moved.model_copy(update={"motion": motion})
        super().__init__(
            moved, folder, step, say,
            record=record, start=start, reset_alarms=reset_alarms, signals=Signals(),
        )  # fmt: skip
        listen(self)

    def check_device(self, device: Device) -> None:
        """Homed drives are where they were left; the gearing is still to be checked."""
        if self.homed:
            check_record(self.plain, device.drives, self.record)

    def arm(self) -> Device:
        """Open, arm; nothing is zeroed, and the moves are small ones."""
        if self.device is None:
            super().arm()
            assert self.device is not None
            self.small = SmallMotion(self.device)
        return self.device

    def device_guard(self, moving: bool = False) -> None:
        """The loop is alive; StopRequested where a stop was asked for."""
        self.arm().guard(moving)

    @property
    def to_go_on(self) -> str:
        return self.again
