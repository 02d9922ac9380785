"""``jaxcal predict``: where a calibrated machine goes for given commands."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from jaxcal.calibration import Calibration
from jaxcal.commands.tables import Table, add_output, read_table, write_rows, written

__all__ = ["add_arguments", "add_files", "columns_of", "emit", "run"]


def add_files(parser: argparse.ArgumentParser, what: str) -> None:
    """The calibration, the table and where the answer goes."""
    parser.add_argument("calibration", metavar="CALIBRATION", help="calibration.json")
    parser.add_argument("file", metavar="FILE", help=f"{what}: .csv, .npz or -")
    parser.add_argument("--columns", metavar="A,B", help=f"columns of {what}")
    add_output(parser)


def emit(
    arguments: argparse.Namespace, names: Sequence[str], values: np.ndarray
) -> None:
    """Rows (N, len(names)) as JSON, else as CSV."""
    rows = values.tolist()
    document = [dict(zip(names, row, strict=True)) for row in rows]
    if not written(arguments, names, rows, document):
        write_rows(None, names, rows)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_files(parser, "commands")
    std = "and the standard error of each output, where the noise is known"
    parser.add_argument("--std", action="store_true", help=std)


def run(arguments: argparse.Namespace) -> None:
    """Predict and print."""
    calibration = Calibration.load(arguments.calibration)
    table = read_table(arguments.file)
    commands = columns_of(table, arguments.columns, calibration.input_names)
    names, values = calibration.output_names, calibration.predict(commands)
    if arguments.std:
        names = (*names, *(f"std_{name}" for name in names))
        values = np.concatenate([values, calibration.predict_std(commands)], axis=1)
    emit(arguments, names, values)


def columns_of(table: Table, chosen: str | None, known: tuple[str, ...]) -> np.ndarray:
    """Columns chosen; else the calibration's own, else all, if they are as many."""
    columns = table.inputs(chosen) if chosen else table.names
    if chosen is None and set(known) <= set(table.names):
        columns = known
    if len(columns) != len(known):
        raise ValueError(
            f"{table.source}: {len(known)} columns are needed ({', '.join(known)}), "
            f"got {len(columns)} ({', '.join(columns)}); name them with --columns"
        )
    return table.columns(columns)
