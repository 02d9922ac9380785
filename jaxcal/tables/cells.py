"""Cells of text as numbers, by one decimal mark for the whole table.

Which mark that is, cells decide that can be read in one way only: 1,5 or 0.25 or
1.234,5. A cell that could be two numbers, 14.036 beside -838, is refused.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence

_BLANKS = " \u00a0\u202f\u2009'\u2019"  # between groups of three digits
_GROUPS = re.compile(rf"([+-]?\d{{1,3}})([{_BLANKS}])(\d{{3}}(?:\2\d{{3}})*)([.,]\d*)?")
_MARKED = re.compile(r"[+-]?\d*(?:[.,]\d+)+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")  # or three decimals
_MISSING = {"", "na", "n/a", "#n/a", "nan", "null", "none", "nat", "<na>"}
_TRUTHS = {"true": 1.0, "yes": 1.0, "false": 0.0, "no": 0.0, "1": 1.0, "0": 0.0}
_WITH_UNIT = re.compile(r"[+-]?\d*[.,]?\d+[.,]?(?:[eE][+-]?\d+)?\s*(?P<unit>[^\s\d].*)")
UNIT = re.compile(
    r"[\[(].*[\])]|[-%°‰]|(?:[/.·*^ ²³0-9-]|[pnuµμmckMGh]?(?:deg|rad|m|s|g|V|A|W|N|Hz"
    r"|Pa|bar|Ω|l|L|C|F|K|J|rpm|min|h|psi|in|inch|°C|°F|°|%|ct|cts|counts?|steps?|pulses?"
    r"|degrees?|radians?|volts?|sec|seconds?|T|S|Ohm|ppm|dB|lx|px|LSB|mmHg|RH|rev"
    r"|arcsec|arcmin|a\.u\.|ε))+"
)
_SHORT = {"degree": "deg", "radian": "rad", "volt": "V", "second": "s", "sec": "s"}
_SHORT |= {"inch": "in", "count": "ct"} | {x: x for x in ("deg", "rad", "ct", "rev")}
_FORTRAN = re.compile(r"[+-]?\d*\.?\d+\.?[dD][+-]?\d+")
_LEAST = 100.0  # a whole number beside 14.036 that makes that one doubtful
_OTHER = {".": ",", ",": "."}


def truths_of(cells: Iterable[str], words: Sequence[str] = ()) -> list[float] | None:
    """1 and 0 for these words, TRUE and yes for two; NaN where empty; else None."""
    known = {word: _TRUTHS[word] for word in words or _TRUTHS} | {"": math.nan}
    numbers = [known.get(cell.casefold()) for cell in cells]
    return None if None in numbers else numbers  # type: ignore[return-value]  # as said


def is_number(cell: str) -> bool:
    """Whether a cell is a number in whatever way it is written."""
    cell = _plain(cell)
    return _float(cell) is not None or _MARKED.fullmatch(cell) is not None


def has_unit(cells: Sequence[str]) -> bool:
    """Whether all cells are numbers with their unit, 12.5 mm or 7%, or fractions."""
    parts = [_WITH_UNIT.fullmatch(_plain(cell)) for cell in cells if cell]
    if None in parts or len(parts) < 2:
        return False
    units = {part["unit"] for part in parts if part}
    if any(unit[0] == "/" for unit in units):
        return all(unit[1:].isdecimal() for unit in units)
    unit = units.pop()
    sure = len(unit) > 1 or unit in "%°" or not {*".,"}.isdisjoint("".join(cells))
    return not units and sure and UNIT.fullmatch(unit) is not None


def unit_of(text: str) -> str:
    """A unit as any other spelling of it: "deg" of "[°]" and "degrees"."""
    text = unicodedata.normalize("NFKC", text).strip(" -[]()").replace("°", "deg")
    text = re.sub(r"[\s.·*^]", "", text.replace("\u03bc", "u"))
    return _SHORT.get(text.lower().removesuffix("s") or text, text)


def decimal_mark(cells: Sequence[str], semicolons: bool) -> tuple[str, bool]:
    """The decimal mark of a table's cells, and whether a cell decides it; with
    ``semicolons``, or other marks than commas between them, 1,234 has decimals."""
    if not any("," in cell or cell.count(".") > 1 for cell in cells):
        return ".", True
    marked = [*filter(_MARKED.fullmatch, map(_plain, cells))]
    votes = Counter(filter(None, map(_vote, marked)))
    if votes["."] or votes[","]:
        return ("." if votes["."] >= votes[","] else ","), True
    commas = any("," in cell for cell in marked)
    return ("," if commas and semicolons else "."), False


def _vote(cell: str) -> str | None:
    """The decimal mark of a number that can be read in one way only."""
    last = "," if cell.rfind(",") > cell.rfind(".") else "."
    if "." in cell and "," in cell:
        return last if cell.count(last) == 1 else None
    if cell.count(last) > 1:
        groups = re.fullmatch(rf"[+-]?\d{{1,3}}(\{last}\d{{3}})+", cell)
        return _OTHER[last] if groups else None
    return None if _THOUSANDS.fullmatch(cell) else last


def ambiguous(cells: Sequence[str], mark: str, decided: bool) -> int | None:
    """The place of the first cell that could be two numbers."""
    marked = [i for i, cell in enumerate(cells) if cell[-4:-3] in (".", ",")]
    doubtful = [i for i in marked if _THOUSANDS.fullmatch(_plain(cells[i]))]
    if grouped := [i for i in doubtful if mark not in cells[i] and not decided]:
        return grouped[0]
    if decimals := [i for i in doubtful if mark in cells[i]]:
        rest = [_plain(cells[i]) for i in {*range(len(cells))} - {*doubtful}]
        rest = [cell for cell in rest if cell.casefold() not in _MISSING]
        if all(cell.lstrip("+-").isdecimal() for cell in rest):
            largest = max((abs(float(cell)) for cell in rest), default=0.0)
            # Who writes 8.200 with its last zero writes -38.000 too.
            zeros = any(cells[i].endswith("0") for i in decimals)
            if (1.0 if zeros else _LEAST) <= largest < 1000.0:
                return decimals[0]
    return None


def _plain(cell: str) -> str:
    """With an ASCII minus, and without blanks between thousands."""
    cell = cell.replace("\u2212", "-")
    if match := _GROUPS.fullmatch(cell):
        return match[1] + match[3].replace(match[2], "") + (match[4] or "")
    return cell


def number_of(cell: str, mark: str = ".") -> float | None:
    """A cell as a number, NaN where it is empty, None where it holds none."""
    if mark == "." and (number := _float(cell)) is not None:
        return number
    if cell.casefold() in _MISSING:
        return math.nan
    cell, other = _plain(cell), _OTHER[mark]
    if other in cell:
        grouped = rf"[+-]?\d{{1,3}}(\{other}\d{{3}})+(\{mark}\d*)?"
        if not re.fullmatch(grouped, cell):
            return None
        cell = cell.replace(other, "")
    return _float(cell.replace(mark, "."))


def _float(cell: str) -> float | None:
    if _FORTRAN.fullmatch(cell):
        cell = cell.lower().replace("d", "e")
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
