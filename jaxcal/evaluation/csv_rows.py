"""CSV files as a header and rows, for readers that name the line of a fault."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["csv_text", "read_columns", "read_rows"]


def read_rows(data: bytes) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header and the rows that are not empty, each with its line number.

    Raises:
        ValueError: no text, or a row that has not as many cells as the header.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line}: not UTF-8 text") from None
    reader = csv.reader(io.StringIO(text, newline=""))
    rows: list[tuple[int, list[str]]] = []
    try:
        header = [name.strip() for name in next(reader, [])]
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                raise ValueError(f"{len(row)} cells, {len(header)} in the header")
            rows.append((reader.line_num, row))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"line {max(reader.line_num, 1)}: {error}") from None
    return header, rows


def read_columns(
    data: bytes,
    choose: Callable[[list[str]], list[str]],
    keep: Callable[[Mapping[str, str]], bool] = lambda cells: True,
) -> tuple[list[str], list[int], NDArray[np.float64]]:
    """Columns of finite numbers.

    Args:
        data: of the file.
        choose: from the header to the columns to read, or ValueError.
        keep: from the cells of a row, by column, to whether it counts.

    Returns:
        Their names, the (N,) lines, and (N, columns) numbers.

    Raises:
        ValueError: naming the line at fault.
    """
    header, rows = read_rows(data)
    lines, values = [1], []  # the header's; then those of the rows
    try:
        names = choose(header)
        for line, row in rows:
            cells = dict(zip(header, row, strict=True))
            if keep(cells):
                lines.append(line)
                values.append([_finite(name, cells[name]) for name in names])
    except ValueError as error:
        raise ValueError(f"line {lines[-1]}: {error}") from None
    return names, lines[1:], np.array(values).reshape(len(values), len(names))


def _finite(name: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise ValueError(f'"{name}" must be a number, got {cell!r}') from None
    if not math.isfinite(number):
        raise ValueError(f'"{name}" must be finite, got {cell!r}')
    return number


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
