"""Frames, and rows that have names: pandas, polars, pyarrow, xarray, dicts, tuples."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from jaxcal.tables.cells import decimal_mark, numbers_of
from jaxcal.tables.decisions import decide
from jaxcal.tables.names import COMMANDS, MEASURED, columns_by_name, say
from jaxcal.tables.table import Table, table_of

__all__ = [
    "columns_of",
    "inputs_of",
    "names_in",
    "of_frame",
    "outputs_of",
    "table_of_frame",
]


def columns_of(argument: str, values: Any) -> dict[str, Any] | None:
    """Columns by their names, or the numbers of one row; None of what has no names.

    Raises:
        ValueError: a name comes twice, or some columns have none.
    """
    try:
        return _columns_of(values)
    except ValueError as error:
        raise ValueError(f"{argument}: {error}") from None


def _columns_of(values: Any) -> dict[str, Any] | None:
    if isinstance(values, Table):
        return dict(zip(values.names, values.values.T, strict=True)) | values.labels
    if isinstance(values, list | tuple) and values and not hasattr(values, "_fields"):
        if _columns_of(values[0]) is None:
            return None
        rows: list[Any] = [*map(_columns_of, values)]
        return {name: [_cell(row, name) for row in rows] for name in rows[0]}
    if hasattr(values, "collect") and not hasattr(values, "to_numpy"):
        values = values.collect()  # of a lazy frame
    names = _names(values)
    if not any(isinstance(name, str | tuple) for name in names):
        return None
    for name in names:
        if not isinstance(name, str):
            raise ValueError(f"every column must have a name, a text, got {name!r}")
        if names.count(name) > 1:
            raise ValueError(f"column {name!r} comes twice")
    if hasattr(values, "_fields"):
        return dict(zip(names, values, strict=True))
    if hasattr(values, "dims") and not hasattr(values, "data_vars"):
        return dict(zip(names, np.moveaxis(values.values, -1, 0), strict=True))
    return {name: _cell(values, name) for name in names}


def _names(values: Any) -> list[Any]:
    """Names as values hold them; [] where they have none."""
    if isinstance(values, np.ndarray | np.void):
        return [*(values.dtype.names or ())]
    if hasattr(values, "dims") and not hasattr(values, "data_vars"):
        axis = values.coords.get(values.dims[-1]) if values.dims else None
        return [] if axis is None else [*axis.values.tolist()]
    for kind in ("_fields", "data_vars", "column_names", "columns"):
        if hasattr(values, kind):
            return [*getattr(values, kind)]
    if isinstance(values, Mapping):
        return [*values]
    index = getattr(values, "index", None)  # of a series, which may be a row
    return [] if index is None or callable(index) else [*index]


def _cell(values: Any, name: str) -> Any:
    """The column, or the number, of this name."""
    try:
        return values[name]
    except KeyError:
        raise ValueError(f"every row must have {name!r}, one has not") from None


def _column(values: Any) -> Any:
    """An array of numbers, or of what is none a list of cells."""
    array = np.asarray(values)
    if array.dtype.kind in "iuf":
        return array
    if array.dtype.kind in "mM":
        array = array.astype(str)
    cells = array.astype(object).ravel().tolist()
    return ["" if str(x) in ("None", "nan", "NaT", "<NA>") else str(x) for x in cells]


def of_frame(
    argument: str, frame: Any, wanted: Sequence[str], prefix: str, used: Any = None
) -> Any:
    """The ``wanted`` columns (..., n) of a frame, or of rows, by name; else as given.

    Args:
        argument: its name in errors.
        frame: what ``columns_of`` takes, or has no names.
        wanted: names.
        prefix: that they, or the columns, may lack.
        used: (N,) rows whose numbers must be finite; all when not given.

    Raises:
        ValueError: a name is missing, or could be either of two; a cell is no number.
    """
    names = names_in(argument, frame, wanted, prefix)
    if names is None:
        return frame
    columns = columns_of(argument, frame) or {}
    arrays = [_numbers(argument, name, columns[name], used) for name in names]
    return np.stack(arrays, axis=-1)


def names_in(
    argument: str,
    frame: Any,
    wanted: Sequence[str],
    prefix: str,
    beside: Collection[str] | None = None,
) -> Any:
    """The columns of a frame that ``of_frame`` takes; None: it has no names.

    Args:
        argument: its name in errors.
        frame: what ``columns_of`` takes, or has no names.
        wanted: names.
        prefix: that they, or the columns, may lack.
        beside: columns that are read too; where it is given, others are said.
    """
    columns = columns_of(argument, frame)
    if columns is None:
        return None
    try:
        names = columns_by_name(wanted, [*columns], prefix)
    except ValueError as error:
        raise ValueError(f"{argument}: {error}") from None
    if None in names:
        raise ValueError(
            f"{argument} must have the columns {', '.join(wanted)}, "
            f"{wanted[names.index(None)]!r} is missing (columns: {', '.join(columns)})"
        )
    if beside is not None:
        table = table_of_frame(argument, frame)
        if text := table.unread(names, prefix, beside):
            say(f"{argument}: {text}")
    return tuple(names)


def _numbers(argument: str, name: str, values: Any, used: Any) -> Any:
    """Numbers of a column, or of a row's cell; NaN only where it is not used."""
    array = np.asarray(values)
    if array.dtype.kind == "b":
        array = array.astype(np.float64)
    elif isinstance(cells := _column(values), list):
        numbers = numbers_of(cells, *decimal_mark(cells, True))
        for row, number in enumerate(numbers):
            if number is None:
                raise ValueError(
                    f"{argument}: row {row}, column {name!r} must hold a number, got "
                    f"{cells[row]!r}"
                )
        array = np.array(numbers, dtype=np.float64).reshape(array.shape)
    bad = ~np.isfinite(array)
    for place in np.argwhere(bad if used is None else bad & used)[:1]:
        where = f"row {place[0]}, " if len(place) else ""
        raise ValueError(
            f"{argument}: {where}column {name!r} must be finite, got {array[*place]}"
        )
    return array


def table_of_frame(argument: str, frame: Any) -> Table:
    """The table of a frame, or of rows that have names; its index, if named, a label.

    Raises:
        ValueError: it has no names, or a column under u_ holds words.
    """
    if isinstance(frame, Table):
        return frame
    columns = columns_of(argument, frame)
    if columns is None:
        raise ValueError(
            f"{argument} must be a path or have names of its columns, got "
            f"{type(frame).__name__}"
        )
    arrays = {name: _column(np.atleast_1d(x)) for name, x in columns.items()}
    count = len(next(iter(arrays.values())))
    for name, array in arrays.items():
        if len(array) != count:
            raise ValueError(
                f"{argument}: column {name!r} must hold {count} rows, got {len(array)}"
            )
    table = table_of(argument, arrays, range(count), None, row="row")
    index: Any = getattr(frame, "index", None)
    if isinstance(label := getattr(index, "name", None), str):
        table.labels.setdefault(label, [*map(str, index)])
    return table


def inputs_of(argument: str, frame: Any, outputs: Sequence[str] = ()) -> Any:
    """Names of the commands in a frame, by the rules of files; None: it has no names.

    Args:
        argument: its name in errors.
        frame: what ``columns_of`` takes.
        outputs: columns of it that are readings.
    """
    if columns_of(argument, frame) is None:
        return None
    return table_of_frame(argument, frame).commands(None, None, outputs)


def outputs_of(argument: str, frame: Any, beside: bool) -> Any:
    """Names of the readings in a frame; None: it has no names.

    All but commands, u_..., and what is no reading by its name: the time, a number of
    the rows.

    Args:
        argument: its name in errors.
        frame: what ``columns_of`` takes.
        beside: commands are in it too, so that readings are y_... alone.
    """
    if columns_of(argument, frame) is None:
        return None
    table = table_of_frame(argument, frame)
    if beside:
        return table.outputs(None, "y_...")
    decisions = decide(table)
    names = [name for name in table.names if not name.startswith(COMMANDS)]
    spare = [x for x in names if decisions[x].role in ("time", "available")]
    spare += [x for x in names if decisions[x].reason.startswith("it counts")]
    words = [name for name in table.labels if name.startswith(MEASURED)]
    names = [name for name in names if name not in spare] or names
    if not words and (unread := [x for x in table.header if x not in names]):
        say(f"{argument}: readings {', '.join(names)}; not read: {', '.join(unread)}")
    return (*names, *words)
