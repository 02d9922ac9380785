"""Tables as CSV: one reader for all, which takes columns by name.

A column that has a name is never read by its place. Places count where a table has no
header, and that is said, as is every name that is not the one asked for ("pitch" for
"y_pitch").
"""

from __future__ import annotations

import csv
import dataclasses
import io
import logging
import math
import pathlib
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import axis_letter

__all__ = [
    "COMMANDS",
    "MEASURED",
    "CsvTable",
    "columns_by_name",
    "csv_text",
    "names_of",
    "of_frame",
    "parse",
    "read_table",
]

Array = NDArray[np.float64]

COMMANDS, MEASURED = "u_", "y_"  # how the names of columns begin

_SAID = logging.getLogger("jaxcal")
# Columns that number the rows or tell their time, by their names.
_NUMBERING = re.compile(
    r"#|(.*_)?(id|idx|index)|no\.?|nr\.?|row|sample|seq|unnamed: 0|available"
    r"|episode|candidate|date|datetime|((time|t)_?)?stamp|time"
    r"|(time|t|stamp)[ _]?[\[(]?(s|ms|us|ns|sec|seconds|min)[\])]?",
    re.IGNORECASE,
)
_LEAST_ROWS = 5  # of which a constant step is no chance


@dataclasses.dataclass(frozen=True)
class CsvTable:
    """Rows of numbers under names, and columns of text beside them."""

    source: str  # the file's name, for messages
    names: tuple[str, ...]  # of the numeric columns
    values: Array  # (N, len(names)), NaN where a cell is empty
    labels: dict[str, list[str]]  # columns that hold text, each of length N
    lines: tuple[int, ...]  # of the file, one for each row
    headed: bool = True  # False: there is no header, the names are u_x, u_y, u_z

    def __len__(self) -> int:
        return len(self.values)

    @property
    def header(self) -> tuple[str, ...]:
        """Names of all columns, those of numbers first."""
        return (*self.names, *self.labels)

    def columns(
        self, wanted: Sequence[str], used: NDArray[np.bool_] | None = None
    ) -> Array:
        """(N, len(wanted)) the columns of these very names, in that order.

        Raises:
            ValueError: there is no such column, or a cell of a row that is ``used``
                (N,), all when not given, is empty, NaN or infinite.
        """
        for name in wanted:
            for line, cell in zip(self.lines, self.labels.get(name, ()), strict=False):
                if not _is_number(cell):
                    raise ValueError(
                        f"{self.source}: line {line}, column {name!r} must hold a "
                        f"number, got {cell!r}"
                    )
            if name not in self.names:
                raise ValueError(
                    f"{self.source}: there is no column {name!r}; columns: "
                    f"{', '.join(self.header)}"
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

    def named(
        self,
        wanted: Sequence[str],
        prefix: str,
        *,
        chosen: str | None = None,
        option: str = "--columns",
        unit: str = "",
    ) -> tuple[str, ...]:
        """The columns that hold what is wanted, in that order.

        Args:
            wanted: names of the commands or outputs of a model, or of a calibration.
            prefix: ``COMMANDS`` or ``MEASURED``, which either side may lack.
            chosen: names separated by commas, where the user gave them: in the order
                of ``wanted``, unless they are its names.
            option: by which they are given; "" where a command has none.
            unit: that the names may hold: "pitch_deg", "u_deg_pitch", "pitch [deg]".

        Raises:
            ValueError: a name is missing, stands twice, or could be either of two.
        """
        count = f"{len(wanted)} columns are needed ({', '.join(wanted)})"
        if chosen is not None:
            chosen_names = split_names(chosen)
            self._require_known(chosen_names, prefix)
            taken = tuple(columns_by_name(chosen_names, self.header, prefix, unit))
            if len(taken) != len(wanted):
                raise ValueError(
                    f"{self.source}: {count}, {option} names {len(taken)}: "
                    f"{', '.join(chosen_names)}"
                )
            by_name = columns_by_name(wanted, taken, prefix, unit)
            if None not in by_name:
                self.say(wanted, by_name, "by name")
                return tuple(by_name)
            for name, column, place in zip(wanted, by_name, taken, strict=True):
                if column not in (None, place):
                    raise ValueError(
                        f"{self.source}: {option} has {place!r} in the place of "
                        f"{name!r}, and {column!r} elsewhere; the order is "
                        f"{', '.join(wanted)}"
                    )
            return taken
        if not self.headed:
            if len(self.names) != len(wanted):
                raise ValueError(
                    f"{self.source}: {count}, got {len(self.names)} without a header"
                )
            _SAID.info(
                "%s has no header: its columns are read by position, as %s",
                self.source,
                ", ".join(wanted),
            )
            return self.names
        try:
            columns = columns_by_name(wanted, self.header, prefix, unit)
        except ValueError as error:
            choose = f"choose with {option}" if option else "rename one of them"
            raise ValueError(f"{self.source}: {error}; {choose}") from None
        advice = f"; name those of {', '.join(wanted)} in that order with {option}"
        advice = advice if option else ""
        if missing := [x for x, y in zip(wanted, columns, strict=True) if y is None]:
            raise ValueError(
                f"{self.source}: there is no column {', '.join(map(repr, missing))}, "
                f"with {prefix} or without; columns: {', '.join(self.header)}" + advice
            )
        self.say(wanted, columns, "by name")
        return tuple(columns)

    def commands(
        self, chosen: str | None, option: str | None = "--columns", but: Any = ()
    ) -> tuple[str, ...]:
        """Columns of commands: those chosen, else ``u_...``, else all but outputs.

        Columns that by their names number the rows or tell their time are left out, as
        are those in ``but``; where the values of another do, it is refused.
        """
        if chosen is not None:
            chosen_names = split_names(chosen)
            self._require_known(chosen_names, COMMANDS)
            return tuple(columns_by_name(chosen_names, self.header, COMMANDS))
        marked = [name for name in self.names if name.startswith(COMMANDS)]
        others = [
            name
            for name in self.names
            if name not in (*marked, *but) and not name.startswith(MEASURED)
        ]
        numbering = [name for name in others if _NUMBERING.fullmatch(name) or not name]
        others = [name for name in others if name not in numbering]
        if self.headed and marked:
            self._say_unread(others, f"commands are those that begin with {COMMANDS}")
            return tuple(marked)
        names = others if self.headed else marked
        told = [name for name in numbering if name != "available"]
        self._say_unread(told, "it counts the rows or tells their time")
        advice = f"begin the names of commands with {COMMANDS}"
        if option:
            advice += f", or name them with {option}"
        if not names:
            raise ValueError(
                f"{self.source}: no column holds commands "
                f"(columns: {', '.join(self.header)}); {advice}"
            )
        steps = [_step(self.values[:, self.names.index(name)]) for name in names]
        if None in steps:  # else all are swept together: a table of one axis, say
            for name, step in zip(names, steps, strict=True):
                if step is not None:
                    place = f"column {self.names.index(name) + 1}"
                    raise ValueError(
                        f"{self.source}: {f'column {name!r}' if self.headed else place}"
                        f" goes up by {step:.4g} from row to row, as a number of the "
                        f"rows or a time does; if it is a command, {advice}"
                    )
        return tuple(names)

    def outputs(self, chosen: str | None, option: str = "--outputs") -> tuple[str, ...]:
        """Columns of measurements: those chosen, else ``y_...``."""
        if chosen is not None:
            chosen_names = split_names(chosen)
            self._require_known(chosen_names, MEASURED)
            return tuple(columns_by_name(chosen_names, self.header, MEASURED))
        marked = tuple(name for name in self.names if name.startswith(MEASURED))
        if not marked:
            raise ValueError(
                f"{self.source}: no column begins with {MEASURED}; name the measured "
                f"columns with {option} (columns: {', '.join(self.header)})"
            )
        return marked

    def available(self) -> NDArray[np.bool_] | None:
        """(N,) True where the column ``available`` is 1; None without that column."""
        if "available" not in self.header:
            return None
        mask = self.columns(["available"])[:, 0]
        for row in np.flatnonzero((mask != 0.0) & (mask != 1.0)):
            raise ValueError(
                f"{self.source}: line {self.lines[row]}, available must be 0 or 1, got "
                f"{mask[row]:g}"
            )
        return mask == 1.0

    def _require_known(self, given: Sequence[str], prefix: str) -> None:
        """Refuse names that no column has, or that are given twice."""
        for name in given:
            if given.count(name) > 1:
                raise ValueError(f"{self.source}: column {name!r} is named twice")
        found = columns_by_name(given, self.header, prefix)
        for name in (x for x, column in zip(given, found, strict=True) if not column):
            self.columns([name])  # says that there is none

    def bare(self, prefix: str) -> list[str]:
        """Names of all columns without the prefix."""
        return [_bare(name, prefix, "") for name in self.header]

    def say(self, wanted: Sequence[str], found: Sequence[Any], how: str) -> None:
        """On standard error, which columns are what; nothing where they say it."""
        order = [name for name in self.header if name in found]
        if [*wanted] != [*found] or order != [*found]:
            _SAID.info(
                "%s: columns %s are read %s, as %s",
                *(self.source, ", ".join(found), how, ", ".join(wanted)),
            )

    def _say_unread(self, names: Sequence[str], why: str) -> None:
        if names:
            listed = ", ".join(map(repr, names))
            _SAID.info("%s: column %s is not read: %s", self.source, listed, why)


def split_names(text: str) -> tuple[str, ...]:
    """Names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


# -- by name ---------------------------------------------------------------------------


def columns_by_name(
    wanted: Sequence[str], header: Sequence[str], prefix: str, unit: str = ""
) -> list[Any]:
    """For each of the wanted the column of its name; None where there is none.

    A column of the very name comes first, then one that differs by the prefix or the
    unit alone.

    Raises:
        ValueError: two columns could be one of the wanted, or one is two of them.
    """
    exact = set(wanted) & set(header)
    rest = [(name, _bare(name, prefix, unit)) for name in header if name not in exact]
    matches: list[str | None] = []
    for name in wanted:
        like = [column for column, bare in rest if bare == _bare(name, prefix, unit)]
        if name not in exact and len(like) > 1:
            raise ValueError(
                f"columns {' and '.join(map(repr, like))} could both be {name!r}"
            )
        matches.append(name if name in exact else next(iter(like), None))
    for column in matches:
        if column is not None and matches.count(column) > 1:
            doubled = [
                name for name, c in zip(wanted, matches, strict=True) if c == column
            ]
            raise ValueError(f"column {column!r} could be {' or '.join(doubled)}")
    return matches


def _bare(name: str, prefix: str, unit: str) -> str:
    """A name without prefix and unit."""
    name = name.removeprefix(prefix) or name
    if unit:
        u = re.escape(unit)
        for pattern in (rf"{u}_(.+)", rf"(.+)_{u}", rf"(.+?) ?[\[(]{u}[\])]"):
            if match := re.fullmatch(pattern, name):
                return match[1]
    return name


def names_of(frame: Any) -> tuple[str, ...]:
    """Names of the columns of a data frame; () of what has none."""
    header = tuple(getattr(frame, "columns", ()))
    return header if all(isinstance(name, str) for name in header) else ()


def of_frame(argument: str, frame: Any, wanted: Sequence[str], prefix: str) -> Any:
    """The ``wanted`` columns of a data frame, by name; anything else as given.

    Raises:
        ValueError: a name is missing, or could be either of two.
    """
    header = names_of(frame)
    if not header:
        return frame
    try:
        columns = columns_by_name(wanted, header, prefix)
    except ValueError as error:
        raise ValueError(f"{argument}: {error}") from None
    if None in columns:
        raise ValueError(
            f"{argument} must have the columns {', '.join(wanted)}, "
            f"{wanted[columns.index(None)]!r} is missing (columns: {', '.join(header)})"
        )
    return frame[columns]


# -- reading ---------------------------------------------------------------------------


def read_table(path: str) -> CsvTable:
    """Read a CSV file (comma, semicolon or tab; header optional); ``-`` is stdin.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and what is wrong in it.
    """
    if path == "-":
        return _from_text("standard input", sys.stdin.read())
    return parse(path, pathlib.Path(path).read_bytes())


def parse(source: str, data: bytes) -> CsvTable:
    """The table in the bytes of a file; ``source`` is its name in errors."""
    if data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise ValueError(f"{source}: a table must be CSV; save this one as CSV")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(
            f"{source}: line {line} is not UTF-8 text; save it as UTF-8"
        ) from None
    return _from_text(source, text)


def _from_text(source: str, text: str) -> CsvTable:
    rows = _rows(source, text)
    if not rows:
        raise ValueError(f"{source}: the table is empty")
    line, header = rows[0]
    numbers = [cell for cell in header if _is_number(cell)]
    headed = len(numbers) < len(header)
    if not headed:
        header = [f"u_{axis_letter(i, len(header))}" for i in range(len(header))]
    elif numbers:
        name = next(cell for cell in header if not _is_number(cell))
        raise ValueError(
            f"{source}: line {line} must hold names alone or numbers alone, got "
            f"{name!r} and {numbers[0]!r}: give every column a name"
        )
    elif not (rows := rows[1:]):
        raise ValueError(f"{source}: there are no rows below the header")
    for place, name in enumerate(header, start=1):
        if header.count(name) > 1 and name:
            raise ValueError(f"{source}: column {name!r} comes twice")
        if not name and any(row[place - 1] for _, row in rows):
            _require_counting(source, place, [row[place - 1] for _, row in rows])
            _SAID.info("%s: column %d is not read: it counts the rows", source, place)
    lines = tuple(line for line, _ in rows)
    columns: dict[str, list[float]] = {}
    labels: dict[str, list[str]] = {}
    for name, *cells in zip(header, *(row for _, row in rows), strict=True):
        if not name:
            continue
        try:
            columns[name] = [float(cell) if cell else math.nan for cell in cells]
        except ValueError:
            _require_text(source, name, cells, lines)
            labels[name] = cells
    if not columns:
        raise ValueError(f"{source}: no column holds numbers: {', '.join(header)}")
    values = np.array([*columns.values()]).reshape(len(columns), len(rows)).T
    return CsvTable(source, tuple(columns), values, labels, lines, headed)


def _rows(source: str, text: str) -> list[tuple[int, list[str]]]:
    """Line and cells of the rows that are not empty, as many in each."""
    first = text.lstrip().partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    rows: list[tuple[int, list[str]]] = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if rows and len(cells) != len(rows[0][1]):
                raise ValueError(
                    f"{source}: line {reader.line_num} has {len(cells)} cells, the "
                    f"first has {len(rows[0][1])}"
                )
            rows.append((reader.line_num, cells))
    except csv.Error as error:
        raise ValueError(f"{source}: line {reader.line_num}: {error}") from None
    return rows


def _require_counting(source: str, place: int, cells: Sequence[str]) -> None:
    """Refuse a column without a name, unless it is a data frame's running number."""
    if [*cells] not in ([f"{i + k}" for i in range(len(cells))] for k in (0, 1)):
        raise ValueError(f"{source}: column {place} has no name")


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


def _step(values: Array) -> float | None:
    """By which a column goes up (or down) from each row to the next; else None."""
    steps = np.diff(values[np.isfinite(values)])
    if len(steps) + 1 < _LEAST_ROWS or not steps.any():
        return None
    mean = float(steps.mean())
    return mean if (np.abs(steps - mean) <= 0.05 * abs(mean)).all() else None


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
