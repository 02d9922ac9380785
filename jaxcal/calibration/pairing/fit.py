"""A table, which commands its readings may belong to, and how well it fits then.

Evidence is the probability of the readings, parameters and noise integrated out; those
that are unpaired, or outliers, count as drawn from anywhere within their spread.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcal.checks import Array, Mask
from jaxcal.models.model import Model, Rows
from jaxcal.models.predictions import derivative, predict

Names = Sequence[str]  # of columns
Path = tuple[tuple[int, int], ...]  # shifts by rows, and from which row on

AS_IT_IS = "as it is"  # kind of a hypothesis
FOREIGN = 99  # shift of readings that belong to no command
SESSIONS = {"offset", "parameters"}  # kinds of tables that join two
BEFORE = 2.0  # times its noise, a calibration explains readings
OUTLIER = np.log(20.0)  # of one row in twenty
_FLOOR = 1e-7  # of the spread of the readings: below it is rounding
_MOST_OUT = 0.35, 0.2  # share of rows that may be outliers: as it is, paired anew
_WAVES = 6  # half periods of a drift
_FREEDOM = 4.0  # of Student's t, of the robust start
_ROUNDS = 6  # of robust weights, and of linearising
_TURNS = 12  # of matching
MOST_ROWS = 150  # of a table whose lost order is looked for
_RIDGE = 1e-11  # of a column's square: what no row excites stays at the prior's mean


@dataclasses.dataclass(frozen=True)
class ColumnChange:
    """Columns of a table as they should be."""

    words: str  # what is wrong with them
    of_readings: bool
    order: tuple[int, ...]  # column i is the table's order[i]
    factors: tuple[float, ...]  # times this
    estimated: bool = False  # the factors, from the readings
    seen: tuple[float, ...] = ()  # factors of columns that a reading brought

    def __call__(self, values: Array) -> Array:
        """(N, k) put right."""
        return values[:, self.order] * self.factors

    @property
    def sizes(self) -> Array:
        """(q,) what it makes of the size of the readings, () where it leaves them."""
        return np.abs(self.factors if self.of_readings else self.seen)

    @property
    def log_size(self) -> float:
        """Log of that, of all outputs together."""
        return float(np.log(self.sizes).sum())


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """Which command each reading belongs to."""

    kind: str
    match: Rows  # (N,) row of the command of each reading, -1 of none
    code: float = 0.0  # -log of its prior probability
    starts: Path = ()
    change: ColumnChange | None = None
    extra: Array | None = None  # (N, e) columns that are fitted too, of each output


@dataclasses.dataclass(frozen=True)
class Table:
    """N rows of commands and readings, and the model that shall explain them."""

    model: Model
    commands: Array  # (N, n)
    measured: Array  # (N, q)
    counted: Mask  # (N,) False: the reading was left out
    mean: Array  # (p,) of the prior
    precision: Array  # (p,) of it
    free: Mask  # (p,)
    theta: Array  # (p,) where the model is linearised
    scale: Array  # (q,) in which outputs are compared
    width: Array  # (q,) spread of the readings, in scales
    shared: bool  # outputs share one regressor, and nothing is known of its factors

    @property
    def flat(self) -> int:
        """Free parameters of which nothing is known."""
        return int((self.free & (self.precision == 0.0)).sum())

    @property
    def outputs(self) -> int:
        """q."""
        return len(self.scale)

    @property
    def sensed(self) -> int:
        """Columns of the commands that come with the readings."""
        return self.commands[:, self.model.fitting.sensed].shape[1]

    @functools.cached_property
    def alike(self) -> Rows | None:
        """(N,) match by which rows are as far apart by readings as by commands,
        whatever the parameters: by each row's sorted distances first, then by those
        from the rows that are matched. None where the model has no such distances, or
        of many rows: N^3 numbers are compared."""
        from scipy.optimize import linear_sum_assignment

        if len(self.commands) > MOST_ROWS:
            return None
        gaps = self.model.fitting.apart(self.commands, self.measured)
        if gaps is None:
            return None
        near, match = [np.sort(gap, axis=1) for gap in gaps], np.zeros(0, dtype=np.intp)
        for _ in range(_TURNS):
            off = np.abs(near[1][:, None] - near[0]).sum(axis=-1)
            before, match = match, linear_sum_assignment(off)[1]
            if np.array_equal(before, match):
                break
            near = [gaps[0][:, match], gaps[1]]
        return match

    @property
    def levels(self) -> int:
        """Levels of noise: one of each output, one of all where a prior counts."""
        return 1 if (self.precision[self.free] > 0.0).any() else len(self.scale)

    def costs(self) -> Array:
        """(N,) -log density of readings that are paired with nothing."""
        middle = np.median(self.measured[self.counted], axis=0)
        off = (self.measured - middle) / self.scale / self.width
        log = 0.5 * np.log(2.0 * np.pi) + np.log(self.width)
        return np.asarray((log + np.minimum(0.5 * off**2, 4.5)).sum(axis=1))

    def paired(self, hypothesis: Hypothesis) -> Rows:
        """(K,) rows whose readings have commands; what would be there twice is once."""
        rows = np.flatnonzero((hypothesis.match >= 0) & self.counted)
        if hypothesis.kind == AS_IT_IS or not self.sensed:
            return rows
        brought = self.commands[rows, self.model.fitting.sensed], self.measured[rows]
        same = np.hstack([hypothesis.match[rows, None], *brought])
        return rows[np.sort(np.unique(same, axis=0, return_index=True)[1])]

    def commands_of(self, hypothesis: Hypothesis, rows: Rows) -> Array:
        """(K, n) commands that the readings of these rows belong to."""
        commands = self.commands[hypothesis.match[rows]]
        sensed = self.model.fitting.sensed
        commands[:, sensed] = self.commands[rows, sensed]
        change = hypothesis.change
        if change is not None and not change.of_readings:
            commands = change(commands)
        return commands

    def readings_of(self, hypothesis: Hypothesis, rows: Rows) -> Array:
        """(K, q) readings of these rows."""
        change = hypothesis.change
        if change is not None and change.of_readings:
            return change(self.measured[rows])
        return self.measured[rows]

    def residuals(self, hypothesis: Hypothesis, rows: Rows, theta: Array) -> Array:
        """(K, q) readings less predictions, in scales."""
        commands = self.commands_of(hypothesis, rows)
        off = self.readings_of(hypothesis, rows) - predict(
            self.model, commands, theta, finite=False
        )
        return np.asarray(self.model.fitting.wrapped(off, commands) / self.scale)

    def system(self, hypothesis: Hypothesis, rows: Rows) -> tuple[Array, Array]:
        """The readings as linear in what is free, less its mean: (K, a, r) and
        (K, a, c), r factors of each of a readings and c columns."""
        none = np.zeros((len(self.commands), 0))
        extra = none if hypothesis.extra is None else hypothesis.extra
        if self.shared:
            regressors = self.model.blocks(self.commands_of(hypothesis, rows))
            return (
                np.concatenate([regressors, extra[rows, None]], axis=-1),
                self.readings_of(hypothesis, rows)[:, None] / self.scale,
            )
        slopes = np.zeros((len(rows), self.outputs, 0))
        off = self.residuals(hypothesis, rows, self.theta)
        if self.free.any():
            commands = self.commands_of(hypothesis, rows)
            slopes = derivative(self.model, commands, self.theta)[..., self.free]
            slopes = slopes / self.scale[:, None]
            off = off + slopes @ (self.theta - self.mean)[self.free]
        more = np.einsum("ke,ab->kaeb", extra[rows], np.eye(self.outputs))
        more = more.reshape(len(rows), self.outputs, -1)
        return np.concatenate([slopes, more], axis=-1), off[..., None]

    def ridge(self, columns: int) -> Array:
        """(r,) precision of ``columns`` factors of ``system``."""
        known = np.zeros(columns)
        if not self.shared:
            known[: self.free.sum()] = self.precision[self.free]
        return known


def as_it_is(table: Table, extra: Array | None = None, code: float = 0.0) -> Hypothesis:
    """Each reading belongs to the command beside it."""
    match = np.arange(len(table.commands))
    return Hypothesis(AS_IT_IS, match, code, extra=extra)


def shifted(count: int, by: int) -> Rows:
    """(count,) the row of the command ``by`` rows on, -1 where there is none."""
    match = np.arange(count) + by
    return np.where((match >= 0) & (match < count), match, -1)


def path_match(count: int, path: Sequence[tuple[int, int]]) -> Rows:
    """(count,) match of shifts that begin at rows."""
    match = np.full(count, -1)
    ends = [*(start for start, _ in path[1:]), count]
    for (start, by), end in zip(path, ends, strict=True):
        if by != FOREIGN:
            match[start:end] = shifted(count, by)[start:end]
    return match


class Fitted(NamedTuple):
    """A hypothesis and its fit."""

    hypothesis: Hypothesis
    evidence: float
    noise: Array  # (q,) of the readings in scales, outliers left out
    rms: Array  # (q,) in scales of all that are paired, by least squares
    theta: Array  # (p,)
    inside: Mask  # (N,) readings that are paired and no outliers
    solution: Array  # (r, c) of the linear system
    table: Table  # as it was fitted: its sensor may be where other rows put it


def log_evidence(table: Table, square: Array, count: Any, extra: int = 0) -> Array:
    """Log probability (...,) of readings by their squares (..., L), of ``count`` rows.

    The noise is integrated out, ``extra`` columns cost half the log of the rows each.
    """
    from scipy import special  # loaded only where a fit is in doubt

    outputs, levels = table.outputs, square.shape[-1]
    free = (table.flat + extra * outputs) / levels
    dof = np.asarray(count)[..., None] * (outputs / levels) - free
    log = np.log(np.pi * square + dof.clip(1.0) * (_FLOOR * table.width.max()) ** 2)
    value = special.gammaln(dof.clip(0.5) / 2.0) - 0.5 * dof * log
    total = np.where(dof >= 1.0, value, -np.inf).sum(axis=-1)
    size = np.log(max(int(table.counted.sum()), 2))
    return np.asarray(total - 0.5 * extra * outputs * size)


def solved(matrix: Array, right: Array, known: Array) -> Array:
    """(..., r, c) solution of normal equations with prior precisions (r,)."""
    size = np.sqrt(np.einsum("...rr->...r", matrix) + known)
    size = np.where(size > 0.0, size, 1.0)
    scaled = matrix / size[..., None] / size[..., None, :]
    at = np.arange(len(known))
    scaled[..., at, at] += known / size**2 + _RIDGE
    found = np.linalg.solve(scaled, right / size[..., None])
    return np.asarray(found / size[..., None])


def fitted(table: Table, hypothesis: Hypothesis, theta: Array | None = None) -> Fitted:
    """The most probable parameters, noise and outliers of a hypothesis; the search
    begins at ``theta`` (p,), where the table is linearised if None."""
    if theta is not None:
        table = dataclasses.replace(table, theta=theta)
    rows = table.paired(hypothesis)
    linear = table.shared or table.model.linear or not table.free.any()
    if not linear and hypothesis.extra is None:
        theta = _searched(table, hypothesis, rows)
        table = dataclasses.replace(table, theta=theta)
    return judged(table, hypothesis, rows)


def _searched(table: Table, hypothesis: Hypothesis, rows: Rows) -> Array:
    """(p,) the parameters of a nonlinear model, by robust Gauss-Newton steps."""
    cost = _misfit(table, hypothesis, rows, table.theta)
    system, sound = table.system(hypothesis, rows), table
    for _ in range(_ROUNDS):
        solution = _robust(table, *system)[0]
        aim = table.mean.copy()
        aim[table.free] += solution[:, 0]
        before = cost
        for share in (1.0, 0.3, 0.1, 0.03):
            theta = table.theta + share * (aim - table.theta)
            if not np.isfinite(theta).all():
                continue
            cost = _misfit(table, hypothesis, rows, theta)
            if cost < before:
                break
        else:
            break
        table = dataclasses.replace(table, theta=theta)
        try:
            system = table.system(hypothesis, rows)
        except ValueError:  # no derivative there
            break
        sound = table
        if before - cost < 1e-3:
            break
    return sound.theta


def _misfit(table: Table, hypothesis: Hypothesis, rows: Rows, theta: Array) -> float:
    """What a search makes smaller: mean log size of the residuals of an output."""
    off = np.abs(table.residuals(hypothesis, rows, theta))
    return float(np.log(off.mean(axis=0) + _FLOOR).sum()) if len(off) else np.inf


def _robust(table: Table, slopes: Array, right: Array) -> tuple[Array, Array, Array]:
    """Student's fit of a linear system: (r, c) the solution, (K,) weights, and (K, q)
    residuals of least squares."""
    ridge, (count, _, r), q = table.ridge(slopes.shape[-1]), slopes.shape, table.outputs
    size = count * slopes.shape[1]
    plain, aim = slopes.reshape(size, r), right.reshape(size, -1)
    weights, first, solution = np.ones(count), np.zeros((count, q)), np.zeros((r, 1))
    for turn in range(_ROUNDS):
        flat = (weights[:, None, None] * slopes).reshape(size, r)
        solution = solved(flat.T @ plain, flat.T @ aim, ridge)
        off = (right - slopes @ solution).reshape(count, q)
        first = off if not turn else first
        noise = _size(off)
        weights = (q + _FREEDOM) / (_FREEDOM + ((off / noise) ** 2).sum(axis=1))
    return solution, weights, first


def _size(off: Array) -> Array:
    """(...) robust size of residuals (K, ...)."""
    return np.asarray(np.median(np.abs(off), axis=0) / 0.6745 + _FLOOR)


def judged(table: Table, hypothesis: Hypothesis, rows: Rows) -> Fitted:
    """The evidence of a hypothesis about ``table.theta``, its outliers left out."""
    from scipy import special

    slopes, right = table.system(hypothesis, rows)
    solution, weights, first = _robust(table, slopes, right)
    extra = 0 if hypothesis.extra is None else hypothesis.extra.shape[1]
    ridge, count, q = table.ridge(slopes.shape[-1]), len(rows), table.outputs
    order = np.argsort(-weights, kind="stable")
    slopes, right, costs = slopes[order], right[order], table.costs()
    off = right - slopes @ solution
    noise = _size(off)
    white = slopes if table.shared else slopes / noise
    aim = off / noise
    # Sums over rows, the most likely first: the fits without the least likely.
    most = int(_MOST_OUT[hypothesis.kind != AS_IT_IS] * count)
    several = np.linspace(0.0, most, 12).astype(np.intp)
    out = np.unique(np.append(several, np.arange(min(most, 12) + 1)))
    at = count - 1 - out
    squares = np.cumsum(np.einsum("kar,kas->krs", white, white), axis=0)[at]
    products = np.cumsum(np.einsum("kar,kac->krc", white, aim), axis=0)[at]
    products -= ridge[:, None] * solution
    totals = np.cumsum((aim**2).sum(axis=(1, 2)))[at]
    steps = solved(squares, products, ridge)
    totals = totals - (products * steps).sum(axis=(1, 2))
    totals += (ridge[:, None] * solution**2).sum()
    outlying = np.cumsum((costs[rows[order]] + OUTLIER)[::-1])
    lost = np.append(0.0, outlying)[out]
    dof = q * (at + 1.0) - (table.flat + extra * q)
    log = np.log(np.pi * np.maximum(totals, 1e-12 * np.maximum(dof, 1.0)))
    value = special.gammaln(np.maximum(dof, 0.5) / 2.0) - 0.5 * dof * log - lost
    value -= (at + 1.0) * np.log(noise).sum()
    best = int(np.where(dof >= 1.0, value, -np.inf).argmax())
    kept = at[best] + 1
    solution = solution + steps[best] * (noise[0] if table.shared else 1.0)
    left = (right - slopes @ solution).reshape(count, q)[:kept]
    by_level = (left**2).sum(axis=0)
    if table.levels == 1:
        prior = (ridge[:, None] * solution**2).sum()
        by_level = np.array([by_level.sum() + prior])
    unpaired = table.counted.copy()
    unpaired[rows] = False
    evidence = float(log_evidence(table, by_level, kept, extra)) - lost[best]
    evidence -= float(costs[unpaired].sum()) + hypothesis.code
    change, times = hypothesis.change, np.ones(q)
    if change is not None and len(change.sizes):
        evidence += (kept - table.flat / q) * change.log_size
        times = change.sizes
    inside = np.zeros(len(table.commands), dtype=np.bool_)
    inside[rows[order[:kept]]] = True
    theta, free = table.theta.copy(), int(table.free.sum())
    if not table.shared and extra == 0:
        theta[table.free] = table.mean[table.free] + solution[:free, 0]
    fixed = table.flat / q + extra
    return Fitted(
        hypothesis,
        evidence,
        np.sqrt((left**2).sum(axis=0) / max(kept - fixed, 1.0)) / times,
        np.sqrt((first**2).sum(axis=0) / max(count - fixed, 1.0)) / times,
        theta,
        inside,
        solution,
        table,
    )


def predicted(fit: Fitted) -> Array:
    """(N, q) what a fit says of the commands as they stand, in scales."""
    table = fit.table
    if table.shared:
        regressors = table.model.blocks(table.commands)[:, 0]
        return np.asarray(regressors @ fit.solution[: regressors.shape[1]])
    return predict(table.model, table.commands, fit.theta, finite=False) / table.scale


def fits_of(table: Table, hypotheses: Sequence[Hypothesis]) -> list[Fitted]:
    """Fits of the hypotheses that the model can answer."""
    fits = []
    for hypothesis in hypotheses:
        with contextlib.suppress(ValueError):
            fits.append(fitted(table, hypothesis))
    return fits


def top(fits: list[Fitted], count: int) -> list[Fitted]:
    return sorted(fits, key=lambda fit: -fit.evidence)[:count]


def as_before(best: Fitted) -> bool:
    """Whether columns put right leave what a calibration's noise was, which is the unit
    here: no machine changes as by a sign, a unit or a place."""
    change = best.hypothesis.change
    if change is None:
        return False
    noise = change(best.noise[None])[0] if change.of_readings else best.noise
    return bool((np.abs(noise) <= BEFORE).all())


def benign_fits(table: Table, plain: Fitted, best: Fitted) -> list[Fitted]:
    """The table as it is, with what machines do: drift, curves, another machine."""
    count = len(table.commands)
    time = np.linspace(-1.0, 1.0, count)[:, None]
    extras = [time, np.hstack([time, time**2])]  # approached from one side, too
    extras += [np.sign(np.gradient(column))[:, None] for column in table.commands.T]
    commands = table.commands - table.commands.mean(axis=0)
    commands = commands / (commands.std(axis=0) + 1e-300)
    n = commands.shape[1]
    i, j = np.triu_indices(n)
    squares = commands[:, i] * commands[:, j]
    products = [*squares.T, *([commands.prod(axis=1)] if n > 2 else [])]
    extras += [product[:, None] for product in products]  # one by one, of few rows
    cubes = np.hstack([squares[:, i == j], commands**3])
    terms = [squares, cubes, np.hstack([cubes, time])]
    if best.hypothesis.kind in SESSIONS:  # a drift that turns
        terms.append(np.cos(0.5 * np.pi * (time + 1.0) * np.arange(1, _WAVES)))
    extras += [more for more in terms if more.shape[1] + n + 1 < count // 2]
    if best.hypothesis.kind in SESSIONS:
        knots = np.quantile(commands, np.linspace(0.1, 0.9, 9), axis=0)
        bent = np.maximum(commands - knots[:, None], 0.0)  # (9, N, n)
        extras += [*bent.transpose(2, 0, 1).reshape(-1, count, 1)]
    at = dataclasses.replace(table, theta=plain.theta)
    if not table.free.any():  # a machine that changed since it was calibrated
        ones = np.ones((count, 1))
        extras = [np.hstack([ones, extra]) for extra in extras]
    fits = [plain, *fits_of(at, [as_it_is(table, extra) for extra in extras])]
    if not (table.free.any() or as_before(best)):
        for more in (ones, np.hstack([ones, commands])):
            code = more.shape[1] * float(np.log(table.width).sum())
            fits += fits_of(at, [as_it_is(table, more, code)])
    return fits
