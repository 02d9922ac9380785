"""What a mispaired table, hidden outliers or a curve do to a verdict, in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.calibration.pairing.fit import Fitted, fitted, predicted
from jaxcal.calibration.pairing.judge import LEAST, RATIO, benign_fits, better, of_fit
from jaxcal.calibration.pairing.table import FOREIGN, Path, Table, as_it_is
from jaxcal.calibration.verdict import Reason, Verdict, bends, in_rows
from jaxcal.checks import in_words

if TYPE_CHECKING:
    from jaxcal.calibration.calibration import Calibration
    from jaxcal.calibration.fit import Fit

_OFF = 6.0  # times the noise of the others
_TURNS, _FLOOR = 4, 0.01  # rounds; noises, below which a row weighs no more
_SAMPLE = 5000  # rows
_READINGS = 3  # for each parameter


def against(verdict: Verdict, fit: Calibration) -> Verdict:
    """The verdict of the fit by itself, which no calibration passes of a mispaired
    table, outliers that hide in its noise, or a curve."""
    pairing = fit.mispairing
    if pairing is None:
        follow = ("outlier", "The noise you gave")  # from these rows, or the curve
        others = tuple(
            text for text in verdict.reasons if not any(x in text for x in follow)
        )
        reason = _hidden_outliers(fit) or (None if others else bends(fit))
        if reason is None:
            return verdict
        return dataclasses.replace(
            verdict, good=False, reasons=(reason.fact, *others), next_step=reason.remedy
        )
    what = "columns" if pairing.kind == "columns" else "table"
    step = f"correct the {what}, then identify again"
    if not pairing.mendable:
        step = "identify each session by itself"
        if pairing.kind == "offset":
            step = f"take the offset off the readings of one session, or {step}"
    if pairing.alternatives:
        step = f"find out which it is, {step}"
    elif pairing.mendable and pairing.kind != "columns":
        step += " (jaxcal identify --repair FILE writes the corrected table)"
    reasons = (pairing.reason, *verdict.reasons)
    return dataclasses.replace(verdict, good=False, reasons=reasons, next_step=step)


def _hidden_outliers(fit: Fit) -> Reason | None:
    """Rows that a fit of the others leaves far off, and least squares does not.

    Where several are off, least squares meets them halfway: its noise grows until none
    of them is an outlier. A model of which nothing is known before is asked, where
    drift and curves explain the rows no better.
    """
    few = fit.residuals.size < _READINGS * fit.free.sum()
    if len(fit.commands) < LEAST or few or not _uneven(fit):
        return None
    table = of_fit(fit)
    if table is None or table.precision[table.free].any():
        return None
    plain, stated = fitted(table, as_it_is(table)), np.asarray(fit.noise_std)
    rows = np.flatnonzero(~plain.inside & table.counted)
    if not len(rows) or {*rows} == {*fit.outliers} or not better(plain, plain):
        return None
    spread = (table.measured / table.scale)[plain.inside].std(axis=0)
    if (plain.noise > 0.5 * spread)[plain.rms > RATIO * plain.noise].any():
        return None  # the others are not explained: a search on a plateau
    if fit.noise_known and (plain.noise * table.scale > RATIO * stated).any():
        return None  # what was stated is too small for the others too
    readings = (table.measured / table.scale)[rows]
    away = np.abs(readings - predicted(table, plain)[rows]) / plain.noise
    least = float(away.max(axis=1).min())
    benign = max(other.evidence for other in benign_fits(table, plain, plain))
    if least < _OFF or benign > plain.evidence:
        return None
    named = in_rows([*map(int, rows)])
    verb = "are outliers" if len(rows) > 1 else "is an outlier"
    noise = f"{in_words(plain.noise * table.scale)} {fit.measured_unit}".strip()
    return Reason(
        f"{named.capitalize()} {verb}, over {least:.2g} times the noise of the "
        f"others, which is {noise} without them.",
        f"repeat {named} (counted from 0), or leave out",
    )


def _uneven(fit: Fit) -> bool:
    """Whether least absolute residuals would leave rows far off.

    To first order, by a few rounds of least squares whose weights fall with distance.
    """
    from scipy.linalg.lapack import dposv

    noise = fit.noise_std
    if noise is None or not noise.all() or fit.prior_precision.any():
        return False
    # Few rows of very many hide in no noise.
    sample = slice(None, None, max(len(fit.commands) // _SAMPLE, 1))
    slopes = fit.linear(fit.commands[sample], misfit=False)[0] / noise[:, None]
    shape = fit.residuals[sample].shape
    first = off = (fit.residuals[sample] / noise).ravel()
    flat = slopes.reshape(len(first), -1)
    flat = flat / ((flat**2).sum(axis=0) ** 0.5 + 1e-300)
    for _ in range(_TURNS):
        away = (off.reshape(shape) ** 2).sum(axis=1) ** 0.5
        weighted = flat.T * (1.0 / (away + _FLOOR)).repeat(shape[1])
        step, undetermined = dposv(weighted @ flat, weighted @ first)[1:]
        if undetermined:
            return False
        off = first - flat @ step
    away = (off.reshape(shape) ** 2).sum(axis=1) ** 0.5
    return bool(away.max() > _OFF * np.median(away))


def sentence(
    table: Table,
    fit: Fitted,
    near: dict[int, list[int]],
    outputs: Sequence[str],
    unit: str,
) -> str:
    noise = f"{in_words(fit.noise * table.scale)} {unit}".strip()
    joined = fit.hypothesis.extra is not None
    without = "with each apart" if joined else "without that"
    text = what_is_wrong(table, fit, near, outputs, unit)
    return f"{text}; {without} the noise is {noise}"


def what_is_wrong(
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
            "the halves of the readings are exchanged: the readings from row "
            f"{-starts[0][1] % count} on belong to the first commands"
        )
    if kind == "rotation" and abs(starts[0][1]) <= count // 3:
        last, far = "first" if starts[0][1] > 0 else "last", abs(starts[0][1])
        these = f"{last} {far} are" if far > 1 else f"{last} is"
        return (
            f"all readings are {_rows_late(starts[0][1])}; the {these} at the other end"
        )
    if kind == "rotation":
        return (
            f"the readings from row {-starts[0][1] % count} on belong to the first "
            "commands, the readings before it to the last"
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
            where += f" (or any from {rows[0]} to {rows[-1]})"
        if by == FOREIGN:
            parts.append(f"{where}, readings do not belong to these commands")
        else:
            parts.append(f"{where}, readings are {_rows_late(by)}")
    return "; ".join(parts)
