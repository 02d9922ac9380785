"""What another package adds to the rig, found by entry points: rig imports none of it.

``jaxcal_rig.commands`` are the commands, ``jaxcal_rig.parts`` what a session may need:
``model`` (of a device that is not affine), ``numbers`` (of a sensor), ``simulator``.
"""

from __future__ import annotations

import importlib.util
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Any, Protocol

from jaxcal.extras import MissingExtraError, install, installed, needs

if TYPE_CHECKING:
    from collections.abc import Callable

    from rig.config import RigConfig
    from rig.journal.run_folder import Record
    from rig.readings.geometry import Array

STEPS = {  # commands that are typed after another one
    "setup": ("home", "axes", "zero", "jog", "characterise"),
    "check": ("ports", "scan", "imu", "identify"),
}
PLACES = {step: place for place, steps in STEPS.items() for step in steps}
COMMANDS, PARTS = "jaxcal_rig.commands", "jaxcal_rig.parts"
NEEDED = {  # by an extra; looked for before any port opens, quicker than importing
    "rig": ("pydantic", "serial", "tomlkit"),
    "workbench": ("pydantic", "serial", "tomlkit", "jinja2"),
}


class SimulatedDevice(Protocol):
    """What a session and commissioning ask of ``rig_workbench.simulator``."""

    config: RigConfig

    def start(self, port: int = 0) -> RigConfig:
        """Serve the drives; the configuration that reaches them."""

    def start_phone(self, port: int) -> int:
        """Send to the port the rig listens on, or listen; the port."""

    def hear(self, record: Record) -> None:
        """Listen to the events of a session."""

    def __enter__(self) -> SimulatedDevice: ...

    def __exit__(self, *_: object) -> None: ...


class DeviceModel(Protocol):
    """A model of a device, and what its readings come to: ``rig_workbench.model``."""

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
        self, config: RigConfig, postures: dict[str, Record]
    ) -> tuple[Any, Record]:
        """The calibration, and what the summary has of it."""


def offered(group: str) -> dict[str, EntryPoint]:
    """What is installed of a group, by name, or MissingExtraError."""
    if not (points := installed(group)):
        raise MissingExtraError(
            f"the installed jaxcal is missing or too old: {install('rig')}"
        )
    return points


def part(name: str, purpose: str, group: str = PARTS) -> Any:
    """A part of the rig, loaded; MissingExtraError says what installs it."""
    point = offered(group)[name]
    with needs(_extra_of(point.module), purpose):
        return point.load()


def model_of(config: RigConfig) -> DeviceModel | None:
    """The model of a device, None where it is affine, or ConfigError."""
    if config.model is None:
        return None
    loaded: DeviceModel = part("model", "[model]")(config)
    return loaded


def require(command: str, simulated: bool = False) -> None:
    """MissingExtraError, with what installs what a command lacks, its device real or
    ``simulated``."""
    module = offered(COMMANDS)[command].module
    extra = "workbench" if simulated else _extra_of(module)
    needed = (module.partition(".")[0], *NEEDED[extra])
    if lacking := [name for name in needed if importlib.util.find_spec(name) is None]:
        verb = "are" if len(lacking) > 1 else "is"
        raise MissingExtraError(
            f"{command}{' --simulate' * simulated} needs {', '.join(lacking)}, which "
            f"{verb} not installed: {install(extra)}"
        )


def _extra_of(module: str) -> str:
    return "rig" if module.partition(".")[0] == "rig" else "workbench"
