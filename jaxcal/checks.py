"""Checks of what a caller hands over, whose errors name argument and value; words."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

ONE_COLUMN = "one column alone is values[:, None], or frame[['name']]"


def in_words(values: ArrayLike) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in np.atleast_1d(values)) + ")"


def aligned(
    rows: Sequence[Sequence[str]], sides: str = ">", *, ruled: bool = False
) -> list[str]:
    """Rows of cells as lines, every column padded to one width.

    Args:
        rows: of as many cells each.
        sides: "<" or ">" for each column, the last for all that follow.
        ruled: the first row is a head, with a rule below it.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if ruled:
        rows = [rows[0], ["-" * width for width in widths], *rows[1:]]
    formats = [f"{{:{sides[: i + 1][-1]}{width}}}" for i, width in enumerate(widths)]
    return ["  ".join(formats).format(*row).rstrip() for row in rows]


def lasted(seconds: float) -> str:
    """A time as one writes it: "35 ms", "2.1 s"."""
    return f"{1e3 * seconds:.0f} ms" if seconds < 0.9995 else f"{seconds:.1f} s"


def axis_letter(index: int, count: int) -> str:
    return "xyz"[index] if count == 3 else str(index + 1)


def require_unmasked(name: str, values: Any) -> None:
    if np.ma.is_masked(values):
        raise ValueError(f"{name} must not be masked; leave the masked rows out")


def numbers(name: str, values: ArrayLike, *, finite: bool = True) -> Array:
    if isinstance(values, np.ma.MaskedArray):
        require_unmasked(name, values)
    try:
        raw = np.asarray(values)
        if raw.dtype.kind not in "biufO":
            raise TypeError
        array = raw.astype(np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} must be an array of numbers, got "
            f"{getattr(values, 'dtype', type(values).__name__)}"
        ) from error
    if finite:
        require_finite(name, array)
    return array


def array_of(
    name: str,
    values: ArrayLike,
    *shape: int | str,
    rule: str = "",
    finite: bool = True,
) -> Array:
    """``values`` as float64 of a shape, in which letters stand for any size."""
    array = numbers(name, values, finite=finite)
    fits = array.ndim == len(shape)
    for want, got in zip(shape, array.shape, strict=False):
        fits = fits and (want == got or isinstance(want, str))
    if not fits:
        comma = "," if len(shape) == 1 else ""
        shape_text = f"({', '.join(map(str, shape))}{comma})"
        alone = len(shape) == 2 and array.ndim == 1
        raise ValueError(
            f"{name} must have shape {shape_text}{rule}, got {array.shape}"
            + ("; " + ONE_COLUMN if alone else "")
        )
    return array


def require_finite(name: str, array: Array) -> None:
    finite = np.isfinite(array)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        at = f" at {where}" if where else ""
        raise ValueError(f"{name} must be finite, got {array[where]}{at}")


def require_size(name: str, array: Array, most: float = 1e100) -> None:
    """Refuse a column (..., n) whose largest number is out of reach of its square."""
    size = np.abs(array).reshape(-1, array.shape[-1]).max(axis=0, initial=0.0)
    rule = f"{name} must be between {1.0 / most:g} and {most:g} in size"
    bad = (size > most) | ((size > 0.0) & (size < 1.0 / most))
    require_none(bad, size, rule, "; choose another unit")


def require_none(bad: NDArray[np.bool_], of: Any, rule: str, more: str = "") -> None:
    """Refuse by ``rule`` the first of the values where ``bad`` holds."""
    if bad.any():
        raise ValueError(f"{rule}, got {of[bad][0]}{more}")


def require_kind(argument: str, value: Any, kind: type) -> None:
    """Refuse what is neither None nor a ``Prior``, or a ``Noise``."""
    if value is not None and not isinstance(value, kind):
        raise ValueError(
            f"{argument} must be a jaxcal.{kind.__name__}(std=...), got "
            f"{type(value).__name__}"
        )


def table(name: str, values: ArrayLike, count: int | None = None) -> Array:
    """Values (N, n) as float64; ``count``: N, where it is that of the commands."""
    table = numbers(name, values)
    if table.ndim != 2 or table.shape[1] < 1:
        raise ValueError(
            f"{name} must have shape (N, {'m' if name == 'measured' else 'n'}), "
            f"got {table.shape}" + ("; " + ONE_COLUMN if table.ndim == 1 else "")
        )
    if count is not None and len(table) != count:
        raise ValueError(
            f"{name} must have shape ({count}, m): as many rows as commands, "
            f"got {table.shape}"
        )
    return table


def one_or_each(name: str, values: ArrayLike, count: int, more: str = "") -> Array:
    """(count,) of one number for all or one each."""
    given = numbers(name, values, finite=False)
    if given.shape not in ((), (count,)):
        raise ValueError(
            f"{name} must be one number or ({count},){more}, got {given.shape}"
        )
    return given if given.shape else np.full(count, given)


def levels(name: str, values: ArrayLike, count: int) -> Array:
    """(count,) positive numbers, one for all or one each."""
    given = one_or_each(name, values, count)
    require_finite(name, given)
    require_none(given <= 0.0, given, f"{name} must be positive")
    require_size(name, given)
    given.flags.writeable = False
    return given


def axis_names(
    argument: str, names: Sequence[str] | None, letter: str, count: int
) -> tuple[str, ...]:
    if names is None:
        return tuple(f"{letter}_{axis_letter(i, count)}" for i in range(count))
    given = () if isinstance(names, str) else tuple(names)
    texts = all(isinstance(name, str) and name for name in given)
    if len(given) != count or not texts or len(set(given)) < count:
        raise ValueError(f"{argument} must hold {count} different names, got {names!r}")
    return given


def one_of(argument: str, value: Any, choices: Sequence[str]) -> str:
    """``value`` where it is one of the choices, else a ValueError that lists them."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(
            f"{argument} must be one of {', '.join(choices)}, got {value!r}"
        )
    return value


def nearest(name: str, names: Iterable[str]) -> str:
    """The most alike of the names, dashes before them aside; "" where none is."""
    import difflib

    bare = {one.lstrip("-"): one for one in names}
    close = difflib.get_close_matches(name.lstrip("-"), bare, 1, 0.65)
    return bare[close[0]] if close else ""


def require_known(what: str, name: str, names: Sequence[str]) -> None:
    """Refuse a name that is none of these: by the one most alike, if any is alike."""
    if name not in names:
        like = nearest(name, names)
        more = f"did you mean {like}?" if like else f"there are {', '.join(names)}"
        raise ValueError(f"there is no {what} {name!r}; {more}")


def whole_number(argument: str, value: Any, least: int) -> int:
    """``value`` as an int of at least ``least``; True and False are no numbers."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{argument} must be a whole number, got {value!r}") from None
    if number < least:
        raise ValueError(f"{argument} must be at least {least}, got {number}")
    return number


def share(argument: str, value: Any) -> float:
    """``value`` as a float in (0, 1]."""
    return _number(argument, value, 1.0, "in (0, 1]")


def seconds(argument: str, value: Any) -> float:
    """``value`` as a time limit above 0 s; infinity is no limit."""
    return _number(argument, value, np.inf, "a number above 0 in seconds")


def _number(argument: str, value: Any, most: float, rule: str) -> float:
    number = isinstance(value, int | float | np.integer | np.floating)
    if not number or isinstance(value, bool) or not 0.0 < value <= most:
        raise ValueError(f"{argument} must be {rule}, got {value!r}")
    return float(value)


def by_unit(
    name: str, given: float | Mapping[str, float], units: tuple[str, ...]
) -> dict[str, float]:
    """Positive sizes by unit; a number alone is of the first of the units."""
    asked = given if isinstance(given, Mapping) else {units[0]: given}
    for unit, size in asked.items():
        one_of(f"unit of {name}", unit, units)
        if not array_of(name, size) > 0.0:
            raise ValueError(f"{name} must be positive, got {size}")
    return {unit: float(size) for unit, size in asked.items()}
