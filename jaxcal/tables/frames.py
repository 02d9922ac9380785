"""Frames, and rows that have names: pandas, polars, pyarrow, xarray, dicts, tuples."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from jaxcal.tables.decisions import (
    COMMANDS,
    COUNTED,
    MEASURED,
    columns_by_name,
    decide,
    is_available,
    say,
)
from jaxcal.tables.table import Table, table_of

_ENDS = ("low", "high"), ("min", "max")  # of limits, by name


def header_of(argument: str, values: Any) -> list[str]:
    """Names of the columns of a frame, or of a row's numbers; [] where there are none.
    A ValueError where one comes twice or is no text, or a row has another."""
    names = _names(values)
    if not any(isinstance(name, str | tuple) for name in names):
        return []
    for name in names:
        if not isinstance(name, str):
            raise ValueError(
                f"{argument}: every column needs a text as its name, got {name!r}"
            )
        if names.count(name) > 1:
            raise ValueError(f"{argument}: column {name!r} comes twice")
    rows = values if isinstance(values, list | tuple) else ()
    for i, row in enumerate(rows):
        if isinstance(row, Mapping) and (more := row.keys() - {*names}):
            raise ValueError(
                f"{argument}: row {i} has {min(map(str, more))!r}, which row 0 lacks"
            )
    if hasattr(values, "columns"):
        for name in getattr(getattr(values, "index", None), "names", None) or ():
            if isinstance(name, str) and name.startswith((COMMANDS, MEASURED)):
                raise ValueError(
                    f"{argument}: {name!r} is in the index; frame.reset_index() makes "
                    "it a column"
                )
    return names


def by_name(argument: str, values: Any) -> Any:
    """A row that has names as a dict, else as given."""
    if values is None or isinstance(values, int | float | Mapping):
        return values
    names = header_of(argument, values)
    if not names:
        return values
    return {name: _column(values, name) for name in names}


def require_unnamed(argument: str, values: Any) -> None:
    """Refuse a row that has names where nothing says which belongs where."""
    if names := header_of(argument, values):
        raise ValueError(
            f"{argument} is read by position, and this has the names "
            f"{', '.join(names)}: pass its numbers alone, in the order of the columns"
        )


def _names(values: Any) -> list[Any]:
    """Names as values hold them; [] where they have none."""
    if isinstance(values, np.ndarray | np.void):
        return [*(values.dtype.names or ())]
    if isinstance(values, list | tuple) and not hasattr(values, "_fields"):  # rows
        number = not values or isinstance(values[0], int | float)
        return [] if number else _names(values[0])
    if isinstance(values, Table):
        return [*values.header]
    if _is_labelled(values):
        axis = values.coords.get(values.dims[-1]) if values.dims else None
        return [] if axis is None else [*axis.values.tolist()]
    for kind in ("_fields", "data_vars", "column_names", "columns"):
        if hasattr(values, kind):
            return [*getattr(values, kind)]
    if isinstance(values, Mapping):
        return [*values]
    index = getattr(values, "index", None)  # of a series, which may be a row
    return [] if index is None or callable(index) else [*index]


def _is_labelled(values: Any) -> bool:
    """Whether it is an array of xarray, whose last axis may have names."""
    return hasattr(values, "dims") and not hasattr(values, "data_vars")


def _column(values: Any, name: str) -> Any:
    """The column, or the number, of this name, as it is held."""
    if isinstance(values, Table):
        if name in values.labels:
            return values.labels[name]
        return values.values[:, values.names.index(name)]
    if hasattr(values, "_fields"):
        return _unmasked(getattr(values, name))
    if isinstance(values, list | tuple):
        return [_column(row, name) for row in values]
    if _is_labelled(values) or not hasattr(values, "__getitem__"):
        return np.asarray(values)[..., _names(values).index(name)]
    try:
        return _unmasked(values[name])
    except KeyError:
        raise ValueError(f"a row lacks {name!r}") from None


def _unmasked(column: Any) -> Any:
    """The column, its masked values made NaN or None."""
    if not isinstance(column, np.ma.MaskedArray):
        return column
    values, masked = np.ma.getdata(column), np.ma.getmaskarray(column)
    if values.dtype.kind in "iuf":
        return np.where(masked, np.nan, values)
    return np.where(masked, np.array(None), values.astype(object))


def _shape(column: Any) -> tuple[int, ...]:
    """Shape of a column as it says, (N,) of lists that differ in length."""
    try:
        return np.shape(column)
    except ValueError:
        return (len(column),)


def _cells(column: Any) -> Any:
    """A flat array of numbers, or of what is none a list of cells."""
    try:
        array = np.asarray(column)
    except ValueError:
        array = np.empty(0)
    if array.shape != _shape(column):
        return [*map(str, column)]  # structs, or lists
    array = array.ravel()
    if array.dtype.kind in "iuf":
        return array
    if array.dtype.kind in "mM":
        array = array.astype(str)
    cells = array.astype(object).tolist()
    return ["" if str(x) in ("None", "nan", "NaT", "<NA>") else str(x) for x in cells]


def of_frame(
    argument: str,
    frame: Any,
    wanted: Sequence[str],
    prefix: str,
    used: Any = None,
    levels: Sequence[Sequence[str]] = (),
    beside: Collection[str] | None = None,
) -> Any:
    """The ``wanted`` columns (..., n) of a frame, or of rows, by name; else as given.

    ``used`` (N,) and ``levels`` as of ``Table.columns``, whose errors it raises; of
    numbers all but these and ``beside`` are said.
    """
    frame = _collected(frame)
    names = names_in(argument, frame, wanted, prefix)
    if names is None:
        return frame
    columns = [_column(frame, name) for name in names]
    shape = _shape(columns[0])
    for name, column in zip(names, columns, strict=True):
        if _shape(column) != shape:
            raise ValueError(
                f"{argument}: column {name!r} must have the shape {shape} of "
                f"{names[0]!r}, got {_shape(column)}"
            )
    cells = [*map(_cells, columns)]
    named = dict(zip(names, cells, strict=True))
    if beside is not None:
        every = {x: _cells(_column(frame, x)) for x in header_of(argument, frame)}
        numbers = {
            name: column
            for name, column in every.items()
            if isinstance(column, np.ndarray) or is_available(name)
            if len(column) == len(cells[0])
        }
        of_numbers = table_of(argument, numbers, range(len(cells[0])), None, row="row")
        of_numbers.say_available()
        if spare := of_numbers.unread(names, prefix, beside):
            say(f"{argument}: {spare}")
    table = table_of(argument, named, range(math.prod(shape)), None, row="row")
    used = None if used is None else np.asarray(used)
    if used is not None:  # what is no mask is refused elsewhere
        valid = used.dtype.kind in "biuf" and used.shape in ((1,), (len(table),))
        used = used.astype(bool) if valid else np.zeros(1, dtype=bool)
    values = table.columns(names, used, levels).reshape(*shape, len(names))
    if any(isinstance(column, list) for column in cells):
        return values
    kind = np.concatenate([column[:0] for column in cells]).dtype
    return values.astype(kind)  # float32 is rounded, which ``select`` must know


def say_order(
    commands: Any,
    measured: Any,
    names: tuple[str, str] = ("commands", "measured"),
) -> None:
    """Say that two frames whose indices differ are paired by place."""
    first, second = names
    pair = getattr(commands, "index", None), getattr(measured, "index", None)
    one, other = ([] if x is None or callable(x) else [*x] for x in pair)
    if one != other and len(one) == len(other) and set(one) & set(other):
        same = set(one) == set(other)
        what = "the same index in different orders" if same else "indices that differ"
        k = next(k for k in range(len(one)) if one[k] != other[k])
        say(
            f"{first} and {second} have {what}. Rows are "
            f"paired by position: row {k} is {one[k]!r} in {first} and {other[k]!r} "
            f"in {second}. To pair by index use {second}.loc[{first}.index]"
        )


def _collected(frame: Any) -> Any:
    """A lazy frame read, and a series of structs as a frame."""
    lazy = hasattr(frame, "collect") and not hasattr(frame, "to_numpy")
    frame = frame.collect() if lazy else frame
    structs = getattr(getattr(frame, "struct", None), "fields", ())  # of polars
    return frame.struct.unnest() if structs else frame


def names_in(
    argument: str,
    frame: Any,
    wanted: Sequence[str],
    prefix: str,
    beside: Collection[str] | None = None,
) -> Any:
    """The columns of a frame that ``of_frame`` takes; None: it has no names. All but
    these and ``beside`` are said."""
    header = header_of(argument, frame)
    if not header:
        rows = _rows_of(frame)
        if rows and None not in columns_by_name(wanted, rows, prefix):
            raise ValueError(
                f"{argument}: {', '.join(rows)} are names of rows; transpose it (.T)"
            )
        return None
    try:
        names = columns_by_name(wanted, header, prefix)
    except ValueError as error:
        raise ValueError(f"{argument}: {error}") from None
    if None in names:
        raise ValueError(
            f"{argument} needs the columns {', '.join(wanted)}; "
            f"{wanted[names.index(None)]!r} is missing (columns: {', '.join(header)})"
        )
    if beside is not None:
        table = _all_rows(argument, frame)
        if spare := table.unread(names, prefix, beside):
            say(f"{argument}: {spare}")
    return tuple(names)


def _rows_of(frame: Any) -> list[str]:
    """Names of the rows of a frame, or of an array of xarray; [] without them."""
    rows: Any = getattr(frame, "index", ()) if hasattr(frame, "columns") else ()
    if hasattr(frame, "dims") and getattr(frame, "ndim", 2) > 1:
        axis = frame.coords.get(next(iter(frame.dims)))
        rows = () if axis is None else axis.values.tolist()
    texts = [row for row in rows if isinstance(row, str)]
    return texts if len(texts) == len(rows) else []


def limits_of_frame(limits: Any, names: Sequence[str]) -> Any:
    """(n, 2) limits of inputs that have names, of a frame or a dict by these: "low" and
    "high", or "min" and "max", and those of the inputs; else as given."""
    limits = _collected(limits)
    columns, rows = header_of("limits", limits), _rows_of(limits)
    if columns and not rows:
        rows = table_of_frame("limits", limits).row_names or []
    ends = next((pair for pair in _ENDS if {*pair} & {*columns, *rows}), ())
    wanted = [ends if {*ends} & {*x} else names or x for x in (columns, rows)]
    if columns:
        limits = of_frame("limits", limits, wanted[0], COMMANDS, [False])
    if rows:
        by_row = dict(zip(rows, np.asarray(limits), strict=True))
        limits = of_frame("limits", by_row, wanted[1], COMMANDS, [False]).T
    return limits.T if columns and wanted[0] is not ends else limits


def table_of_frame(argument: str, frame: Any) -> Table:
    """The table of a frame, or of rows that have names; its index, if named, a
    label."""
    frame = _collected(frame)
    if isinstance(frame, Table):
        return frame
    header = header_of(argument, frame)
    if not header:
        raise ValueError(
            f"{argument} must be a path or have names of its columns, got "
            f"{type(frame).__name__}"
        )
    columns = {}
    for name in header:
        column = _column(frame, name)
        if len(shape := _shape(column)) > 1 and not _is_labelled(frame):
            raise ValueError(
                f"{argument}: column {name!r} must hold one number a row, got the "
                f"shape {shape}"
            )
        columns[name] = _cells(column)
    count = len(columns[header[0]])
    for name, cells in columns.items():
        if len(cells) != count:
            raise ValueError(
                f"{argument}: column {name!r} must hold {count} rows, got {len(cells)}"
            )
    table = table_of(argument, columns, range(count), None, row="row")
    index: Any = getattr(frame, "index", None)
    if isinstance(label := getattr(index, "name", None), str):
        table.labels.setdefault(label, [*map(str, index)])
    return table


def inputs_of(argument: str, frame: Any, outputs: Sequence[str] = ()) -> Any:
    """Names of the commands in a frame, by the rules of files; None: it has no
    names."""
    if not header_of(argument, frame):
        return None
    return _all_rows(argument, frame).commands(None, None, outputs)


def _all_rows(argument: str, frame: Any) -> Table:
    """The table of a frame, whose rows all count unless they are candidates."""
    table = table_of_frame(argument, frame)
    if argument != "candidates":
        table.say_available()
    return table


def outputs_of(argument: str, frame: Any, beside: bool) -> Any:
    """Names of the readings in a frame: y_... where commands are ``beside`` them, else
    all but u_..., the time and numbers of the rows; None: it has no names."""
    if not header_of(argument, frame):
        return None
    table = table_of_frame(argument, frame)
    if beside:
        return table.outputs(None, "y_...")
    decisions = decide(table)
    names = [
        name
        for name in table.names
        if not name.startswith(COMMANDS)
        and decisions[name].role != "available"
        and decisions[name].reason != COUNTED
    ]
    names = names or [*table.names]
    words = [name for name in table.labels if name.startswith(MEASURED)]
    if not words and (unread := [x for x in table.header if x not in names]):
        say(f"{argument}: readings {', '.join(names)}; ignored: {', '.join(unread)}")
    return (*names, *words)
