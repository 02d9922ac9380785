"""Pairings of rows that are tried, ranked by least squares, and what they are called.

Those of a change at any row follow from sums of normal equations over the rows before
and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcal.calibration.pairing.fit import (
    FOREIGN,
    SESSIONS,
    Fitted,
    Hypothesis,
    Path,
    Table,
    as_it_is,
    log_evidence,
    path_match,
    shifted,
    solved,
)
from jaxcal.checks import Array, Mask, in_words
from jaxcal.models.model import Rows

_SHIFTS = (0, 1, -1, 2, -2, 3, -3)
_EDGES = 128  # rows at which a change is tried first, and of models of many parameters:
_EDGES_OF_MANY = 40
_MANY = 20  # parameters
_LEAST = 3  # rows that a change leaves on either side
_KINDS = np.log(10.0)
_LAGS = 200  # rows, of a recording
_WHOLE = {
    "reversed": "the readings are in reverse order",
    "commands sorted": "the commands are sorted and the readings are not",
    "readings sorted": "the readings are sorted and the commands are not",
}


class _Sums(NamedTuple):
    """Normal equations of rows, summed up to each edge: (..., r, r), ..."""

    squares: Array  # (..., r, r)
    products: Array  # (..., r, c)
    totals: Array  # (..., c)
    costs: Array  # (...) of readings that are paired with nothing
    counts: Array  # (...)

    def at(self, rows: Any) -> _Sums:
        """Sums at some of the edges."""
        return _Sums(*(part[rows] for part in self))

    def plus(self, other: _Sums, sign: float = 1.0) -> _Sums:
        """These and the ``other``, or without them."""
        return _Sums(*(a + sign * b for a, b in zip(self, other, strict=True)))


class _Systems:
    """The linear systems of hypotheses about one table."""

    def __init__(self, table: Table) -> None:
        self.table, self.costs = table, table.costs()
        rows = np.arange(len(table.commands))
        self.fast = table.model.periods is None and not table.sensed
        self.slopes, right = table.system(as_it_is(table), rows)
        read = (table.measured / table.scale).reshape(right.shape)
        self.read, self.of_commands = read, right - read

    def of(self, match: Rows) -> tuple[Array, Array, Mask]:
        """Systems of matches (..., N), and which of their rows are paired."""
        paired = (match >= 0) & self.table.counted
        if self.fast:
            used = paired[..., None, None]
            right = (self.read + self.of_commands[match]) * used
            return self.slopes[match] * used, right, paired
        slopes = np.zeros((*match.shape, *self.slopes.shape[1:]))
        right = np.zeros((*match.shape, *self.read.shape[1:]))
        for at in np.ndindex(match.shape[:-1]):
            rows, hypothesis = np.flatnonzero(paired[at]), Hypothesis("", match[at])
            slopes[at][rows], right[at][rows] = self.table.system(hypothesis, rows)
        return slopes, right, paired

    def sums(self, match: Rows, edges: Rows) -> _Sums:
        """Sums of matches (..., N) up to each of the edges (B,): (..., B, ...)."""
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
        axis, total = match.ndim - 1, []
        for part in parts:
            begin = np.zeros_like(np.take(part, [0], axis=axis))
            upto = np.concatenate([begin, np.cumsum(part, axis=axis)], axis=axis)
            total.append(np.take(upto, edges, axis=axis))
        return _Sums(*total)

    def total(self, match: Rows) -> _Sums:
        """Sums over all rows of matches (H, N)."""
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
            paired.sum(axis=1, dtype=np.float64),
        )

    def evidence(self, sums: _Sums, extra: int = 0) -> Array:
        """(...) of least squares, no outlier left out."""
        known = self.table.ridge(sums.squares.shape[-1])
        steps = solved(sums.squares, sums.products, known)
        square = sums.totals - (sums.products * steps).sum(axis=-2)
        square = np.maximum(square, 0.0)
        return log_evidence(self.table, square, sums.counts, extra) - sums.costs


def ranked(table: Table) -> tuple[float, list[tuple[float, Hypothesis]]]:
    """Evidence of the table as it is, and hypotheses with theirs, the best first."""
    count = len(table.commands)
    systems = _Systems(table)
    alike = _of_all_rows(table, systems.fast)
    scores = systems.evidence(systems.total(np.array([x.match for x in alike])))
    scored = zip(scores.tolist(), alike, strict=True)
    (base, _), *hypotheses = [(score - x.code, x) for score, x in scored]
    if count >= 2 * _LEAST:
        hypotheses += _paths(systems) + _steps(systems)
    return base, sorted(hypotheses, key=lambda pair: -pair[0])


def _of_all_rows(table: Table, fast: bool) -> list[Hypothesis]:
    """Pairings of all rows alike, the table as it is first."""
    count = len(table.commands)
    rows = np.arange(count)
    alike = [as_it_is(table), Hypothesis("reversed", rows[::-1], _KINDS)]
    most = min(_LAGS, count // 3) if fast else 3
    lags, half = {*range(1, most + 1), *range(-most, 0)}, count // 2
    turns = {*range(1, count)} if fast and count <= _EDGES else {half, count - half}
    if table.alike is not None:  # by how many rows most are apart
        turn = int(np.bincount((table.alike - rows) % count).argmax())
        lags, turns = lags | {turn, turn - count}, turns | {turn}
    for by in sorted(lags - {0}):
        if abs(by) < count - _LEAST:
            code = _KINDS + np.log(6.0 if abs(by) <= 3 else 2.0 * count)
            alike.append(Hypothesis("shift", shifted(count, by), code, ((0, by),)))
    for by in sorted(turns - {0}):  # a lag, its rows at the other end
        halves = by in (half, count - half)
        near = min(by, count - by) <= 3
        code = _KINDS + np.log(2.0 if halves else 6.0 if near else count)
        kind = "halves" if halves and not near else "rotation"
        path = ((0, by if by < half else by - count),)
        alike.append(Hypothesis(kind, (rows + by) % count, code, path))
    return alike


def _paths(systems: _Systems) -> list[tuple[float, Hypothesis]]:
    """Shifts that change at one row or two, and blocks of readings from elsewhere."""
    table = systems.table
    count = len(table.commands)
    columns = systems.slopes.shape[-1]
    most = _EDGES_OF_MANY if columns > _MANY else _EDGES
    edges = np.unique(np.linspace(0, count, min(count, most) + 1).astype(np.intp))
    last = len(edges) - 1
    shifts = np.array([shifted(count, by) for by in _SHIFTS])
    of_shift = systems.sums(shifts, edges)  # (S, B, ...)
    code = _KINDS + np.log(12.0 * count)
    inner = np.arange(1, last)
    inner = inner[(edges[inner] >= _LEAST) & (count - edges[inner] >= 1)]
    scored: list[tuple[float, Path]] = []
    plain = of_shift.at(0)
    for index, by in enumerate(_SHIFTS[1:], 1):
        other = of_shift.at(index)
        after = plain.at(inner).plus(other.at([last]).plus(other.at(inner), -1.0))
        before = other.at(inner).plus(plain.at([last]).plus(plain.at(inner), -1.0))
        for sums, (first, then) in ((after, (0, by)), (before, (by, 0))):
            scores = systems.evidence(sums) - code
            best = int(scores.argmax())
            at = int(edges[inner[best]])
            scored.append((float(scores[best]), ((0, first), (at, then))))
    scored += _blocks(systems, of_shift, edges)
    return [
        (score, Hypothesis("path", path_match(count, path), _code(count, path), path))
        for score, path in scored
    ]


def _code(count: int, path: Sequence[tuple[int, int]]) -> float:
    if any(by == FOREIGN for _, by in path):
        return float(_KINDS + np.log(0.5 * count**2))
    return float(_KINDS + (len(path) - 1) * np.log(12.0 * count))


def _blocks(
    systems: _Systems, of_shift: _Sums, edges: Rows
) -> list[tuple[float, Path]]:
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
    scored: list[tuple[float, Path]] = []
    around = plain.at([last]).plus(plain.at(second).plus(plain.at(first), -1.0), -1.0)
    costs = np.append(0.0, np.cumsum(systems.costs * systems.table.counted))[edges]
    none = around._replace(costs=around.costs + costs[second] - costs[first])
    scores = systems.evidence(none) - code
    for best in np.argsort(-scores)[:2]:
        begin, end = int(edges[first[best]]), int(edges[second[best]])
        scored.append((float(scores[best]), ((0, 0), (begin, FOREIGN), (end, 0))))
    # Shifted: about the best edges of a block that does not belong.
    near = np.argsort(-scores)[:60]
    for index, by in enumerate(_SHIFTS[1:], 1):
        other = of_shift.at(index)
        inside = other.at(second[near]).plus(other.at(first[near]), -1.0)
        sums = around.at(near).plus(inside)
        scores_here = systems.evidence(sums) - code - np.log(6.0)
        best = int(scores_here.argmax())
        begin, end = int(edges[first[near[best]]]), int(edges[second[near[best]]])
        scored.append((float(scores_here[best]), ((0, 0), (begin, by), (end, 0))))
    return scored


def _steps(systems: _Systems) -> list[tuple[float, Hypothesis]]:
    """Rows of two sessions: from one on another offset, or other parameters too."""
    table, count = systems.table, len(systems.table.commands)
    scored: list[tuple[float, Hypothesis]] = []
    path: Path
    after, ones = np.arange(count), np.ones((count, 1))
    code = _KINDS + np.log(count)
    slopes, right, _ = (part[0] for part in systems.of(after[None]))
    kinds = [("offset", ones, _LEAST)]
    if table.shared:
        kinds.append(("parameters", slopes[:, 0], slopes.shape[-1] + 2))
        if right.shape[-1] == 1:  # another gain of the one reading
            theta = np.linalg.lstsq(slopes[:, 0], right[:, 0], rcond=None)[0]
            said = slopes[:, 0] @ theta
            for gain in (said, said - said.mean(), np.hstack([ones, said])):
                kinds.append(("parameters", gain, gain.shape[-1] + 2))
    elif table.model.linear and not table.free.any():  # calibrated before
        moved = np.hstack([ones, table.commands - table.commands.mean(axis=0)])
        kinds.append(("parameters", moved, moved.shape[-1] + 2))
    before = np.append(0, _distinct(table.commands)[:-1])
    behind = _distinct(table.commands[::-1])[::-1]
    for kind, factors, least in kinds:
        edges = after[(before >= least) & (behind >= least)]
        if not len(edges):
            continue
        edges = edges[:: len(edges) // _EDGES + 1]
        more = (after >= edges[:, None]).astype(np.float64)[..., None] * factors
        scores = _with_columns(systems, slopes, right, more)
        at = int(scores.argmax())
        path = ((0, 0), (int(edges[at]), 0))
        hypothesis = Hypothesis(kind, after, code, path, extra=more[at])
        scored.append((float(scores[at]) - code, hypothesis))
        if kind == "offset" and table.shared:  # a third session
            both = np.concatenate([more, np.broadcast_to(more[at], more.shape)], -1)
            scores = _with_columns(systems, slopes, right, both)
            scores[np.abs(edges - edges[at]) < _LEAST] = -np.inf
            other = int(scores.argmax())
            path = ((0, 0), *((int(edges[i]), 0) for i in sorted((at, other))))
            hypothesis = Hypothesis(kind, after, 2.0 * code, path, extra=both[other])
            scored.append((float(scores[other]) - 2.0 * code, hypothesis))
    return scored


def _distinct(commands: Array) -> Rows:
    """(N,) how many different commands there are up to each row."""
    first = np.unique(commands, axis=0, return_index=True)[1]
    return np.cumsum(np.isin(np.arange(len(commands)), first))


def _with_columns(systems: _Systems, slopes: Array, right: Array, more: Array) -> Array:
    """(H,) evidence with columns (H, N, e) of each output besides."""
    table, (count, a, r), e = systems.table, slopes.shape, more.shape[-1]
    spread = more[:, :, None, :, None] * np.eye(a)[:, None, :]  # (H, N, a, e, a)
    extra = spread.reshape(len(more), count * a, e * a)
    flat, aim = slopes.reshape(count * a, r), right.reshape(count * a, -1)
    counted = np.repeat(table.counted, a)[:, None]
    flat, aim, extra = flat * counted, aim * counted, extra * counted
    corner = np.swapaxes(extra, 1, 2) @ flat  # (H, ea, r)
    squares = np.empty((len(more), r + e * a, r + e * a))
    squares[:, :r, :r], squares[:, r:, :r] = flat.T @ flat, corner
    squares[:, :r, r:] = np.swapaxes(corner, 1, 2)
    squares[:, r:, r:] = np.swapaxes(extra, 1, 2) @ extra
    products = np.empty((len(more), r + e * a, aim.shape[1]))
    products[:, :r], products[:, r:] = flat.T @ aim, np.swapaxes(extra, 1, 2) @ aim
    ones = np.ones(len(more))
    totals, count = ones[:, None] * (aim**2).sum(axis=0), ones * table.counted.sum()
    return systems.evidence(_Sums(squares, products, totals, 0.0 * ones, count), e)


def what_is_wrong(
    table: Table, fit: Fitted, near: dict[int, list[int]], unit: str
) -> str:
    """The mispairing as a sentence; rows are counted from 0."""
    hypothesis, count = fit.hypothesis, len(table.commands)
    kind, starts = hypothesis.kind, hypothesis.starts
    if hypothesis.change is not None:
        return hypothesis.change.words
    if kind in _WHOLE:
        return _WHOLE[kind]
    by = starts[0][1] if starts else 0
    if kind == "shift":
        return f"all readings are {_rows_late(by)}"
    of_first = f"the readings from row {-by % count} on belong to the first commands"
    if kind == "halves":
        return f"the halves of the readings are exchanged: {of_first}"
    if kind == "rotation" and abs(by) <= count // 3:
        end = "first" if by > 0 else "last"
        these = f"{end} {abs(by)} are" if abs(by) > 1 else f"{end} is"
        return f"all readings are {_rows_late(by)}; the {these} at the other end"
    if kind == "rotation":
        return f"{of_first}, the readings before it to the last"
    if kind == "exchanged":
        rows = np.flatnonzero(hypothesis.match != np.arange(count))
        return f"the readings of rows {', '.join(map(str, rows))} are exchanged"
    if kind == "offset" and len(starts) > 2:
        return (
            f"the table seems to join three sessions: from row {starts[1][0]} on and "
            f"from row {starts[2][0]} on the readings have another offset"
        )
    if kind in SESSIONS:
        another = "slope or offset"
        if kind == "offset":
            step = fit.solution[-1]
            step = step if table.shared else fit.solution[-table.outputs :, 0]
            another = f"offset, by {in_words(step * table.scale)} {unit}".strip()
        return (
            f"the table seems to join two sessions: from row {starts[1][0]} on the "
            f"readings have another {another}"
        )
    return _path_words(starts, near, count)


def _rows_late(by: int) -> str:
    rows = "one row" if abs(by) == 1 else f"{abs(by)} rows"
    late, where = ("early", "below") if by > 0 else ("late", "above")
    return f"{rows} {late} (each belongs to the command {rows} {where})"


def _path_words(path: Path, near: dict[int, list[int]], count: int) -> str:
    parts = []
    ends = [*(start for start, _ in path[1:]), count]
    for i, ((start, by), end) in enumerate(zip(path, ends, strict=True)):
        if by == 0:
            continue
        where = f"from row {start} " + ("on" if end == count else f"to {end - 1}")
        where = where if start else f"up to row {end - 1}"
        if len(rows := near.get(i, [])) > 1:
            where += f" (or any from {rows[0]} to {rows[-1]})"
        foreign = "do not belong to these commands"
        what = foreign if by == FOREIGN else f"are {_rows_late(by)}"
        parts.append(f"{where}, readings {what}")
    return "; ".join(parts)
