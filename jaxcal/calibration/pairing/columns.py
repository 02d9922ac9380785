"""Columns with another sign, unit or place, and where a sensor stands then."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from jaxcal.calibration.pairing.fit import Fitted, fits_of, solved
from jaxcal.calibration.pairing.table import (
    ColumnChange,
    Hypothesis,
    Rows,
    Table,
    as_it_is,
    shifted,
)
from jaxcal.checks import Array
from jaxcal.models.predictions import predict

_TURNS = 1.7453292519943295e-2  # radians in a degree
_UNITS = {
    "is in radians instead of degrees": 1.0 / _TURNS,
    "is in degrees instead of radians": _TURNS,
    "is too small by 1000 (m for mm?)": 1000.0,
    "is too large by 1000 (mm for m?)": 0.001,
    "is too small by 10": 10.0,
    "is too large by 10": 0.1,
    "is too small by 100": 100.0,
    "is too large by 100": 0.01,
}
_DECADES = {0.01, 0.1, 10.0, 100.0}  # by which a nominal may be off
_COLUMNS = 6  # changes of columns that are fitted one by one
_MOST = 30  # columns that are tried one by one
_PLACES = 2  # of a sensor, that are tried
_KINDS = np.log(10.0)
_ROWS = 50  # that are predicted in each unit
_FACTOR, _LEFT_OVER = 1.5, 0.6  # between machine and nominal; of the readings' squares


def changed_columns(
    table: Table, plain: Fitted, inputs: Sequence[str], outputs: Sequence[str]
) -> list[Fitted]:
    """Columns with another sign, unit or place."""
    least = 0.1 if table.model.resolution else 0.02
    if table.shared or not (plain.rms > least * table.width).any():
        return []
    tables, every = [], np.flatnonzero(table.counted)
    for hypothesis in _kinds_of_columns(table, inputs, outputs):
        anew = _anew(table, hypothesis, every)
        with contextlib.suppress(ValueError):  # the number of a chain has no sign
            if anew is not None:
                tables.append((_distance(anew, hypothesis, every), anew, hypothesis))
    tables.sort(key=lambda row: row[0])
    return [
        fit
        for _, anew, hypothesis in tables[:_COLUMNS]
        for fit in fits_of(anew, [hypothesis])
    ]


def by_nominal(
    table: Table, inputs: Sequence[str], outputs: Sequence[str]
) -> Fitted | None:
    """A change by which the prior's mean explains readings that it does not without.

    A nonlinear fit may take up a unit or a sign in a parameter and leave nothing over.
    """
    rows = np.flatnonzero(table.counted)[:_ROWS]
    if (_unexplained(table, as_it_is(table), rows) < 1.0).all():
        return None
    kinds = [
        hypothesis
        for hypothesis in _kinds_of_columns(table, inputs, outputs)
        if hypothesis.change and _DECADES.isdisjoint(hypothesis.change.factors)
    ]
    if not kinds:
        return None
    shares = [_unexplained(table, hypothesis, rows) for hypothesis in kinds]
    best = min(range(len(kinds)), key=lambda i: shares[i].sum())
    if (shares[best] >= _LEFT_OVER).any():
        return None
    nominal = dataclasses.replace(table, theta=table.mean)
    for fit in fits_of(nominal, [kinds[best]]):  # whose parameters are near it
        near = np.abs(fit.theta - table.mean) <= np.abs(table.mean)
        if near[table.mean != 0.0].all():
            return fit
    return None


def _unexplained(table: Table, hypothesis: Hypothesis, rows: Rows) -> Array:
    """(q,) share of the readings' squares about their means left by the prior's mean.

    Its outputs may be larger or smaller by a factor.
    """
    readings = table.readings_of(hypothesis, rows)
    commands = table.commands_of(hypothesis, rows)
    outputs = predict(table.model, commands, table.mean, finite=False)
    with np.errstate(all="ignore"):
        ratio = (readings * outputs).sum(axis=0) / (outputs**2).sum(axis=0)
        off = readings - outputs * np.clip(ratio, 1.0 / _FACTOR, _FACTOR)
        off = table.model.wrapped(off, commands)
        share = (off**2).sum(axis=0) / (readings.var(axis=0) * len(rows))
    return np.nan_to_num(share, nan=np.inf, posinf=np.inf)


def _kinds_of_columns(
    table: Table, inputs: Sequence[str], outputs: Sequence[str]
) -> list[Hypothesis]:
    """Columns with another sign or unit, or in the place of another's."""
    moved = table.commands.shape[1] - table.sensed
    tables = [(inputs, len(inputs), moved, False)]
    if not table.model.relative:
        tables.append((outputs, len(outputs), len(outputs), True))
    # A machine that hardly moves has zero readings everywhere, as contacts.
    units = _UNITS if table.measured.any() else {}
    changes: list[ColumnChange] = []
    for names, size, count, of_readings in tables:
        if of_readings and not table.measured.any():
            continue
        kinds: list[tuple[str, list[int], float]] = []  # words, columns and factor
        singly = range(count if count <= _MOST else 0)  # no trajectory's readings
        for i in singly:
            for what, factor in {"has the other sign": -1.0, **units}.items():
                kinds.append((f"{names[i]} {what}", [i], factor))
        side = "the readings" if of_readings else "the commands"
        for what, factor in units.items() if count > 1 else ():
            every = f"every column of {side} {what}"
            kinds.append((every, [*range(count)], factor))
        for i, j in itertools.combinations(singly, 2):
            both = f"{names[i]} and {names[j]}"
            kinds.append((f"{both} are exchanged", [i, j], 1.0))
            if not of_readings:
                kinds.append((f"{both} have the wrong sign", [i, j], -1.0))
        for words, columns, factor in kinds:
            order, factors = np.arange(size), np.ones(size)
            factors[columns] = factor
            if factor == 1.0:  # exchanged
                order[columns] = columns[::-1]
            places = tuple(order.tolist()), tuple(factors.tolist())
            changes.append(ColumnChange(words, of_readings, *places))
    code, several = _KINDS + np.log(len(changes) + 1.0), np.log(20.0)
    rows = np.arange(len(table.commands))
    costs = [
        several * (" and " in x.words) + _KINDS * ("every" in x.words) for x in changes
    ]
    return [
        Hypothesis("columns", rows, code + cost, change=x)
        for x, cost in zip(changes, costs, strict=True)
    ]


def _distance(table: Table, hypothesis: Hypothesis, rows: Rows) -> float:
    """Log size of what is off before anything is fitted that a prior is known of."""
    off = table.residuals(hypothesis, rows, table.theta)
    if table.flat:
        with contextlib.suppress(ValueError):  # least squares about ``theta``
            slopes, right = table.system(hypothesis, rows)
            flat = slopes.reshape(-1, slopes.shape[-1])
            aim = flat.T @ right.reshape(len(flat), -1)
            solution = solved(flat.T @ flat, aim, table.ridge(flat.shape[1]))
            off = np.asarray((right - slopes @ solution).reshape(len(rows), -1))
    size = float(np.log(np.median(np.abs(off), axis=0) + 1e-300).sum())
    if hypothesis.change is not None:
        size -= hypothesis.change.log_size
    return size if size == size else np.inf


def _anew(table: Table, hypothesis: Hypothesis, rows: Rows) -> Table | None:
    """The table of the machine that these readings show if the hypothesis holds."""
    if not table.free.any():
        return table
    try:
        model = table.model.anew(
            table.commands_of(hypothesis, rows), table.readings_of(hypothesis, rows)
        )
    except ValueError:
        return None
    mean = table.mean + np.asarray(model.nominal) - table.model.nominal
    return dataclasses.replace(table, model=model, mean=mean, theta=mean)


def places(table: Table) -> list[Table]:
    """The table with its sensor where some rows, or some pairing of them, put it.

    That of the rows which then fit best come first: where readings are mispaired, all
    of them together put it nowhere.
    """
    count = len(table.commands)
    every, half = np.arange(count), count // 2
    windows = [(every, every), (every, every[:half]), (every, every[half:])]
    matches = [shifted(count, by) for by in (1, -1, 2, -2, 3, -3)]
    matches += [every[::-1], (every + half) % count, (every - half) % count]
    windows += [(match, every) for match in matches]
    ranked = []
    for match, rows in windows:
        hypothesis = Hypothesis("", match)
        rows = rows[(match[rows] >= 0) & table.counted[rows]]
        anew = _anew(table, hypothesis, rows)
        if anew is not None:
            ranked.append((_distance(anew, hypothesis, rows), anew))
    ranked.sort(key=lambda pair: pair[0])
    return [anew for _, anew in ranked[:_PLACES]] or [table]
