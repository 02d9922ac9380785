"""Tables in and out of the commands: CSV, JSON, ``-`` for standard input."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import pathlib
import re
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import axis_letter
from jaxcal.files import write_text

__all__ = [
    "Output",
    "Table",
    "TablePath",
    "read_table",
    "write_json",
    "write_rows",
]

Array = NDArray[np.float64]

TablePath = Annotated[str, "CSV, or - (standard input)"]


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of numbers under names, and columns of text beside them."""

    source: str  # the file's name, for messages
    names: tuple[str, ...]  # of the numeric columns
    values: Array  # (N, len(names)), NaN where a cell is empty
    labels: dict[str, list[str]]  # columns that hold text, each of length N
    lines: tuple[int, ...]  # of the file, one for each row

    def __len__(self) -> int:
        return len(self.values)

    def columns(
        self, wanted: Sequence[str], used: NDArray[np.bool_] | None = None
    ) -> Array:
        """(N, len(wanted)) the named columns, in that order.

        Raises:
            ValueError: there is no such column, or a cell of a row that is ``used``
                (N,), all when not given, is empty, NaN or infinite.
        """
        for name in wanted:
            if name in self.labels:
                cell = next(c for c in self.labels[name] if not _is_number(c))
                raise ValueError(
                    f"{self.source}: column {name!r} must hold numbers, got {cell!r}"
                )
            if name not in self.names:
                known = ", ".join(self.names)
                raise ValueError(
                    f"{self.source}: there is no column {name!r}; columns: {known}"
                )
        values = self.values[:, [self.names.index(name) for name in wanted]]
        bad = ~np.isfinite(values)
        for row, place in np.argwhere(bad if used is None else bad & used[:, None]):
            raise ValueError(
                f"{self.source}: line {self.lines[row]}, column {wanted[place]!r} must "
                f"hold a number, got {values[row, place]} or an empty cell; fill it or "
                "leave the row out"
            )
        return values

    def inputs(self, chosen: str | None) -> tuple[str, ...]:
        """Columns of commands: those chosen, else ``u_...``, else all but outputs."""
        if chosen is not None:
            return _split(chosen)
        marked = tuple(name for name in self.names if name.startswith("u_"))
        special = {"available", "episode", "candidate", "index"}
        others = (name for name in self.names if name not in special)
        return marked or tuple(name for name in others if not name.startswith("y_"))

    def outputs(self, chosen: str | None) -> tuple[str, ...]:
        """Columns of measurements: those chosen, else ``y_...``."""
        if chosen is not None:
            return _split(chosen)
        marked = tuple(name for name in self.names if name.startswith("y_"))
        if not marked:
            raise ValueError(
                f"{self.source}: no column begins with y_; name the measured columns "
                f"with --outputs (columns: {', '.join(self.names)})"
            )
        return marked

    def available(self) -> NDArray[np.bool_] | None:
        """(N,) True where the column ``available`` is 1; None without that column."""
        if "available" not in (*self.names, *self.labels):
            return None
        mask = self.columns(["available"])[:, 0]
        for row in np.flatnonzero((mask != 0.0) & (mask != 1.0)):
            raise ValueError(
                f"{self.source}: available must be 0 or 1, got {mask[row]:g} in row "
                f"{row}"
            )
        return mask == 1.0


def _split(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def read_table(path: str) -> Table:
    """Read a CSV file (comma, semicolon or tab; header optional); ``-`` is stdin.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and what is wrong in it.
    """
    if path == "-":
        return _from_csv("standard input", sys.stdin.read())
    data = pathlib.Path(path).read_bytes()
    if data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise ValueError(f"{path}: a table must be CSV; save this one as CSV")
    try:
        return _from_csv(path, data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(
            f"{path}: line {line} is not UTF-8 text; save it as UTF-8"
        ) from None


def _from_csv(source: str, text: str) -> Table:
    first = text.partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    cells = enumerate(csv.reader(io.StringIO(text), delimiter=delimiter), start=1)
    rows = [(line, [cell.strip() for cell in row]) for line, row in cells if any(row)]
    if not rows:
        raise ValueError(f"{source}: the table is empty")
    header = rows[0][1]
    if all(map(_is_number, header)):
        header = [f"u_{axis_letter(i, len(header))}" for i in range(len(header))]
    elif not (rows := rows[1:]):
        raise ValueError(f"{source}: there are no rows below the header")
    for name in header:
        if header.count(name) > 1:
            raise ValueError(f"{source}: column {name!r} comes twice")
    for line, row in rows:
        if len(row) != len(header):
            raise ValueError(
                f"{source}: line {line} has {len(row)} cells, the first has "
                f"{len(header)}"
            )
    lines = tuple(line for line, _ in rows)
    numbers: dict[str, list[float]] = {}
    labels: dict[str, list[str]] = {}
    for i, name in enumerate(header):
        column = [row[i] for _, row in rows]
        if all(_is_number(cell) or not cell for cell in column):
            numbers[name] = [float(cell) if cell else np.nan for cell in column]
        else:
            _require_text(source, name, column, lines)
            labels[name] = column
    if not numbers:
        raise ValueError(f"{source}: no column holds numbers: {', '.join(header)}")
    values = np.array(list(numbers.values())).reshape(len(numbers), len(rows)).T
    return Table(source, tuple(numbers), values, labels, lines)


def _require_text(
    source: str, name: str, column: list[str], lines: Sequence[int]
) -> None:
    """Refuse a column of numbers that one cell would turn into labels, by that cell."""
    spoilt = [cell for cell in column if cell and not _is_number(cell)]
    for line, cell in zip(lines, column, strict=True):
        like = re.match(r"[+-]?\d+[.,]\d+", cell)
        if cell in spoilt and (like or 2 * len(spoilt) < len(column)):
            comma = re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", cell)
            raise ValueError(
                f"{source}: line {line}, column {name!r} must hold a number, got "
                f"{cell!r}" + (": write a decimal point" if comma else "")
            )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


@dataclasses.dataclass
class Output:
    """Where the answer goes and in which form."""

    json: Annotated[bool, "print JSON"] = False
    csv: Annotated[bool, "print CSV"] = False
    out: Annotated[str, "write to FILE (.csv or .json) instead", "FILE"] = ""

    def written(
        self, names: Sequence[str], rows: Sequence[Sequence[Any]], document: Any = None
    ) -> bool:
        """Write where a form or a file is asked for; False where neither is.

        As JSON the document, an object for each row where there is none.
        """
        if self.json and self.csv:
            raise ValueError("one of --json and --csv must be left out")
        ending = pathlib.PurePath(self.out).suffix.lower()
        if ending not in ("", ".csv", ".json", ".txt"):
            raise ValueError(f"--out must end in .csv or .json, got {self.out}")
        if self.json or ending == ".json":
            each = [dict(zip(names, row, strict=True)) for row in rows]
            write_json(self.out, each if document is None else document)
        elif self.csv or self.out:
            write_rows(self.out, names, rows)
        else:
            return False
        return True


def write_rows(out: str, names: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Write rows as CSV to a file, atomically, or to standard output."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    _emit(out, text.getvalue())


def write_json(out: str, document: Any) -> None:
    """Write a JSON document to a file, atomically, or to standard output."""
    _emit(out, json.dumps(document, indent=1, default=_plain) + "\n")


def _emit(out: str, text: str) -> None:
    if out in ("", "-"):
        sys.stdout.write(text)
    else:
        write_text(out, text)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")
