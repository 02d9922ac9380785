"""Columns and rows that were rearranged: another sign, unit, place or order."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxcal.calibration.pairing.fit import (
    MOST_ROWS,
    ColumnChange,
    Fitted,
    Hypothesis,
    Names,
    Table,
    as_it_is,
    fits_of,
    fitted,
    path_match,
    predicted,
    shifted,
    solved,
)
from jaxcal.calibration.reasons import in_order
from jaxcal.checks import Array
from jaxcal.models.model import Rows
from jaxcal.models.predictions import predict

_RADIAN = 1.7453292519943295e-2  # a degree in radians
_UNITS = {
    "is in radians instead of degrees": 1.0 / _RADIAN,
    "is in degrees instead of radians": _RADIAN,
    "is too small by 1000 (m for mm?)": 1000.0,
    "is too large by 1000 (mm for m?)": 0.001,
    "is too small by 10": 10.0,
    "is too large by 10": 0.1,
    "is too small by 100": 100.0,
    "is too large by 100": 0.01,
}
_COUNTS = (200, 400, 1000, 2000, 4096, 10_000, 16_384, 65_536)  # of a turn
_TURNS_OF = {"degrees": 360.0, "radians": 2.0 * np.pi}
_TURNED = 0.05  # turns, at least, of commands that may be in counts
_ALIKE, _MULTIPLE = 1.1, 0.05  # of factors; of the readings' squares, that is left
_DECADES = {0.01, 0.1, 10.0, 100.0}  # by which a nominal may be off
_COLUMNS = 6  # changes of columns that are fitted one by one
_NEAREST = 24  # of them that are located, where views show turns
_MOST = 30  # columns that are tried one by one
_PLACES = 2  # of a sensor, that are tried
_KINDS = np.log(10.0)
_ROWS = 50  # that are predicted in each unit
# Between machine and nominal, and where is stated how far off that may be; shares of
# the readings' squares that a change leaves.
_FACTOR, _FACTOR_STATED = 1.5, 1.2
_LEFT_OVER, _AS_GOOD_SHARE = 0.6, 1e-4
_STARTS, _REFINED, _ROUNDS = 12_000, 8, 12  # of that search: rows times starts, ...
_SOLVED = 0.003  # share of the squares that the right order leaves
_FAR = 1e9  # noises: what a model cannot predict
_TURNS = 12  # of assigning readings and fitting


def changed_columns(
    table: Table, plain: Fitted, inputs: Names, outputs: Names
) -> list[Fitted]:
    """Columns with another sign, unit or place."""
    least = 0.1 if table.model.fitting.resolution else 0.02
    size = np.maximum(plain.rms, plain.noise)  # rms is less, where a prior is known
    if table.shared or not (size > least * table.width).any():
        return []
    tables, every = [], np.flatnonzero(table.counted)
    theta = table.theta if not table.free.any() else table.mean
    expected = None if table.model.linear and table.free.any() else theta
    kinds = _kinds_of_columns(table, inputs, outputs, expected)
    if table.sensed and table.alike is not None:
        kinds = sorted(kinds, key=lambda x: _apart(table, x, every))[:_NEAREST]
    for hypothesis in kinds:
        anew = _anew(table, hypothesis, every)
        with contextlib.suppress(ValueError):  # the number of a chain has no sign
            if anew is not None:
                tables.append((_left_over(anew, hypothesis, every), anew, hypothesis))
    tables.sort(key=lambda row: row[0])
    few = tables[:_COLUMNS]
    return [fit for _, anew, kind in few for fit in fits_of(anew, [kind])]


def by_nominal(table: Table, inputs: Names, outputs: Names) -> Fitted | None:
    """A change by which the prior's mean explains readings that it does not without: a
    nonlinear fit may take up a unit or a sign in a parameter."""
    rows = np.flatnonzero(table.counted)[:_ROWS]
    said = predict(table.model, table.commands[rows], table.mean, finite=False)
    if (_unexplained(table, as_it_is(table), rows, said) < 1.0).all():
        return None
    kinds = [
        hypothesis
        for hypothesis in _kinds_of_columns(table, inputs, outputs, table.mean)
        if hypothesis.change and _DECADES.isdisjoint(hypothesis.change.factors)
    ]
    if not kinds:
        return None
    shares = np.array([_unexplained(table, x, rows, said) for x in kinds])
    best, *others = np.argsort(shares.sum(axis=1), kind="stable").tolist()
    change = kinds[best].change
    for unit in others[:1] if change and change.estimated else ():
        if (shares[unit] <= 4.0 * shares[best] + _AS_GOOD_SHARE).all():
            best = unit  # which is as good as a number
    if (shares[best] >= _LEFT_OVER).any():
        return None
    nominal = dataclasses.replace(table, theta=table.mean)
    for fit in fits_of(nominal, [kinds[best]]):  # whose parameters are near it
        near = np.abs(fit.theta - table.mean) <= np.abs(table.mean)
        if near[table.mean != 0.0].all():
            return fit
    return None


def _unexplained(
    table: Table, hypothesis: Hypothesis, rows: Rows, outputs: Array
) -> Array:
    """(q,) share of the readings' squares about their means left by the prior's mean,
    whose ``outputs`` (K, q) at the commands as they stand may be larger or smaller."""
    readings = table.readings_of(hypothesis, rows)
    commands = table.commands_of(hypothesis, rows)
    change = hypothesis.change
    if change is not None and not change.of_readings:
        outputs = predict(table.model, commands, table.mean, finite=False)
    with np.errstate(all="ignore"):
        ratio = (readings * outputs).sum(axis=0) / (outputs**2).sum(axis=0)
        most = _FACTOR if table.model.fitting.off_by is None else _FACTOR_STATED
        off = readings - outputs * np.clip(ratio, 1.0 / most, most)
        off = table.model.fitting.wrapped(off, commands)
        share = (off**2).sum(axis=0) / (readings.var(axis=0) * len(rows))
    return np.nan_to_num(share, nan=np.inf, posinf=np.inf)


def _kinds_of_columns(
    table: Table, inputs: Names, outputs: Names, theta: Array | None = None
) -> list[Hypothesis]:
    """Columns with another sign or unit, or in the place of another's; where parameters
    ``theta`` (p,) are expected also in counts."""
    moved = table.commands.shape[1] - table.sensed
    tables = [(inputs, moved, False)]
    # A machine that hardly moves has zero readings everywhere, as contacts, not views.
    read = table.measured.any() or table.alike is not None
    if table.measured.any() and not table.model.fitting.relative:
        tables.append((outputs, len(outputs), True))
    units = {what: factor for what, factor in _UNITS.items() if read or factor > 1.0}
    ways = {"has the other sign": -1.0} | units
    changes: list[ColumnChange] = []
    for names, count, of_readings in tables:
        kinds: list[tuple[str, list[int], float]] = []  # words, columns and factor
        singly = range(count if count <= _MOST else 0)  # no trajectory's readings
        kinds += [
            (f"{names[i]} {what}", [i], factor)
            for i in singly
            for what, factor in ways.items()
        ]
        together = ways if count > 1 else {}
        if theta is not None and read and moved and not of_readings:
            most = np.ptp(table.commands[:, :moved], axis=0).max()
            together = together | {
                f"is in counts of {count} a turn, not in {unit}": turn / count
                for unit, turn in _TURNS_OF.items()
                for count in _COUNTS
                if most > _TURNED * count
            }
        every = f"every column of the {'readings' if of_readings else 'commands'}"
        for what, factor in together.items():
            kinds.append((f"{every} {what}", [*range(count)], factor))
        for i, j in itertools.combinations(singly, 2):
            both = f"{names[i]} and {names[j]}"
            kinds.append((f"{both} are exchanged", [i, j], 1.0))
            if not of_readings:
                kinds.append((f"{both} have the wrong sign", [i, j], -1.0))
        seen = range(count, len(names) if table.alike is not None else 0)
        for i in seen:  # of a pose that a reading brought, its place and its turn
            kinds.append((f"{names[i]} has the other sign", [i], -1.0))
            for j in range(i + 1, count + 3 + (i - count) // 3 * 3):
                both = f"{names[i]} and {names[j]}"
                kinds.append((f"{both} are exchanged", [i, j], 1.0))
        for k, (what, factor) in enumerate([*_UNITS.items()][:4] if seen else ()):
            i = seen[0] if k > 1 else seen[3]  # a length, or a turn
            words = f"{names[i]} to {names[i + 2]}: each {what}"
            kinds.append((words, [i, i + 1, i + 2], factor))
        for words, columns, factor in kinds:
            order, factors = np.arange(len(names)), np.ones(len(names))
            factors[columns] = factor
            if factor == 1.0:  # exchanged
                order[columns] = columns[::-1]
            places = tuple(order.tolist()), tuple(factors.tolist())
            of_seen = places[1][count:] if seen else ()
            changes.append(ColumnChange(words, of_readings, *places, seen=of_seen))
    if theta is not None and (times := _multiple(table, theta)):
        words = f"the readings are {times:.3g} times what the parameters say (counts?)"
        places = tuple(range(len(outputs))), (1.0 / times,) * len(outputs)
        changes.append(ColumnChange(words, True, *places, estimated=True))
    code, rows = _KINDS + np.log(len(changes) + 1.0), np.arange(len(table.commands))

    def cost(words: str) -> float:
        several = np.log(20.0) * (" and " in words)
        return float(code + (several + _KINDS * ("every" in words)))

    return [Hypothesis("columns", rows, cost(x.words), change=x) for x in changes]


def _multiple(table: Table, theta: Array) -> float:
    """How many times the predictions all readings are, where it is no unit's factor; 0
    where they are no multiple of these."""
    rows = np.flatnonzero(table.counted)[:_ROWS]
    said = predict(table.model, table.commands[rows], theta, finite=False)
    read = table.measured[rows]
    with np.errstate(all="ignore"):
        times = (read * said).sum(axis=0) / (said**2).sum(axis=0)
        rest = ((read - said * times) ** 2).sum(axis=0) / (read**2).sum(axis=0)
        units = [1.0, *(x for x in _UNITS.values() if x not in _DECADES)]
        apart = np.abs(np.log(np.abs(times) / np.array([units]).T))
        alike = times.max() < _ALIKE * times.min()
        if not (alike and times.min() > 0.0 and (rest < _MULTIPLE).all()):
            return 0.0
    most = _FACTOR if table.model.fitting.off_by is None else _FACTOR_STATED
    near_unit = (apart < np.log(most)).all(axis=1).any()
    return 0.0 if near_unit else float(np.median(times))


def _apart(table: Table, hypothesis: Hypothesis, rows: Rows) -> float:
    """Median of how far rows are apart on one side and not on the other."""
    columns = table.commands_of(hypothesis, rows), table.readings_of(hypothesis, rows)
    gaps = table.model.fitting.apart(*columns)
    assert gaps is not None
    return float(np.median(np.abs(gaps[0] - gaps[1])))


def _left_over(table: Table, hypothesis: Hypothesis, rows: Rows) -> float:
    """Log size of what least squares about ``theta`` leaves, of all outputs together,
    with how far it moves what a prior is known of."""
    off, moved = _residuals(table, hypothesis, rows)
    if table.levels == 1:
        size = 0.5 * table.outputs * float(np.log((off**2).sum() + moved + 1e-300))
    else:
        size = 0.5 * float(np.log((off**2).sum(axis=0) + 1e-300).sum())
    if hypothesis.change is not None:
        size -= hypothesis.change.log_size
    return size if size == size else np.inf


def _residuals(table: Table, hypothesis: Hypothesis, rows: Rows) -> tuple[Array, float]:
    """(K, q) residuals of least squares about ``theta``, and the prior's share."""
    slopes, right = table.system(hypothesis, rows)
    size, columns = len(rows) * slopes.shape[1], slopes.shape[2]
    flat, aim = slopes.reshape(size, columns), right.reshape(size, -1)
    ridge = table.ridge(columns)
    solution = solved(flat.T @ flat, flat.T @ aim, ridge)
    off = (aim - flat @ solution).reshape(len(rows), -1)
    return off, float((ridge[:, None] * solution**2).sum())


def _distance(table: Table, hypothesis: Hypothesis, rows: Rows) -> float:
    """Median log size of what is off before what a prior is known of is fitted."""
    off = table.residuals(hypothesis, rows, table.theta)
    if table.flat:
        with contextlib.suppress(ValueError):
            off = _residuals(table, hypothesis, rows)[0]
    size = float(np.log(np.median(np.abs(off), axis=0) + 1e-300).sum())
    return size if size == size else np.inf


def _anew(table: Table, hypothesis: Hypothesis, rows: Rows) -> Table | None:
    """The table of the machine that these readings show if the hypothesis holds."""
    if not table.free.any():
        return table
    try:
        model = table.model.fitting.anew(
            table.commands_of(hypothesis, rows), table.readings_of(hypothesis, rows)
        )
    except ValueError:
        return None
    if model is table.model:
        return table
    mean = table.mean + np.asarray(model.nominal) - table.model.nominal
    return dataclasses.replace(table, model=model, mean=mean, theta=mean)


def places(table: Table) -> list[Table]:
    """The table with its sensor where some rows, or some pairing of them, put it, those
    that fit best first: mispaired readings together put it nowhere."""
    count = len(table.commands)
    every, half = np.arange(count), count // 2
    windows = [(every, every), (every, every[:half]), (every, every[half:])]
    matches = [shifted(count, by) for by in (1, -1, 2, -2, 3, -3)]
    matches += [every[::-1], (every + half) % count, (every - half) % count]
    matches += [] if table.alike is None else [table.alike]
    ranked = []
    for match, rows in [*windows, *((match, every) for match in matches)]:
        hypothesis = Hypothesis("", match)
        rows = rows[(match[rows] >= 0) & table.counted[rows]]
        anew = _anew(table, hypothesis, rows)
        if anew is not None:
            ranked.append((_distance(anew, hypothesis, rows), anew))
    ranked.sort(key=lambda pair: pair[0])
    return [anew for _, anew in ranked[:_PLACES]] or [table]


def polished(fit: Fitted) -> tuple[Fitted, dict[int, list[int]]]:
    """A path with its changes at their most probable rows, and rows about as good."""
    table, path = fit.table, list(fit.hypothesis.starts)
    near: dict[int, list[int]] = {}
    count, costs = len(table.commands), table.costs()
    noise = np.maximum(fit.noise, 1e-7)
    for _ in range(2):
        of_rows: dict[int, Array] = {}
        for by in {shift for _, shift in path}:
            cost = costs.copy()
            match = path_match(count, [(0, by)])
            rows = np.flatnonzero((match >= 0) & table.counted)
            if len(rows):
                off = _off(fit, match, rows) / noise
                inside = 0.5 * (off**2).sum(axis=1) + np.log(noise).sum()
                inside += 0.5 * table.outputs * np.log(2.0 * np.pi)
                cost[rows] = np.minimum(inside, costs[rows] + np.log(20.0))
            of_rows[by] = cost * table.counted
        near = {}
        for i in range(1, len(path)):
            low = path[i - 1][0] + 1
            high = path[i + 1][0] if i + 1 < len(path) else count
            gain = of_rows[path[i - 1][1]] - of_rows[path[i][1]]
            upto = np.append(0.0, np.cumsum(gain))[low:high]
            best = int(upto.argmin())
            near[i] = [low + int(k) for k in np.flatnonzero(upto < upto[best] + 2.0)]
            path[i] = (low + best, path[i][1])
        if tuple(path) == fit.hypothesis.starts:
            break
        match, old = path_match(count, path), fit.hypothesis
        hypothesis = dataclasses.replace(old, match=match, starts=tuple(path))
        fit = fitted(table, hypothesis, fit.theta)
        noise = np.maximum(fit.noise, 1e-7)
    return fit, near


def _off(fit: Fitted, match: Rows, rows: Rows) -> Array:
    """(K, q) residuals of rows paired by ``match``, in scales, at the fit."""
    table = fit.table
    if table.shared:
        reading = table.measured[rows] / table.scale
        return np.asarray(reading - predicted(fit)[match[rows]])
    return table.residuals(Hypothesis("", match), rows, fit.theta)


def assigned(fit: Fitted, rows: Rows) -> Rows:
    """(N,) match in which readings of ``rows`` have those commands that fit best."""
    table, match = fit.table, fit.hypothesis.match.copy()
    commands = match[rows]
    noise = np.maximum(fit.noise, 1e-7)
    if table.sensed:  # a reading brings columns of the commands
        offs = [_off(fit, np.full_like(match, row), rows) for row in commands]
        off = np.stack(offs, axis=1)
    else:
        off = table.measured[rows, None] / table.scale - predicted(fit)[commands]
    apart = np.minimum(np.nan_to_num(off / noise, nan=_FAR), _FAR) ** 2
    reading, other = linear_sum_assignment(apart.sum(axis=-1))
    match[rows[reading]] = commands[other]
    return match


def exchanged(table: Table, plain: Fitted) -> list[Fitted]:
    """Outliers whose readings fit one another's commands."""
    rows = np.flatnonzero(~plain.inside & table.counted)
    count = len(table.commands)
    if not 2 <= len(rows) <= count // 2:
        return []
    match = assigned(plain, rows)
    moved = np.flatnonzero(match != np.arange(count))
    if len(moved) < 2:
        return []
    code = 2.3 + float(len(moved) * np.log(count))
    return [fitted(table, Hypothesis("exchanged", match, code), plain.theta)]


def sorted_alone(table: Table, plain: Fitted) -> list[Fitted]:
    """Commands or readings that were sorted without the others."""
    count = len(table.commands)
    poor = (plain.rms > 0.3 * table.width).any()
    if not poor or count > MOST_ROWS:
        return []
    kinds, sensed = [], table.model.fitting.sensed
    moved = np.delete(table.commands, sensed, axis=1)
    read = np.hstack([table.measured, table.commands[:, sensed]])
    # Commands may be of few levels; by chance noise is in no order.
    commands, readings = in_order(moved, 1.0 / count), in_order(read, 0.7)
    if commands.all() and readings.all():  # what depends on one command and bends
        return []
    if commands.any():
        alike = np.unique(moved, axis=0, return_counts=True)[1]  # rows of one command
        code = 2.3 + math.lgamma(count + 1.0) - sum(map(math.lgamma, alike + 1.0))
        kinds.append(("commands sorted", code))
    if readings.any():
        kinds.append(("readings sorted", 5.0 * np.log(count)))
    if not kinds:
        return []
    matches = [] if table.alike is None else [table.alike]
    if not table.sensed:
        matches += matched_anew(dataclasses.replace(table, theta=table.mean), plain)
    fits = [_matched(table, match) for match in matches]
    return [
        fit._replace(
            hypothesis=dataclasses.replace(fit.hypothesis, kind=kind, code=code),
            evidence=fit.evidence - code,
        )
        for kind, code in kinds
        for fit in fits
    ]


def _matched(table: Table, match: Rows) -> Fitted:
    """An assignment that is refined in turn with its fit."""
    hypothesis, every = Hypothesis("sorted", match), np.arange(len(match))
    table = _anew(table, hypothesis, every) or table
    fit = fitted(table, hypothesis)
    for _ in range(_TURNS):
        match = assigned(fit, every)
        if (match == fit.hypothesis.match).all():
            break
        fit = fitted(table, dataclasses.replace(hypothesis, match=match), fit.theta)
    return fit


def matched_anew(table: Table, fit: Fitted) -> list[Rows]:
    """Matches (N,) by which readings that lost their order fit some parameters best.
    One output alone is matched by sorting, for many parameters at once, in turn with
    least squares; the best matches are refined with all outputs by assignment."""
    every = np.arange(len(table.commands))
    if not table.free.any():
        return [assigned(fit, every)]
    factors, right = table.system(as_it_is(table), every)
    (count, a, r), c = factors.shape, right.shape[-1]
    read = (table.measured / table.scale).reshape(count, -1)
    fixed = read - right.reshape(count, -1)  # of predictions, by nothing that is free
    flat = factors.reshape(count * a, r)
    inverse = np.linalg.pinv(flat)
    middle = read.mean(axis=0)  # of both, so that squares keep their digits
    read, fixed = read - middle, fixed - middle
    all_of_it = (read**2).sum()
    tried: dict[bytes, tuple[float, Rows]] = {}
    for k in range(read.shape[1]):
        for match in _sorted_matches(factors[:, k % a], fixed[:, k], read[:, k]):
            square = np.inf
            for _ in range(_ROUNDS):
                aim = (read[np.argsort(match)] - fixed).reshape(count * a, c)
                said = fixed + (flat @ (inverse @ aim)).reshape(count, -1)
                apart = (said**2).sum(axis=1) - 2.0 * read @ said.T
                better = float(apart[every, match].sum() + all_of_it)
                if not better < square:
                    break
                square, match = better, linear_sum_assignment(apart)[1]
            tried[match.tobytes()] = square, match
            if square < _SOLVED * all_of_it:
                return [match]
    return [match for _, match in sorted(tried.values(), key=lambda x: x[0])[:2]]


def _sorted_matches(factors: Array, fixed: Array, read: Array) -> Rows:
    """(K, N) matches of one output's readings (N,) that fit it best, by factors (N, r)
    of the commands and what is ``fixed`` (N,) besides."""
    count = len(read)
    axes = np.linalg.svd(factors - factors.mean(axis=0), full_matrices=False)[0]
    into = factors @ np.linalg.pinv(factors)
    starts = max(_STARTS // count, 60)
    turns = np.random.default_rng(0).normal(size=(starts, axes.shape[1]))
    size = read.std() * np.sqrt(count)
    if fixed.any():  # parameters near those that are expected
        size *= np.linspace(0.0, 1.0, starts)[:, None] ** 2
    said = fixed + size * turns @ axes.T / np.sqrt(axes.shape[1])
    lines, ordered = np.arange(starts)[:, None], np.sort(read)
    aim = np.empty_like(said)
    for _ in range(_ROUNDS):
        aim[lines, np.argsort(said, axis=1)] = ordered
        said = fixed + (aim - fixed) @ into
    squares = ((aim - said) ** 2).sum(axis=1)
    ranks = np.argsort(np.argsort(aim[np.argsort(squares)], axis=1), axis=1)
    _, first = np.unique(ranks, axis=0, return_index=True)
    best = ranks[np.sort(first)[:_REFINED]]
    matches = np.empty_like(best)  # of the reading of a rank, its command
    matches[:, np.argsort(read, kind="stable")] = np.argsort(best, axis=1)
    return matches
