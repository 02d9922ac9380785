"""``jaxcal select``, ``score`` and ``plan``: questions to a table of candidates."""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
from typing import Any

import numpy as np

from jaxcal.arguments import flag, several
from jaxcal.commands.tables import OUTPUT, Table, read_table, written
from jaxcal.information.excitation import require_excited
from jaxcal.models import Affine, Model, Noise, SerialChain, from_dict
from jaxcal.selection import Design, Selection
from jaxcal.selection.criteria import CRITERIA
from jaxcal.selection.solvers import OPTIONS

__all__ = ["FLAGS", "MODEL", "plan", "read_model", "score", "select"]

_numbers = several(float, "numbers")
_rows = several(int, "whole numbers")

MODEL = flag(
    "--model", "model: JSON of its to_dict(), or an arm's .urdf; y = A u + b by default"
)
_DESIGN = (
    flag("file", "candidates: .csv, .npz or -"),
    flag("--columns", "commands; those that begin with u_, else all of numbers", "A,B"),
    MODEL,
    flag("--outputs", "of y = A u + b; as many as commands", "M", int),
    flag(
        "--noise", "std of a measurement; one number or one per output", "S", _numbers
    ),
    flag("--replicates", "how often one row may be measured", "R", int, default=1),
    flag("--required", "rows, counted from 0, that must be chosen", "I,J", _rows),
)
_CRITERION = (
    flag("--criterion", "D for y = A u + b, I for another model", choices=CRITERIA),
    flag("--parameters", "of Ds and As: the parameters of interest", "A,B",
         several(str, "names")),
)  # fmt: skip
FLAGS = {
    "select": (
        *_DESIGN,
        flag("-k", "rows to choose", "K", int, long="--k"),
        flag("--method", "auto (the cheapest proof), exact, exchange, greedy, random, "
             "policy", "NAME", default="auto"),
        *_CRITERION,
        flag("--seed", "of methods that draw at random; 0", "S", int),
        flag("--restarts", "random starts of the exchange", "N", int),
        flag("--time-limit", "of auto and exact; 10", "SECONDS", float),
        flag("--best", "the B best, of exact", "B", int),
        flag("--least-efficiency", "of auto: D-efficiency in (0, 1] to prove; 0.999",
             "E", float),
        flag("--checkpoint", "a trained policy", "DIR"),
        flag("--decoding", "of policy: greedy, first, samples, exchange", "NAME"),
        flag("--num", "tries of first and samples; 16", "N", int),
        *OUTPUT,
    ),
    "score": (
        *_DESIGN,
        *_CRITERION,
        flag("--indices", "rows, counted from 0", "I,J", _rows),
        flag("--subset", "table with a column index, as select --csv writes it"),
        flag("--reference", "an upper bound or the proven optimum", default="bound",
             choices=("bound", "exact")),
        flag("--time-limit", "of exact", "SECONDS", float),
        *OUTPUT,
    ),
    "plan": (
        *_DESIGN,
        flag("--accuracy", "standard error that a prediction may have; one number or "
             "one per output", "E", _numbers, required=True),
        flag("--criterion", "G: the largest standard error over the candidates; I: the "
             "average", default="G", choices=("G", "I")),
        flag("--max-k", "most measurements", "K", int),
        flag("--more", "rows beyond the answer", "N", int, default=0),
        *OUTPUT,
    ),
}  # fmt: skip


def select(arguments: argparse.Namespace) -> None:
    """Choose the few rows of a table worth measuring.

    A column named available (0 or 1) says which rows may be chosen. Columns of text are
    kept as labels. Without --k the fewest rows that identify the model are chosen.
    """
    table = read_table(arguments.file)
    options = {name: getattr(arguments, name) for name in OPTIONS}
    selection = _design(arguments, table).select(
        arguments.k,
        _criterion(arguments),
        arguments.method,
        **{name: value for name, value in options.items() if value is not None},
    )
    _show(selection, table, arguments)


def score(arguments: argparse.Namespace) -> None:
    """Judge a choice made elsewhere."""
    table, indices = read_table(arguments.file), arguments.indices
    if (indices is None) == (arguments.subset is None):
        raise ValueError("one of --indices and --subset must be given")
    if indices is None:
        if set(arguments.subset) <= set("0123456789, "):
            raise ValueError(
                f"--subset must be a file, got {arguments.subset!r}; rows by their "
                f"numbers are --indices {arguments.subset}"
            )
        column = read_table(arguments.subset).columns(["index"])[:, 0]
        if not (column == column.round()).all():
            raise ValueError(f"{arguments.subset}: index must hold whole numbers")
        indices = column.astype(int)
    selection = _design(arguments, table).score(
        indices,
        _criterion(arguments),
        reference=arguments.reference,
        time_limit=arguments.time_limit,
    )
    _show(selection, table, arguments)


def plan(arguments: argparse.Namespace) -> None:
    """How many measurements a wanted accuracy takes."""
    if arguments.noise is None:
        raise ValueError("--noise, the std of a measurement, must be given")
    result = _design(arguments, read_table(arguments.file)).plan(
        _one_or_all(arguments.accuracy),
        criterion=arguments.criterion,
        max_k=arguments.max_k,
        more=arguments.more,
    )
    header = ("k", "distinct", "standard_error", "least_error")
    rows = [
        [row.k, row.num_distinct, row.standard_error.max(), row.least_error.max()]
        for row in result.rows
    ]
    if not written(arguments, header, rows, dataclasses.asdict(result)):
        print(result.table())
        print(f"measure rows {', '.join(str(i) for i in result.indices)}")


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


def _design(arguments: argparse.Namespace, table: Table) -> Design:
    """The problem that the flags of ``_DESIGN`` and a table describe."""
    candidates = table.frame(table.inputs(arguments.columns))
    model, outputs = read_model(arguments.model), arguments.outputs
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
        noise=None if arguments.noise is None else Noise(_one_or_all(arguments.noise)),
        available=mask,
        required=arguments.required,
        max_replicates=arguments.replicates,
    )


def _one_or_all(values: list[float]) -> float | list[float]:
    """The number itself where there is one."""
    return values[0] if len(values) == 1 else values


def _criterion(arguments: argparse.Namespace) -> Any:
    """The criterion that the flags of ``_CRITERION`` describe."""
    name, parameters = arguments.criterion, arguments.parameters
    if (name in ("Ds", "As")) != (parameters is not None):
        raise ValueError(
            "--parameters, those of interest, must be given with --criterion Ds or As, "
            f"and with no other, got {parameters!r} with {name!r}"
        )
    return name if parameters is None else CRITERIA[name](parameters)  # type: ignore[call-arg]  # these two take them


def _show(selection: Selection, table: Table, arguments: argparse.Namespace) -> None:
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
