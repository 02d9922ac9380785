"""``jaxcal identify``: fit a model to measurements and save the calibration.

Columns that begin with u_ are commands, those with y_ what was measured; --inputs and
--outputs name others.
"""

from __future__ import annotations

import argparse

from jaxcal.calibration import identify
from jaxcal.commands.model import add_model, read_model
from jaxcal.commands.select import numbers
from jaxcal.commands.tables import read_table, write_json

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add = parser.add_argument
    add("file", metavar="FILE", help="measurements: .csv, .npz or -")
    add("--inputs", metavar="A,B", help="columns of commands")
    add("--outputs", metavar="C,D", help="columns of measurements")
    add_model(parser)
    noise = "standard deviation of a measurement, where it is known"
    add("--noise", type=numbers, metavar="S", help=noise)
    add("--weights", metavar="W", help="column of relative weights")
    add("--command-unit", default="", metavar="UNIT")
    add("--measured-unit", default="", metavar="UNIT")
    add("--out", metavar="FILE", help="save the calibration (.json)")
    add("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Fit, print and save."""
    table, noise = read_table(arguments.file), arguments.noise
    outputs, inputs = table.outputs(arguments.outputs), table.inputs(arguments.inputs)
    if not arguments.inputs:
        inputs = tuple(n for n in inputs if n not in (*outputs, arguments.weights))
    calibration = identify(
        table.columns(inputs),
        table.columns(outputs),
        model=read_model(arguments.model),
        noise_std=noise[0] if noise and len(noise) == 1 else noise,
        weights=table.columns([arguments.weights])[:, 0] if arguments.weights else None,
        input_names=inputs,
        output_names=outputs,
        command_unit=arguments.command_unit,
        measured_unit=arguments.measured_unit,
    )
    if arguments.out:
        calibration.save(arguments.out)
    if arguments.json:
        write_json(None, calibration.to_dict())
        return
    print(calibration.summary())
    if arguments.out:
        print(f"saved {arguments.out}")
