"""Whether readings belong to the commands beside them, and how a table was mispaired.

The commonest fault of a logged calibration is a reading that was lost: all later ones
stand beside the command before theirs. ``mispairing`` looks for that and its kin, and
says one where it explains the readings far better than the table as it stands and than
what machines do: outliers, drift, a curve that the model lacks.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.pairing_fit import (
    ColumnChange,
    Fitted,
    Hypothesis,
    Table,
    fitted,
    solved,
)
from jaxcal.calibration.pairing_search import (
    FOREIGN,
    as_it_is,
    assigned,
    changed_columns,
    matched_anew,
    polished,
    ranked,
    shifted,
)
from jaxcal.checks import in_words
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Prior
from jaxcal.models.verdict import Verdict

__all__ = [
    "Mispairing",
    "against",
    "mispairing",
    "of_new_readings",
    "of_unfitted",
]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Fit = Any  # a jaxcal.calibration.fit.Fit, whose module need not be known here

_SURE = 8.0  # log of the odds at which a mispairing is said
_RATIO = 2.0  # times the noise without it, least squares of the table as it stands
_AS_GOOD = 3.0  # log of the odds within which another kind is named too
_TRIED = 6  # hypotheses that are fitted one by one
_WORTH = 12.0  # log of the odds: of those that are so much worse at first, none
_EXACT = 1e-6  # of the spread: readings so near a fit have nothing to explain
_APART, _LARGE = 8.0, 4.5  # times the noise: neighbours, a residual
_TREND = 1.4  # of a sum of residuals, over the root of their squares
_LEAST = 6  # rows
_PLACES = 2  # of a sensor, that are tried
_NAMED = 2  # other explanations
_COLUMNS = 6  # changes of columns that are fitted one by one
_BLOCK = 4  # rows from elsewhere: fewer are outliers
_TURNS = 6  # of assigning readings and fitting
_ROWS = 20_000  # of more the first


@dataclasses.dataclass(frozen=True)
class Mispairing:
    """How a table was mispaired."""

    kind: str
    reason: str  # a sentence
    noise: Array  # (q,) of the readings without it
    match: Rows  # (N,) row of the command that a reading belongs to, -1 of none
    change: ColumnChange | None = None
    sensed: Any = (
        None  # slice of the columns of the commands that come with the reading
    )

    @property
    def mendable(self) -> bool:
        """Whether ``repaired`` puts the table right."""
        return self.kind not in ("offset", "parameters")

    def repaired(self, commands: Array, measured: Array) -> tuple[Array, Array]:
        """The rows that belong together, (K, n) and (K, q).

        Args:
            commands: (N, n) of the table.
            measured: (N, q) of it.

        Raises:
            ValueError: rows of two sessions cannot be made one.
        """
        if not self.mendable:
            raise ValueError(
                "a table of two sessions cannot be repaired: identify from each alone"
            )
        rows = np.flatnonzero(self.match >= 0)
        paired, readings = commands[self.match[rows]], measured[rows]
        if self.sensed is not None:
            paired[:, self.sensed] = commands[rows, self.sensed]
        if self.change is not None:
            if self.change.of_readings:
                return paired, self.change(readings)
            return self.change(paired), readings
        return paired, readings


def mispairing(fit: Fit) -> Mispairing | None:
    """How the measurements of a calibration were mispaired; None: they were not."""
    if fit.noise_known:
        lack = fit.lack_of_fit()
        if lack is None or lack > 1e-3:
            return None
    prior = fit.stated_prior or fit.model.default_prior()
    measured = fit.residuals + fit.predict(fit.commands)
    counted = fit.loss_weights > 0.0
    table = _table(fit.model, fit.commands, measured, counted, prior)
    if table is None:
        return None
    table = dataclasses.replace(table, theta=np.asarray(fit.parameters))
    return _found(table, fit.input_names, fit.output_names, fit.measured_unit)


def of_unfitted(
    model: Model,
    commands: Array,
    measured: Array,
    prior: Prior | None,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Mispairing | None:
    """How a table was mispaired that could not be fitted, with names of its columns."""
    counted = np.ones(len(commands), dtype=np.bool_)
    with contextlib.suppress(ValueError):
        prior = prior or model.default_prior()
        table = _table(model, commands, measured, counted, prior)
        return None if table is None else _found(table, inputs, outputs, "")
    return None


def of_new_readings(fit: Fit, commands: Array, measured: Array) -> Mispairing | None:
    """How readings of a machine that was calibrated before were mispaired."""
    here = Prior(np.inf, mean=np.asarray(fit.estimate))
    counted = np.ones(len(commands), dtype=np.bool_)
    table = _table(fit.whole, commands, measured, counted, here, held=True)
    if table is None:
        return None
    noise = np.asarray(fit.require_noise("check"))
    table = dataclasses.replace(
        table, scale=noise, width=table.width * table.scale / noise
    )
    return _found(table, fit.input_names, fit.output_names, fit.measured_unit)


def against(verdict: Verdict, found: Mispairing | None) -> Verdict:
    """The verdict, which no calibration of a mispaired table passes."""
    if found is None:
        return verdict
    step = "correct the table, then identify again"
    if found.mendable:
        step += " (jaxcal identify --repair FILE writes it mended)"
    reasons = (found.reason, *verdict.reasons)
    return dataclasses.replace(verdict, good=False, reasons=reasons, next_step=step)


def _table(
    model: Model,
    commands: Array,
    measured: Array,
    counted: Any,
    prior: Prior,
    held: bool = False,
) -> Table | None:
    """The table, linearised at the prior's mean, or all parameters held there.

    None where there is too little.
    """
    known = prior.resolve(model)
    free = known.free & (not held)
    if len(commands) > _ROWS:
        commands, measured, counted = (
            commands[:_ROWS], measured[:_ROWS], counted[:_ROWS],
        )  # fmt: skip
    flat = bool((known.precisions == 0.0).all() and free.all())
    shared = model.multiplicity > 0 and flat
    # A measurement that is written twice counts once.
    rows = np.hstack([commands, measured])
    first = np.unique(rows, axis=0, return_index=True)[1]
    counted = counted & np.isin(np.arange(len(rows)), first)
    if counted.sum() < _LEAST:
        return None
    if shared:
        commands = commands - commands.mean(axis=0)
        measured = measured - measured.mean(axis=0)
    spread = measured[counted].std(axis=0)
    if not spread.any():  # a sensor that reads zero where all is as it should be
        half = np.roll(np.arange(len(commands)), len(commands) // 2)
        paired = commands[half]
        paired[:, model.sensed] = commands[:, model.sensed]
        spread = np.sqrt((model.predict(paired, known.mean) ** 2).mean(axis=0))
    spread = np.where(spread > 0.0, spread, 1.0)
    usual, scale = model.default_noise(), spread
    if usual is not None and usual.std is not None:
        scale = np.broadcast_to(np.asarray(usual.std, dtype=np.float64), spread.shape)
    return Table(
        model, commands, measured, counted, known.mean, known.precisions, free,
        known.mean, scale, spread / scale, shared,
    )  # fmt: skip


def _found(
    table: Table,
    inputs: Sequence[str],
    outputs: Sequence[str],
    unit: str,
) -> Mispairing | None:
    """The mispairing of a table."""
    plain = fitted(table, as_it_is(table))
    if _plainly_right(table, plain):
        return None
    fits = _alternatives(table, plain)
    if not any(_explains(plain, fit) for fit in fits):
        fits += _columns(table, plain, inputs, outputs)
    fits = [fit for fit in fits if np.isfinite(fit.evidence) and not _few(fit)]
    if not fits:
        return None
    best = max(fits, key=lambda fit: fit.evidence)
    if not _better(plain, best):
        return None
    if not _stands_apart(plain, best):
        for benign in _benign(table, plain, best):
            if best.evidence - benign.evidence < _SURE:
                return None
            by_itself = benign is not plain and not benign.hypothesis.code
            if by_itself and not _better(benign, best):
                return None
    near: dict[int, list[int]] = {}
    if best.hypothesis.kind == "path":
        at_best, near = polished(table, best)
        best, near = (best, {}) if _few(at_best) else (at_best, near)
    reason = _words(table, best, near, outputs, unit)
    for fit in _top(fits, len(fits)):
        other = _what(table, fit, {}, outputs, unit)
        kind = (fit.hypothesis.kind, fit.hypothesis.change)
        as_good = fit.evidence > best.evidence - _AS_GOOD
        if as_good and kind != (best.hypothesis.kind, best.hypothesis.change):
            if other not in reason and reason.count("; or ") < _NAMED:
                reason += f"; or {other}"
    return Mispairing(
        best.hypothesis.kind,
        reason,
        best.noise * table.scale,
        best.hypothesis.match,
        best.hypothesis.change,
        table.model.sensed,
    )


def _plainly_right(table: Table, plain: Fitted) -> bool:
    """Whether the fit tells neighbours apart, and leaves no row and no trend over.

    Rows that were mispaired are then off by far more than the others.
    """
    noise = np.maximum(plain.noise, _EXACT * table.width)
    if (plain.rms <= _EXACT * table.width).all():
        return True
    rows = np.flatnonzero(table.counted)
    if not plain.inside[rows].all():
        return False
    at = dataclasses.replace(table, theta=plain.theta)
    slopes, right = at.system(as_it_is(table), rows)
    off = (right - slopes @ plain.solution).reshape(len(rows), -1)
    said = (right - off.reshape(right.shape)).reshape(off.shape)
    apart = np.median(np.abs(np.diff(said, axis=0)), axis=0)
    if (apart < _APART * noise).any() or (np.abs(off) > _LARGE * noise).any():
        return False
    scores = off[..., None]
    if table.shared:
        scores = scores * slopes / np.sqrt((slopes**2).mean(axis=0))
    size = np.sqrt((scores**2).sum(axis=0))
    return bool((np.abs(np.cumsum(scores, axis=0)) < _TREND * size).all())


def _few(fit: Fitted) -> bool:
    """Whether a hypothesis is of so few rows from elsewhere that they are outliers."""
    path = fit.hypothesis.starts
    ends = [start for start, _ in (*path[1:], (len(fit.inside), 0))]
    return bool(path) and any(
        by == FOREIGN and end - start < _BLOCK
        for (start, by), end in zip(path, ends, strict=True)
    )


def _stands_apart(plain: Fitted, best: Fitted) -> bool:
    """Whether the outliers of a table are one block of rows, as those of none are."""
    path = best.hypothesis.starts
    if len(path) != 3 or path[1][1] != FOREIGN:
        return False
    block = np.arange(path[1][0], path[2][0])
    outliers = np.flatnonzero(~plain.inside)
    most = len(block) + 1  # of outliers, one of which may stand elsewhere
    return bool(len(outliers) <= most and np.isin(block, outliers).sum() >= _BLOCK)


def _better(fit: Fitted, best: Fitted) -> bool:
    """Whether an output's residuals are far larger than the noise of the best."""
    return bool((fit.rms > _RATIO * best.noise).any())


def _explains(plain: Fitted, fit: Fitted) -> bool:
    """Whether nothing is left to explain."""
    sure = fit.evidence - plain.evidence > _SURE or _stands_apart(plain, fit)
    return sure and bool((fit.rms < 0.1 * plain.rms).any())


def _alternatives(table: Table, plain: Fitted) -> list[Fitted]:
    """Other pairings of rows, fitted."""
    tables = [table]
    if not (table.shared or table.model.linear) and table.free.any():
        at_fit = dataclasses.replace(table, theta=plain.theta)
        tables = [*_places(table), at_fit] if table.levels == 1 else [table, at_fit]
    fits: list[Fitted] = []
    for one in tables:
        if any(_explains(plain, fit) for fit in fits):
            break
        base, hypotheses = ranked(one)
        worth = [h for score, h in hypotheses[:_TRIED] if score > base - _WORTH]
        fits += _fits(one, worth)
    paths = [fit for fit in fits if fit.hypothesis.kind == "path"]
    fits += [polished(table, fit)[0] for fit in _top(paths, 2)]
    return fits + _exchanged(table, plain) + _sorted(table, plain)


def _fits(table: Table, hypotheses: Sequence[Hypothesis]) -> list[Fitted]:
    """Those of the hypotheses that the model can answer."""
    fits = []
    for hypothesis in hypotheses:
        with contextlib.suppress(ValueError):
            fits.append(fitted(table, hypothesis))
    return fits


def _top(fits: list[Fitted], count: int) -> list[Fitted]:
    return sorted(fits, key=lambda fit: -fit.evidence)[:count]


def _exchanged(table: Table, plain: Fitted) -> list[Fitted]:
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


def _sorted(table: Table, plain: Fitted) -> list[Fitted]:
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
            fits += [_matched(table, Hypothesis(kind, each, code)) for each in starts]
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


def _columns(
    table: Table, plain: Fitted, inputs: Sequence[str], outputs: Sequence[str]
) -> list[Fitted]:
    """Columns with another sign, unit or place."""
    least = 0.1 if table.model.resolution else 0.02
    if table.shared or not (plain.rms > least * table.width).any():
        return []
    tables, every = [], np.flatnonzero(table.counted)
    for hypothesis in changed_columns(table, inputs, outputs):
        anew = _anew(table, hypothesis, every)
        if anew is not None:
            tables.append((_distance(anew, hypothesis, every), anew, hypothesis))
    tables.sort(key=lambda each: each[0])
    return [fit for _, one, each in tables[:_COLUMNS] for fit in _fits(one, [each])]


def _distance(table: Table, hypothesis: Hypothesis, rows: Rows) -> float:
    """Log size of what is off before anything is fitted that a prior is known of."""
    off = table.residuals(hypothesis, rows, table.theta)
    if table.flat:
        with contextlib.suppress(ValueError):
            off = _flat_fit(table, hypothesis, rows)
    size = np.log(np.median(np.abs(off), axis=0) + 1e-300).sum()
    change = hypothesis.change
    return (
        float(size - (change.log_size if change else 0.0)) if size == size else np.inf
    )


def _flat_fit(table: Table, hypothesis: Hypothesis, rows: Rows) -> Array:
    """(K, q) residuals of least squares about ``theta``."""
    slopes, right = table.system(hypothesis, rows)
    flat = slopes.reshape(-1, slopes.shape[-1])
    known = table.ridge(flat.shape[1])
    solution = solved(flat.T @ flat, flat.T @ right.reshape(len(flat), -1), known)
    return np.asarray((right - slopes @ solution).reshape(len(rows), -1))


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


def _places(table: Table) -> list[Table]:
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
    found = []
    for match, rows in windows:
        hypothesis = Hypothesis("", match)
        rows = rows[(match[rows] >= 0) & table.counted[rows]]
        anew = _anew(table, hypothesis, rows)
        if anew is not None:
            found.append((_distance(anew, hypothesis, rows), anew))
    found.sort(key=lambda each: each[0])
    return [each for _, each in found[:_PLACES]] or [table]


def _benign(table: Table, plain: Fitted, best: Fitted) -> list[Fitted]:
    """The table as it is, with what machines do: drift, curves, another machine."""
    count = len(table.commands)
    time = np.linspace(-1.0, 1.0, count)[:, None]
    extras = [time, np.hstack([time, time**2])]
    for column in table.commands.T:  # approached from one side
        extras.append(np.sign(np.gradient(column))[:, None])
    commands = table.commands - table.commands.mean(axis=0)
    commands = commands / (commands.std(axis=0) + 1e-300)
    n = commands.shape[1]
    i, j = np.triu_indices(n)
    squares = commands[:, i] * commands[:, j]
    cubes = np.hstack([squares[:, i == j], commands**3])
    for more in (squares, cubes, np.hstack([cubes, time])):
        if more.shape[1] + n + 1 < count // 2:
            extras.append(more)
    if best.hypothesis.kind in ("offset", "parameters"):
        for column in commands.T:
            for knot in np.quantile(column, np.linspace(0.1, 0.9, 9)):
                extras.append(np.maximum(column - knot, 0.0)[:, None])
    at = dataclasses.replace(table, theta=plain.theta)
    fits = [plain]
    fits += [fitted(at, as_it_is(table, extra)) for extra in extras]
    if not table.free.any():  # a machine that changed since it was calibrated
        ones = np.ones((count, 1))
        for more in (ones, np.hstack([ones, commands])):
            code = more.shape[1] * float(np.log(table.width).sum())
            fits.append(fitted(at, as_it_is(table, more, code)))
    return fits


def _words(
    table: Table,
    fit: Fitted,
    near: dict[int, list[int]],
    outputs: Sequence[str],
    unit: str,
) -> str:
    noise = f"{in_words(fit.noise * table.scale)} {unit}".strip()
    without = "with each apart" if fit.hypothesis.extra is not None else "without that"
    return f"{_what(table, fit, near, outputs, unit)}; {without} the noise is {noise}"


def _rows_late(by: int) -> str:
    rows = "one row" if abs(by) == 1 else f"{abs(by)} rows"
    where = "the command that far below" if by > 0 else "the command that far above"
    return f"{rows} {'early' if by > 0 else 'late'} (each belongs to {where})"


def _what(
    table: Table,
    fit: Fitted,
    near: dict[int, list[int]],
    outputs: Sequence[str],
    unit: str,
) -> str:
    """The mispairing as a sentence; rows are counted from 0."""
    hypothesis, count = fit.hypothesis, len(table.commands)
    kind, starts = hypothesis.kind, hypothesis.starts
    if hypothesis.change is not None:
        return hypothesis.change.words
    if kind == "shift":
        return f"all readings are {_rows_late(starts[0][1])}"
    if kind == "reversed":
        return "the readings are in reverse order"
    if kind == "halves":
        return (
            "the halves of the readings are exchanged: those from row "
            f"{-starts[0][1] % count} on belong to the first commands"
        )
    if kind == "rotation" and abs(starts[0][1]) <= count // 3:
        last = "first" if starts[0][1] > 0 else "last"
        return (
            f"all readings are {_rows_late(starts[0][1])}; the {last} "
            f"{abs(starts[0][1])} stand at the other end"
        )
    if kind == "rotation":
        return (
            f"the readings from row {-starts[0][1] % count} on belong to the first "
            "commands, those before to the last"
        )
    if kind == "commands sorted":
        return "the commands are sorted and the readings are not"
    if kind == "readings sorted":
        return "the readings are sorted and the commands are not"
    if kind == "exchanged":
        rows = np.flatnonzero(hypothesis.match != np.arange(count))
        return f"the readings of rows {', '.join(map(str, rows))} are exchanged"
    if kind in ("offset", "parameters"):
        another = "slope or offset"
        if kind == "offset":
            steps = (
                fit.solution[-1] if table.shared else fit.solution[-table.outputs :, 0]
            )
            size = f"{in_words(steps * table.scale)} {unit}".strip()
            another = f"offset, by {size}"
        return (
            f"rows of two sessions seem joined: from row {starts[1][0]} on the "
            f"readings have another {another}"
        )
    return _path_words(starts, near, count)


def _path_words(
    path: Sequence[tuple[int, int]], near: dict[int, list[int]], count: int
) -> str:
    parts = []
    for i, (start, by) in enumerate(path):
        if by == 0:
            continue
        end = path[i + 1][0] if i + 1 < len(path) else count
        where = (
            f"from row {start} on" if end == count else f"from row {start} to {end - 1}"
        )
        if start == 0:
            where = f"up to row {end - 1}"
        rows = near.get(i, [])
        if len(rows) > 1:
            where += f" (or {', '.join(str(row) for row in rows if row != start)})"
        if by == FOREIGN:
            parts.append(f"{where} the readings do not belong to these commands")
        else:
            parts.append(f"{where}, readings are {_rows_late(by)}")
    return "; ".join(parts)
