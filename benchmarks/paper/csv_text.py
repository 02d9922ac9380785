"""Columns as the text of a CSV file, as the report and kept runs hold them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def csv_text(columns: Mapping[str, Sequence[Any] | Any], digits: int = 12) -> str:
    """Columns of equal length as text; NaN becomes an empty cell."""

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
