"""Orders of readings that no shift explains, and rows at which a shift changes."""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxcal.calibration.pairing.fit import Fitted, fitted, predicted
from jaxcal.calibration.pairing.table import (
    Hypothesis,
    Rows,
    Table,
    as_it_is,
    path_match,
)
from jaxcal.checks import Array

_MOST_ROWS = 150  # of a table whose lost order is looked for
_STARTS, _REFINED, _ROUNDS = 12_000, 8, 12  # of that search: rows times starts, ...
_SOLVED = 0.003  # share of the squares that the right order leaves
_FAR = 1e9  # noises: what a model cannot predict
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
    apart = np.minimum(np.nan_to_num(off / noise, nan=_FAR), _FAR) ** 2
    reading, other = linear_sum_assignment(apart.sum(axis=-1))
    match[rows[reading]] = commands[other]
    return match


def exchanged(table: Table, plain: Fitted) -> list[Fitted]:
    """Outliers whose readings fit one another's commands."""
    rows = np.flatnonzero(~plain.inside & table.counted)
    count = len(table.commands)
    if not 2 <= len(rows) <= count // 2 or table.sensed:
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
    poor = (plain.rms > 0.3 * table.width).any()
    if table.sensed or not poor or count > _MOST_ROWS:
        return []
    kinds = []
    if _in_order(table.commands, 0.1):  # as levels, of which many rows have one
        code = 2.3 + float(np.log(np.arange(1, count + 1)).sum())
        kinds.append(("commands sorted", code))
    if _in_order(table.measured, 0.7):  # by chance noise is in no order
        kinds.append(("readings sorted", 5.0 * np.log(count)))
    if not kinds:
        return []
    expected = dataclasses.replace(table, theta=table.mean)
    fits = [_matched(table, match) for match in matched_anew(expected, plain)]
    return [
        fit._replace(
            hypothesis=dataclasses.replace(fit.hypothesis, kind=kind, code=code),
            evidence=fit.evidence - code,
        )
        for kind, code in kinds
        for fit in fits
    ]


def _in_order(side: Array, share: float) -> bool:
    """Whether a column never falls, or never rises, and moves at enough rows."""
    way = np.sign(np.diff(side, axis=0))
    moves = np.abs(way).sum(axis=0) >= share * len(side)
    return bool((moves & (np.ptp(way, axis=0) < 2)).any())


def _matched(table: Table, match: Rows) -> Fitted:
    """An assignment that is refined in turn with its fit."""
    hypothesis, every = Hypothesis("sorted", match), np.arange(len(match))
    fit = fitted(table, hypothesis)
    for _ in range(_TURNS):
        match = assigned(table, fit, every)
        if (match == fit.hypothesis.match).all():
            break
        fit = fitted(table, dataclasses.replace(hypothesis, match=match), fit.theta)
    return fit


def matched_anew(table: Table, fit: Fitted) -> list[Rows]:
    """Matches (N,) by which readings that lost their order fit some parameters best.

    One output alone is matched by sorting, for many parameters at once: predictions in
    their order take the readings in theirs, least squares give the next predictions.
    The best such matches are refined with all outputs by assignment.
    """
    from scipy.optimize import linear_sum_assignment

    every = np.arange(len(table.commands))
    if not table.free.any():
        return [assigned(table, fit, every)]
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
    best = sorted(tried.values(), key=lambda pair: pair[0])[:2]
    return [match for _, match in best]


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
    by_rank = np.argsort(best, axis=1)
    matches[:, np.argsort(read, kind="stable")] = by_rank
    return matches
