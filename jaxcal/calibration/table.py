"""Columns as text or as a pandas data frame."""

from __future__ import annotations

import importlib
from typing import Any

__all__ = ["in_lines", "to_frame"]


def in_lines(columns: dict[str, list[str]]) -> list[str]:
    """A header and a line for each row, columns padded to the same width."""
    widths = [max(map(len, [name, *column])) for name, column in columns.items()]
    lines = []
    for row in [list(columns), *zip(*columns.values(), strict=True)]:
        padded = [f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)]
        lines.append(("  " + "  ".join(padded)).rstrip())
    return lines


def to_frame(columns: dict[str, list[Any]]) -> Any:
    """A ``pandas.DataFrame`` with the column ``parameter`` as its index.

    Raises:
        ImportError: pandas is not installed.
    """
    try:
        pandas = importlib.import_module("pandas")
    except ModuleNotFoundError:
        raise ImportError(
            "to_frame needs pandas, which is not installed: pip install pandas"
        ) from None
    return pandas.DataFrame(columns).set_index("parameter")
