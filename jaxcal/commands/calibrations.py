"""``jaxcal identify``, ``predict`` and ``command``: making a calibration, using it."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import flag, several
from jaxcal.calibration import Calibration
from jaxcal.calibration import identify as identified
from jaxcal.commands.questions import MODEL, read_model
from jaxcal.commands.tables import (
    OUTPUT,
    Table,
    read_table,
    write_json,
    write_rows,
    written,
)
from jaxcal.models import SerialChain
from jaxcal.models.sensors import SENSORS, Placed, Socket

__all__ = ["ARM", "FLAGS", "command", "commands_of", "identify", "predict", "read_arm"]

Array = NDArray[np.float64]

_KINDS = tuple(kind for kind in SENSORS if kind != "several")
ARM = (
    flag("--sensor", "of an arm, what its tip is measured with", choices=_KINDS,
         default="position"),
    flag("--base", "of an arm, the link that stands still", "LINK"),
    flag("--tip", "of an arm, the link that is measured", "LINK"),
    flag("--radians", "joint columns are in radians", on=True),
    flag("--distance", "two sockets, how far apart they are and its std: "
         "0,1,0.05,0.0001", "N", several(float, "numbers"), action="append"),
)  # fmt: skip
_CALIBRATION = flag("calibration", "calibration.json", "CALIBRATION")
FLAGS = {
    "identify": (
        flag("file", "measurements: .csv, .npz or -"),
        flag("--inputs", "columns of commands", "A,B"),
        flag("--outputs", "columns of measurements", "C,D"),
        MODEL,
        *ARM,
        flag("--noise", "standard deviation of a measurement, where it is known", "S",
             several(float, "numbers")),
        flag("--weights", "column of relative weights", "W"),
        flag("--command-unit", "stored with the result", "UNIT", default=""),
        flag("--measured-unit", "stored with the result", "UNIT", default=""),
        flag("--out", "save the calibration (.json), or of an arm the corrected file "
             "(.urdf)"),
        flag("--force", "write a .urdf over another one, or from a fit that is refused",
             on=True),
        flag("--json", "print JSON", on=True),
    ),
    "predict": (
        _CALIBRATION,
        flag("file", "commands: .csv, .npz or -"),
        flag("--columns", "columns of commands", "A,B"),
        flag("--std", "and the standard error of each output, where the noise is known",
             on=True),
        *OUTPUT,
    ),
    "command": (
        _CALIBRATION,
        flag("file", "desired outputs: .csv, .npz or -"),
        flag("--columns", "columns of desired outputs", "A,B"),
        flag("--limits", "of every command, or LOW,HIGH for each separated by spaces "
             "(--limits='-20,20 -30,30'); inf where there is none", "LOW,HIGH"),
        flag("--clip", "move onto the limits", on=True),
        *OUTPUT,
    ),
}  # fmt: skip


def identify(arguments: argparse.Namespace) -> None:
    """Fit a model to measurements and save the calibration.

    Columns that begin with u_ are commands, those with y_ what was measured; --inputs
    and --outputs name others. Of an arm in a URDF file the commands are the columns
    named as its joints, in any order, and what its sensor asks for.
    """
    table, noise, out = read_table(arguments.file), arguments.noise, arguments.out
    as_urdf = (out or "").lower().endswith(".urdf")
    if (arguments.model or "").lower().endswith(".urdf"):
        model: Any = read_arm(arguments, table)
        commands, measured, inputs, outputs = _readings(model, table, arguments)
        if as_urdf and os.path.exists(out) and not arguments.force:
            raise ValueError(f"{out} is there already; --force writes over it")
    else:
        if as_urdf:
            raise ValueError("--out FILE.urdf needs --model FILE.urdf")
        outputs = table.outputs(arguments.outputs)
        inputs = table.inputs(arguments.inputs)
        if not arguments.inputs:
            inputs = tuple(n for n in inputs if n not in (*outputs, arguments.weights))
        commands, measured = table.columns(inputs), table.columns(outputs)
        model = read_model(arguments.model)
    calibration = identified(
        commands,
        measured,
        model=model,
        noise_std=noise[0] if noise and len(noise) == 1 else noise,
        weights=table.columns([arguments.weights])[:, 0] if arguments.weights else None,
        input_names=inputs,
        output_names=outputs,
        command_unit=arguments.command_unit,
        measured_unit=arguments.measured_unit,
    )
    told, saved = calibration.verdict, f"saved {out}"
    if as_urdf and told and not told.good and not arguments.force:
        raise ValueError(
            f"{out} is not written, --force writes it all the same:\n{told}"
        )
    if as_urdf:
        saved += f", tip link {calibration.to_urdf(out, force=arguments.force)}"
    elif out:
        calibration.save(out)
    if arguments.json:
        write_json(None, calibration.to_dict())
        return
    print(calibration.summary())
    if out:
        print(saved)


def predict(arguments: argparse.Namespace) -> None:
    """Where a calibrated machine goes for given commands."""
    calibration = Calibration.load(arguments.calibration)
    commands = _given(arguments, calibration.input_names)
    names, values = calibration.output_names, calibration.predict(commands)
    if arguments.std:
        names = (*names, *(f"std_{name}" for name in names))
        values = np.concatenate([values, calibration.predict_std(commands)], axis=1)
    _emit(arguments, names, values)


def command(arguments: argparse.Namespace) -> None:
    """What to command to reach given outputs, the inverse map.

    A command beyond its limits is refused; --clip moves it onto the limit instead.
    """
    calibration = Calibration.load(arguments.calibration)
    desired, limits = _given(arguments, calibration.output_names), None
    if arguments.limits is not None:
        limits = _limits(arguments.limits, calibration.num_inputs)
    elif arguments.clip:
        raise ValueError("--clip needs --limits")
    commands = calibration.command_for(desired, limits=limits, clip=arguments.clip)
    _emit(arguments, calibration.input_names, commands)


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


def _given(arguments: argparse.Namespace, known: tuple[str, ...]) -> Array:
    """Columns chosen; else the calibration's own, else all, if they are as many."""
    table = read_table(arguments.file)
    columns = table.inputs(arguments.columns) if arguments.columns else table.names
    if not arguments.columns and set(known) <= set(table.names):
        columns = known
    if len(columns) != len(known):
        raise ValueError(
            f"{table.source}: {len(known)} columns are needed ({', '.join(known)}), "
            f"got {len(columns)} ({', '.join(columns)}); name them with --columns"
        )
    return table.columns(columns)


def _emit(arguments: argparse.Namespace, names: Sequence[str], values: Array) -> None:
    """Rows (N, len(names)) as JSON, else as CSV."""
    rows = values.tolist()
    document = [dict(zip(names, row, strict=True)) for row in rows]
    if not written(arguments, names, rows, document):
        write_rows(None, names, rows)


def read_arm(
    arguments: argparse.Namespace, table: Table | None, places: Any = None
) -> SerialChain:
    """The arm in a URDF file; things that it touches are given or in the table."""
    kind = SENSORS[arguments.sensor]
    given: dict[str, Any] = {}
    if issubclass(kind, Placed):
        if places is not None:
            given |= {"count": len(places), "places": places}
        elif table is not None and arguments.sensor in table.names:
            column = table.columns([arguments.sensor])
            given["count"] = 1 + int(column.max(initial=0.0))
    if arguments.distance:
        if kind is not Socket:
            raise ValueError("--distance is of --sensor socket")
        given["distances"] = arguments.distance
    return SerialChain.from_urdf(
        arguments.model, base=arguments.base, tip=arguments.tip, sensor=kind(**given)
    )


def commands_of(
    arm: SerialChain, table: Table, inputs: Sequence[str], radians: bool
) -> Array:
    """(N, n) the columns of joints and sensor, in degrees."""
    commands = table.columns(inputs).copy()
    if radians:
        turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
        commands[:, turning] = np.degrees(commands[:, turning])
    return commands


def _readings(
    arm: SerialChain, table: Table, arguments: argparse.Namespace
) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Commands in degrees, what was measured, and the names of both.

    A sensor whose readings are zeros (a contact) needs no columns of them.
    """
    inputs = table.inputs(arguments.inputs) if arguments.inputs else arm.inputs
    commands = commands_of(arm, table, inputs, arguments.radians)
    outputs = arm.sensor.outputs
    if arm.sensor.zeros:
        return commands, np.zeros((len(commands), len(outputs))), inputs, outputs
    named = arguments.outputs or set(outputs) - set(table.names)
    outputs = table.outputs(arguments.outputs) if named else outputs
    return commands, table.columns(outputs), inputs, outputs
