"""Which commands the readings of a table may belong to: what is tried, and ranked.

Every change of the pairing at any row is one hypothesis. Its least squares follow from
sums of normal equations over the rows before and after, so all of them are solved at
once; the best are then fitted one by one (``pairing_fit.fitted``).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.pairing_fit import (
    AS_IT_IS,
    ColumnChange,
    Fitted,
    Hypothesis,
    Table,
    fitted,
    log_evidence,
    predicted,
    solved,
)

__all__ = [
    "FOREIGN",
    "as_it_is",
    "assigned",
    "changed_columns",
    "matched_anew",
    "polished",
    "ranked",
    "shifted",
]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

FOREIGN = 99  # shift of readings that belong to no command
_SHIFTS = (0, 1, -1, 2, -2, 3, -3)
_EDGES = 128  # rows at which a change is tried first, and of models of many parameters:
_EDGES_OF_MANY = 40
_MANY = 20  # parameters
_LEAST = 3  # rows that a change leaves on either side
_KINDS = np.log(10.0)
_LAGS = 200  # rows, of a recording
_STARTS, _REFINED, _ROUNDS = 60, 30, 12  # of a search for an order that was lost
_TURNS = 1.7453292519943295e-2  # radians in a degree
_UNITS = {
    "is in radians, degrees are meant": 1.0 / _TURNS,
    "is in degrees, radians are meant": _TURNS,
    "is too small by 1000 (m for mm?)": 1000.0,
    "is too large by 1000 (mm for m?)": 0.001,
    "is too small by 10": 10.0,
    "is too large by 10": 0.1,
    "is too small by 100": 100.0,
    "is too large by 100": 0.01,
}


def as_it_is(table: Table, extra: Array | None = None, code: float = 0.0) -> Hypothesis:
    """Each reading belongs to the command beside it."""
    match = np.arange(len(table.commands))
    return Hypothesis(AS_IT_IS, match, code, extra=extra)


class _Sums(NamedTuple):
    """Normal equations of rows, summed up to each edge: (..., r, r), ..."""

    squares: Array  # (..., r, r)
    products: Array  # (..., r, c)
    totals: Array  # (..., c)
    costs: Array  # (...) of readings that are paired with nothing
    counts: Array  # (...)

    def at(self, rows: Any) -> _Sums:
        """Of some of them."""
        return _Sums(*(part[rows] for part in self))

    def plus(self, other: _Sums, sign: float = 1.0) -> _Sums:
        """These and the ``other``, or without them."""
        return _Sums(*(a + sign * b for a, b in zip(self, other, strict=True)))


class _Systems:
    """The linear systems of hypotheses about one table."""

    def __init__(self, table: Table) -> None:
        self.table, self.costs = table, table.costs()
        rows = np.arange(len(table.commands))
        width = table.commands.shape[1]
        self.fast = table.model.periods is None and not len(
            np.arange(width)[table.model.sensed]
        )
        self.slopes, right = table.system(as_it_is(table), rows)
        read = (table.measured / table.scale).reshape(right.shape)
        self.read, self.of_commands = read, right - read

    def of(self, match: Rows) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Systems of matches (..., N), and which of their rows are paired."""
        paired = (match >= 0) & self.table.counted
        if self.fast:
            slopes = self.slopes[match] * paired[..., None, None]
            return (
                slopes,
                (self.read + self.of_commands[match]) * paired[..., None, None],
                paired,
            )
        found = [self._one(each) for each in match.reshape(-1, match.shape[-1])]
        slopes, right = (np.stack(each) for each in zip(*found, strict=True))
        lead = match.shape[:-1]
        return (
            slopes.reshape(*lead, *slopes.shape[1:]),
            right.reshape(*lead, *right.shape[1:]),
            paired,
        )

    def _one(self, match: Rows) -> tuple[Array, Array]:
        slopes, right = np.zeros_like(self.slopes), np.zeros_like(self.read)
        rows = np.flatnonzero((match >= 0) & self.table.counted)
        slopes[rows], right[rows] = self.table.system(Hypothesis("", match), rows)
        return slopes, right

    def sums(self, match: Rows, edges: Rows) -> _Sums:
        """Of matches (..., N), up to each of the edges (B,): (..., B, ...)."""
        slopes, right, paired = self.of(match)
        costs = np.where(paired | ~self.table.counted, 0.0, self.costs)
        products = np.swapaxes(slopes, -1, -2)
        parts = (
            products @ slopes,
            products @ right,
            (right**2).sum(axis=-2),
            costs,
            paired.astype(np.float64),
        )
        axis = match.ndim - 1
        total = []
        for part in parts:
            begin = np.zeros_like(np.take(part, [0], axis=axis))
            upto = np.concatenate([begin, np.cumsum(part, axis=axis)], axis=axis)
            total.append(np.take(upto, edges, axis=axis))
        return _Sums(*total)

    def total(self, match: Rows) -> _Sums:
        """Of all rows of matches (H, N)."""
        slopes, right, paired = self.of(match)
        count, rows, a, r = slopes.shape
        flat = slopes.reshape(count, rows * a, r)
        aim = right.reshape(count, rows * a, -1)
        turned = np.swapaxes(flat, 1, 2)
        costs = np.where(paired | ~self.table.counted, 0.0, self.costs)
        return _Sums(
            turned @ flat,
            turned @ aim,
            (aim**2).sum(axis=1),
            costs.sum(axis=1),
            paired.sum(axis=1),
        )

    def evidence(self, sums: _Sums, extra: int = 0) -> Array:
        """(...) of least squares, no outlier left out."""
        known = self.table.ridge(sums.squares.shape[-1])
        square = sums.totals - (
            sums.products * solved(sums.squares, sums.products, known)
        ).sum(axis=-2)
        square = np.maximum(square, 0.0)
        return log_evidence(self.table, square, sums.counts, extra) - sums.costs


def ranked(table: Table) -> tuple[float, list[tuple[float, Hypothesis]]]:
    """Evidence of the table as it is, and hypotheses with theirs, the best first."""
    count = len(table.commands)
    systems = _Systems(table)
    matches, names = _of_all_rows(table, systems.fast)
    scores = systems.evidence(systems.total(matches))
    found = [
        (float(score) - code, Hypothesis(kind, match, code, starts))
        for score, match, (kind, code, starts) in zip(
            scores, matches, names, strict=True
        )
    ]
    base, found = found[0][0], found[1:]
    if count >= 2 * _LEAST:
        paths = _paths(systems)
        found += paths
        found += _steps(systems)
    return base, sorted(found, key=lambda each: -each[0])


def shifted(count: int, by: int) -> Rows:
    """(count,) the row of the command ``by`` rows on, -1 where there is none."""
    match = np.arange(count) + by
    return np.where((match >= 0) & (match < count), match, -1)


def _of_all_rows(
    table: Table, fast: bool
) -> tuple[Rows, list[tuple[str, float, tuple[tuple[int, int], ...]]]]:
    """Pairings of all rows alike: (H, N), and kind, code and shift of each."""
    count = len(table.commands)
    rows = np.arange(count)
    matches = [rows, rows[::-1]]
    names: list[tuple[str, float, tuple[tuple[int, int], ...]]] = [
        (AS_IT_IS, 0.0, ()),
        ("reversed", _KINDS, ()),
    ]
    most = min(_LAGS, count // 3) if fast else 3
    for by in itertools.chain(range(1, most + 1), range(-most, 0)):
        if abs(by) < count - _LEAST:
            code = _KINDS + np.log(6.0 if abs(by) <= 3 else 2.0 * count)
            matches.append(shifted(count, by))
            names.append(("shift", code, ((0, by),)))
    half = count // 2
    turns = range(1, count) if fast and count <= _EDGES else {half, count - half}
    for by in turns:
        halves = by in (half, count - half)
        near = min(by, count - by) <= 3
        code = _KINDS + np.log(2.0 if halves else 6.0 if near else count)
        matches.append((rows + by) % count)
        kind = "halves" if halves and not near else "rotation"
        names.append((kind, code, ((0, by if by < half else by - count),)))
    return np.array(matches), names


def _paths(systems: _Systems) -> list[tuple[float, Hypothesis]]:
    """Shifts that change at one row or two, and blocks of readings from elsewhere."""
    table = systems.table
    count = len(table.commands)
    columns = systems.slopes.shape[-1]
    most = _EDGES_OF_MANY if columns > _MANY else _EDGES
    edges = np.unique(np.linspace(0, count, min(count, most) + 1).astype(np.intp))
    last = len(edges) - 1
    of_shift = systems.sums(
        np.array([shifted(count, by) for by in _SHIFTS]), edges
    )  # (S, B, ...)
    code = _KINDS + np.log(12.0 * count)
    inner = np.arange(1, last)
    inner = inner[(edges[inner] >= _LEAST) & (count - edges[inner] >= 1)]
    found: list[tuple[float, tuple[tuple[int, int], ...]]] = []
    plain = of_shift.at(0)
    for index, by in enumerate(_SHIFTS[1:], 1):
        other = of_shift.at(index)
        after = plain.at(inner).plus(other.at([last]).plus(other.at(inner), -1.0))
        before = other.at(inner).plus(plain.at([last]).plus(plain.at(inner), -1.0))
        for sums, (first, then) in ((after, (0, by)), (before, (by, 0))):
            scores = systems.evidence(sums) - code
            best = int(scores.argmax())
            at = int(edges[inner[best]])
            found.append((float(scores[best]), ((0, first), (at, then))))
    found += _blocks(systems, of_shift, edges)
    return [
        (score, Hypothesis("path", path_match(count, path), _code(count, path), path))
        for score, path in found
    ]


def _code(count: int, path: Sequence[tuple[int, int]]) -> float:
    if any(by == FOREIGN for _, by in path):
        return float(_KINDS + np.log(0.5 * count**2))
    return float(_KINDS + (len(path) - 1) * np.log(12.0 * count))


def _blocks(
    systems: _Systems, of_shift: _Sums, edges: Rows
) -> list[tuple[float, tuple[tuple[int, int], ...]]]:
    """Rows between two edges whose readings are shifted, or belong nowhere."""
    count, last = len(systems.table.commands), len(edges) - 1
    first, second = np.triu_indices(last + 1, 1)
    width = edges[second] - edges[first]
    fits = (width >= 2) & (width <= 0.6 * count) & (first > 0) & (second < last)
    if fits.sum() > 4000:
        fits &= (first % 2 == 0) & (second % 2 == 0)
    first, second = first[fits], second[fits]
    if not len(first):
        return []
    code = _KINDS + np.log(0.5 * count**2)
    plain = of_shift.at(0)
    found: list[tuple[float, tuple[tuple[int, int], ...]]] = []
    around = plain.at([last]).plus(plain.at(second).plus(plain.at(first), -1.0), -1.0)
    costs = np.append(0.0, np.cumsum(systems.costs * systems.table.counted))[edges]
    none = around._replace(costs=around.costs + costs[second] - costs[first])
    scores = systems.evidence(none) - code
    for best in np.argsort(-scores)[:2]:
        begin, end = int(edges[first[best]]), int(edges[second[best]])
        found.append((float(scores[best]), ((0, 0), (begin, FOREIGN), (end, 0))))
    # Shifted: about the best edges of a block that does not belong.
    near = np.argsort(-scores)[:60]
    for index, by in enumerate(_SHIFTS[1:], 1):
        other = of_shift.at(index)
        sums = around.at(near).plus(
            other.at(second[near]).plus(other.at(first[near]), -1.0)
        )
        scores_here = systems.evidence(sums) - code - np.log(6.0)
        best = int(scores_here.argmax())
        begin, end = int(edges[first[near[best]]]), int(edges[second[near[best]]])
        found.append((float(scores_here[best]), ((0, 0), (begin, by), (end, 0))))
    return found


def path_match(count: int, path: Sequence[tuple[int, int]]) -> Rows:
    """(count,) match of shifts that begin at rows."""
    match = np.full(count, -1)
    ends = [*(start for start, _ in path[1:]), count]
    for (start, by), end in zip(path, ends, strict=True):
        if by != FOREIGN:
            match[start:end] = shifted(count, by)[start:end]
    return match


def _steps(systems: _Systems) -> list[tuple[float, Hypothesis]]:
    """Rows of two sessions: from one on another offset, or other parameters too."""
    table, count = systems.table, len(systems.table.commands)
    if not (table.shared or table.free.any()):
        return []
    found: list[tuple[float, Hypothesis]] = []
    after = np.arange(count)
    code = _KINDS + np.log(count)
    slopes, right, _ = systems.of(after[None])
    slopes, right = slopes[0], right[0]
    factors = slopes[:, 0] if table.shared else None
    before = np.append(0, _distinct(table.commands)[:-1])
    behind = _distinct(table.commands[::-1])[::-1]
    for whole in (False, True) if factors is not None else (False,):
        best: tuple[float, Hypothesis] | None = None
        widths = factors.shape[1] if whole and factors is not None else 1
        least = widths + 2 if whole else _LEAST
        edges = after[(before >= least) & (behind >= least)]
        if not len(edges):
            continue
        edges = edges[:: len(edges) // _EDGES + 1]
        step = (after[None] >= edges[:, None]).astype(np.float64)[..., None]
        more = step * (factors if whole and factors is not None else 1.0)
        scores = _with_columns(systems, slopes, right, more)
        at = int(scores.argmax())
        kind = "parameters" if whole else "offset"
        best = (
            float(scores[at]) - code,
            Hypothesis(
                kind, after, code, ((0, 0), (int(edges[at]), 0)), None, more[at]
            ),
        )
        found.append(best)
    return found


def _distinct(commands: Array) -> Rows:
    """(N,) how many different commands there are up to each row."""
    first = np.unique(commands, axis=0, return_index=True)[1]
    return np.cumsum(np.isin(np.arange(len(commands)), first))


def _with_columns(systems: _Systems, slopes: Array, right: Array, more: Array) -> Array:
    """(H,) evidence with columns (H, N, e) of each output besides."""
    table, (count, a, r), e = systems.table, slopes.shape, more.shape[-1]
    each = more[:, :, None, :, None] * np.eye(a)[:, None, :]  # (H, N, a, e, a)
    extra = each.reshape(len(more), count * a, e * a)
    flat, aim = slopes.reshape(count * a, r), right.reshape(count * a, -1)
    counted = np.repeat(table.counted, a)[:, None]
    flat, aim, extra = flat * counted, aim * counted, extra * counted
    corner = np.swapaxes(extra, 1, 2) @ flat  # (H, ea, r)
    squares = np.concatenate(
        [
            np.concatenate(
                [np.broadcast_to(flat.T @ flat, (len(more), r, r)),
                 np.swapaxes(corner, 1, 2)], axis=2
            ),
            np.concatenate([corner, np.swapaxes(extra, 1, 2) @ extra], axis=2),
        ],
        axis=1,
    )  # fmt: skip
    products = np.concatenate(
        [
            np.broadcast_to(flat.T @ aim, (len(more), r, aim.shape[1])),
            np.swapaxes(extra, 1, 2) @ aim,
        ],
        axis=1,
    )
    ones = np.ones(len(more))
    sums = _Sums(
        squares, products, ones[:, None] * (aim**2).sum(axis=0), 0.0 * ones,
        ones * table.counted.sum(),
    )  # fmt: skip
    return systems.evidence(sums, e)


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
    own, others = linear_sum_assignment(((off / noise) ** 2).sum(axis=-1))
    match[rows[own]] = commands[others]
    return match


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
    tried.sort(key=lambda each: each[0])
    best: list[tuple[float, Rows]] = []
    for square, match in tried[:_REFINED]:
        for _ in range(_ROUNDS):
            better, moved, _ = refit(match)
            if not better < square:
                break
            square, match = better, moved
        best.append((square, match))
    return [match for _, match in sorted(best, key=lambda each: each[0])[:2]]


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


def changed_columns(
    table: Table, inputs: Sequence[str], outputs: Sequence[str]
) -> list[Hypothesis]:
    """Columns with another sign or unit, or in the place of another's."""
    width = np.arange(table.commands.shape[1])
    moved = len(width) - len(width[table.model.sensed])
    tables = [(inputs, len(inputs), moved, False)]
    if not table.model.relative:
        tables.append((outputs, len(outputs), len(outputs), True))
    changes: list[ColumnChange] = []
    for names, size, count, of_readings in tables:
        if of_readings and not table.measured.any():
            continue
        order, ones = tuple(range(size)), (1.0,) * size
        single = [((i,), f"{names[i]}") for i in range(count)]
        every = [
            (
                tuple(range(count)),
                "every column of "
                + ("the readings" if of_readings else "the commands"),
            )
        ]
        for columns, words in single + (every if count > 1 else []):
            for what, factor in {"has the other sign": -1.0, **_UNITS}.items():
                if len(columns) > 1 and factor == -1.0:
                    continue
                factors = tuple(factor if i in columns else 1.0 for i in range(size))
                changes.append(
                    ColumnChange(f"{words} {what}", of_readings, order, factors)
                )
        for i, j in itertools.combinations(range(count), 2):
            swapped = list(order)
            swapped[i], swapped[j] = j, i
            changes.append(
                ColumnChange(
                    f"{names[i]} and {names[j]} are exchanged",
                    of_readings, tuple(swapped), ones,
                )
            )  # fmt: skip
            if not of_readings:
                factors = tuple(-1.0 if k in (i, j) else 1.0 for k in range(size))
                changes.append(
                    ColumnChange(
                        f"{names[i]} and {names[j]} have the other sign",
                        of_readings, order, factors,
                    )
                )  # fmt: skip
    code = _KINDS + np.log(len(changes) + 1.0)
    rows, several = np.arange(len(table.commands)), np.log(20.0)
    return [
        Hypothesis(
            "columns",
            rows,
            code
            + several * (" and " in change.words)
            + _KINDS * ("every" in change.words),
            change=change,
        )
        for change in changes
    ]
