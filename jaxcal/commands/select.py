"""``jaxcal select``: the few rows of a table worth measuring."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from jaxcal.commands.tables import Table, read_table, write_json, write_rows
from jaxcal.selection import Selection, select

__all__ = ["add_arguments", "add_candidates", "add_output", "run", "whole_numbers"]

EPILOG = """\
A column named available (0 or 1) says which rows may be chosen. Columns of text are
kept as labels. Without --k the fewest rows that identify the model are chosen."""

_OPTIONS = (
    "seed",
    "restarts",
    "time_limit",
    "best",
    "checkpoint",
    "decoding",
    "num",
    "least_efficiency",
)


def add_candidates(parser: argparse.ArgumentParser) -> None:
    """The table of candidates and what a choice may hold."""
    parser.add_argument("file", metavar="FILE", help="candidates: .csv, .npz or -")
    parser.add_argument(
        "--columns",
        metavar="A,B",
        help="columns of commands; those that begin with u_, else all of numbers",
    )
    parser.add_argument(
        "--outputs",
        dest="num_outputs",
        type=int,
        metavar="M",
        help="outputs of the machine; as many as commands",
    )
    parser.add_argument(
        "--replicates",
        dest="max_replicates",
        type=int,
        default=1,
        metavar="R",
        help="how often one row may be measured; 1",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Where the answer goes and in which form."""
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print JSON")
    form.add_argument("--csv", action="store_true", help="print CSV")
    parser.add_argument(
        "--out", metavar="FILE", help="write to FILE (.csv or .json) instead"
    )


def whole_numbers(text: str) -> list[int]:
    """Whole numbers separated by commas."""
    try:
        return [int(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be whole numbers separated by commas, got {text!r}"
        ) from None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_candidates(parser)
    parser.add_argument("-k", "--k", type=int, metavar="K", help="rows to choose")
    parser.add_argument(
        "--method",
        default="auto",
        help="auto (the cheapest proof), exact, exchange, greedy, random or policy",
    )
    parser.add_argument(
        "--required",
        type=whole_numbers,
        metavar="I,J",
        help="rows, counted from 0, that must be chosen",
    )
    parser.add_argument("--seed", type=int, help="of methods that draw at random; 0")
    parser.add_argument("--restarts", type=int, help="random starts of the exchange")
    parser.add_argument(
        "--time-limit", type=float, metavar="SECONDS", help="of auto and exact; 10"
    )
    parser.add_argument("--best", type=int, metavar="B", help="the B best, of exact")
    parser.add_argument(
        "--least-efficiency",
        type=float,
        metavar="E",
        help="of auto: D-efficiency in (0, 1] to prove; 0.999",
    )
    parser.add_argument("--checkpoint", metavar="DIR", help="a trained policy")
    parser.add_argument(
        "--decoding", help="of policy: greedy, first, samples, exchange"
    )
    parser.add_argument("--num", type=int, help="tries of first and samples; 16")
    add_output(parser)


def run(arguments: argparse.Namespace) -> int:
    """Choose and print."""
    table = read_table(arguments.file)
    names = table.inputs(arguments.columns)
    given = {name: getattr(arguments, name) for name in _OPTIONS}
    selection = select(
        table.frame(names),
        arguments.k,
        arguments.method,
        available=table.available(),
        required=arguments.required,
        max_replicates=arguments.max_replicates,
        num_outputs=arguments.num_outputs,
        **{name: value for name, value in given.items() if value is not None},
    )
    show(selection, table, arguments)
    return 0


def show(selection: Selection, table: Table, arguments: argparse.Namespace) -> None:
    """The rows chosen, as a table for people, CSV or JSON."""
    out = arguments.out
    if arguments.json or (out and out.endswith(".json")):
        document = selection.to_dict()
        document["rows"] = [row_of(table, i) for i in selection.indices]
        write_json(out, document)
    elif arguments.csv or out:
        header = ["index", *table.labels, *table.names]
        rows = [
            [int(i), *(column[i] for column in table.labels.values()), *numbers]
            for i, numbers in zip(
                selection.indices, table.values[selection.indices].tolist(), strict=True
            )
        ]
        write_rows(out, header, rows)
    else:
        print(selection)


def row_of(table: Table, index: int | np.integer[Any]) -> dict[str, Any]:
    """One row of a table by column name."""
    numbers = dict(zip(table.names, table.values[index].tolist(), strict=True))
    return {name: column[index] for name, column in table.labels.items()} | numbers
