"""``read_table``: the table of a file, or of a frame."""

from __future__ import annotations

import os
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from jaxcal.checks import axis_letter
from jaxcal.tables.cells import decimal_mark, numbers_of
from jaxcal.tables.frames import table_of_frame
from jaxcal.tables.names import say
from jaxcal.tables.table import Table, table_of
from jaxcal.tables.text import decoded, sheet_of

__all__ = ["parse", "read_table"]


def read_table(path: Any) -> Table:
    """Read a table of a file or a data frame.

    Files are CSV as spreadsheets, R, numpy and loggers write it: cells separated by
    commas, semicolons, tabs or blanks, decimal points or commas, comments after #, a
    row of units, UTF-8, UTF-16 or cp1252. Frames are of pandas, polars or pyarrow, a
    dict of columns, an xarray dataset, or rows that have names.

    Args:
        path: of the file, ``-`` for standard input, or the frame.

    Returns:
        The table. ``decisions`` says what each column is.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and what is wrong in it: the line, the column and
            the cell.
    """
    if not isinstance(path, str | os.PathLike):
        return table_of_frame("table", path)
    if path == "-":
        stream = getattr(sys.stdin, "buffer", None)
        data = stream.read() if stream else sys.stdin.read().encode()
        return parse("standard input", data)
    return parse(os.fspath(path), pathlib.Path(path).read_bytes())


def parse(source: str, data: bytes) -> Table:
    """The table in the bytes of a file; ``source`` is its name in errors."""
    text, note = decoded(source, data)
    try:
        table, notes = _of_text(source, text)
    except ValueError as error:
        raise ValueError(f"{error}; {note}" if note else str(error)) from None
    if notes := [*filter(None, [note]), *notes]:
        say(f"{source}: {'; '.join(notes)}")
    return table


def _of_text(source: str, text: str) -> tuple[Table, list[str]]:
    """The table in a text, and what is to be said of how it was read."""
    sheet = sheet_of(source, text)
    rows, notes = sheet.rows, [*sheet.notes]
    _, header = rows[0]
    mark = decimal_mark(
        [cell for _, row in rows for cell in row], sheet.delimiter != ","
    )
    if not sheet.headed:
        header = [f"u_{axis_letter(i, len(header))}" for i in range(len(header))]
    elif numbers := [cell for cell in header if _is_plain(cell)]:
        name = next(cell for cell in header if not _is_plain(cell))
        raise ValueError(
            f"{source}: line {rows[0][0]} must hold names alone or numbers alone, got "
            f"{name!r} and {numbers[0]!r}: give every column a name"
        )
    elif not (rows := rows[1:]):
        raise ValueError(f"{source}: there are no rows below the header")
    columns = dict[str, Sequence[str]]()
    for place, name in enumerate(header, start=1):
        cells = [row[place - 1] for _, row in rows]
        if header.count(name) > 1 and name:
            raise ValueError(f"{source}: column {name!r} comes twice")
        if name:
            columns[name] = cells
        elif any(cells):
            notes += _unnamed(source, place, cells, columns)
    lines = tuple(line for line, _ in rows)
    table = table_of(source, columns, lines, mark, headed=sheet.headed)
    if not table.names:
        raise ValueError(f"{source}: no column holds numbers: {', '.join(header)}")
    return table, notes


def _is_plain(cell: str) -> bool:
    return numbers_of([cell])[0] is not None and bool(cell)


def _unnamed(
    source: str, place: int, cells: Sequence[str], columns: dict[str, Sequence[str]]
) -> list[str]:
    """What is said of a column without a name, a frame's index; words are labels."""
    if not any(map(_is_plain, cells)) and "index" not in columns:
        columns["index"] = cells
        return []
    if len({*cells}) == len(cells) and all(cell.isdecimal() for cell in cells):
        return [f"column {place} is not read: it counts the rows"]
    raise ValueError(f"{source}: column {place} has no name")
