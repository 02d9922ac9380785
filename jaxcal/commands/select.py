"""``jaxcal select``: the few rows of a table worth measuring.

A column named available (0 or 1) says which rows may be chosen. Columns of text are
kept as labels. Without --k the fewest rows that identify the model are chosen.
"""

from __future__ import annotations

import argparse
from typing import Any

from jaxcal.arguments import several
from jaxcal.commands.model import add_model, read_model
from jaxcal.commands.tables import Table, add_output, read_table, written
from jaxcal.information.criterion import CRITERIA
from jaxcal.models import Noise
from jaxcal.selection import Selection, select

__all__ = [
    "about",
    "add_about",
    "add_arguments",
    "add_candidates",
    "numbers",
    "run",
    "show",
    "whole_numbers",
]

_OPTIONS = ("seed", "restarts", "time_limit", "best", "checkpoint", "decoding", "num")

numbers = several(float, "numbers")
whole_numbers = several(int, "whole numbers")


def add_candidates(parser: argparse.ArgumentParser) -> None:
    """The table of candidates and what a choice may hold."""
    add = parser.add_argument
    add("file", metavar="FILE", help="candidates: .csv, .npz or -")
    columns = "columns of commands; those that begin with u_, else all of numbers"
    add("--columns", metavar="A,B", help=columns)
    outputs = "outputs of the machine; as many as commands"
    add("--outputs", dest="num_outputs", type=int, metavar="M", help=outputs)
    often = "how often one row may be measured; 1"
    cap: dict[str, Any] = {"dest": "max_replicates", "default": 1, "metavar": "R"}
    add("--replicates", type=int, help=often, **cap)


def add_about(parser: argparse.ArgumentParser) -> None:
    """What is measured, and how good a choice is."""
    add_model(parser)
    add = parser.add_argument
    criterion = "D for y = A u + b, I for another model"
    add("--criterion", choices=CRITERIA, help=criterion)
    names = "of Ds and As: the parameters of interest"
    add("--parameters", type=lambda x: x.split(","), metavar="A,B", help=names)
    noise = "standard deviation of a measurement; one number or one per output"
    add("--noise", type=numbers, metavar="S", help=noise)


def about(arguments: argparse.Namespace) -> dict[str, Any]:
    """The keywords of ``add_about``'s flags."""
    noise = arguments.noise
    return {
        "model": read_model(arguments.model),
        "criterion": arguments.criterion,
        "parameters": arguments.parameters,
        "noise": noise and Noise(noise[0] if len(noise) == 1 else noise),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_candidates(parser)
    add = parser.add_argument
    add("-k", "--k", type=int, metavar="K", help="rows to choose")
    methods = "auto (the cheapest proof), exact, exchange, greedy, random or policy"
    add("--method", default="auto", help=methods)
    add_about(parser)
    required = "rows, counted from 0, that must be chosen"
    add("--required", type=whole_numbers, metavar="I,J", help=required)
    add("--seed", type=int, help="of methods that draw at random; 0")
    add("--restarts", type=int, help="random starts of the exchange")
    limit = "of auto and exact; 10"
    add("--time-limit", type=float, metavar="SECONDS", help=limit)
    add("--best", type=int, metavar="B", help="the B best, of exact")
    efficiency = "of auto: D-efficiency in (0, 1] to prove; 0.999"
    add("--least-efficiency", type=float, metavar="E", help=efficiency)
    add("--checkpoint", metavar="DIR", help="a trained policy")
    add("--decoding", help="of policy: greedy, first, samples, exchange")
    add("--num", type=int, help="tries of first and samples; 16")
    add_output(parser)


def run(arguments: argparse.Namespace) -> None:
    """Choose and print."""
    table = read_table(arguments.file)
    options = {n: getattr(arguments, n) for n in (*_OPTIONS, "least_efficiency")}
    selection = select(
        table.frame(table.inputs(arguments.columns)),
        arguments.k,
        arguments.method,
        available=table.available(),
        required=arguments.required,
        max_replicates=arguments.max_replicates,
        num_outputs=arguments.num_outputs,
        **about(arguments),
        **{name: value for name, value in options.items() if value is not None},
    )
    show(selection, table, arguments)


def show(selection: Selection, table: Table, arguments: argparse.Namespace) -> None:
    """The rows chosen, as a table for people, CSV or JSON."""
    names = [*table.labels, *table.names]
    rows: list[list[Any]] = [
        [*(column[i] for column in table.labels.values()), *table.values[i].tolist()]
        for i in selection.indices
    ]
    document = selection.to_dict()
    document["rows"] = [dict(zip(names, row, strict=True)) for row in rows]
    numbered = [[int(i), *row] for i, row in zip(selection.indices, rows, strict=True)]
    if not written(arguments, ["index", *names], numbered, document):
        print(selection)
