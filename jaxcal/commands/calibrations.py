"""``jaxcal identify``, ``predict`` and ``command``: making a calibration, using it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import several
from jaxcal.calibration import Calibration
from jaxcal.calibration import identify as identified
from jaxcal.commands.questions import ModelPath, Numbers, read_model
from jaxcal.commands.tables import (
    Output,
    Table,
    TablePath,
    read_table,
    write_json,
    write_rows,
)
from jaxcal.models import SerialChain
from jaxcal.models.sensors import SENSORS, Placed, Socket

__all__ = ["ArmOptions", "command", "identify", "predict"]

Array = NDArray[np.float64]

_KINDS = [kind for kind in SENSORS if kind != "several"]


@dataclasses.dataclass
class ArmOptions:
    """Of an arm in a URDF file: its links, its sensor, the unit of its columns."""

    sensor: Annotated[str, "of an arm, what its tip is measured with", _KINDS] = (
        "position"
    )
    base: Annotated[str | None, "of an arm, the link that stands still", "LINK"] = None
    tip: Annotated[str | None, "of an arm, the link that is measured", "LINK"] = None
    radians: Annotated[bool, "joint columns are in radians"] = False
    distance: Annotated[
        list[list[float]] | None,
        "two sockets, how far apart they are and its std: 0,1,0.05,0.0001",
        several(float, "numbers"),
    ] = None

    def read(self, path: str, table: Table | None, places: Any = None) -> SerialChain:
        """The arm in this file; things that it touches are given or in the table."""
        kind = SENSORS[self.sensor]
        given: dict[str, Any] = {}
        if issubclass(kind, Placed):
            if places is not None:
                given |= {"count": len(places), "places": places}
            elif table is not None and self.sensor in table.names:
                column = table.columns([self.sensor])
                given["count"] = 1 + int(column.max(initial=0.0))
        if self.distance:
            if kind is not Socket:
                raise ValueError("--distance is of --sensor socket")
            given["distances"] = self.distance
        sensor = kind(**given)
        return SerialChain.from_urdf(path, base=self.base, tip=self.tip, sensor=sensor)

    def commands(self, arm: SerialChain, table: Table, inputs: Sequence[str]) -> Array:
        """(N, n) the columns of joints and sensor, in degrees."""
        commands = table.columns(inputs)
        if self.radians:
            turning = np.flatnonzero(np.array(arm.command_units) == "deg")
            commands[:, turning] = np.degrees(commands[:, turning])
        return commands


def identify(
    file: TablePath,
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B"] = None,
    outputs: Annotated[str | None, "columns of measurements", "C,D"] = None,
    model: ModelPath = None,
    of_arm: ArmOptions,
    noise: Annotated[Numbers, "std of a measurement, where it is known", "S"] = None,
    weights: Annotated[str | None, "column of relative weights", "W"] = None,
    command_unit: Annotated[str, "stored with the result", "UNIT"] = "",
    measured_unit: Annotated[str, "stored with the result", "UNIT"] = "",
    out: Annotated[
        str,
        "save the calibration (.json), or of an arm the corrected file (.urdf)",
        "FILE",
    ] = "",
    force: Annotated[bool, "write a .urdf over another, or from a bad fit"] = False,
    json: Annotated[bool, "print JSON"] = False,
) -> None:
    """Fit a model to measurements and save the calibration.

    Columns that begin with u_ are commands, those with y_ what was measured; --inputs
    and --outputs name others. Of an arm in a URDF file the commands are the columns
    named as its joints, in any order, and what its sensor asks for.
    """
    table, as_urdf = read_table(file), out.lower().endswith(".urdf")
    if (model or "").lower().endswith(".urdf"):
        machine: Any = of_arm.read(str(model), table)
        names = table.inputs(inputs) if inputs else machine.inputs
        commands = of_arm.commands(machine, table, names)
        known = machine.sensor.outputs
        if machine.sensor.zeros:  # a contact needs no columns of readings
            measured = np.zeros((len(commands), len(known)))
        else:
            if outputs or set(known) - set(table.names):
                known = table.outputs(outputs)
            measured = table.columns(known)
        if as_urdf and os.path.exists(out) and not force:
            raise ValueError(f"{out} is there already; --force writes over it")
    else:
        if as_urdf:
            raise ValueError("--out FILE.urdf needs --model FILE.urdf")
        if of_arm != ArmOptions():
            raise ValueError("options of an arm need --model FILE.urdf")
        known, names = table.outputs(outputs), table.inputs(inputs)
        if not inputs:
            names = tuple(n for n in names if n not in (*known, weights))
        if both := sorted({*names} & {*known}):
            raise ValueError(f"--inputs and --outputs must differ, both hold {both[0]}")
        commands, measured = table.columns(names), table.columns(known)
        machine = read_model(model)
    calibration = identified(
        commands,
        measured,
        model=machine,
        noise_std=noise[0] if noise and len(noise) == 1 else noise,
        weights=table.columns([weights])[:, 0] if weights else None,
        input_names=names,
        output_names=known,
        command_unit=command_unit,
        measured_unit=measured_unit,
    )
    told, saved = calibration.verdict, f"saved {out}"
    if as_urdf and told and not told.good and not force:
        raise ValueError(
            f"{out} is not written, --force writes it all the same:\n{told}"
        )
    if as_urdf:
        saved += f", tip link {calibration.to_urdf(out, force=force)}"
    elif out:
        calibration.save(out)
    if json:
        write_json("", calibration.to_dict())
        return
    print(calibration.summary())
    if out:
        print(saved)


CalibrationPath = Annotated[str, "made by identify", "calibration.json"]


def predict(
    calibration: CalibrationPath,
    file: Annotated[str, "commands: CSV, or -"],
    *,
    columns: Annotated[str | None, "columns of commands", "A,B"] = None,
    std: Annotated[bool, "and the standard error of each output"] = False,
    output: Output,
) -> None:
    """Where a calibrated machine goes for given commands."""
    found = Calibration.load(calibration)
    commands = _given(file, columns, found.input_names)
    names, values = found.output_names, found.predict(commands)
    if std:
        names = (*names, *(f"std_{name}" for name in names))
        values = np.concatenate([values, found.predict_std(commands)], axis=1)
    _emit(output, names, values)


def command(
    calibration: CalibrationPath,
    file: Annotated[str, "desired outputs: CSV, or -"],
    *,
    columns: Annotated[str | None, "columns of desired outputs", "A,B"] = None,
    limits: Annotated[
        str | None,
        "of every command, or LOW,HIGH for each separated by spaces "
        "(--limits='-20,20 -30,30'); inf where there is none",
        "LOW,HIGH",
    ] = None,
    clip: Annotated[bool, "move onto the limits"] = False,
    output: Output,
) -> None:
    """What to command to reach given outputs, the inverse map.

    A command beyond its limits is refused; --clip moves it onto the limit instead.
    """
    found = Calibration.load(calibration)
    desired, bounds = _given(file, columns, found.output_names), None
    if limits is not None:
        bounds = _limits(limits, found.num_inputs)
    elif clip:
        raise ValueError("--clip needs --limits")
    commands = found.command_for(desired, limits=bounds, clip=clip)
    _emit(output, found.input_names, commands)


def _limits(text: str, count: int) -> list[list[float]]:
    """(count, 2) least and greatest command."""
    try:
        pairs = [[float(end) for end in pair.split(",")] for pair in text.split()]
    except ValueError:
        pairs = []
    if len(pairs) not in (1, count) or any(len(pair) != 2 for pair in pairs):
        raise ValueError(
            f"--limits must be LOW,HIGH, once or for each of {count} commands, got "
            f"{text!r}"
        )
    return pairs * count if len(pairs) == 1 else pairs


def _given(file: str, chosen: str | None, known: tuple[str, ...]) -> Array:
    """Columns chosen; else the calibration's own, else all, if they are as many."""
    table = read_table(file)
    columns = table.inputs(chosen) if chosen else table.names
    if not chosen and set(known) <= set(table.names):
        columns = known
    if len(columns) != len(known):
        raise ValueError(
            f"{table.source}: {len(known)} columns are needed ({', '.join(known)}), "
            f"got {len(columns)} ({', '.join(columns)}); name them with --columns"
        )
    return table.columns(columns)


def _emit(output: Output, names: Sequence[str], values: Array) -> None:
    """Rows (N, len(names)) as JSON, else as CSV."""
    rows = values.tolist()
    document = [dict(zip(names, row, strict=True)) for row in rows]
    if not output.written(names, rows, document):
        write_rows("", names, rows)
