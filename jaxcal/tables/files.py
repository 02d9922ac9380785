"""``read_table``: tables as spreadsheets, R, numpy and loggers write them."""

from __future__ import annotations

import csv
import gzip
import os
import pathlib
import re
import sys
from collections.abc import Sequence
from typing import Any

from jaxcal.checks import axis_letter
from jaxcal.tables.cells import UNIT, decimal_mark, is_number, number_of
from jaxcal.tables.decisions import say
from jaxcal.tables.frames import table_of_frame
from jaxcal.tables.table import Table, table_of

_DELIMITERS = "\t;, "  # the first of those that serve alike
_OF_R = " \t"  # with which R names rows, and not the column of these names
_LOOKED_AT = 20  # rows by which the delimiter is judged
_BREAK = re.compile(r"\s*\n\s*")  # of a line, in a quoted cell
# A line that begins with #, unless that is a spreadsheet's error: #DIV/0!, #N/A, #NV.
_COMMENT = re.compile(r"\s*#(?!([¡¿]?[^\W\da-z][^\sa-z]*[!?]|N/[AD]|NV)\s*([,;\t]|$))")


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
        if sys.stdin is None:  # <&-
            raise ValueError("standard input is closed")
        stream = getattr(sys.stdin, "buffer", None)
        data = stream.read() if stream else sys.stdin.read().encode()
        return parse("standard input", data)
    return parse(os.fspath(path), pathlib.Path(path).read_bytes())


def parse(source: str, data: bytes) -> Table:
    """The table in the bytes of a file; ``source`` is its name in errors."""
    note = ""
    try:
        text, note = _decoded(data)
        table, notes = _of_text(source, text)
    except ValueError as error:
        fault = str(error).removeprefix(f"{source}: ") + (f"; {note}" if note else "")
        raise ValueError(f"{source}: {fault}") from None
    if notes := [*filter(None, [note]), *notes]:
        say(f"{source}: {'; '.join(notes)}")
    return table


def _of_text(source: str, text: str) -> tuple[Table, list[str]]:
    """The table in a text, and what is to be said of how it was read."""
    rows, delimiter, headed, units, notes = _sheet_of(text)
    _, header = rows[0]
    mark = decimal_mark([cell for _, row in rows for cell in row], delimiter != ",")
    if not headed:
        _require_decimals(rows, delimiter)
        header = [f"u_{axis_letter(i, len(header))}" for i in range(len(header))]
    elif numbers := [cell for cell in header if _is_plain(cell)]:
        name = next(cell for cell in header if not _is_plain(cell))
        raise ValueError(
            f"line {rows[0][0]} mixes names and numbers, {name!r} and "
            f"{numbers[0]!r}: give every column a name"
        )
    elif not (rows := rows[1:]):
        raise ValueError("no rows below the header")
    columns = dict[str, Sequence[str]]()
    for place, name in enumerate(header, start=1):
        cells = [row[place - 1] for _, row in rows]
        if header.count(name) > 1 and name:
            raise ValueError(f"column {name!r} comes twice")
        if name:
            columns[name] = cells
        elif any(cells):
            notes += _unnamed(place, cells, columns)
    lines = tuple(line for line, _ in rows)
    named = dict(zip(header, units, strict=False))
    table = table_of(source, columns, lines, mark, headed=headed, units=named)
    if not table.names:
        raise ValueError(f"no column contains numbers: {', '.join(header)}")
    return table, notes


def _require_decimals(rows: list[tuple[int, list[str]]], delimiter: str) -> None:
    """Refuse numbers that decimal commas have cut into two cells each: -0,79."""
    width = len(rows[0][1])
    whole = all(cell.lstrip("+-").isdecimal() for _, row in rows for cell in row)
    for line, row in rows if whole and delimiter == "," and width % 2 == 0 else ():
        if any(cell in ("-0", "+0") or re.match(r"0\d", cell) for cell in row):
            raise ValueError(
                f"line {line} may hold {width // 2} numbers with decimal "
                f"commas, or {width} whole ones: separate cells with semicolons"
            )


def _is_plain(cell: str) -> bool:
    return bool(cell) and number_of(cell) is not None


def _unnamed(
    place: int, cells: Sequence[str], columns: dict[str, Sequence[str]]
) -> list[str]:
    """What is said of a column without a name, a frame's index; words are labels."""
    if not any(map(_is_plain, cells)) and "index" not in columns:
        columns["index"] = cells
        return []
    if len({*cells}) == len(cells) and all(cell.isdecimal() for cell in cells):
        return [f"ignored column {place} (looks like a row number)"]
    raise ValueError(f"column {place} has no name")


def _decoded(data: bytes) -> tuple[str, str]:
    """The text of a file, and a note where it is not UTF-8."""
    if data.startswith(b"\x1f\x8b"):
        data = gzip.decompress(data)
    if data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"PAR1", b"{", b"<")):
        raise ValueError("a table must be CSV; save this one as CSV")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), ""
    if data[1::2].count(0) > len(data) // 4:
        return data.decode("utf-16-le", errors="replace"), ""
    note = ""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        note = f"line {line} is not UTF-8; read as Windows cp1252"
        text = data.decode("cp1252", errors="replace")
    if bad := re.search("[\x00-\x08\x0e-\x1f\ufffd]", text):
        line = text.count("\n", 0, bad.start()) + 1
        raise ValueError(f"line {line} is not UTF-8 text; save it as UTF-8") from None
    return text, note


def _sheet_of(
    text: str,
) -> tuple[list[tuple[int, list[str]]], str, bool, list[str], list[str]]:
    """Rows of a text, line and as many cells each, without comments and row of units;
    the delimiter; whether the first row holds names; the units; what is to be said."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    notes: list[str] = []
    stated = re.fullmatch(r"\"?sep=(.)\"?\s*", lines[0].lstrip(), re.IGNORECASE)
    if stated:
        lines[0] = ""
    lines, comment = _without_comments(lines, notes)
    delimiter = stated[1] if stated else _delimiter(lines)
    rows = _rows(lines, delimiter)
    if not rows:
        raise ValueError("the table is empty")
    if comment and all(map(is_number, rows[0][1])):
        line, text = comment
        for mark in (delimiter, " "):
            names = _cells([text], mark)[0][1]
            if len(names) == len(rows[0][1]) and not any(map(is_number, names)):
                notes.append(f"names are taken from line {line}: {', '.join(names)}")
                rows.insert(0, (line, names))
                break
    headed = not all(map(is_number, rows[0][1]))
    units: list[str] = []
    if headed and len(rows) > 2 and _holds_units(rows[1][1], rows[2:]):
        line, units = rows.pop(1)
        listed = ", ".join(filter(None, units))
        notes.append(f"units are taken from line {line}: {listed}")
    return rows, delimiter, headed, units, notes


def _without_comments(
    lines: list[str], notes: list[str]
) -> tuple[list[str], tuple[int, str] | None]:
    """Lines that begin with # made empty, and the last one above all others; a table
    whose header or whose rows begin so keeps them."""
    filled = [i for i, line in enumerate(lines) if line.strip()]
    begin = [i for i in filled if _COMMENT.match(lines[i])]
    if not begin or re.match(r"\s*#\s*[,;\t]", lines[filled[0]]):
        return lines, None
    above = [i for i, j in zip(begin, filled, strict=False) if i == j]
    inside = [i for i in begin if i not in above]
    if len(inside) > (len(filled) - len(above)) // 2:
        return lines, None  # names of rows: #1, #2
    if inside:
        lines_of = [str(i + 1) for i in inside[:5]] + ["..."] * (len(inside) > 5)
        notes.append(f"ignored comment (#): line {', '.join(lines_of)}")
    head = None
    if above and (names := lines[above[-1]].strip().lstrip("# \t")):
        head = (above[-1] + 1, names)
    return ["" if i in {*begin} else line for i, line in enumerate(lines)], head


def _delimiter(lines: Sequence[str]) -> str:
    """What separates the cells: it makes rows alike, of numbers where it can."""
    sample = [line for line in lines if line.strip()][:_LOOKED_AT]
    best, most = "", 0.0
    for delimiter in _DELIMITERS:
        try:
            rows = [cells for _, cells in _cells(sample, delimiter)]
        except ValueError:
            continue
        widths = {len(row) for row in rows[1:] or rows}
        if not rows:
            continue
        more = max(widths) - len(rows[0])
        if len(widths) > 1 or more not in (0, delimiter in _OF_R):
            continue
        below = [cell for row in rows[1:] or rows for cell in row if cell]
        share = sum(map(is_number, below)) / max(len(below), 1)
        if max(widths) > 1 and share > most:
            best, most = delimiter, share
    first = sample[0] if sample else ""
    mark = max(",;\t", key=first.count)
    return best or (mark if mark in first else ";")  # of a single column


def _cells(lines: Sequence[str], delimiter: str) -> list[tuple[int, list[str]]]:
    """Line, counted from 1, and cells of the lines that are not empty."""
    if delimiter == " ":
        lines = [re.sub(r"[ \t]+", " ", line.strip()) for line in lines]
    reader = csv.reader((f"{line}\n" for line in lines), delimiter=delimiter)
    rows, line, begun = [], 1, 1  # where the next row begins, and the last one
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((reader.line_num, cells))
                begun = line
            line = reader.line_num + 1
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None
    if rows and any("\n" in cell for cell in rows[-1][1]):
        texts = (f"{text}\n" for text in lines)
        try:  # a quote within a cell is none: only the strict reader knows
            for _ in csv.reader(texts, delimiter=delimiter, strict=True):
                pass
        except csv.Error as error:
            if "end of data" in str(error):
                raise ValueError(f'line {begun}: a quote (") is never closed') from None
    return [(line, [_BREAK.sub(" ", cell) for cell in cells]) for line, cells in rows]


def _rows(lines: Sequence[str], delimiter: str) -> list[tuple[int, list[str]]]:
    """Rows of as many cells each; empty ones beyond the header are left out."""
    rows = _cells(lines, delimiter)
    width = len(rows[0][1]) if rows else 0
    numbered = all(row[0] == str(i) for i, (_, row) in enumerate(rows[1:], 1))
    if (
        (delimiter in _OF_R or numbered)
        and {len(cells) for _, cells in rows[1:]} == {width + 1}
        and any(cells[-1] for _, cells in rows[1:])
        and not any(map(is_number, rows[0][1]))
    ):
        rows[0][1].insert(0, "")
        width += 1
    for line, cells in rows:
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if len(cells) != width:
            raise ValueError(
                f"line {line} has {len(cells)} cells, the first has {width}"
            )
    return rows


def _holds_units(cells: Sequence[str], rows: Sequence[tuple[int, list[str]]]) -> bool:
    """Whether the row below the header names units of the numbers below it."""
    of_numbers = [
        cell
        for i, cell in enumerate(cells)
        if all(is_number(row[i]) for _, row in rows if row[i])
    ]
    units = [cell for cell in of_numbers if cell]
    recognised = sum(bool(UNIT.fullmatch(cell)) for cell in units)
    some = any(cell != "-" for cell in units) and not any(map(is_number, units))
    return some and 2 * recognised > len(units)
