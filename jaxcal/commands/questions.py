"""``jaxcal select`` and ``plan``: questions to a table of candidates."""

from __future__ import annotations

import dataclasses
import os
import re
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import Numbers, Was, levels, several
from jaxcal.commands.arms import ArmOptions, ModelPath
from jaxcal.commands.tables import Output, TablePath
from jaxcal.information.singular import require_excited
from jaxcal.selection import Design, Selection, Worst
from jaxcal.selection.criteria import CRITERIA, offered
from jaxcal.tables import Table, read_table

Names = Annotated[list[str] | None, several(str, "names")]
Rows = Annotated[list[int] | None, several(int, "whole numbers")]


@dataclasses.dataclass
class DesignOptions:
    """The problem that a table of candidates and these options describe."""

    RARE: ClassVar[Any] = {"required", "scenarios"}

    inputs: Annotated[
        str | None,
        "columns of commands; default those that begin with u_, else all numeric ones",
        "A,B",
        Was("columns"),
    ] = None
    model: ModelPath = None
    noise: Annotated[
        Numbers, "standard deviation of a measurement: one, or one per output", "S"
    ] = None
    replicates: Annotated[int, (1,), "how often a row may be measured", "R"] = 1
    required: Annotated[Rows, "rows that must be chosen, counted from 0", "I,J"] = None
    scenarios: Annotated[
        int | None, "average over this many random draws of the model's parameters", "N"
    ] = None

    def design(self, table: Table, of_arm: ArmOptions) -> Design:
        """The design of the candidates in a table."""
        model, mask = of_arm.machine(self.model, table), table.available()
        names = of_arm.columns(model, table, self.inputs)
        candidates = of_arm.commands(model, table, names, mask)
        if self.model is None:  # said here in the names of the columns
            used = candidates if mask is None else candidates[mask]
            distinct = f"rows ({len(np.unique(used, axis=0))} of them distinct)"
            offered = "" if mask is None else ", rows whose 'available' is 1,"
            require_excited(used, names, table.source + offered, distinct)
        design = Design(
            candidates,
            model,
            noise=self.noise,
            available=mask,
            required=self.required,
            max_replicates=self.replicates,
            scenarios=self.scenarios,
            names=table.row_names,
        )
        design.axes = names
        return design


def _of_parameters(word: str) -> str:
    """The letters of criteria that are made of the parameters of interest."""
    letters = [name for name, kind in CRITERIA.items() if kind.of_parameters]
    return f" {word} ".join(letters)


def _criterion(name: str | None, parameters: list[str] | None) -> Any:
    """The criterion as ``Design`` takes it."""
    kind = None if name is None else CRITERIA[name]
    if (kind is not None and kind.of_parameters) != (parameters is not None):
        raise ValueError(
            f"--criterion {name} needs --parameters NAME,..."
            if parameters is None
            else f"--parameters goes with --criterion {_of_parameters('or')} only"
        )
    if kind is None or parameters is None:
        return name
    return kind(parameters)  # type: ignore[call-arg]  # of_parameters


@dataclasses.dataclass
class MethodOptions:
    """Options of the methods of ``select``."""

    TITLE: ClassVar[str] = "of the method"
    RARE: ClassVar[bool] = True

    seed: Annotated[int | None, "seed of random methods; default 0", "S"] = None
    time_limit: Annotated[float | None, "for auto and exact; default 10", "SECONDS"] = (
        None
    )
    best: Annotated[int | None, "with exact: prove the B best selections", "B"] = None
    checkpoint: Annotated[str | None, "with policy: a trained policy", "DIR"] = None
    worst: Annotated[bool, "with --scenarios: by the worst, not the mean"] = False
    between: Annotated[
        bool, "then refine the chosen rows between the candidates, within their range"
    ] = False


def _scored(given: str, table: Table) -> NDArray[np.int64]:
    """(k,) rows of a selection made elsewhere."""
    if re.fullmatch(r"\s*\d+\s*(,\s*\d+\s*)*", given):
        return np.array([int(row) for row in given.split(",")])
    if given == "-" or os.path.exists(given):
        return _rows_of(read_table(given), table)
    raise ValueError(
        "--score must be rows counted from 0, such as 0,4,7, or a table "
        f"written by --csv; {given!r} is neither: no such file"
    )


def select(
    file: TablePath,
    of_design: DesignOptions,
    of_arm: ArmOptions,
    *,
    k: Annotated[
        int | None,
        "rows to choose; default the fewest that identify the model",
        "K",
    ] = None,
    method: Annotated[
        str,
        "auto (the cheapest proof), exact, exchange, greedy, random, policy",
        "NAME",
    ] = "auto",
    criterion: Annotated[
        str | None, "default D for affine models, else I", offered()
    ] = None,
    parameters: Annotated[
        Names, f"parameters of interest, with {_of_parameters('and')}", "A,B"
    ] = None,
    score: Annotated[
        str | None,
        "score this selection: rows counted from 0, or a table written by --csv",
        "ROWS|FILE",
        Was("indices"),
        Was("subset"),
    ] = None,
    of_method: MethodOptions,
    output: Output,
) -> None:
    """Choose the few rows of a table worth measuring, or score a selection (--score).

    A column named available (0 or 1) marks the rows that may be chosen. Text columns
    are kept as labels. Without --k the fewest rows that identify the model are chosen.
    """
    table = read_table(file)
    given = vars(of_method).items()
    options = {name: x for name, x in given if x is not None and x is not False}
    design = of_design.design(table, of_arm)
    wanted = _criterion(criterion, parameters)
    if options.pop("worst", False):
        if of_design.scenarios is None:
            raise ValueError("--worst needs --scenarios N")
        wanted = Worst(wanted)
    if score is None:
        between = options.pop("between", False)
        selection = design.select(k, wanted, method, **options)
        if between and of_arm.kind != "position":
            raise ValueError(
                "--between needs a sensor that reads everywhere, not --sensor "
                f"{of_arm.kind}. In Python: design.refine(..., allowed=arm.reachable())"
            )
        if between:
            refined = design.refine(selection, criterion=wanted)
            names, rows = list(design.axes or ()), refined.commands.tolist()
            if not output.written(names, rows, refined.to_dict()):
                print(refined)
            return
    else:
        if others := [f"--{name.replace('_', '-')}" for name in sorted(options)]:
            raise ValueError(f"Leave out with --score: {', '.join(others)}")
        if k is not None or method != "auto":
            raise ValueError("Leave out -k and --method with --score")
        selection = design.score(_scored(score, table), wanted)
    _show(selection, table, output)


def plan(
    file: TablePath,
    of_design: DesignOptions,
    of_arm: ArmOptions,
    *,
    accuracy: Annotated[
        float | list[float],
        "largest allowed standard error of a prediction: one, or one per output",
        "E",
        levels,
    ],
    criterion: Annotated[
        Literal["G", "I"],
        "G: largest standard error over the candidates; I: mean",
    ] = "G",
    output: Output,
) -> None:
    """Find the number of measurements that a wanted accuracy needs."""
    if of_design.noise is None:
        raise ValueError("--noise is missing: the standard deviation of a measurement")
    result = of_design.design(read_table(file), of_arm).plan(
        accuracy, criterion=criterion
    )
    header = ("k", "distinct", "standard_error", "least_error")
    rows = [
        [row.k, row.num_distinct, row.standard_error.max(), row.least_error.max()]
        for row in result.rows
    ]
    if not output.written(header, rows, dataclasses.asdict(result)):
        print(result)
        print(f"measure rows {', '.join(str(i) for i in result.indices)}")


def _rows_of(subset: Table, table: Table) -> NDArray[np.int64]:
    """(k,) rows of the table, by the column ``index`` of what ``select`` wrote; refused
    where the numbers beside it are not those of the table's row."""
    column = subset.columns(["index"])[:, 0]
    for line, number in zip(subset.lines, column, strict=True):
        if not (number == round(number) and 0 <= number < len(table)):
            raise ValueError(
                f"{subset.source}: line {line}, index must be a row of {table.source}, "
                f"0 to {len(table) - 1}, got {number:g}"
            )
    rows = column.astype(np.int64)
    shared = [name for name in table.names if name in subset.names and name != "index"]
    if not subset.headed or not shared:
        return rows
    in_subset, in_table = subset.columns(shared), table.columns(shared)[rows]
    for row, place in np.argwhere(
        ~np.isclose(in_subset, in_table, rtol=1e-9, atol=0.0)
    ):
        raise ValueError(
            f"{subset.cell(row, shared[place])} is {in_subset[row, place]:g}, but row "
            f"{rows[row]} of {table.source} has {in_table[row, place]:g}. This "
            "selection is from another table"
        )
    return rows


def _show(selection: Selection, table: Table, output: Output) -> None:
    names = [*table.labels, *table.names]
    rows: list[list[Any]] = [
        [*(column[i] for column in table.labels.values()), *table.values[i].tolist()]
        for i in selection.indices
    ]
    document = selection.to_dict()
    document["rows"] = [dict(zip(names, row, strict=True)) for row in rows]
    numbered = [[int(i), *row] for i, row in zip(selection.indices, rows, strict=True)]
    if not output.written(["index", *names], numbered, document):
        print(selection)
