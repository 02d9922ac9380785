"""``jaxcal identify``, ``check``, ``predict``, ``command``."""

from __future__ import annotations

import dataclasses
import os
from argparse import ArgumentTypeError
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import numpy as np

from jaxcal.arguments import Numbers, Was, number_type, several
from jaxcal.calibration import Calibration
from jaxcal.calibration import identify as identified
from jaxcal.checks import Array
from jaxcal.commands.arms import (
    ArmOptions,
    ModelPath,
    RecordingOptions,
    in_degrees,
    input_units,
    is_arm,
    is_recording,
)
from jaxcal.commands.tables import Output, write_json, write_rows
from jaxcal.tables import COMMANDS, MEASURED, Table, read_table

ReportFolder = Annotated[
    str,
    "write a page, verdict.json and the calibration into this folder; exit code 1 if "
    "the calibration is not good",
    "FOLDER",
]


@dataclasses.dataclass
class SavedFiles:
    """What an identification is saved as."""

    RARE: ClassVar[Any] = {"overwrite", "unproven", "repair", "servos_out"}

    out: Annotated[
        str,
        "save the calibration (.json) or an arm's corrected file (.urdf)",
        "FILE",
    ] = ""
    overwrite: Annotated[
        bool, "overwrite an existing .urdf, servos or --repair file"
    ] = False
    unproven: Annotated[bool, "write the .urdf even if the calibration is not good"] = (
        False
    )
    repair: Annotated[
        str, "if rows are mispaired, write the corrected table", "FILE"
    ] = ""
    servos_out: Annotated[
        str, "write LeRobot's calibration file: --servos with corrected zeros", "FILE"
    ] = ""

    transform: Annotated[
        str,
        "--sensor board: write the camera's pose for the uncorrected arm, as a "
        "TransformStamped (.yaml), ROS 2's static_transform_publisher (.sh), or the "
        ".urdf with the camera's link",
        "FILE",
    ] = ""
    frames: Annotated[
        str | None,
        "with --transform: the camera's parent link and the name of its optical frame",
        "PARENT,CHILD",
    ] = None

    @property
    def as_urdf(self) -> bool:
        """The arm's own file is written, corrected."""
        return self.out.lower().endswith(".urdf")

    @property
    def corrected(self) -> str:
        """The file that a robot would go by, if one was asked for."""
        return (self.out if self.as_urdf else self.servos_out) or self.transform

    def require(self, file: str, of_urdf: bool, servos: str | None) -> None:
        """Refuse files that cannot be written, or must not be, before the fit."""
        if self.servos_out and self.as_urdf:
            raise ValueError(
                "Leave out --servos-out or --out FILE.urdf: each corrects the zeros, "
                "so both would correct them twice"
            )
        files = "--out FILE.urdf, --servos-out and --transform"
        if self.unproven and not self.corrected:
            raise ValueError(f"--unproven needs {files}")
        if self.overwrite and not (self.corrected or self.repair):
            raise ValueError(f"--overwrite needs {files} or --repair")
        if self.frames is not None and not self.transform:
            raise ValueError("--frames needs --transform FILE")
        if len((self.frames or "a,b").split(",")) != 2:
            raise ValueError(f"--frames takes PARENT,CHILD, got {self.frames}")
        if self.transform and not of_urdf:
            raise ValueError("--transform needs --model FILE.urdf and --sensor board")
        if self.servos_out and not servos:
            raise ValueError("--servos-out needs --servos FILE")
        if servos and not (self.servos_out or is_recording(file)):
            raise ValueError("--servos needs a recording or --servos-out")
        if self.as_urdf and not of_urdf:
            raise ValueError("--out FILE.urdf needs --model FILE.urdf")
        for path in (self.transform, self.out if self.as_urdf else "", self.repair):
            if path and os.path.exists(path) and not self.overwrite:
                raise ValueError(f"{path} exists; pass --overwrite to replace it")

    def written(self, calibration: Calibration, servos: str | None) -> list[str]:
        """Write the files that were asked for; a line of each."""
        corrected = self.corrected
        if corrected and not calibration.verdict.good and not self.unproven:
            raise ValueError(
                f"{corrected} was not written: the calibration is not good (reasons "
                "above). --unproven writes it anyway"
            )
        lines = []
        of_arm: Any = calibration
        if self.as_urdf:
            tip = of_arm.to_urdf(self.out, force=self.overwrite)
            lines = [f"saved {self.out}, tip link {tip}"]
        elif self.out:
            calibration.save(self.out)
            lines = [f"saved {self.out}"]
        if self.transform:
            parent, child = (self.frames or ",").split(",")
            arm: Any = calibration.model
            count = len(arm.sensor.members)
            for camera in range(count):
                stem, ending = os.path.splitext(self.transform)
                number = f"_{camera}" if count > 1 else ""
                pose = of_arm.to_transform(
                    f"{stem}{number}{ending}",
                    child=child.strip() + number * bool(child.strip()) or None,
                    parent=parent.strip() or None,
                    camera=camera,
                    force=self.overwrite,
                )
                lines.append(f"saved {stem}{number}{ending}: {pose}")
        if self.servos_out:
            steps = of_arm.to_lerobot(
                self.servos_out, str(servos), force=self.overwrite
            )
            moved = ", ".join(f"{name} {step:+d}" for name, step in steps.items())
            lines.append(f"saved {self.servos_out}, steps: {moved}")
        return lines


def commands_for(
    calibration: Calibration,
    table: Table,
    chosen: str | None = None,
    option: str = "--inputs",
    *,
    radians: bool = False,
) -> tuple[tuple[str, ...], Array]:
    """The columns of the commands of a calibration in a table, and (N, n) they hold;
    ``radians``: of an arm, whose commands are then made degrees."""
    model: Any = calibration.model
    if radians and not is_arm(model):
        raise ValueError("--radians needs an arm")
    table.say_available()
    names = table.named(
        calibration.input_names,
        COMMANDS,
        chosen=chosen,
        option=option,
        unit=calibration.command_unit,
        others=calibration.output_names,
    )
    table.require_units(names, input_units(model, calibration.command_unit, radians))
    commands = table.columns(names, None, getattr(model, "levels", ()))
    return names, in_degrees(model, commands) if radians else commands


def output_units(model: Any, unit: str) -> list[str]:
    """Units of the readings of a model, of an arm lengths and turns; "" is any."""
    if not is_arm(model):
        return [unit]
    units = [""] * model.num_outputs
    for quantity in model.quantities(unit):
        if quantity.unit in ("deg", model.length_unit(unit)):
            units[quantity.columns] = [quantity.unit] * len(units[quantity.columns])
    return units


@dataclasses.dataclass
class NoiseOptions:
    """What is known of the noise beside --noise."""

    RARE: ClassVar[bool] = True

    play: Annotated[
        float | None, "backlash of an arm's joints in degrees: hobby servos 0.3"
    ] = None
    weights: Annotated[str | None, "column of relative weights", "W"] = None

    def noise(self, machine: Any, std: float | list[float] | None) -> Any:
        """``noise`` and ``noise_std`` of ``identify``, by --noise and --play."""
        if self.play is None:
            return {"noise_std": std}
        if not is_arm(machine):
            raise ValueError("--play needs an arm: --model FILE.urdf")
        noise = machine.noise_with_play(self.play)
        return {"noise": noise if std is None else dataclasses.replace(noise, std=std)}


RecordPath = Annotated[
    str, "CSV, or - (standard input); for an arm also a bag or a LeRobot dataset"
]


def _by_unit(text: str) -> float | dict[str, float]:
    """A number, or numbers of units: mm=0.5,deg=0.1."""
    number = number_type(float)
    if "=" not in text:
        return number(text)
    pairs = [part.rpartition("=") for part in text.split(",")]
    if not all(unit.strip() for unit, _, _ in pairs):
        raise ArgumentTypeError(f"must be UNIT=NUMBER,UNIT=NUMBER, got {text!r}")
    return {unit.strip(): number(value) for unit, _, value in pairs}


def identify(
    file: RecordPath,
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B"] = None,
    outputs: Annotated[str | None, "columns of measurements", "C,D"] = None,
    model: ModelPath = None,
    saved: SavedFiles,
    report: ReportFolder = "",
    against: Annotated[
        str | None, "earlier calibration.json to compare with on the page", "FILE"
    ] = None,
    of_arm: ArmOptions,
    recording: RecordingOptions,
    noise: Annotated[Numbers, "std of a measurement, if known", "S"] = None,
    of_noise: NoiseOptions,
    command_unit: Annotated[str, "unit of the commands", "UNIT"] = "",
    measured_unit: Annotated[str, "unit of the readings", "UNIT"] = "",
    accuracy: Annotated[
        Any,
        "arms: cross-validated error that you need, 0.002 in the first unit (length if "
        "any), or m=0.002,deg=0.1",
        _by_unit,
        "A",
    ] = None,
    session: Annotated[
        str | None, "column that names the session (day, mounting) of each row", "S"
    ] = None,
    json: Annotated[bool, "print JSON"] = False,
) -> int:
    """Fit a model to measurements and save the calibration.

    Columns that begin with u_ are commands, those with y_ readings; --inputs and
    --outputs name others. For an arm in a URDF file the commands are the columns named
    like its joints, in any order, and those that its sensor needs. A bag or a LeRobot
    dataset may replace the table; the postures are then those where the arm rested.
    """
    of_urdf = (model or "").lower().endswith(".urdf")
    if saved.repair and os.path.realpath(saved.repair) == os.path.realpath(file):
        raise ValueError(f"--repair must name another file than {file}")
    saved.require(file, of_urdf, recording.servos)
    if against and not report:
        raise ValueError("--against needs --report FOLDER")
    if saved.repair and of_noise.weights:
        raise ValueError("--repair writes no weights: leave out --repair or --weights")
    table = recording.table(file, lambda which: of_arm.of_recording(model, which))
    table = read_table(file) if table is None else table
    machine: Any = of_arm.machine(model, table)
    if accuracy is not None and not is_arm(machine):
        raise ValueError("--accuracy needs an arm: --model FILE.urdf")
    table.say_available(of_noise.weights, session)
    beside = [name for name in (of_noise.weights, session) if name]
    commands, measured, names, columns = _readings(
        of_arm, machine, table, inputs, outputs, beside, of_urdf=of_urdf
    )
    if of_urdf and machine.sensor.lengths:  # files of this format are in metres
        measured_unit = measured_unit or "m"
    table.require_units(names, input_units(machine, command_unit, of_arm.radians))
    table.require_units(columns, output_units(machine, measured_unit))
    calibration = identified(
        commands,
        measured,
        model=machine,
        **of_noise.noise(machine, noise),
        weights=table.columns([of_noise.weights])[:, 0] if of_noise.weights else None,
        input_names=names,
        output_names=columns,
        command_unit=command_unit,
        measured_unit=measured_unit,
        accuracy=accuracy,
        sessions=table.keys(session) if session else None,
    )
    lines = saved.written(calibration, recording.servos)
    if saved.repair:
        lines.append(_repaired(saved.repair, file, calibration, table, names, columns))
    good = not report or calibration.report(
        report,
        before=Calibration.load(against) if against else None,
        files=[path for path in (file, model) if path and os.path.isfile(path)],
    )
    if json:
        write_json("", calibration.to_dict())
        return int(not good)
    print("\n".join([calibration.summary(), *lines]))
    if report:
        print(f"report {os.path.join(report, 'index.html')}")
    return int(not good)


def _repaired(
    path: str,
    file: str,
    calibration: Calibration,
    table: Table,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> str:
    """Write the rows of a mispaired table that belong together; a line that says so."""
    mispairing = calibration.mispairing
    if mispairing is None:
        raise ValueError(f"{path} was not written: {file} has no mispaired rows")
    names, measured = [*inputs], np.zeros((len(table), 0))
    if {*outputs} <= {*table.names}:
        names, measured = [*names, *outputs], table.columns(outputs)
    columns = mispairing.repaired(table.columns(inputs), measured)
    rows, match = np.hstack(columns).tolist(), mispairing.match
    for name, cells in table.labels.items():  # words stand beside their command
        names.append(name)
        for row, of in zip(rows, match[match >= 0], strict=True):
            row.append(cells[of])
    write_rows(path, names, rows)
    return f"saved {path}, {len(columns[0])} of {len(table)} rows; {file} is unchanged"


def _readings(
    of_arm: ArmOptions,
    machine: Any,
    table: Table,
    inputs: str | None,
    outputs: str | None,
    beside: Sequence[str],
    *,
    of_urdf: bool,
) -> tuple[Array, Array, Sequence[str], Sequence[str]]:
    """Commands (N, n), readings (N, m) and their columns: u_ and y_, or those named;
    ``of_urdf``: as the arm's joints and its sensor's; contacts have none. ``beside``:
    columns that hold something else."""
    contacts = of_urdf and machine.sensor.contacts
    if contacts and outputs:
        raise ValueError(f"contacts have no readings: leave out --outputs {outputs}")
    columns = machine.sensor.outputs if of_urdf else table.outputs(outputs)
    if of_urdf and not contacts:
        columns = table.named(
            columns,
            MEASURED,
            chosen=outputs,
            option="--outputs",
            others=table.without(MEASURED),
        )
    names = of_arm.columns(machine, table, inputs, (*columns, *beside))
    commands = of_arm.commands(machine, table, names)
    if contacts:
        measured = np.zeros((len(table), len(columns)))
    elif both := sorted({*names} & {*columns}):
        raise ValueError(f"--inputs and --outputs both hold {both[0]}")
    else:
        measured = table.columns(columns)
    return commands, measured, names, columns


CalibrationPath = Annotated[str, "made by identify", "calibration.json"]


def check(
    calibration: CalibrationPath,
    file: RecordPath,
    *,
    recording: RecordingOptions,
    tolerance: Annotated[
        Any,
        "change of the outputs that matters, a number or m=0.002,deg=0.1; default "
        "three times the noise",
        _by_unit,
        "T",
    ] = None,
    placed_anew: Annotated[
        bool, "arms: sockets, planes, anchors or the board were moved since"
    ] = False,
    radians: Annotated[bool, "arms: joint columns are in radians"] = False,
    report: ReportFolder = "",
    json: Annotated[bool, "print JSON"] = False,
) -> int:
    """Test with a few new readings whether a calibration still holds.

    The table has the calibration's columns; contacts have no readings. For an arm a
    recording may replace it. Exit code 0: the calibration holds; 1: it does not, or the
    test is inconclusive; 2: bad input.
    """
    calibrated = Calibration.load(calibration)
    if recording.servos and not is_recording(file):
        raise ValueError("--servos goes with a recording, not a table")
    table = recording.table(file, lambda which: calibrated.model)
    if table is not None and radians:
        raise ValueError("--radians goes with tables; recordings state their unit")
    table = read_table(file) if table is None else table
    inputs, commands = commands_for(calibrated, table, option="", radians=radians)
    if getattr(getattr(calibrated.model, "sensor", None), "contacts", False):
        measured = np.zeros((len(commands), calibrated.num_outputs))
    else:
        unit = calibrated.measured_unit
        outputs = table.named(
            calibrated.output_names,
            MEASURED,
            option="",
            unit=unit,
            others=table.without(MEASURED),
        )
        table.require_units(outputs, output_units(calibrated.model, unit))
        if both := sorted({*inputs} & {*outputs}):
            raise ValueError(
                f"{table.source}: {', '.join(both)} would be both commands and "
                f"readings; begin the names with {COMMANDS} and {MEASURED}"
            )
        measured = table.columns(outputs)
    result = calibrated.check(
        commands, measured, tolerance=tolerance, placed_anew=placed_anew
    )
    if report:
        files = [path for path in (calibration, file) if os.path.isfile(path)]
        calibrated.report(
            report, check=result, readings=(commands, measured), files=files
        )
    if json:
        more = {"good": result.good, "next_step": result.next_step}
        write_json("", dataclasses.asdict(result) | more)
    else:
        print(result)
        if report:
            print(f"report {os.path.join(report, 'index.html')}")
    return int(not result.good)


def predict(
    calibration: CalibrationPath,
    file: Annotated[str, "commands: CSV, or -"],
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B", Was("columns")] = None,
    std: Annotated[bool, "add the standard error of each output"] = False,
    radians: Annotated[bool, "arms: joint columns are in radians"] = False,
    output: Output,
) -> None:
    """Predict the outputs of a calibrated machine for given commands."""
    calibrated = Calibration.load(calibration)
    table = read_table(file)
    _, commands = commands_for(calibrated, table, inputs, radians=radians)
    calibrated.model.fitting.require_commands(commands)
    names, values = calibrated.output_names, calibrated.predict(commands)
    if std:
        names = (*names, *(f"std_{name}" for name in names))
        values = np.concatenate([values, calibrated.predict_std(commands)], axis=1)
    _emit(output, names, values)


def command(
    calibration: CalibrationPath,
    file: Annotated[str, "desired outputs: CSV, or -"],
    *,
    outputs: Annotated[
        str | None, "columns of desired outputs", "A,B", Was("columns")
    ] = None,
    limits: Annotated[
        list[list[float]] | None,
        "lowest and highest command, once for all or once per input; inf for none",
        "LOW,HIGH",
        several(float, "numbers"),
    ] = None,
    clip: Annotated[bool, "move commands beyond the limits to the limit"] = False,
    output: Output,
) -> None:
    """Compute the commands that reach given outputs (inverse map).

    A command beyond its limits is refused; --clip moves it onto the limit instead.
    """
    calibrated = Calibration.load(calibration)
    table, unit = read_table(file), calibrated.measured_unit
    table.say_available()
    names = table.named(
        calibrated.output_names,
        MEASURED,
        chosen=outputs,
        option="--outputs",
        unit=unit,
        others=calibrated.input_names,
    )
    table.require_units(names, output_units(calibrated.model, unit))
    desired = table.columns(names)
    if clip and not limits:
        raise ValueError("--clip needs --limits")
    if limits and len(limits) == 1:
        limits = limits * calibrated.num_inputs
    if limits and {len(pair) for pair in limits} != {2}:
        raise ValueError("--limits takes LOW,HIGH, once for all axes or once per axis")
    commands = calibrated.command_for(desired, limits=limits or None, clip=clip)
    _emit(output, calibrated.input_names, commands)


def _emit(output: Output, names: Sequence[str], values: Array) -> None:
    rows = values.tolist()
    if not output.written(names, rows):
        write_rows("", names, rows)
