"""``jaxcal identify``, ``check``, ``predict``, ``command``."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from jaxcal.arguments import Numbers, Was, several
from jaxcal.calibration import Calibration
from jaxcal.calibration import identify as identified
from jaxcal.checks import Array
from jaxcal.commands.arms import (
    ArmOptions,
    ModelPath,
    RecordingOptions,
    is_recording,
)
from jaxcal.commands.calibration_files import (
    ReportFolder,
    ReportOptions,
    SavedFiles,
    commands_for,
    is_arm,
)
from jaxcal.commands.tables import Output, write_json, write_rows
from jaxcal.tables import COMMANDS, MEASURED, Table, read_table

RecordPath = Annotated[
    str, "CSV, or - (standard input); for an arm also a bag or a LeRobot dataset"
]


def _by_unit(text: str) -> float | dict[str, float]:
    """A number, or numbers of units: mm=0.5,deg=0.1."""
    if "=" not in text:
        return float(text)
    pairs = (part.rpartition("=") for part in text.split(","))
    return {unit.strip(): float(value) for unit, _, value in pairs}


def identify(
    file: RecordPath,
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B"] = None,
    outputs: Annotated[str | None, "columns of measurements", "C,D"] = None,
    model: ModelPath = None,
    saved: SavedFiles,
    page: ReportOptions,
    of_arm: ArmOptions,
    recording: RecordingOptions,
    noise: Annotated[Numbers, "std of a measurement, if known", "S"] = None,
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
    page.require()
    table = recording.table(file, lambda which: of_arm.of_recording(model, which))
    table = read_table(file) if table is None else table
    machine: Any = of_arm.machine(model, table)
    if accuracy is not None and not is_arm(machine):
        raise ValueError("--accuracy needs an arm: --model FILE.urdf")
    readings = _readings(of_arm, machine, table, inputs, outputs, of_urdf=of_urdf)
    if of_urdf and machine.sensor.lengths:  # files of this format are in metres
        measured_unit = measured_unit or "m"
    calibration = identified(
        readings.commands,
        readings.measured,
        model=machine,
        noise_std=noise[0] if noise and len(noise) == 1 else noise,
        input_names=readings.inputs,
        output_names=readings.outputs,
        command_unit=command_unit,
        measured_unit=measured_unit,
        accuracy=accuracy,
        sessions=table.columns([session])[:, 0] if session else None,
    )
    lines = saved.written(calibration, recording.servos)
    if saved.repair:
        lines.append(_repaired(saved.repair, file, calibration, table, readings))
    good = page.written(calibration, (file, model))
    if json:
        write_json("", calibration.to_dict())
        return int(not good)
    print("\n".join([calibration.summary(), *lines]))
    if page.report:
        print(f"report {os.path.join(page.report, 'index.html')}")
    return int(not good)


def _repaired(
    path: str,
    file: str,
    calibration: Calibration,
    table: Table,
    readings: _Readings,
) -> str:
    """Write the rows of a mispaired table that belong together; a line that says so."""
    mispairing = calibration.mispairing
    if mispairing is None:
        raise ValueError(f"{path} was not written: {file} has no mispaired rows")
    names, measured = [*readings.inputs], np.zeros((len(table), 0))
    if {*readings.outputs} <= {*table.names}:
        names, measured = [*names, *readings.outputs], table.columns(readings.outputs)
    columns = mispairing.repaired(table.columns(readings.inputs), measured)
    rows, match = np.hstack(columns).tolist(), mispairing.match
    for name, cells in table.labels.items():  # words stand beside their command
        names.append(name)
        for row, of in zip(rows, match[match >= 0], strict=True):
            row.append(cells[of])
    write_rows(path, names, rows)
    return f"saved {path}, {len(columns[0])} of {len(table)} rows; {file} is unchanged"


class _Readings(NamedTuple):
    """Commands (N, n) and readings (N, m), and the names of their columns."""

    commands: Array
    measured: Array
    inputs: Sequence[str]
    outputs: Sequence[str]


def _readings(
    of_arm: ArmOptions,
    machine: Any,
    table: Table,
    inputs: str | None,
    outputs: str | None,
    *,
    of_urdf: bool,
) -> _Readings:
    """The columns that begin with u_ and y_, or those that were named.

    ``of_urdf``: those named as the arm's joints and its sensor's; contacts have none.
    """
    contacts = of_urdf and machine.sensor.contacts
    if contacts and outputs:
        raise ValueError(f"contacts have no readings: leave out --outputs {outputs}")
    columns = machine.sensor.outputs if of_urdf else table.outputs(outputs)
    if of_urdf and not contacts:
        columns = table.named(columns, MEASURED, chosen=outputs, option="--outputs")
    names = of_arm.columns(machine, table, inputs, columns)
    commands = of_arm.commands(machine, table, names)
    if contacts:
        measured = np.zeros((len(table), len(columns)))
    elif both := sorted({*names} & {*columns}):
        raise ValueError(f"--inputs and --outputs both hold {both[0]}")
    else:
        measured = table.columns(columns)
    return _Readings(commands, measured, names, columns)


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
        outputs = table.named(
            calibrated.output_names, MEASURED, option="", unit=calibrated.measured_unit
        )
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
    calibrated.model.require_commands(commands)
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
    names = table.named(
        calibrated.output_names,
        MEASURED,
        chosen=outputs,
        option="--outputs",
        unit=unit,
        others=calibrated.input_names,
    )
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
