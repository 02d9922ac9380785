"""``jaxcal predict``: where a calibrated machine goes for given commands."""

from __future__ import annotations

import argparse

import numpy as np

from jaxcal.calibration import Calibration
from jaxcal.commands.tables import Table, read_table, write_json, write_rows

__all__ = ["add_arguments", "add_files", "emit", "run"]


def add_files(parser: argparse.ArgumentParser, what: str) -> None:
    """The calibration, the table and where the answer goes."""
    parser.add_argument("calibration", metavar="CALIBRATION", help="calibration.json")
    parser.add_argument("file", metavar="FILE", help=f"{what}: .csv, .npz or -")
    parser.add_argument("--columns", metavar="A,B", help=f"columns of {what}")
    parser.add_argument("--json", action="store_true", help="print JSON, not CSV")
    parser.add_argument("--out", metavar="FILE", help="write to FILE (.csv or .json)")


def emit(
    arguments: argparse.Namespace, names: tuple[str, ...], values: np.ndarray
) -> None:
    """Rows (N, len(names)) as CSV or JSON."""
    out = arguments.out
    if arguments.json or (out and out.endswith(".json")):
        rows = [dict(zip(names, row, strict=True)) for row in values.tolist()]
        write_json(out, rows)
    else:
        write_rows(out, names, values.tolist())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_files(parser, "commands")
    parser.add_argument(
        "--std",
        action="store_true",
        help="and the standard error of each output, where the noise is known",
    )


def run(arguments: argparse.Namespace) -> int:
    """Predict and print."""
    calibration = Calibration.load(arguments.calibration)
    table = read_table(arguments.file)
    columns = columns_of(table, arguments.columns, calibration.input_names)
    commands = table.columns(columns)
    names, values = calibration.output_names, calibration.predict(commands)
    if arguments.std:
        names = (*names, *(f"std_{name}" for name in names))
        values = np.concatenate([values, calibration.predict_std(commands)], axis=1)
    emit(arguments, names, values)
    return 0


def columns_of(
    table: Table, chosen: str | None, known: tuple[str, ...]
) -> tuple[str, ...]:
    """The calibration's own names where the table has them, else all of numbers."""
    if chosen is None and set(known) <= set(table.names):
        return known
    columns: tuple[str, ...] = table.inputs(chosen) if chosen else table.names
    if len(columns) != len(known):
        raise ValueError(
            f"{table.source}: {len(known)} columns are needed ({', '.join(known)}), "
            f"got {len(columns)} ({', '.join(columns)}); name them with --columns"
        )
    return columns
