"""What a mispaired table, hidden outliers or a curve do to a verdict."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.calibration.fit import linearised
from jaxcal.calibration.pairing.fit import (
    SESSIONS,
    Table,
    as_it_is,
    benign_fits,
    fitted,
    predicted,
)
from jaxcal.calibration.pairing.judge import (
    LEAST,
    RATIO,
    Mispairing,
    alone,
    better,
    of_fit,
)
from jaxcal.calibration.reasons import Reason, in_rows
from jaxcal.calibration.resolution import COARSE, resolution
from jaxcal.calibration.verdict import Verdict, bends
from jaxcal.checks import in_words

if TYPE_CHECKING:
    from jaxcal.calibration.fit import Fit

_OFF = 6.0  # times the noise of the others
_TURNS, _FLOOR = 4, 0.01  # rounds; noises, below which a row weighs no more
_SAMPLE = 5000  # rows
_READINGS = 3  # for each parameter


def against(verdict: Verdict, fit: Fit, pairing: Mispairing | None) -> Verdict:
    """The verdict of the fit by itself, which no calibration passes of a mispaired
    table, outliers that hide in its noise, or a curve."""
    if pairing is None:
        if verdict.reasons and "froze" in verdict.reasons[0]:
            return verdict
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
    if pairing.kind in SESSIONS:
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
    """Rows that a fit of the others leaves far off, and least squares does not, which
    meets several halfway: its noise grows until none of them is an outlier."""
    if len(fit.commands) < LEAST or not _uneven(fit):
        return None
    if fit.residuals.size < _READINGS * fit.free.sum():
        return None
    table = of_fit(fit)
    if table is None or table.precision[table.free].any():
        return None
    outputs = [*range(table.outputs)]
    several = outputs if table.shared and len(outputs) > 1 else []
    tables = [(table, outputs), *((alone(table, j), [j]) for j in several)]
    return next(filter(None, (_outliers_of(fit, *part) for part in tables)), None)


def _outliers_of(fit: Fit, table: Table, outputs: list[int]) -> Reason | None:
    """Outliers of some outputs that hide in the noise of a fit of their ``table``."""
    plain, stated = fitted(table, as_it_is(table)), np.asarray(fit.noise_std)[outputs]
    rows = np.flatnonzero(~plain.inside & table.counted)
    if {*rows} <= {*fit.outliers} or not better(plain, plain):
        return None
    spread = (table.measured / table.scale)[plain.inside].std(axis=0)
    if (plain.noise > 0.5 * spread)[plain.rms > RATIO * plain.noise].any():
        return None  # the others are not explained: a search on a plateau
    if fit.noise_known and (plain.noise * table.scale > RATIO * stated).any():
        return None  # what was stated is too small for the others too
    readings = (table.measured / table.scale)[rows]
    steps = resolution(fit.measured, COARSE)[outputs]
    noise = np.hypot(plain.noise, steps / table.scale)
    away = np.abs(readings - predicted(plain)[rows]) / noise
    away, benign = away.max(axis=1), benign_fits(table, plain, plain)
    rows = rows[away >= _OFF]
    if not len(rows) or max(x.evidence for x in benign) > plain.evidence:
        return None
    least = float(away[away >= _OFF].min())
    named = in_rows([*map(int, rows)])
    verb = "are outliers" if len(rows) > 1 else "is an outlier"
    others = f"{in_words(noise * table.scale)} {fit.measured_unit}".strip()
    of_one = len(outputs) < len(fit.output_names)
    which = f" of {fit.output_names[outputs[0]]}" if of_one else ""
    return Reason(
        f"{named.capitalize()} {verb}{which}, over {least:.2g} times the noise of the "
        f"others, which is {others} without them.",
        f"repeat {named} (counted from 0), or leave out",
    )


def _uneven(fit: Fit) -> bool:
    """Whether least absolute residuals would leave rows far off, to first order, by a
    few rounds of least squares whose weights fall with distance."""
    from scipy.linalg.lapack import dposv

    noise = fit.noise_std
    if noise is None or not noise.all() or fit.prior_precision.any():
        return False
    # Few rows of very many hide in no noise.
    sample = slice(None, None, max(len(fit.commands) // _SAMPLE, 1))
    slopes = linearised(fit, fit.commands[sample], misfit=False)[0] / noise[:, None]
    shape = fit.residuals[sample].shape
    first = off = (fit.residuals[sample] / noise).ravel()
    flat = slopes.reshape(len(first), -1)
    flat = flat / ((flat**2).sum(axis=0) ** 0.5 + 1e-300)
    for _ in range(_TURNS):
        weighted = flat.T * (1.0 / (np.abs(off) + _FLOOR))
        step, undetermined = dposv(weighted @ flat, weighted @ first)[1:]
        if undetermined:
            return False
        off = first - flat @ step
    away = np.sort(np.abs(off).reshape(shape), axis=0)
    by = (flat.reshape(*shape, -1) != 0.0).any(axis=0)  # (q, F)
    moved = int((by / by.sum(axis=0).clip(1)).sum(axis=1).max())
    middle = min((shape[0] + moved) // 2, shape[0] - 1)  # they meet as many readings
    return bool((away[-1] > _OFF * away[middle]).any())
