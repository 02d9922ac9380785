"""``jaxcal identify``: fit a model to measurements and save the calibration.

Columns that begin with u_ are commands, those with y_ what was measured; --inputs and
--outputs name others. Of an arm in a URDF file the commands are the columns named as
its joints, in any order, and what its sensor asks for.
"""

from __future__ import annotations

import argparse
import os

from jaxcal.calibration import identify
from jaxcal.commands.arm import add_arm, read_arm, readings
from jaxcal.commands.model import add_model, read_model
from jaxcal.commands.select import numbers
from jaxcal.commands.tables import read_table, write_json
from jaxcal.models import Model

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add = parser.add_argument
    add("file", metavar="FILE", help="measurements: .csv, .npz or -")
    add("--inputs", metavar="A,B", help="columns of commands")
    add("--outputs", metavar="C,D", help="columns of measurements")
    add_model(parser)
    add_arm(parser)
    noise = "standard deviation of a measurement, where it is known"
    add("--noise", type=numbers, metavar="S", help=noise)
    add("--weights", metavar="W", help="column of relative weights")
    add("--command-unit", default="", metavar="UNIT")
    add("--measured-unit", default="", metavar="UNIT")
    out = "save the calibration (.json), or of an arm the corrected file (.urdf)"
    add("--out", metavar="FILE", help=out)
    add("--force", action="store_true", help="write over a .urdf that is there")
    add("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Fit, print and save."""
    table, noise = read_table(arguments.file), arguments.noise
    as_urdf = (arguments.out or "").lower().endswith(".urdf")
    if (arguments.model or "").lower().endswith(".urdf"):
        arm = read_arm(arguments, table)
        commands, measured, inputs, outputs = readings(arm, table, arguments)
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
