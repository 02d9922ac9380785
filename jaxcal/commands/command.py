"""``jaxcal command``: what to command to reach given outputs, the inverse map.

A command beyond its limits is refused; --clip moves it onto the limit instead.
"""

from __future__ import annotations

import argparse

from jaxcal.calibration import Calibration
from jaxcal.commands.predict import add_files, columns_of, emit
from jaxcal.commands.tables import read_table

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_files(parser, "desired outputs")
    limits = (
        "of every command, or LOW,HIGH for each separated by spaces "
        "(--limits='-20,20 -30,30'); inf where there is none"
    )
    parser.add_argument("--limits", metavar="LOW,HIGH", help=limits)
    parser.add_argument("--clip", action="store_true", help="move onto the limits")


def run(arguments: argparse.Namespace) -> None:
    """Invert and print."""
    calibration = Calibration.load(arguments.calibration)
    table = read_table(arguments.file)
    desired = columns_of(table, arguments.columns, calibration.output_names)
    limits = None
    if arguments.limits is not None:
        limits = _limits(arguments.limits, calibration.num_inputs)
    elif arguments.clip:
        raise ValueError("--clip needs --limits")
    commands = calibration.command_for(desired, limits=limits, clip=arguments.clip)
    emit(arguments, calibration.input_names, commands)


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
