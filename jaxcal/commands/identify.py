"""``jaxcal identify``: fit a model to measurements and save the calibration.

Columns that begin with u_ are commands, those with y_ what was measured; --inputs and
--outputs name others. Of an arm in a URDF file the commands are the columns named as
its joints, in any order, and what its sensor asks for.
"""

from __future__ import annotations

import argparse
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import several
from jaxcal.calibration import identify
from jaxcal.commands.select import add_model, numbers, read_model
from jaxcal.commands.tables import Table, read_table, write_json
from jaxcal.models import Model, SerialChain
from jaxcal.models.sensors import SENSORS, Placed, Socket

__all__ = ["add_arguments", "run"]

Array = NDArray[np.float64]

_KINDS = tuple(kind for kind in SENSORS if kind != "several")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add = parser.add_argument
    add("file", metavar="FILE", help="measurements: .csv, .npz or -")
    add("--inputs", metavar="A,B", help="columns of commands")
    add("--outputs", metavar="C,D", help="columns of measurements")
    add_model(parser)
    _add_arm(parser)
    noise = "standard deviation of a measurement, where it is known"
    add("--noise", type=numbers, metavar="S", help=noise)
    add("--weights", metavar="W", help="column of relative weights")
    add("--command-unit", default="", metavar="UNIT")
    add("--measured-unit", default="", metavar="UNIT")
    out = "save the calibration (.json), or of an arm the corrected file (.urdf)"
    add("--out", metavar="FILE", help=out)
    add(
        "--force",
        action="store_true",
        help="write a .urdf over another one, or from a fit that is refused",
    )
    add("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Fit, print and save."""
    table, noise = read_table(arguments.file), arguments.noise
    as_urdf = (arguments.out or "").lower().endswith(".urdf")
    if (arguments.model or "").lower().endswith(".urdf"):
        arm = _read_arm(arguments, table)
        commands, measured, inputs, outputs = _readings(arm, table, arguments)
        model: Model | None = arm
        if as_urdf and os.path.exists(arguments.out) and not arguments.force:
            raise ValueError(
                f"{arguments.out} is there already; --force writes over it"
            )
    else:
        if as_urdf:
            raise ValueError("--out FILE.urdf needs --model FILE.urdf")
        outputs = table.outputs(arguments.outputs)
        inputs = table.inputs(arguments.inputs)
        if not arguments.inputs:
            inputs = tuple(n for n in inputs if n not in (*outputs, arguments.weights))
        commands, measured = table.columns(inputs), table.columns(outputs)
        model = read_model(arguments.model)
    calibration = identify(
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
    told = calibration.verdict
    if arguments.out and as_urdf and told and not told.good and not arguments.force:
        raise ValueError(
            f"{arguments.out} is not written, --force writes it all the same:\n{told}"
        )
    if arguments.out and as_urdf:
        tip = calibration.to_urdf(arguments.out, force=arguments.force)
    elif arguments.out:
        calibration.save(arguments.out)
    if arguments.json:
        write_json(None, calibration.to_dict())
        return
    print(calibration.summary())
    if arguments.out:
        print(f"saved {arguments.out}" + (f", tip link {tip}" if as_urdf else ""))


def _add_arm(parser: argparse.ArgumentParser) -> None:
    """Flags of an arm from a URDF file."""
    add = parser.add_argument
    what = f"of an arm, what its tip is measured with: {', '.join(_KINDS)}"
    add("--sensor", choices=_KINDS, default="position", help=what)
    add("--base", metavar="LINK", help="of an arm, the link that stands still")
    add("--tip", metavar="LINK", help="of an arm, the link that is measured")
    add("--radians", action="store_true", help="joint columns are in radians")
    apart = "two sockets, how far apart they are and its std: 0,1,0.05,0.0001"
    add("--distance", type=several(float, "numbers"), action="append", help=apart)


def _read_arm(arguments: argparse.Namespace, table: Table) -> SerialChain:
    """The arm in a URDF file; things that it touches are counted in the table."""
    kind = SENSORS[arguments.sensor]
    given: dict[str, Any] = {}
    if issubclass(kind, Placed) and arguments.sensor in table.names:
        column = table.columns([arguments.sensor])
        given["count"] = 1 + int(column.max(initial=0.0))
    if arguments.distance:
        if kind is not Socket:
            raise ValueError("--distance is of --sensor socket")
        given["distances"] = arguments.distance
    return SerialChain.from_urdf(
        arguments.model,
        base=arguments.base,
        tip=arguments.tip,
        sensor=kind(**given),
    )


def _readings(
    arm: SerialChain, table: Table, arguments: argparse.Namespace
) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Commands in degrees, what was measured, and the names of both.

    A sensor whose readings are zeros (a contact) needs no columns of them.
    """
    inputs = table.inputs(arguments.inputs) if arguments.inputs else arm.inputs
    commands = table.columns(inputs).copy()
    if arguments.radians:
        turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
        commands[:, turning] = np.degrees(commands[:, turning])
    outputs = arm.sensor.outputs
    if arm.sensor.zeros:
        return commands, np.zeros((len(commands), len(outputs))), inputs, outputs
    named = arguments.outputs or set(outputs) - set(table.names)
    outputs = table.outputs(arguments.outputs) if named else outputs
    return commands, table.columns(outputs), inputs, outputs
