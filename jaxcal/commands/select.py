"""``jaxcal select``: the few rows of a table worth measuring.

A column named available (0 or 1) says which rows may be chosen. Columns of text are
kept as labels. Without --k the fewest rows that identify the model are chosen.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import numpy as np

from jaxcal.arguments import several
from jaxcal.commands.tables import Table, add_output, read_table, written
from jaxcal.information.excitation import require_excited
from jaxcal.models import Affine, Model, Noise, SerialChain, from_dict
from jaxcal.selection import Design, Selection
from jaxcal.selection.criteria import CRITERIA
from jaxcal.selection.solvers import OPTIONS

__all__ = [
    "add_arguments",
    "add_criterion",
    "add_design",
    "add_model",
    "criterion_of",
    "design_of",
    "numbers",
    "one_or_all",
    "read_model",
    "run",
    "show",
    "whole_numbers",
]

numbers = several(float, "numbers")
whole_numbers = several(int, "whole numbers")


def add_model(parser: argparse.ArgumentParser) -> None:
    """``--model``: a model from a file."""
    what = "model: JSON of its to_dict(), or an arm's .urdf; y = A u + b by default"
    parser.add_argument("--model", metavar="FILE", help=what)


def read_model(path: str | None) -> Model | None:
    """The model in a file; None without one.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and what is wrong in it.
    """
    if path is None:
        return None
    if path.lower().endswith(".urdf"):
        return SerialChain.from_urdf(path)
    try:
        read = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except ValueError:
        raise ValueError(
            f"{path}: a model must be a JSON file of its to_dict(), or an arm's .urdf"
        ) from None
    if isinstance(read, dict) and read.get("format") == "jaxcal-calibration":
        raise ValueError(
            f"{path}: a model is needed, this is a calibration; commands that apply "
            "one are predict and command"
        )
    try:
        return from_dict(read)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def add_design(parser: argparse.ArgumentParser, noise_needed: bool = False) -> None:
    """The table of candidates, what is measured, and what a choice may hold."""
    add = parser.add_argument
    add("file", metavar="FILE", help="candidates: .csv, .npz or -")
    columns = "columns of commands; those that begin with u_, else all of numbers"
    add("--columns", metavar="A,B", help=columns)
    add_model(parser)
    outputs = "outputs of y = A u + b; as many as commands"
    add("--outputs", dest="num_outputs", type=int, metavar="M", help=outputs)
    noise = "standard deviation of a measurement; one number or one per output"
    add("--noise", type=numbers, required=noise_needed, metavar="S", help=noise)
    often = "how often one row may be measured; 1"
    cap: dict[str, Any] = {"dest": "max_replicates", "default": 1, "metavar": "R"}
    add("--replicates", type=int, help=often, **cap)
    required = "rows, counted from 0, that must be chosen"
    add("--required", type=whole_numbers, metavar="I,J", help=required)


def design_of(arguments: argparse.Namespace, table: Table) -> Design:
    """The problem that the flags of ``add_design`` and a table describe."""
    candidates = table.frame(table.inputs(arguments.columns))
    model, outputs = read_model(arguments.model), arguments.num_outputs
    if outputs is not None:
        if model is not None:
            raise ValueError("--outputs must be left out with --model, which has them")
        model = Affine(len(candidates.columns), outputs)
    mask = table.available()
    if arguments.model is None:  # said here in the names of the columns
        used = candidates.values if mask is None else candidates.values[mask]
        distinct = f"rows ({len(np.unique(used, axis=0))} of them distinct)"
        require_excited(used, candidates.columns, table.source, distinct)
    return Design(
        candidates,
        model,
        noise=None if arguments.noise is None else Noise(one_or_all(arguments.noise)),
        available=mask,
        required=arguments.required,
        max_replicates=arguments.max_replicates,
    )


def one_or_all(values: list[float]) -> float | list[float]:
    """The number itself where there is one."""
    return values[0] if len(values) == 1 else values


def add_criterion(parser: argparse.ArgumentParser) -> None:
    """How good a choice is."""
    criterion = "D for y = A u + b, I for another model"
    parser.add_argument("--criterion", choices=tuple(CRITERIA), help=criterion)
    names = "of Ds and As: the parameters of interest"
    parser.add_argument(
        "--parameters", type=lambda x: x.split(","), metavar="A,B", help=names
    )


def criterion_of(arguments: argparse.Namespace) -> Any:
    """The criterion that the flags of ``add_criterion`` describe."""
    name, parameters = arguments.criterion, arguments.parameters
    if (name in ("Ds", "As")) != (parameters is not None):
        raise ValueError(
            "--parameters, those of interest, must be given with --criterion Ds or As, "
            f"and with no other, got {parameters!r} with {name!r}"
        )
    return name if parameters is None else CRITERIA[name](parameters)  # type: ignore[call-arg]  # these two take them


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_design(parser)
    add = parser.add_argument
    add("-k", "--k", type=int, metavar="K", help="rows to choose")
    methods = "auto (the cheapest proof), exact, exchange, greedy, random or policy"
    add("--method", default="auto", help=methods)
    add_criterion(parser)
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
    options = {name: getattr(arguments, name) for name in OPTIONS}
    selection = design_of(arguments, table).select(
        arguments.k,
        criterion_of(arguments),
        arguments.method,
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
