"""Columns by name, whatever prefix or unit they bear, and what is said of them."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Sequence
from typing import Any

__all__ = ["COMMANDS", "MEASURED", "bare", "columns_by_name", "say", "split_names"]

COMMANDS, MEASURED = "u_", "y_"  # how the names of columns begin

_LOG = logging.getLogger("jaxcal")


def say(text: str) -> None:
    """A line on standard error in the shell, a warning in Python."""
    if _LOG.isEnabledFor(logging.INFO):
        _LOG.info(text)
    else:
        warnings.warn(text, stacklevel=2)


def split_names(text: str) -> tuple[str, ...]:
    """Names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


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
    rest = [(name, bare(name, prefix, unit)) for name in header if name not in exact]
    matches: list[str | None] = []
    for name in wanted:
        like = [column for column, root in rest if root == bare(name, prefix, unit)]
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


def bare(name: str, prefix: str, unit: str = "") -> str:
    """A name without prefix and unit: "pitch" of "u_pitch", "u_deg_pitch"."""
    name = name.removeprefix(prefix) or name
    if unit:
        u = re.escape(unit)
        for pattern in (rf"{u}_(.+)", rf"(.+)_{u}", rf"(.+?) ?[\[(]{u}[\])]"):
            if match := re.fullmatch(pattern, name):
                return match[1]
    return name
