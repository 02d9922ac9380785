"""Text as rows of cells, as spreadsheets, R, numpy and loggers write it."""

from __future__ import annotations

import csv
import dataclasses
import gzip
import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxcal.tables.cells import is_number

__all__ = ["Sheet", "csv_text", "decoded", "sheet_of"]

_DELIMITERS = "\t;, "  # the first of those that serve alike
_OF_R = " \t"  # with which R names rows, and not the column of these names
_LOOKED_AT = 20  # rows by which the delimiter is judged
_UNIT = re.compile(
    r"[\[(].*[\])]|[-%°‰]|(?:[/.·*^ ²³0-9-]|[pnuµμmckMGh]?(?:deg|rad|m|s|g|V|A|W|N|Hz"
    r"|Pa|bar|Ω|l|L|C|F|K|J|rpm|min|h|psi|in|inch|°C|°F|°|%|ct|cts|counts?|steps?|pulses?"
    r"|degrees?|radians?|volts?|sec|seconds?))+"
)


@dataclasses.dataclass(frozen=True)
class Sheet:
    """Cells of a table as it was written."""

    rows: list[tuple[int, list[str]]]  # line and cells, as many in each row
    delimiter: str
    headed: bool  # the first row holds names
    notes: tuple[str, ...]  # how it was read, where that is not the plain way


def decoded(source: str, data: bytes) -> tuple[str, str]:
    """The text of a file, and a note where it is not UTF-8.

    Raises:
        ValueError: the file is a spreadsheet's own, or no text.
    """
    if data.startswith(b"\x1f\x8b"):
        data = gzip.decompress(data)
    if data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"PAR1")):
        raise ValueError(f"{source}: a table must be CSV; save this one as CSV")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), ""
    if data[1::2].count(0) > len(data) // 4:
        return data.decode("utf-16-le", errors="replace"), ""
    note = ""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        note = f"line {line} is not UTF-8 text, it is read as Windows' cp1252"
        text = data.decode("cp1252", errors="replace")
    if bad := re.search("[\x00-\x08\x0e-\x1f\ufffd]", text):
        line = text.count("\n", 0, bad.start()) + 1
        raise ValueError(
            f"{source}: line {line} is not UTF-8 text; save it as UTF-8"
        ) from None
    return text, note


def sheet_of(source: str, text: str) -> Sheet:
    """Rows of a text, its comments and its row of units left out.

    Raises:
        ValueError: naming the line at fault.
    """
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    notes: list[str] = []
    stated = re.fullmatch(r"\"?sep=(.)\"?", lines[0].strip())
    if stated:
        lines[0] = ""
    lines, comment = _without_comments(lines, notes)
    delimiter = stated[1] if stated else _delimiter(lines)
    rows = _rows(source, lines, delimiter)
    if not rows:
        raise ValueError(f"{source}: the table is empty")
    if comment and all(map(is_number, rows[0][1])):
        line, text = comment
        for mark in (delimiter, " "):
            names = _cells([text], mark)[0][1]
            if len(names) == len(rows[0][1]) and not any(map(is_number, names)):
                notes.append(f"names are those of line {line}: {', '.join(names)}")
                rows.insert(0, (line, names))
                break
    headed = not all(map(is_number, rows[0][1]))
    if headed and len(rows) > 2 and _holds_units(rows[1][1], rows[2:]):
        units = ", ".join(filter(None, rows[1][1]))
        notes.append(f"line {rows[1][0]} is read as units: {units}")
        del rows[1]
    return Sheet(rows, delimiter, headed, tuple(notes))


def _without_comments(
    lines: list[str], notes: list[str]
) -> tuple[list[str], tuple[int, str] | None]:
    """Lines that begin with # made empty, and the last one above all others.

    A table whose header or whose rows begin so keeps them.
    """
    filled = [i for i, line in enumerate(lines) if line.strip()]
    begin = [i for i in filled if lines[i].lstrip().startswith("#")]
    if not begin or re.match(r"\s*#\s*[,;\t]", lines[filled[0]]):
        return lines, None
    above = [i for i, j in zip(begin, filled, strict=False) if i == j]
    inside = [i for i in begin if i not in above]
    if len(inside) > (len(filled) - len(above)) // 2:
        return lines, None  # names of rows: #1, #2
    if inside:
        listed = ", ".join(str(i + 1) for i in inside[:5])
        more = ", ..." if len(inside) > 5 else ""
        notes.append(f"a comment, begun with #, is not read: line {listed}{more}")
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
    marks = max(",;\t", key=first.count)
    single = not any(mark in first for mark in ",;\t")  # its name holds none
    return best or (";" if single else marks)


def _cells(lines: Sequence[str], delimiter: str) -> list[tuple[int, list[str]]]:
    """Line, counted from 1, and cells of the lines that are not empty."""
    if delimiter == " ":
        lines = [re.sub(r"[ \t]+", " ", line.strip()) for line in lines]
    reader = csv.reader((f"{line}\n" for line in lines), delimiter=delimiter)
    rows = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((reader.line_num, cells))
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None
    return rows


def _rows(
    source: str, lines: Sequence[str], delimiter: str
) -> list[tuple[int, list[str]]]:
    """Rows of as many cells each; empty ones beyond the header are left out."""
    try:
        rows = _cells(lines, delimiter)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    width = len(rows[0][1]) if rows else 0
    if (
        delimiter in _OF_R
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
                f"{source}: line {line} has {len(cells)} cells, the first has {width}"
            )
    return rows


def _holds_units(cells: Sequence[str], rows: Sequence[tuple[int, list[str]]]) -> bool:
    """Whether the row below the header names units of the numbers below it."""
    of_numbers = [
        cell
        for i, cell in enumerate(cells)
        if all(is_number(row[i]) for _, row in rows if row[i])
    ]
    units = [cell for cell in of_numbers if cell and not is_number(cell)]
    return (
        any(cell != "-" for cell in units)
        and len(units) == sum(map(bool, of_numbers))
        and all(map(_UNIT.fullmatch, units))
    )


def csv_text(columns: Mapping[str, Sequence[Any] | Any], digits: int = 12) -> str:
    """Columns of equal length as text; NaN becomes an empty cell.

    Args:
        columns: by the name in the header.
        digits: of a float.
    """

    def cell(value: Any) -> str:
        if not isinstance(value, float | np.floating):
            return str(value)
        return "" if math.isnan(value) else f"{value:.{digits}g}"

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([cell(value) for value in row])
    return text.getvalue()
