"""Whether readings belong to the commands beside them, and how a table was mispaired.

A mispairing is named where it explains the readings far better than the table as it
stands and than what machines do: outliers, drift, a curve that the model lacks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.calibration.fit import noise_of, outputs_at, stated_prior
from jaxcal.calibration.pairing.fit import (
    BEFORE,
    FOREIGN,
    SESSIONS,
    ColumnChange,
    Fitted,
    Hypothesis,
    Names,
    Table,
    as_before,
    as_it_is,
    benign_fits,
    fits_of,
    fitted,
    path_match,
    top,
)
from jaxcal.calibration.reasons import froze, in_rows
from jaxcal.calibration.resolution import COARSE, resolution
from jaxcal.checks import Array, in_words
from jaxcal.models.model import Model, Rows
from jaxcal.models.uncertainty import Prior

if TYPE_CHECKING:
    from jaxcal.calibration.fit import Fit

_SURE = 8.0  # log of the odds at which a mispairing is said
RATIO = 2.0  # times the noise without it, least squares of the table as it stands
_SURE_BESIDE, _BENIGN = 6.0, 1.4  # both, beside what machines do
_FAR = 20.0  # log of the odds from which the noise beside that does not count
_AS_GOOD = 3.0  # log of the odds within which another kind is named too
_TRIED = 6  # hypotheses that are fitted one by one
_WORTH = 12.0  # log of the odds: of those that are so much worse at first, none
_EXACT = 1e-6  # of the spread: readings so near a fit have nothing to explain
_NEXT, _LARGE = 8.0, 3.0  # times the residuals: neighbours, a row
_USUAL = 2.0  # times the usual noise of a sensor
# Of rows that are not explained: times it, times the others, share of all.
_OFF, _APART_BY, _FEW = 5.0, 1.5, 0.3
_TREND, _TREND_OF_MANY = 1.4, 2.0  # of a sum of residuals, over their squares' root
LEAST, _MANY = 6, 500  # rows
_MOVED, _ROWS_ALONE = 4, 2000  # rows of one output alone: least, and the first
_NAMED = 2  # other explanations
# For each parameter that no prior knows; of fewer another machine explains as much.
_READINGS = 1.5
_CHANCE = 0.02  # that so many outliers stand so near one another
_APART = "apart"  # kind: outliers that are one block
_FREQUENT = ("shift", "path")  # kinds that are named first among as good ones
_SORTED = ("commands sorted", "readings sorted")  # kinds
_ROWS, _RUNS = 20_000, 400  # of more the first; of a function that is run


@dataclasses.dataclass(frozen=True)
class Mispairing:
    """How a table was mispaired."""

    kind: str
    reason: str  # a sentence
    noise: Array  # (q,) of the readings without it
    match: Rows  # (N,) row of the command that a reading belongs to, -1 of none
    change: ColumnChange | None = None
    sensed: Any = None  # slice of columns of commands that come with the reading
    alternatives: tuple[str, ...] = ()  # what would explain the readings as well
    output: str = ""  # whose readings alone are mispaired

    @property
    def mendable(self) -> bool:
        """Whether ``repaired`` puts the table right."""
        return self.kind not in SESSIONS and not self.output

    def repaired(self, commands: Array, measured: Array) -> tuple[Array, Array]:
        """The rows of the table that belong together, (K, n) and (K, q); a ValueError
        where rows of two sessions cannot be made one."""
        if self.output:
            raise ValueError(f"one column cannot be repaired: {self.reason}")
        if not self.mendable:
            raise ValueError(
                "a table of two sessions cannot be repaired: identify each alone"
            )
        if self.alternatives and 2 * (self.match >= 0).sum() < len(self.match):
            raise ValueError(
                f"the table cannot be repaired, several explanations fit: {self.reason}"
            )
        if self.change is not None and self.change.estimated:
            raise ValueError(
                f"{self.change.words}: how many exactly is not known. Write the "
                "readings in the model's unit"
            )
        rows = np.flatnonzero(self.match >= 0)
        paired, readings = commands[self.match[rows]], measured[rows]
        if self.sensed is not None:
            paired[:, self.sensed] = commands[rows, self.sensed]
        if self.change is not None and self.change.of_readings:
            readings = self.change(readings)
        elif self.change is not None:
            paired = self.change(paired)
        return paired, readings


def mispairing(fit: Fit) -> Mispairing | None:
    """How the measurements of a calibration were mispaired; None: they were not."""
    if len(fit.commands) < LEAST:
        return None
    lack, seen = fit.lack_of_fit() if fit.noise_known else 0.0, None
    if lack is not None and lack <= 1e-3 and not _plainly_right(fit):
        if froze(fit):
            return None
        seen = _found(of_fit(fit), fit.input_names, fit.output_names, fit.measured_unit)
        # Linearised on a plateau the table may look worse than the fit itself.
        rms = np.sqrt((fit.residuals**2).mean(axis=0))
        seen = seen if seen is None or (seen.noise < rms).any() else None
    if seen is None and not fit.model.linear and fit.model.default_noise() is None:
        return _taken_up(fit)
    return seen


def _taken_up(fit: Fit) -> Mispairing | None:
    """A unit, a sign or a place that a nonlinear fit took up in its parameters."""
    if stated_prior(fit) is not None and not fit.prior_precision.any():
        return None  # its mean is where a search starts, no machine
    from jaxcal.calibration.pairing.rearranged import by_nominal

    table = of_fit(fit)
    nominal = table and by_nominal(table, fit.input_names, fit.output_names)
    if not (table and nominal):
        return None
    change, match = nominal.hypothesis.change, np.arange(len(fit.commands))
    assert change is not None
    reason = f"{change.words}, for the nominal parameters explain it then and not now"
    noise = nominal.noise * table.scale
    return Mispairing("columns", reason, noise, match, change, fit.model.fitting.sensed)


def of_unfitted(
    model: Model,
    commands: Array,
    measured: Array,
    prior: Prior | None,
    inputs: Names,
    outputs: Names,
) -> Mispairing | None:
    """How a table was mispaired that could not be fitted, with names of its columns."""
    with contextlib.suppress(ValueError):
        if isinstance(prior, Prior | None):  # else refused by the fit
            table = _table(model, commands, measured, prior or model.default_prior())
            return _found(table, inputs, outputs, "")
    return None


def of_new_readings(fit: Fit, commands: Array, measured: Array) -> Mispairing | None:
    """How readings of a machine that was calibrated before were mispaired."""
    here = Prior(np.inf, mean=np.asarray(fit.estimate))
    table = _table(fit.whole, commands, measured, here, held=True)
    if table is None:
        return None
    noise = np.asarray(noise_of(fit, "check"))
    width = table.width * table.scale / noise
    table = dataclasses.replace(table, scale=noise, width=width)
    names = fit.input_names, fit.output_names
    return _found(table, *names, fit.measured_unit) or _rows_off(table)


def _rows_off(table: Table) -> Mispairing | None:
    """Few rows that are far off a calibration which explains the others as before."""
    right, every = as_it_is(table), np.arange(len(table.commands))
    off = table.residuals(right, every, table.theta)
    size = np.abs(off).max(axis=1)
    far = size > _OFF
    if not 0 < far.sum() <= _FEW * len(far):
        return None
    noise = np.sqrt((off[~far] ** 2).mean(axis=0))
    if (noise > BEFORE).any() or size[far].min() < _APART_BY * size[~far].max():
        return None
    reason = (
        f"{in_rows(every[far].tolist())} off by {size[far].min():.2g} times the noise "
        "or more, the others as before"
    )
    match = np.where(far, -1, every)
    return Mispairing("rows", reason, noise * table.scale, match)


def of_fit(fit: Fit) -> Table | None:
    """The table of a fit, linearised there."""
    prior = stated_prior(fit) or fit.model.default_prior()
    measured = fit.residuals + outputs_at(fit, fit.commands)
    if fit.noise_std is not None:  # what a display rounded, it read within a step
        step = resolution(measured, COARSE)
        step[fit.noise_std >= step] = 0.0
        if step.any():
            within = np.random.default_rng(0).uniform(-0.5, 0.5, measured.shape)
            measured += step * within
    counted = fit.loss_weights > 0.0
    table = _table(fit.model, fit.commands, measured, prior, counted)
    return table and dataclasses.replace(table, theta=np.asarray(fit.parameters))


def _table(
    model: Model,
    commands: Array,
    measured: Array,
    prior: Prior,
    counted: Any = None,
    held: bool = False,
) -> Table | None:
    """The table, linearised at the prior's mean, or all parameters held there; None
    where there is too little."""
    resolved = prior.resolve(model)
    free = resolved.free & (not held)
    most = _RUNS if model.fitting.resolution else _ROWS
    commands, measured = commands[:most], measured[:most]
    counted = np.ones(len(commands), np.bool_) if counted is None else counted[:most]
    flat = bool((resolved.precisions == 0.0).all() and free.all())
    shared = model.fitting.multiplicity > 0 and flat
    # A measurement that is written twice counts once.
    rows = np.hstack([commands, measured])
    first = np.unique(rows, axis=0, return_index=True)[1]
    counted = counted & np.isin(np.arange(len(rows)), first)
    readings = counted.sum() * measured.shape[1]
    unknown = int((free & (resolved.precisions == 0.0)).sum())
    few = not model.linear and readings < _READINGS * unknown
    moved = np.delete(commands, model.fitting.sensed, axis=1)
    if counted.sum() < LEAST or few or (moved == moved[0]).all():
        return None
    if shared:
        commands = commands - commands.mean(axis=0)
        measured = measured - measured.mean(axis=0)
    spread = measured[counted].std(axis=0)
    if not spread.any():  # a sensor that reads zero where all is as it should be
        half = np.roll(np.arange(len(commands)), len(commands) // 2)
        paired = commands[half]
        paired[:, model.fitting.sensed] = commands[:, model.fitting.sensed]
        spread = np.sqrt((model.predict(paired, resolved.mean) ** 2).mean(axis=0))
    spread = np.where(spread > 0.0, spread, 1.0)
    usual, scale = model.default_noise(), spread
    if usual is not None and usual.std is not None:
        scale = np.broadcast_to(np.asarray(usual.std, dtype=np.float64), spread.shape)
    return Table(
        model, commands, measured, counted, resolved.mean, resolved.precisions, free,
        resolved.mean, scale, spread / scale, shared,
    )  # fmt: skip


def _found(
    table: Table | None, inputs: Names, outputs: Names, unit: str
) -> Mispairing | None:
    """The mispairing of a table, or of one of its outputs."""
    if table is None:
        return None
    pairing = _of_all(table, inputs, outputs, unit)
    if pairing is not None or not table.shared or len(outputs) == 1:
        return pairing
    for j, name in enumerate(outputs):
        pairing = _of_all(alone(table, j), inputs, (name,), unit)
        if pairing is None:
            continue
        moved = (pairing.match >= 0) & (pairing.match != np.arange(len(pairing.match)))
        if moved.sum() >= _MOVED:
            reason = f"{name} alone: {pairing.reason}"
            return dataclasses.replace(pairing, reason=reason, output=name)
    return None


def alone(table: Table, output: int) -> Table:
    """One output of a linear model without a prior, its first rows."""
    rows = len(table.mean) // table.outputs
    none, first, column = np.zeros(rows), slice(_ROWS_ALONE), [output]
    return dataclasses.replace(
        table, commands=table.commands[first], counted=table.counted[first],
        measured=table.measured[first, column], mean=none, precision=none, theta=none,
        free=np.ones(rows, np.bool_), scale=table.scale[column],
        width=table.width[column],
    )  # fmt: skip


def _of_all(
    table: Table, inputs: Names, outputs: Names, unit: str
) -> Mispairing | None:
    """The mispairing of all outputs together."""
    plain = fitted(table, as_it_is(table))
    if (plain.rms <= _EXACT * table.width).all():
        return None
    # Loaded, here and below, only where a table is in doubt.
    from jaxcal.calibration.pairing.rearranged import changed_columns, polished
    from jaxcal.calibration.pairing.search import what_is_wrong

    fits = [fit for fit in _alternatives(table, plain) if not _few(fit)]
    if not any(_explains(plain, fit) for fit in fits):
        fits += changed_columns(table, plain, inputs, outputs)
    fits = [fit for fit in fits if np.isfinite(fit.evidence)]
    if _lost_its_way(table, plain):
        fits = [fit for fit in fits if fit.hypothesis.kind in _SORTED]
    if not fits:
        return None
    best = max(fits, key=lambda fit: fit.evidence)
    if best.hypothesis.kind == "parameters":  # an offset says it in fewer words
        offsets = [fit for fit in fits if fit.hypothesis.kind == "offset"]
        as_good = (x for x in offsets if x.evidence > best.evidence - _AS_GOOD)
        best = next(as_good, best)
    if best.evidence - plain.evidence <= _SURE:
        best = next((fit for fit in fits if fit.hypothesis.kind == _APART), best)
    size = np.maximum(plain.rms, plain.noise)  # rms is less, where a prior is known
    if not better(plain._replace(rms=size), best):
        return None
    if best.hypothesis.kind != _APART:
        far = _SURE if not table.free.any() and as_before(best) else _FAR
        for benign in benign_fits(table, plain, best):
            ahead = best.evidence - benign.evidence
            by_itself = benign is not plain and not benign.hypothesis.code
            close = ahead < far or best.hypothesis.kind in SESSIONS
            if ahead < _SURE_BESIDE:
                return None
            if by_itself and close and not better(benign, best, _BENIGN):
                return None
    near: dict[int, list[int]] = {}
    if best.hypothesis.kind == "path":
        with contextlib.suppress(ValueError):
            at_best, rows_near = polished(best)
            best, near = (best, {}) if _few(at_best) else (at_best, rows_near)
    rivals = _as_good(table, best, fits)
    if best.hypothesis.kind not in _FREQUENT:
        shifts = [fit for fit in rivals if fit.hypothesis.kind in _FREQUENT]
        if shifts:
            rivals[rivals.index(shifts[0])], best = best, shifts[0]
    noise = f"{in_words(best.noise * table.scale)} {unit}".strip()
    joined = best.hypothesis.extra is not None
    without = "with each apart" if joined else "without that"
    reason = what_is_wrong(table, best, near, unit)
    reason += f"; {without} the noise is {noise}"
    named = [what_is_wrong(table, fit, {}, unit) for fit in rivals]
    others = [*dict.fromkeys(x for x in named if x not in reason)][:_NAMED]
    reason = "; or ".join([reason, *others])
    alike = [_mirrors(fit.hypothesis.change) for fit in (best, *rivals)]
    if len(alike) > 2 and all(alike):
        axes = ", ".join(outputs)
        reason = (
            f"the readings are mirrored: one of {axes} has the other sign or two of "
            f"them are exchanged; compare their axes with the instrument's; {without} "
            f"the noise is {noise}"
        )
    match = best.hypothesis.match
    if best.hypothesis.kind == _APART:
        match = path_match(len(match), best.hypothesis.starts)
    match = _certain(table, best, match, near)
    for fit in rivals:
        by_rows = fit.hypothesis.extra is None and fit.hypothesis.kind != _APART
        if not by_rows or fit.hypothesis.change or best.hypothesis.change:
            match = np.full_like(match, -1)
        match[match != fit.hypothesis.match] = -1  # where explanations agree
    return Mispairing(
        best.hypothesis.kind,
        reason,
        best.noise * table.scale,
        match,
        best.hypothesis.change,
        table.model.fitting.sensed,
        tuple(others),
    )


def _mirrors(change: ColumnChange | None) -> bool:
    """Whether a change of readings turns a right-handed frame into a left-handed one;
    where an arm's frame is known from its readings alone, each such explains them."""
    if change is None or not change.of_readings or len(change.order) != 3:
        return False
    turn = np.eye(3)[list(change.order)] * change.factors
    return bool(np.isclose(np.linalg.det(turn), -1.0))


def _certain(
    table: Table, fit: Fitted, match: Rows, near: dict[int, list[int]]
) -> Rows:
    """(N,) match without readings whose command may be another: where a shift may begin
    at several rows, outliers beside that, which may be shifted by more, and those of a
    command that has several, but for copies."""
    match = match.copy()
    if near:
        match[~fit.inside] = -1
    for rows in near.values():
        match[rows[0] : rows[-1]] = -1
    for row in np.flatnonzero(np.bincount(match[match >= 0]) > 1):
        readings = np.flatnonzero(match == row)
        inside = readings[fit.inside[readings]]
        same = len(inside) and (table.measured[inside] == table.measured[inside[0]])
        match[readings] = -1
        match[inside[: int(np.all(same))]] = row
    return match


def _as_good(table: Table, best: Fitted, fits: list[Fitted]) -> list[Fitted]:
    """Mispairings of another kind that explain the readings as well as the best; rows
    that a shift leaves unpaired do not speak against it."""
    noise = np.maximum(best.noise, 1e-300)
    row = float((2.0 + np.log(table.width / noise).clip(0.0)).sum())
    paired = best.hypothesis.match >= 0
    kind, change = best.hypothesis.kind, best.hypothesis.change

    def rivals(fit: Fitted) -> bool:
        other, fewer = fit.hypothesis, 0
        if other.kind in _FREQUENT and all(by != FOREIGN for _, by in other.starts):
            fewer = int((paired & (other.match < 0)).sum())
        near = fit.evidence > best.evidence - _AS_GOOD - fewer * row
        same = (kind, change) == (other.kind, other.change)
        return near and not same and not {kind, other.kind} <= SESSIONS

    return [*filter(rivals, top(fits, len(fits)))]


def _plainly_right(fit: Fit) -> bool:
    """Whether the fit tells neighbours apart, and leaves no row and no trend over."""
    off, used = fit.residuals, fit.loss_weights > 0.0
    if not used.all():
        return False
    said = outputs_at(fit, fit.commands)
    rms = np.sqrt((off**2).mean(axis=0))
    apart = np.sort(np.abs(said[1:] - said[:-1]), axis=0)[len(off) // 2 - 1]
    if (rms <= _EXACT * apart).all():
        return True
    # Of many normal residuals the largest is about the root of 2 log N.
    large = max(_LARGE, float(np.sqrt(2.0 * np.log(off.size))) + 0.7)
    if (np.abs(off) > large * rms).any():
        return False
    if (apart < _NEXT * rms).any() and not _white(off, rms, said):
        return False
    usual = fit.model.default_noise()
    if usual is not None and (rms <= _USUAL * np.asarray(usual.std)).all():
        return True  # no more is left than a sensor of its kind reads beside
    moved = fit.commands - fit.commands.mean(axis=0)
    factors = np.concatenate([np.ones((len(off), 1)), moved], axis=1)
    scores = off[..., None] * factors[:, None]
    size = np.sqrt((scores**2).sum(axis=0))
    trend = _TREND if len(off) < _MANY else _TREND_OF_MANY
    return bool((np.abs(scores.cumsum(axis=0)) <= trend * size).all())


def _white(off: Array, rms: Array, said: Array) -> bool:
    """Whether many residuals of a fit that explains the readings are independent: a lag
    or a block from elsewhere makes those in a row alike, or larger than the others."""
    count = len(off)
    if count < _MANY or (rms > 0.5 * said.std(axis=0)).any():
        return False
    square = np.where(rms > 0.0, rms, 1.0) ** 2  # a reading may stand still
    alike = (off[1:] * off[:-1]).mean(axis=0) / square
    larger = np.abs((off**2 - rms**2).cumsum(axis=0)).max(axis=0) / square
    calm = larger < _TREND_OF_MANY * np.sqrt(2.0 * count)  # of normal residuals
    return bool((np.abs(alike) < 3.0 / np.sqrt(count)).all() and calm.all())


def _lost_its_way(table: Table, plain: Fitted) -> bool:
    """Whether a search explains nothing of a sweep, which other parameters might."""
    if table.shared or table.model.linear or not table.free.any():
        return False
    steps = np.sign(np.diff(table.commands, axis=0))
    swept = (np.ptp(steps, axis=0) < 2.0) & steps.any(axis=0)
    return bool(swept.any() and (plain.rms > 0.5 * table.width).all())


def _few(fit: Fitted) -> bool:
    """Whether a hypothesis is of so few rows from elsewhere that they are outliers, or
    of so many that few are left."""
    path, count = fit.hypothesis.starts, len(fit.inside)
    if (fit.hypothesis.match >= 0).sum() < max(LEAST, count // 2):
        return True
    ends = [start for start, _ in (*path[1:], (count, 0))]
    return bool(path) and any(
        by == FOREIGN and _chance(end - start, end - start, count) > _CHANCE
        for (start, by), end in zip(path, ends, strict=True)
    )


def _chance(outliers: int, width: int, count: int) -> float:
    """Probability that so many outliers of ``count`` rows are within ``width`` rows."""
    if outliers < 2:
        return 1.0
    placed = sum(
        (count - wide + 1) * math.comb(wide - 2, outliers - 2)
        for wide in range(outliers, width + 1)
    )
    return placed / math.comb(count, outliers)


def _apart(table: Table, plain: Fitted) -> list[Fitted]:
    """Outliers that are one block of rows, as those of none are, but for the first or
    the last: one outlier may stand apart."""
    count = len(table.commands)
    outliers = np.flatnonzero(~plain.inside & table.counted)
    for rows in (outliers, outliers[1:], outliers[:-1]):
        if len(rows) < 3:
            continue
        start, end = int(rows[0]), int(rows[-1]) + 1
        inner = 0 < start and end < count
        if not inner or _chance(len(rows), end - start, count) > _CHANCE:
            continue
        path = ((0, 0), (start, FOREIGN), (end, 0))
        code = math.log(0.5 * count**2)
        match = np.arange(count)
        match[rows] = -1
        return [fitted(table, Hypothesis(_APART, match, code, path), plain.theta)]
    return []


def better(fit: Fitted, best: Fitted, ratio: float = RATIO) -> bool:
    """Whether an output's residuals are far larger than the noise of the best."""
    return bool((fit.rms > ratio * best.noise).any())


def _explains(plain: Fitted, fit: Fitted) -> bool:
    """Whether nothing is left to explain."""
    sure = fit.evidence - plain.evidence > _SURE or fit.hypothesis.kind == _APART
    return sure and bool((fit.rms < 0.1 * plain.rms).all())


def _alternatives(table: Table, plain: Fitted) -> list[Fitted]:
    """Other pairings of rows, fitted."""
    from jaxcal.calibration.pairing.rearranged import (
        exchanged,
        places,
        polished,
        sorted_alone,
    )
    from jaxcal.calibration.pairing.search import ranked

    tables = [table]
    if not (table.shared or table.model.linear) and table.free.any():
        at_fit = dataclasses.replace(table, theta=plain.theta)
        expected = [dataclasses.replace(table, theta=table.mean)]
        tables = [*(places(table) if table.levels == 1 else expected), at_fit]
    fits: list[Fitted] = []
    for one in tables:
        if any(_explains(plain, fit) for fit in fits):
            break
        with contextlib.suppress(ValueError):  # parameters that predict nothing there
            base, hypotheses = ranked(one)
            worth = [h for score, h in hypotheses[:_TRIED] if score > base - _WORTH]
            fits += fits_of(one, worth)
    paths = [fit for fit in fits if fit.hypothesis.kind == "path"]
    for path in top(paths, 2):
        with contextlib.suppress(ValueError):
            fits.append(polished(path)[0])
    for search in (_apart, exchanged, sorted_alone):
        with contextlib.suppress(ValueError):
            fits += search(table, plain)
    return fits
