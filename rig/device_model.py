"""The model of a device that is not ``y = A u + b``: what the rig asks of it.

rig.toml names it in ``[model]``; ``rig_workbench.model`` loads it. The core is given
its predictions as a function.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rig.config import RigConfig
from rig.journal.run_folder import Record
from rig.parts import part
from rig.readings.attitude import Array


class DeviceModel(Protocol):
    """A model of a device, and what its readings come to."""

    @property
    def model(self) -> Any:
        """The ``jaxcal`` model."""

    @property
    def prior(self) -> Any:
        """What is known of it before measuring; None: the model's own."""

    @property
    def rotations(self) -> Callable[[Array], Array] | None:
        """(N, n) commands to (N, 3, 3) attitudes of the tip, of an arm."""

    def predict(self, command: Array) -> Array:
        """(m,) that is measured at a command (n,) by the device as designed."""

    def axes_at(self, command: Array) -> Array:
        """(3, n) axes about which the joints of an arm turn, in the tip's frame."""

    def outputs(self, config: RigConfig, records: list[Record]) -> tuple[Array, Array]:
        """(N, n) commands and (N, m) of what it predicts, of N posture records."""

    def held_out_errors(
        self, config: RigConfig, calibration: Any, records: list[Record]
    ) -> Record:
        """Errors of the predictions at held-out postures."""

    def conclude(
        self,
        config: RigConfig,
        postures: dict[str, Record],
        notes: Record,
        told: Record,
    ) -> tuple[Any, Record]:
        """The calibration, with ``notes`` in its file, and its summary."""


def model_of(config: RigConfig) -> DeviceModel | None:
    """The model of a device; None where it is affine.

    Raises:
        ConfigError: it cannot be loaded, or is of other axes or readings.
    """
    if config.model is None:
        return None
    loaded: DeviceModel = part("model", "[model]")(config)
    return loaded
