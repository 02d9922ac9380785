"""``Table``: columns of numbers and of words under names, and what each of them is."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from jaxcal.checks import Array, Mask
from jaxcal.tables.cells import ambiguous, decimal_mark, number_of, truths_of, unit_of
from jaxcal.tables.decisions import (
    AVAILABLE,
    COMMANDS,
    COUNTED,
    MEASURED,
    Decision,
    bare,
    columns_by_name,
    decide,
    is_available,
    listed,
    of_role,
    say,
    sentence,
    split,
)


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of numbers under names, and columns of words beside them."""

    source: str  # the file's name, for messages
    names: tuple[str, ...]  # of the columns of numbers
    values: Array  # (N, len(names)), NaN where a cell is empty
    labels: dict[str, list[str]]  # columns that hold words, each of length N
    lines: tuple[int, ...]  # of the file, or rows of a frame, one for each row
    headed: bool = True  # False: there is no header, the names are u_x, u_y, u_z
    row: str = "line"  # what ``lines`` counts
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)  # as written

    def __len__(self) -> int:
        return len(self.values)

    @property
    def header(self) -> tuple[str, ...]:
        """Names of all columns, those of numbers first."""
        return (*self.names, *self.labels)

    @property
    def row_names(self) -> list[str] | None:
        """(N,) the first column of words that are no TRUE and FALSE; None: none is."""
        words = (cells for cells in self.labels.values() if truths_of(cells) is None)
        return next(words, None)

    @property
    def decisions(self) -> dict[str, Decision]:
        """For each column its role and why, where nothing but the table says it."""
        return decide(self)

    def columns(
        self,
        wanted: Sequence[str],
        used: Mask | None = None,
        levels: Sequence[Sequence[str]] = (),
    ) -> Array:
        """(N, len(wanted)) the columns of these very names, in that order.

        TRUE and FALSE are 1 and 0, words of ``levels`` 0, 1, ...

        Raises:
            ValueError: there is no such column, or a cell of a row that is ``used``
                (N,), all when not given, is no finite number.
        """
        values = np.empty((len(self), len(wanted)))
        for place, name in enumerate(wanted):
            if name in self.names:
                values[:, place] = self.values[:, self.names.index(name)]
            elif name in self.labels:
                cells = self.labels[name]
                if levels and levels[place]:
                    values[:, place] = _places(self, name, cells, levels[place])
                    continue
                truths = truths_of(cells, ("true", "false"))
                values[:, place] = truths or _require_numbers(self, name, cells)
            else:
                raise ValueError(
                    f"{self.source}: there is no column {name!r}; columns: "
                    f"{', '.join(self.header)}"
                )
        bad = ~np.isfinite(values)
        for row, place in np.argwhere(bad if used is None else bad & used[:, None]):
            raise ValueError(
                f"{self.cell(row, wanted[place])} must hold a number, got "
                f"{values[row, place]} or an empty cell; fill it or leave the row out"
            )
        return values

    def cell(self, row: int, name: str) -> str:
        """Where a cell stands, in words."""
        return f"{self.source}: {self.row} {self.lines[row]}, column {name!r}"

    def named(
        self,
        wanted: Sequence[str],
        prefix: str,
        *,
        chosen: str | None = None,
        option: str = "--inputs",
        unit: str = "",
        others: Collection[str] | None = None,
    ) -> tuple[str, ...]:
        """The columns that hold what is wanted, in that order.

        Args:
            wanted: names of the commands or outputs of a model, or of a calibration.
            prefix: ``COMMANDS`` or ``MEASURED``, which either side may lack.
            chosen: names separated by commas, where the user gave them: in the order
                of ``wanted``, unless they are its names.
            option: by which they are given; "" where a command has none.
            unit: that the names may hold: "pitch_deg", "u_deg_pitch", "pitch [deg]".
            others: names of what the table may hold beside them; where they are given,
                the columns that are neither are said.

        Raises:
            ValueError: a name is missing, stands twice, or could be either of two.
        """
        count = f"{len(wanted)} columns are needed ({', '.join(wanted)})"
        if chosen is not None:
            taken = self._chosen(chosen, prefix, unit)
            if len(taken) != len(wanted):
                raise ValueError(
                    f"{self.source}: {count}, {option} names {len(taken)}: "
                    f"{', '.join(split(chosen))}"
                )
            by_name = columns_by_name(wanted, taken, prefix, unit)
            if None not in by_name:
                self.say(by_name)
                return tuple(by_name)
            for name, column, place in zip(wanted, by_name, taken, strict=True):
                if column not in (None, place):
                    raise ValueError(
                        f"{self.source}: {option} has {place!r} at the position of "
                        f"{name!r}, and {column!r} elsewhere; the order is "
                        f"{', '.join(wanted)}"
                    )
            return taken
        if not self.headed:
            if len(self.names) != len(wanted):
                raise ValueError(
                    f"{self.source}: {count}, got {len(self.names)} without a header"
                )
            say(
                f"{self.source} has no header: columns are read by position as "
                f"{', '.join(wanted)}"
            )
            return self.names
        try:
            columns = columns_by_name(wanted, self.header, prefix, unit)
        except ValueError as error:
            choose = f"choose with {option}" if option else "rename one of them"
            raise ValueError(f"{self.source}: {error}; {choose}") from None
        if missing := [x for x, y in zip(wanted, columns, strict=True) if y is None]:
            advice = f"; name {', '.join(wanted)} in that order with {option}"
            raise ValueError(
                f"{self.source}: there is no column {', '.join(map(repr, missing))}, "
                f"with or without {prefix}; columns: {', '.join(self.header)}"
                + (advice if option else "")
            )
        spare = "" if others is None else self.unread(columns, prefix, others)
        self.say(columns, spare)
        return tuple(columns)

    def require_units(self, columns: Sequence[str], units: Sequence[str]) -> None:
        """Refuse columns whose row of units says another than these, or than the only
        one; "" is any."""
        units = [*units] * len(columns) if len(units) == 1 else units
        for name, unit in zip(columns, units, strict=True):
            stated = self.units.get(name, "")
            if unit and unit_of(stated) not in ("", unit_of(unit)):
                raise ValueError(
                    f"{self.source}: column {name!r} is in {stated}, by its row of "
                    f"units, and must be in {unit}: convert it, or correct that row"
                )

    def commands(
        self,
        chosen: str | None,
        option: str | None = "--inputs",
        but: Collection[str] = (),
    ) -> tuple[str, ...]:
        """Columns of commands: those chosen, else ``u_...``, else all but outputs.

        Args:
            chosen: names separated by commas, where the user gave them.
            option: by which they are given; None where a command has none.
            but: columns that hold readings, or weights.
        """
        if chosen is not None:
            return self._chosen(chosen, COMMANDS)
        decisions = decide(self, {*but}, fit=bool(but))
        advice = f"begin the names of commands with {COMMANDS}"
        advice += f", or name them with {option}" if option else ""
        for place, (name, decision) in enumerate(decisions.items(), start=1):
            if not decision.asks or decision.role == "output":
                continue
            if decision.role == "label":
                or_choose = f", or choose the commands with {option}" if option else ""
                raise ValueError(
                    f"{self.source}: column {name!r} {decision.reason}: write the "
                    f"number alone in each cell{or_choose}"
                )
            if self.row != "line":
                decisions[name] = Decision("input", decision.reason)
                continue
            what = f"column {name!r}" if self.headed else f"column {place}"
            raise ValueError(
                f"{self.source}: {what} {decision.reason}; if it is a command, {advice}"
            )
        names = of_role("input", decisions)
        if not names:
            raise ValueError(
                f"{self.source}: no column contains commands (columns: "
                f"{', '.join(self.header)}); {advice}"
            )
        if not self.headed:
            say(f"{self.source} has no header: its columns are {', '.join(names)}")
        if text := sentence(decisions):
            more = f"; to use other columns: {option}" if option else ""
            say(f"{self.source}: {text}{more}")
        return names

    def outputs(self, chosen: str | None, option: str = "--outputs") -> tuple[str, ...]:
        """Columns of measurements: those chosen, else ``y_...``."""
        if chosen is not None:
            return self._chosen(chosen, MEASURED)
        decisions = decide(self, fit=True)
        names = of_role("output", decisions)
        names += tuple(x for x in self.labels if x.startswith(MEASURED))  # refused
        axes = [name for name in names if decisions[name].asks]
        if names and not axes:
            return names
        axes = axes or [name for name in self.names if name.startswith(MEASURED)]
        fault = f"no column begins with {MEASURED}"
        if axes:
            fault = f"column {axes[0]!r} may be a coordinate, not a reading"
        raise ValueError(
            f"{self.source}: {fault}; name the measured columns with {option} "
            f"(columns: {', '.join(self.header)})"
        )

    def available(self) -> Mask | None:
        """(N,) True where the column ``available`` is 1; None without that column."""
        names = [x for x in self.header if is_available(x)]
        if len(names) > 1:
            both = " and ".join(map(repr, names))
            raise ValueError(f"{self.source}: columns {both} could both be {AVAILABLE}")
        if not names:
            return None
        cells = self._words(names[0])
        numbers = [(truths_of([cell]) or [np.nan])[0] for cell in cells]
        for line, cell, number in zip(self.lines, cells, numbers, strict=True):
            if number not in (0.0, 1.0):
                raise ValueError(
                    f"{self.source}: {self.row} {line}, {names[0]} must be 1 or 0, "
                    f"TRUE or FALSE, or yes or no, got {cell or 'an empty cell'}"
                )
        return np.array(numbers) == 1.0

    def _words(self, name: str) -> list[str]:
        """(N,) the cells of a column as words, numbers as well; "" where empty."""
        if name in self.labels:
            return self.labels[name]
        numbers = self.values[:, self.names.index(name)].tolist()
        return [f"{x:g}" if x == x else "" for x in numbers]

    def keys(self, name: str) -> list[str] | Array:
        """(N,) the words of a column, or its numbers; none may be missing."""
        if name not in self.labels:
            return self.columns([name])[:, 0]
        for row, cell in enumerate(self.labels[name]):
            if not cell:
                raise ValueError(f"{self.cell(row, name)} is empty")
        return self.labels[name]

    def say_available(self, *read: str | None) -> None:
        """Say that rows are used whose column ``available`` holds 0; ``read``: columns
        that are read as something else."""
        for name in filter(is_available, self.header):
            zeros = (truths_of(self._words(name)) or []).count(0.0)
            if zeros and name not in read:
                say(
                    f"{self.source}: column {name!r} is not read here: all rows are "
                    f"used, {zeros} of them with 0"
                )

    def say(self, columns: Sequence[Any], more: str = "") -> None:
        """Say where columns stand in another order than is asked for, and ``more``."""
        order = [name for name in self.header if name in columns]
        moved = "" if order == [*columns] else "columns reordered by name"
        if parts := [*filter(None, [moved, more])]:
            say(f"{self.source}: {'; '.join(parts)}")

    def without(self, prefix: str) -> list[str]:
        """Names of the columns that lack the prefix."""
        return [name for name in self.header if not name.startswith(prefix)]

    def bare(self, prefix: str) -> list[str]:
        """Names of all columns without the prefix."""
        return [bare(name, prefix) for name in self.header]

    def _chosen(self, chosen: str, prefix: str, unit: str = "") -> tuple[str, ...]:
        """The columns of the names given, which must be there, each once."""
        given = split(chosen)
        for name in given:
            if given.count(name) > 1:
                raise ValueError(f"{self.source}: column {name!r} is named twice")
        columns = columns_by_name(given, self.header, prefix, unit)
        for name, column in zip(given, columns, strict=True):
            if column is None:
                self.columns([name])  # says that there is none
        return tuple(columns)

    def unread(
        self, columns: Sequence[str], prefix: str, others: Collection[str]
    ) -> str:
        """Which columns are neither these nor ``others``, in words."""
        other = COMMANDS if prefix == MEASURED else MEASURED
        beside = {*columns, *columns_by_name([*others], self.header, other)}
        decisions = decide(self, {*columns})
        groups: dict[str, list[str]] = {}
        for name in self.header:
            role, reason, _ = decisions[name]
            spare = not (name in beside or name.startswith(other))
            if spare and reason != COUNTED and role != AVAILABLE:
                of_words = name in self.labels
                what = (
                    f"read as label: {reason}" if of_words else "ignored (not needed)"
                )
                groups.setdefault(what, []).append(name)
        return "; ".join(listed(names, what) for what, names in groups.items())


def table_of(
    source: str,
    columns: Mapping[str, Sequence[str] | Array],
    lines: Sequence[int],
    mark: tuple[str, bool] | None,
    *,
    headed: bool = True,
    row: str = "line",
    units: Mapping[str, str] | None = None,
) -> Table:
    """The table of columns of cells, or of numbers (N,); ``mark`` is what
    ``decimal_mark`` says of all cells, None: of each column by itself."""
    numeric: dict[str, Any] = {}
    table = Table(source, (), np.empty((len(lines), 0)), {}, tuple(lines), headed, row)
    marked = any(name.startswith(COMMANDS) for name in columns)
    for name, cells in columns.items():
        if isinstance(cells, np.ndarray):
            numeric[name] = cells
            continue
        point, decided = mark or decimal_mark(cells, True)
        numbers = [number_of(cell, point) for cell in cells]
        if (place := ambiguous(cells, point, decided)) is not None:
            cell = cells[place]
            plain = cell.replace(",", "").replace(".", "")
            raise ValueError(
                f"{table.cell(place, name)}: {cell!r} may mean {plain} or a number "
                f"with three decimals: write {plain}, or a fourth decimal"
            )
        must = name.startswith(COMMANDS) or (marked and name.startswith(MEASURED))
        truths = truths_of(cells, ("true", "false")) if must else None
        count = sum(number is None for number in numbers)
        if truths is not None and any(cells):
            numeric[name] = truths
        elif not count:
            numeric[name] = numbers
        else:
            filled = sum(map(bool, cells))
            if must or 2 * count < filled:
                _require_numbers(table, name, cells, numbers)
            table.labels[name] = [*cells]
    values = np.array([*numeric.values()], dtype=np.float64)
    values = values.reshape(len(numeric), len(lines)).T
    return dataclasses.replace(
        table, names=tuple(numeric), values=values, units=units or {}
    )


def _places(
    table: Table, name: str, cells: Sequence[str], levels: Sequence[str]
) -> list[float]:
    """The place of each word among the levels."""
    places = {level.strip(): float(place) for place, level in enumerate(levels)}
    places[""] = np.nan  # refused where its row is used
    for row, cell in enumerate(cells):
        if cell.strip() not in places:
            rule = f"must be one of {', '.join(levels)}, got {cell!r}"
            raise ValueError(f"{table.cell(row, name)} {rule}")
    return [places[cell.strip()] for cell in cells]


def _require_numbers(
    table: Table, name: str, cells: Sequence[str], numbers: Collection[Any] = ()
) -> NoReturn:
    """Refuse a column of cells by the first that is no number."""
    numbers = numbers or [number_of(cell) for cell in cells]
    row = [number is None for number in numbers].index(True)
    raise ValueError(
        f"{table.cell(row, name)} must hold a number, got {cells[row]!r}; correct it, "
        "or leave the row or column out"
    )
