"""``jaxcal identify``: fit ``y = A u + b`` to measurements and save the calibration."""

from __future__ import annotations

import argparse

from jaxcal.calibration import identify
from jaxcal.commands.plan import numbers
from jaxcal.commands.tables import read_table, write_json

__all__ = ["add_arguments", "run"]

EPILOG = """\
Columns that begin with u_ are commands, those with y_ what was measured; --inputs and
--outputs name others."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    parser.add_argument("file", metavar="FILE", help="measurements: .csv, .npz or -")
    parser.add_argument("--inputs", metavar="A,B", help="columns of commands")
    parser.add_argument("--outputs", metavar="C,D", help="columns of measurements")
    parser.add_argument(
        "--noise",
        type=numbers,
        metavar="S",
        help="standard deviation of a measurement, where it is known",
    )
    parser.add_argument("--weights", metavar="W", help="column of relative weights")
    parser.add_argument("--command-unit", default="", metavar="UNIT")
    parser.add_argument("--measured-unit", default="", metavar="UNIT")
    parser.add_argument("--out", metavar="FILE", help="save the calibration (.json)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Fit, print and save."""
    table = read_table(arguments.file)
    outputs = table.outputs(arguments.outputs)
    inputs = tuple(
        name
        for name in table.inputs(arguments.inputs)
        if arguments.inputs or name not in (*outputs, arguments.weights)
    )
    noise = arguments.noise
    calibration = identify(
        table.columns(inputs),
        table.columns(outputs),
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
    else:
        print(calibration.summary())
        if arguments.out:
            print(f"saved {arguments.out}")
    return 0
