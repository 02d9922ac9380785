"""Options of commands: which device, simulated how, and how a session is begun."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rig.parts import SimulatedDevice, part

if TYPE_CHECKING:
    from rig.config import RigConfig


def _axes(text: str) -> list[str]:
    return text.split(",")


Path = pathlib.Path
FILE = Path("rig.toml")  # without --config
ConfigPath = Annotated[Path, "rig.toml of the device; default: rig.toml in this folder"]
Faults = Annotated[list[str], "inject KIND[@PHASE][,count=N]...; list: shows kinds"]


@dataclasses.dataclass
class Simulation:
    """What a simulated device is."""

    transport: Annotated[
        Literal["tcp", "rtu_tcp", "rtu"],
        "transport of the simulated bus; rtu is a pseudo-terminal",
    ] = "tcp"
    noise: Annotated[float, "degrees", (0, 90)] = 0.02
    backlash: Annotated[float, "degrees", (0, 90)] = 0.0
    dead_zone: Annotated[float, "degrees", (0, 90)] = 0.0
    breakaway: Annotated[float, "degrees before a joint at rest moves", (0, 90)] = 0.0
    drift: Annotated[float, "degrees per minute", (-90, 90)] = 0.0
    speedup: Annotated[float, "factor on the speed of the axes", (0.01, 100)] = 1.0
    rate: Annotated[float, "of the phone, Hz", (0.1, 1000)] = 100.0
    reversed: Annotated[list[str], "AXES that turn backwards", _axes] | None = None
    swapped: (
        Annotated[list[str], "A,B: two drives with swapped cables", _axes] | None
    ) = None
    gearing: Annotated[int, "pulses per turn that the drives are set to"] | None = None
    lost_origin: Annotated[float, "offset of the counts, deg", (-90, 90)] = 0.0
    realistic: Annotated[bool, "slow replies and enabling, jitter, watchdog"] = False


SIMULATOR = {field.name for field in dataclasses.fields(Simulation)} | {"fault"}


@dataclasses.dataclass
class DeviceOptions(Simulation):
    """The device that a command is about."""

    config: ConfigPath | None = None
    simulate: Annotated[bool, "run with a simulated device"] = False
    fault: Faults | None = None

    @property
    def simulation(self) -> dict[str, Any]:
        names = [field.name for field in dataclasses.fields(Simulation)]
        return {name: getattr(self, name) for name in names}

    def load(self, simulated: bool = False) -> RigConfig:
        """The configuration given, the simulator's own, or that of rig.toml here."""
        from rig.config import ConfigError, example_text, load_config, parse_config

        if self.fault == ["list"]:
            kinds = part("simulator", "--fault").KINDS.items()
            print(*(f"{kind:<16} {text}" for kind, text in kinds), sep="\n")
            raise SystemExit
        if self.config is None:
            if self.simulate or simulated:
                return parse_config(example_text("simulate"))
            if not FILE.exists():
                lack = "no rig.toml in this folder: give --config FILE or --simulate; "
                lack += "`jaxcal-rig setup` writes one"
                raise ConfigError("configuration", [lack])
            self.config = FILE
        return load_config(self.config)

    def simulator(
        self, config: RigConfig, options: dict[str, Any] | None = None
    ) -> SimulatedDevice:
        """A simulated rig as these options, or those of a run, describe it."""
        options, simulator = options or self.simulation, part("simulator", "--simulate")
        made: SimulatedDevice = simulator.simulated(config, options, self.fault or ())
        return made


@dataclasses.dataclass
class Step(DeviceOptions):
    """How a step of commissioning is begun."""

    yes: Annotated[bool, "confirm every question and take every default"] = False
    reset_alarms: Annotated[bool, "reset alarms of the drives before arming"] = False


@dataclasses.dataclass
class Session(DeviceOptions):
    """How a session is begun and shown."""

    out: Annotated[Path, "folder in which the run's folder is made"] | None = None
    arm: Annotated[bool, "arm without prompting"] = False
    reset_alarms: Annotated[bool, "reset alarms of the drives before arming"] = False
    zero: Annotated[bool, "confirm that the device is in its zero posture"] = False
    use: Annotated[
        bool, "goto: use a calibration although its session advised against it"
    ] = False
    live: Annotated[bool, "show the live page in the browser"] = False
