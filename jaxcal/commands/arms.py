"""Options of an arm in a URDF file on the command line, and models in files."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import several
from jaxcal.checks import Array, one_of
from jaxcal.models.model import Model, Recording, as_model
from jaxcal.tables import COMMANDS, Table, say

if TYPE_CHECKING:
    from jaxcal.arms import Sensor, SerialChain


ModelPath = Annotated[
    str | None,
    "arm (.urdf), saved model (.json) or a Python file that sets `model`; default y = "
    "A u + b",
    "FILE",
]


def _of_joint(text: str) -> list[Any]:
    name, _, values = text.rpartition("=")
    return [name, several(float, "numbers")(values)]


@dataclasses.dataclass
class ArmOptions:
    """Links of an arm in a URDF file, its sensor, the unit of its columns."""

    TITLE: ClassVar[str] = "arms: needs --model FILE.urdf"
    RARE: ClassVar[Any] = {"base", "tip", "radians", "locked", "limits", "distance"}

    sensor: Annotated[
        str | None,
        "what measures the tip: position (default), pose, socket, plane, distance, "
        "gravity, wrench or board",
        "KIND",
    ] = None
    base: Annotated[str | None, "the link that is fixed", "LINK"] = None
    tip: Annotated[list[str] | None, "the link that is measured", "LINK"] = None
    on_tip: Annotated[
        str | None,
        "--sensor board: which of the two is on the tip, camera (default) or board",
        ["camera", "board"],
    ] = None
    radians: Annotated[bool, "joint columns are in radians"] = False
    locked: Annotated[
        list[list[Any]] | None,
        "a fixed joint and its value in degrees or metres: finger=0.01",
        _of_joint,
    ] = None
    limits: Annotated[
        list[list[Any]] | None,
        "limits of a joint in degrees or metres: wrist=-160,160",
        _of_joint,
    ] = None
    distance: Annotated[
        list[list[float]] | None,
        "two sockets, the distance between them and its std: 0,1,0.05,0.0001",
        several(float, "numbers"),
    ] = None

    @property
    def kind(self) -> str:
        """The sensor's kind."""
        from jaxcal.arms.sensors import SENSORS

        kinds = [name for name in SENSORS if name != "several"]
        return one_of("--sensor", self.sensor or "position", kinds)

    def read(self, path: str, table: Table | None, places: Any = None) -> SerialChain:
        """The arm in this file; things that it touches are given or in the table."""
        from jaxcal.arms import SerialChain

        tips = ",".join(self.tip or ())
        if "," in tips:
            raise ValueError(
                f"--tip takes one link, got {tips}. Several chains in one model need "
                "Python: Chains in docs/arms.md"
            )
        sensor = self._sensor(table, places)
        for option, count in (("locked", 1), ("limits", 2)):
            for name, values in getattr(self, option) or ():
                if not name or len(values) != count:
                    numbers = "LOW,HIGH" if count == 2 else "VALUE"
                    raise ValueError(f"--{option} must be JOINT={numbers}")
        return SerialChain.from_urdf(
            path,
            base=self.base,
            tip=tips or None,
            sensor=sensor,
            locked={name: value for name, (value,) in self.locked or ()},
            limits=dict(self.limits or ()),
        )

    def _sensor(self, table: Table | None, places: Any) -> Sensor:
        """The sensor, with as many landmarks as are given or in the table."""
        from jaxcal.arms.sensors import SENSORS, Board, Landmarks, Several, Socket

        kind, names = SENSORS[self.kind], () if table is None else table.names
        if self.on_tip is not None and kind is not Board:
            raise ValueError("--on-tip needs --sensor board")
        if self.distance and kind is not Socket:
            raise ValueError("--distance needs --sensor socket")
        if self.distance and table is not None and self.kind not in names:
            raise ValueError(
                f"{table.source}: --distance needs a column 'socket', from 0"
            )
        if kind is Board and table is not None and "sensor" in names:
            # Cameras that stand around one board on the tip, from 0.
            cameras = range(1 + int(table.columns(["sensor"]).max(initial=0.0)))
            boards = [Board("board", same_board=i > 0) for i in cameras]
            return Several(tuple(boards)) if len(boards) > 1 else boards[0]
        fields: dict[str, Any] = {}
        if self.on_tip is not None:
            fields["moves"] = self.on_tip
        if self.distance:
            fields["distances"] = self.distance
        if issubclass(kind, Landmarks) and places is not None:
            if {len(place) for place in places} != {kind.width}:
                raise ValueError(
                    f"--near takes {kind.width} numbers for --sensor {self.kind}, got "
                    f"{places}"
                )
            fields |= {"count": len(places), "places": places}
        elif issubclass(kind, Landmarks) and table is not None and self.kind in names:
            fields["count"] = 1 + int(table.columns([self.kind]).max(initial=0.0))
        return kind(**fields)

    def of_recording(self, path: str | None, which: Sequence[int] | None) -> Any:
        """The arm of a recording whose rests are of ``which`` sockets."""
        if not (path or "").lower().endswith(".urdf"):
            return None
        if self.radians:
            raise ValueError("--radians goes with tables; recordings state their unit")
        if which is None:
            return self.read(str(path), None)
        column = np.array(which, dtype=np.float64)[:, None]
        lines = tuple(range(1, 1 + len(column)))
        return self.read(str(path), Table("", (self.kind,), column, {}, lines))

    def machine(self, path: str | None, table: Table | None) -> Model | None:
        """The model in a file, an arm or another; None without one. A ValueError names
        the file and what is wrong in it."""
        if path and path.lower().endswith(".urdf"):
            return self.read(path, table)
        if self != ArmOptions():
            raise ValueError("options of an arm need --model FILE.urdf")
        if path is None:
            return None
        try:
            ending = path.lower().endswith(".py")
            return _run_model(path) if ending else _read_model(path)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def columns(
        self,
        model: Any,
        table: Table,
        chosen: str | None = None,
        but: Sequence[str] = (),
    ) -> tuple[str, ...]:
        """The columns of the commands, those of the model's inputs where it has names;
        None is an affine model. ``chosen``: by --inputs; ``but``: columns that hold
        something else."""
        inputs = tuple(getattr(model, "inputs", ()))
        if not inputs:
            return table.commands(chosen, but=but)
        from jaxcal.models.linear import input_letters

        letters = inputs == input_letters(len(inputs))
        if letters and table.headed and not {*inputs} & {*table.bare(COMMANDS)}:
            # x, y, z of a polynomial are places: the table's columns in their order.
            names = table.commands(chosen, but=but)
            if len(names) == len(inputs):
                listed = f"{', '.join(names)} are used as {', '.join(inputs)}"
                say(f"{table.source}: columns {listed}, in their order")
                return names
        beside = but or getattr(getattr(model, "sensor", None), "outputs", ())
        return table.named(inputs, COMMANDS, chosen=chosen, others=beside)

    def commands(
        self,
        model: Any,
        table: Table,
        columns: Sequence[str],
        used: NDArray[np.bool_] | None = None,
    ) -> Array:
        """(N, n) the columns of the commands, an arm's joints in degrees."""
        table.require_units(columns, input_units(model, "", self.radians))
        commands = table.columns(columns, used, getattr(model, "levels", ()))
        return in_degrees(model, commands) if self.radians else commands


def _counted(text: str) -> list[int]:
    """Whole numbers separated by commas, "1x12" for twelve of them."""
    numbers: list[int] = []
    for part in text.split(","):
        number, _, times = part.strip().partition("x")
        numbers += [int(number)] * int(times or 1)
    return numbers


@dataclasses.dataclass
class RecordingOptions:
    """Options of a bag or a LeRobot dataset in the place of a table."""

    TITLE: ClassVar[str] = "recordings of an arm"
    RARE: ClassVar[bool] = True

    which: Annotated[
        list[int] | None,
        "socket, plane or wire of each rest of a recording: 0,0,1 or 0x12,1x12",
        _counted,
    ] = None
    topic: Annotated[str, "topic of the sensor in a recording"] = ""
    servos: Annotated[
        str | None,
        "calibration file of the arm's servos, for a LeRobot dataset in -100 to 100",
        "FILE",
    ] = None
    in_degrees: Annotated[
        bool, "the dataset is in degrees; --servos is what --servos-out corrects"
    ] = False

    def table(self, path: str, arm: Any) -> Table | None:
        """The rests of a recording as a table, degrees; None where the path is of a
        table. ``arm(which)`` gives the arm of the recording."""
        if not is_recording(path):
            if self.which is not None or self.topic or self.in_degrees:
                raise ValueError(
                    "--which, --topic and --in-degrees go with a recording, not a table"
                )
            return None
        from jaxcal.arms import SerialChain

        model = arm(self.which)
        if not isinstance(model, SerialChain):
            raise ValueError(f"{path}: a recording needs --model FILE.urdf")
        servos = None if self.in_degrees else self.servos
        recording = Recording(path, self.which, servos=servos, topic=self.topic)
        commands, read = model.recorded(recording)
        names = (*model.joint_names, *model.sensor.inputs)
        if read is None:
            raise ValueError(
                f"{path} has no readings of a {model.sensor.kind}. Pass a table "
                "instead: the postures at rest and their readings"
            )
        values = np.hstack([commands, read])
        lines = tuple(range(1, len(values) + 1))
        return Table(path, (*names, *model.sensor.outputs), values, {}, lines)


def is_recording(path: str) -> bool:
    """Whether a path is of a bag or a LeRobot dataset, not of a table."""
    return os.path.isdir(path) or path.lower().endswith((".mcap", ".db3"))


def input_units(model: Any, unit: str, radians: bool = False) -> list[str]:
    """Units of the commands of a model, of an arm those of its joints; "" is any."""
    if not is_arm(model):
        return [unit]
    turning, sliding = "rad" if radians else "deg", model.length_unit("")
    units = [turning if kind == "deg" else sliding for kind in model.command_units]
    return units + [""] * len(model.sensor.inputs)


def is_arm(model: Any) -> bool:
    """Whether a model is an arm, of which some options are."""
    arms = sys.modules.get("jaxcal.arms.chain")  # loaded with the first arm
    return arms is not None and isinstance(model, arms.SerialChain)


def in_degrees(arm: SerialChain, commands: Array) -> Array:
    """Commands (N, n) in radians, made degrees where joints turn; changed in place."""
    turning = np.flatnonzero(np.array(arm.command_units) == "deg")
    commands[:, turning] = np.degrees(commands[:, turning])
    return commands


def _run_model(path: str) -> Model:
    """What a file of Python calls ``model``, its folder importable as for a script."""
    file = pathlib.Path(path).resolve()
    file.read_bytes()
    sys.path.insert(0, str(file.parent))
    try:
        module = importlib.import_module(file.stem)
    except Exception as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    if pathlib.Path(getattr(module, "__file__", None) or "").resolve() != file:
        raise ValueError(f"rename this file; another module is named {file.stem}")
    if not hasattr(module, "model"):
        raise ValueError("it must set `model`, of jaxcal.models")
    return as_model(module.model)


def _read_model(path: str) -> Model:
    if path.lower().endswith(".xacro"):
        raise ValueError(f"expand it first: xacro {path} > arm.urdf")
    try:
        read = json.loads(pathlib.Path(path).read_text(encoding="utf-8-sig"))
    except ValueError:
        raise ValueError(
            "--model takes an arm (.urdf), a saved model (.json) or a Python file (.py)"
        ) from None
    if isinstance(read, dict) and read.get("format") == "jaxcal-calibration":
        raise ValueError(
            "this is a calibration, and a model is needed. `predict` and `command` "
            "take calibrations"
        )
    from jaxcal.models import from_dict

    return from_dict(read)
