"""What another package adds to the rig, found by entry points; only types import it.

``jaxcal_rig.commands`` are the commands, ``jaxcal_rig.parts`` what a session may need:
``model`` (of a device that is not affine), ``numbers`` (of a sensor), ``simulator``.
"""

from __future__ import annotations

import importlib.util
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Any

from jaxcal.extras import MissingExtraError, install, installed, needs

if TYPE_CHECKING:
    from rig.config import RigConfig
    from rig_workbench.model import DeviceModel

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
