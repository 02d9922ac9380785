"""Orders of readings that no shift explains, and rows at which a shift changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.pairing.fit import (
    Fitted,
    fitted,
    predicted,
)
from jaxcal.calibration.pairing.table import (
    Hypothesis,
    Table,
    as_it_is,
    path_match,
)

__all__ = ["exchanged", "polished", "sorted_alone"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

_STARTS, _REFINED, _ROUNDS = 60, 30, 12  # of a search for an order that was lost
_TURNS = 6  # of assigning readings and fitting


def polished(table: Table, fit: Fitted) -> tuple[Fitted, dict[int, list[int]]]:
    """A path with its changes at their most probable rows, and rows about as good."""
    path = list(fit.hypothesis.starts)
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
                off = _off(table, fit, match, rows) / noise
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
        match = path_match(count, path)
        fit = fitted(
            table,
            dataclasses.replace(fit.hypothesis, match=match, starts=tuple(path)),
            fit.theta,
        )
        noise = np.maximum(fit.noise, 1e-7)
    return fit, near


def _off(table: Table, fit: Fitted, match: Rows, rows: Rows) -> Array:
    """(K, q) residuals of rows paired by ``match``, in scales, at the fit."""
    if table.shared:
        reading = table.measured[rows] / table.scale
        return np.asarray(reading - predicted(table, fit)[match[rows]])
    return table.residuals(Hypothesis("", match), rows, fit.theta)


def assigned(table: Table, fit: Fitted, rows: Rows) -> Rows:
    """(N,) match in which readings of ``rows`` have those commands that fit best."""
    from scipy.optimize import linear_sum_assignment

    match = fit.hypothesis.match.copy()
    commands = match[rows]
    noise = np.maximum(fit.noise, 1e-7)
    off = table.measured[rows, None] / table.scale - predicted(table, fit)[commands]
    reading, other = linear_sum_assignment(((off / noise) ** 2).sum(axis=-1))
    match[rows[reading]] = commands[other]
    return match


def exchanged(table: Table, plain: Fitted) -> list[Fitted]:
    """Outliers whose readings fit one another's commands."""
    rows = np.flatnonzero(~plain.inside & table.counted)
    count = len(table.commands)
    sensed = len(np.arange(table.commands.shape[1])[table.model.sensed])
    if not 2 <= len(rows) <= count // 2 or sensed:
        return []
    match = assigned(table, plain, rows)
    moved = np.flatnonzero(match != np.arange(count))
    if len(moved) < 2:
        return []
    code = 2.3 + float(len(moved) * np.log(count))
    return [fitted(table, Hypothesis("exchanged", match, code), plain.theta)]


def sorted_alone(table: Table, plain: Fitted) -> list[Fitted]:
    """Commands or readings that were sorted without the others."""
    count = len(table.commands)
    sensed = len(np.arange(table.commands.shape[1])[table.model.sensed])
    poor = (plain.rms > 0.3 * table.width).any()
    if sensed or not poor or count > 150:
        return []
    fits: list[Fitted] = []
    starts: list[Rows] = []
    for side, kind in (
        (table.commands, "commands sorted"),
        (table.measured, "readings sorted"),
    ):
        for column in side.T:
            way = np.sign(np.diff(column))
            if not (np.ptp(way) < 2 and np.abs(way).sum() > 0.7 * count):
                continue
            code = 2.3 + float(np.log(np.arange(1, count + 1)).sum())
            if side is table.measured:  # by chance noise is in no order
                code = 5.0 * np.log(count)
            starts = starts or matched_anew(table, plain)
            fits += [_matched(table, Hypothesis(kind, start, code)) for start in starts]
    return fits


def _matched(table: Table, hypothesis: Hypothesis) -> Fitted:
    """An assignment that is refined in turn with its fit."""
    fit, every = fitted(table, hypothesis), np.arange(len(table.commands))
    for _ in range(_TURNS):
        match = assigned(table, fit, every)
        if (match == fit.hypothesis.match).all():
            break
        fit = fitted(table, dataclasses.replace(hypothesis, match=match), fit.theta)
    return fit


def matched_anew(table: Table, fit: Fitted) -> list[Rows]:
    """Matches (N,) by which readings that lost their order fit some parameters best.

    Assigned and fitted in turn, from several starts: outputs that follow the commands,
    each by itself, one output that follows one, and any.
    """
    every = np.arange(len(table.commands))
    if not (table.shared or table.model.linear) or not table.free.any():
        return [assigned(table, fit, every)]
    from scipy.optimize import linear_sum_assignment

    factors, right = table.system(as_it_is(table), every)
    read, (_, a, r), c = right.reshape(len(every), -1), factors.shape, right.shape[-1]
    white = (read - read.mean(axis=0)) / (read.std(axis=0) + 1e-300)

    def refit(match: Rows) -> tuple[float, Rows, Array]:
        """Square of a match refitted, the next one, and what it predicts."""
        flat = factors[match].reshape(-1, r)
        slopes = np.linalg.lstsq(flat, right.reshape(len(flat), c))[0]
        off = (factors @ slopes).reshape(read.shape)
        apart = ((read[:, None] - off) ** 2).sum(axis=-1)
        moved = linear_sum_assignment(apart)[1]
        return float(apart[every, moved].sum()), moved, off

    tried: list[tuple[float, Rows]] = []
    for start in _starts(factors, white, a, c):
        apart = ((white[:, None] - start) ** 2).sum(axis=-1)
        square, match, _ = refit(linear_sum_assignment(apart)[1])
        tried.append((square, match))
    tried.sort(key=lambda pair: pair[0])
    best: list[tuple[float, Rows]] = []
    for square, match in tried[:_REFINED]:
        for _ in range(_ROUNDS):
            better, moved, _ = refit(match)
            if not better < square:
                break
            square, match = better, moved
        best.append((square, match))
    return [match for _, match in sorted(best, key=lambda pair: pair[0])[:2]]


def _starts(factors: Array, white: Array, a: int, c: int) -> Iterator[Array]:
    """(N, q) readings, of unit size, by parameters that may be right.

    The covariance of readings does not depend on how they are paired, so commands and
    readings of unit covariance differ by a turn alone.
    """
    rng, count = np.random.default_rng(0), len(white)
    for _ in range(_STARTS):
        off = (factors @ rng.normal(size=(factors.shape[-1], c))).reshape(count, -1)
        yield (off - off.mean(axis=0)) / (off.std(axis=0) + 1e-300)
    if a > 1:  # outputs that share no regressor
        return
    commands = factors[:, 0, :-1] - factors[:, 0, :-1].mean(axis=0)
    n = commands.shape[1]
    size = commands.std(axis=0) + 1e-300
    for sign in (1.0, -1.0):  # outputs that follow the commands, each its own
        yield sign * (commands / size) @ np.eye(n, c)
    unit = np.linalg.svd(commands, full_matrices=False)[0] * np.sqrt(count)
    _, scale, axes = np.linalg.svd(white, full_matrices=False)
    shape = (scale[:, None] / np.sqrt(count)) * axes  # (c, c) of unit readings
    for _ in range(_STARTS):
        turn = np.linalg.qr(rng.normal(size=(max(n, c), max(n, c))))[0]
        yield unit @ turn[: unit.shape[1], : len(shape)] @ shape
