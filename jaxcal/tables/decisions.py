"""What each column of a table is, by its name first, then by its values; columns by
name, whatever prefix or unit they bear; and what is said of them.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcal.checks import Array
from jaxcal.tables.cells import has_unit, truths_of

COMMANDS, MEASURED = "u_", "y_"  # how the names of columns begin
_LOG = logging.getLogger("jaxcal")
AVAILABLE = "available"
_AVAILABLE = re.compile(
    r"(is[ _]?)?avail(able|ability)?([ _](rows?|flags?|mask|now))?[\W_]*([\[(].*)?",
    re.IGNORECASE,
)
_LEAST_ROWS = 5  # of which a constant step is no chance
# Columns that number the rows, by their names; runs only where each has its own.
_NUMBERS = re.compile(
    r"#|(.*[_ ])?(id|idx|index)|no\.?|nr\.?|row|sample|seq|unnamed: 0(\.\d+)?|level_0"
    r"|episode|candidate",
    re.IGNORECASE,
)
_RUNS = re.compile(
    r"((std|run|standard|random)[ _.]?)?(order|number|no\.?|nr\.?)|run|std|trial"
    r"|versuch|lauf",
    re.IGNORECASE,
)
_STAMPS = {"stamp", "timestamp", "date", "datetime", "epoch", "datum"}
_TIMES = {"time", "uhrzeit", "elapsed", "clock"}
# T alone is a temperature.
_SECONDS = re.compile(r"t|[tT][ _]?[\[(]?(s|ms|us|ns|sec|seconds|min)[\])]?")
_LIKE_COUNT = "may be a time or a row number: it {}; if so, leave it out"
_MARKS = "holds 0 and 1; if it says which rows may be chosen, name it available"
COUNTED = "like a row number or a time"
_LIKE_U, _LIKE_Y = (  # u1, U_pitch, u[0]
    re.compile(rf"[{letter}](\d*|[\[(]\d+[\])]|_.*)") for letter in ("uU", "yY")
)
_GAPS = 1.25  # of the numbers in a range to the rows that hold them
_EPOCH = 1e8  # seconds; no factor of an experiment is so large


class Decision(NamedTuple):
    """What a column is."""

    role: str  # input, output, label, available, time or left out
    reason: str = ""  # said where it is not ""
    asks: bool = False  # commands are read only once it is named, or marked


def decide(
    table: Any, outputs: Collection[str] = (), *, fit: bool = False
) -> dict[str, Decision]:
    """The decision for each column of a table; ``outputs`` are readings; ``fit``: it
    has some."""
    marked = [x for x in table.header if table.headed and x.startswith(COMMANDS)]
    decisions = {}
    for name in table.header:
        if name in outputs:
            decision = Decision("output")
        elif table.headed and is_available(name):
            decision = Decision("available")
        elif name.startswith(COMMANDS):
            decision = Decision("input")
        elif name in table.labels:
            decision = _of_words(table.labels[name])
        else:
            column = table.values[:, table.names.index(name)]
            decision = _of_numbers(name, column, table.header, marked, outputs, fit)
        decisions[name] = decision
    if not of_role("input", decisions):
        for name in of_role("time", decisions):  # a course over time, say
            if not _is_stamp(name):
                decisions[name] = Decision("input", "the only one")
                break
    return decisions if marked else decisions | _counting(table, decisions)


def _of_words(cells: Sequence[str]) -> Decision:
    if has_unit(cells):
        cell = next(filter(None, cells))
        return Decision("label", f"holds numbers and units, {cell!r}", asks=True)
    truths = truths_of(cells, ("true", "false"))
    return Decision("label", "words" if truths is None else "TRUE, FALSE")


def is_available(name: str) -> bool:
    """Whether a column tells which rows may be chosen, by its name."""
    return bool(_AVAILABLE.fullmatch(name.strip()))


def _of_numbers(
    name: str,
    column: Array,
    header: Sequence[str],
    marked: Sequence[str],
    outputs: Collection[str],
    fit: bool,
) -> Decision:
    """The decision for a column of numbers that is neither named nor begins with u_."""
    numbers = column[np.isfinite(column)]
    if name.startswith(MEASURED):
        return _of_y(name, header, bool(marked), outputs, fit)
    if not len(numbers):
        return Decision("left out", "empty")
    if timed := _of_time(name, numbers):
        if timed.role == "time" or not marked:
            return timed
    distinct, plain = len(np.unique(numbers)) == len(column), name.strip()
    counts = _NUMBERS.fullmatch(plain) or (distinct and _RUNS.fullmatch(plain))
    if counts and (numbers == np.round(numbers)).all():
        return Decision("left out", COUNTED)
    if marked:
        return Decision("left out", f"commands begin with {COMMANDS}")
    if _RUNS.fullmatch(plain):
        return Decision("input", "holds a number twice or more")
    if _LIKE_Y.fullmatch(name) and any(_LIKE_U.fullmatch(x) for x in header):
        return Decision("input", f"readings begin with {MEASURED}")
    return Decision("input")


def _of_y(
    name: str, header: Sequence[str], marked: bool, outputs: Collection[str], fit: bool
) -> Decision:
    """An output, or the axis y of x, y and z."""
    root, names = name[len(MEASURED) :], {other.casefold() for other in header}
    digits = root.isdecimal() or root in ("x", "y", "z")
    depth = f"z_{root}".casefold() in names
    axis = depth or (f"x_{root}".casefold() in names and not digits)
    if marked:
        return Decision("output", f"x_{root} is beside it" if axis else "", asks=axis)
    if axis or (outputs and not any(x.startswith(MEASURED) for x in outputs)):
        return Decision("input", "a coordinate: no column begins with u_")
    if outputs:
        return Decision("left out", "the outputs are named")
    if fit or digits or root in header:
        return Decision("output", "no column begins with u_")
    return Decision("input", "no column begins with u_")


def _is_stamp(name: str) -> bool:
    return bool(_STAMPS & _words(name))


def _words(name: str) -> set[str]:
    """Words of a name in snake, camel or plain case, without its unit."""
    plain = re.sub(r"[\[(].*", "", name)
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", plain)}


def _of_time(name: str, numbers: Array) -> Decision | None:
    """When the rows were made, or a factor of the experiment; None: no time by name."""
    stamp = _is_stamp(name)
    if not (stamp or _TIMES & _words(name) or _SECONDS.fullmatch(name.strip())):
        return None
    rising = len(numbers) > 1 and bool((np.diff(numbers) > 0.0).all())
    if stamp or rising or numbers.min() > _EPOCH:
        return Decision("time", COUNTED)
    return Decision("input", "a factor: no rise from row to row")


def _counting(table: Any, decisions: dict[str, Decision]) -> dict[str, Decision]:
    """Inputs that by their values count or mark the rows, beside others that do not."""
    names = [name for name, decision in decisions.items() if decision.role == "input"]
    columns = [table.values[:, table.names.index(name)] for name in names]
    reasons = [_count(column) for column in columns]
    if None not in reasons:
        return {}  # all are swept together: a table of one axis, say
    marks = [{*np.unique(column)} == {0.0, 1.0} for column in columns]
    doubts = [_doubt(column) for column in columns]
    counting = {}
    for name, reason, mark, doubt in zip(names, reasons, marks, doubts, strict=True):
        if mark and False in marks:
            counting[name] = Decision("input", _MARKS)
        elif reason is not None:
            counting[name] = Decision("left out", reason, asks=True)
        elif doubt and None in doubts:
            counting[name] = Decision("input", _LIKE_COUNT.format(doubt))
    return {name: x for name, x in counting.items() if not decisions[name].reason}


def _count(column: Array) -> str | None:
    """In which way a column counts the rows; None where it does not."""
    numbers = column[np.isfinite(column)]
    steps, count = np.diff(numbers), len(numbers)
    if count < _LEAST_ROWS or not steps.any():
        return None
    mean = float(steps.mean())
    if (np.abs(steps - mean) <= 0.05 * abs(mean)).all():
        return f"rises by {mean:.4g} per row, like a row number or a time"
    for first in (0.0, 1.0):
        if count > _LEAST_ROWS and np.array_equal(
            np.sort(numbers), np.arange(count) + first
        ):
            return (
                f"holds each number from {first:g} to {count - 1 + first:g} once, like "
                "a row number"
            )
    return None


def _doubt(column: Array) -> str | None:
    """In which way a column is like an uneven time or a row number with gaps."""
    numbers = column[np.isfinite(column)]
    count = len(numbers)
    if count < _LEAST_ROWS or numbers.min() < 0.0:
        return None
    if (np.diff(numbers) > 0.0).all():
        return "rises in every row"
    whole = (numbers == np.round(numbers)).all() and len(np.unique(numbers)) == count
    if whole and count >= 2 * _LEAST_ROWS and np.ptp(numbers) < _GAPS * count:
        return "holds different whole numbers, few of them missing"
    return None


def sentence(decisions: dict[str, Decision]) -> str:
    """What was read as what, in one line; "" where names alone say it."""
    groups: dict[str, list[str]] = {}
    for name, (role, reason, _) in decisions.items():
        if reason:
            read = role in ("input", "output", "label")
            what = f"read as {role}: {reason}" if read else f"not read: {reason}"
            groups.setdefault(what, []).append(name)
    parts = [listed(names, what) for what, names in groups.items()]
    inputs = f"inputs {', '.join(of_role('input', decisions))}"
    return "; ".join([inputs, *parts]) if parts else ""


def of_role(role: str, decisions: Mapping[str, Decision]) -> tuple[str, ...]:
    """The columns of a role."""
    return tuple(name for name, decision in decisions.items() if decision.role == role)


def listed(names: Sequence[str], what: str) -> str:
    """Columns and what they are, as part of a sentence."""
    begin = "columns {} are" if len(names) > 1 else "column {} is"
    return f"{begin.format(', '.join(map(repr, names)))} {what}"


def say(text: str) -> None:
    """A line on standard error in the shell, a warning in Python."""
    if _LOG.isEnabledFor(logging.INFO):
        _LOG.info(text)
    else:
        warnings.warn(text, stacklevel=2)


def split(text: str) -> tuple[str, ...]:
    """Names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def columns_by_name(
    wanted: Sequence[str], header: Sequence[str], prefix: str, unit: str = ""
) -> list[Any]:
    """For each of the wanted the column of its name, or that which differs by the
    prefix or the unit alone; None where there is none. A ValueError where two could be
    one of the wanted, or one is two of them."""
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
