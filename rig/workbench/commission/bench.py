"""The run of a moving step of commissioning: slower, straight, and not resumed."""

from __future__ import annotations

import pathlib
from collections.abc import Callable

from rig.config import RigConfig
from rig.core.known import check_record
from rig.core.proof import slowed
from rig.journal import DeviceRecord, new_run_folder
from rig.signals import Signals
from rig.workbench.outputs.console import listen
from rig.workbench.run import Run


class Bench(Run):
    """A run that commissions. It has a folder and a journal; it is not resumed."""

    def __init__(
        self,
        config: RigConfig,
        step: str,
        record: DeviceRecord,
        say: Callable[[str], None],
        *,
        folder: pathlib.Path | None = None,
        again: str = "",
        homed: bool = True,
        simulated: bool = False,
        reset_alarms: bool = False,
    ) -> None:
        self.plain = config  # as it stands in the file
        self.again = again
        self.simulated = simulated
        # Homed drives are where they were left; the gearing is still to be checked.
        self.check = check_record if homed else lambda *_: None
        folder = folder or new_run_folder(pathlib.Path(config.output), step)
        if not simulated:
            axes = tuple(slowed(axis) for axis in config.axes)
            config = config.model_copy(update={"axes": axes})
        # Every way to a place is straight, so that play is seen and not made a bias.
        motion = config.motion.model_copy(update={"approach_overshoot_deg": 0.0})
        super().__init__(
            config.model_copy(update={"motion": motion}), folder, step, say,
            record=record, start={"simulated": None, "inputs": {}, "maps_from": ""},
            reset_alarms=reset_alarms, signals=Signals(),
        )  # fmt: skip
        listen(self)

    @property
    def to_go_on(self) -> str:
        return self.again
