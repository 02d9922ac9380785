"""Tables as columns by name: made from arrays and rows, written as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxcal.paper.datasets import AXES

__all__ = ["Columns", "as_csv", "by_axis", "from_rows"]

Columns = Mapping[str, Sequence[Any] | np.ndarray]


def by_axis(values: Mapping[str, np.ndarray], name: str = "{}_{}_deg") -> Columns:
    """Columns of (..., 3) arrays: pitch, yaw and roll of each, flattened.

    Args:
        values: arrays by name.
        name: of a column, from the array's name and the axis.
    """
    return {
        name.format(key, axis): np.ravel(array[..., i])
        for key, array in values.items()
        for i, axis in enumerate(AXES)
    }


def from_rows(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """Columns by name of a table given row by row."""
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


def as_csv(columns: Columns) -> str:
    """Columns of equal length as text, numbers with twelve digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([_cell(value) for value in row])
    return text.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, (float, np.floating)):
        return "" if np.isnan(value) else f"{value:.12g}"
    return str(value)
