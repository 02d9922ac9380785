"""What readings themselves speak against, and the words of all reasons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxcal.calibration.resolution import resolution
from jaxcal.checks import Array, Mask

if TYPE_CHECKING:
    from jaxcal.calibration.fit import Fit

_FROZEN = 3  # readings after the first that repeat it
_STEPS = 20.0  # of a sensor between readings: with fewer, some repeat by chance
_EXACT = 1e-12  # of the largest reading: rounding, and no noise of a sensor
_UNITS = np.outer([1.0, -1.0], [1.0, np.pi / 180.0, 180.0 / np.pi, 1e3, 1e-3]).ravel()
_NAMED, _DIGITS = 6, 7  # rows in one sentence; decimals of a table
_ENDS, _END_SHARE = 4, 0.15  # rows at the end of a sensor's range, at least
_TWICE = 1.1  # rows of a value within it, in the mean, at most
_FLAT = 0.05  # of the readings: a fit that moves less there is flat itself


class Reason(NamedTuple):
    """What speaks against a calibration, and what to do about it."""

    fact: str
    remedy: str


def each(values: Array) -> str:
    """Numbers with a comma between, those that are alike once."""
    return ", ".join(dict.fromkeys(short(value) for value in values))


def short(value: float) -> str:
    """A number of two digits, without an exponent below a million."""
    return f"{float(f'{value:.2g}'):g}"


def in_rows(rows: Sequence[int]) -> str:
    """``rows 3, 14``, the first few of many."""
    named = ", ".join(map(str, rows[:_NAMED]))
    more = f" and {len(rows) - _NAMED} more" if len(rows) > _NAMED else ""
    return f"row{'s' * (len(rows) > 1)} {named}{more}"


# -- readings that were not measured ---------------------------------------------------


def never_measured(fit: Fit) -> Reason | None:
    """Commands pasted as readings, or readings that never change."""
    return _equals_command(fit) or _stands_still(fit) or froze(fit)


def _equals_command(fit: Fit) -> Reason | None:
    commands, readings = fit.commands, fit.measured
    if len(commands) < 3 or not (varies := np.ptp(commands, axis=0) > 0.0).any():
        return None
    few = commands[:_NAMED, None, :, None] * _UNITS  # (K, 1, n, units), then all
    size = 0.1 * np.abs(few).max(axis=0)
    near = np.abs(readings[:_NAMED, :, None, None] - few).max(axis=0) <= size
    for output, command, unit in np.argwhere(near & varies[:, None]):
        times, reading = _UNITS[unit], readings[:, output]
        image = times * commands[:, command]
        same = 1e-9 * np.abs(image).max()
        images = (image, *(image.round(digits) for digits in range(_DIGITS)))
        if any(np.abs(reading - image).max() <= same for image in images):
            how = "" if times == 1.0 else f" times {short(times)}"
            return Reason(
                f"{fit.output_names[output]} equals the command "
                f"{fit.input_names[command]}{how} in every row: not measured.",
                "put the sensor's readings into that column",
            )
    return None


def _stands_still(fit: Fit) -> Reason | None:
    readings = fit.measured
    size = np.abs(readings).max(axis=0)
    still = (np.abs(readings - readings[0]) <= 1e-14 * size).all(axis=0)
    if len(readings) < 3 or not still.any():
        return None
    slopes = fit.model.jacobian(fit.commands, fit.parameters)
    still &= np.ptp(slopes, axis=0).any(axis=-1)  # not by a constant alone
    if not still.any():
        return None
    return Reason(
        f"{', '.join(np.array(fit.output_names)[still])}: the reading never "
        f"changes: {each(readings[0, still])} in all {len(readings)} rows.",
        "check that the sensor is connected, recorded and mounted on the moving part",
    )


def froze(fit: Fit) -> Reason | None:
    """A reading that repeats over rows of other commands, and nowhere else."""
    readings = fit.measured
    least = _EXACT * np.abs(readings).max(axis=0)
    repeats = abs(readings[1:] - readings[:-1]) <= least
    if not repeats.any():
        return None
    moves = (fit.commands[1:] != fit.commands[:-1]).any(axis=1)
    repeats &= moves[:, None]
    counts = repeats.sum(axis=0)
    for j in ((counts >= _FROZEN) & (counts < len(moves))).nonzero()[0]:
        (same,) = repeats[:, j].nonzero()
        said = (readings - fit.residuals)[same, j]
        if readings[same[0], j] == 0.0 and not fit.model.linear:
            continue  # contacts, beside readings of another kind
        if np.ptp(same) >= len(same) or np.ptp(said) <= 1e3 * least[j]:
            continue  # not one run of rows; a machine that gives way there
        if not _coarse(readings[:, j]):
            return Reason(
                f"{fit.output_names[j]} reads {short(readings[same[0], j])} in every "
                f"row from {same[0]} to {same[-1] + 1}, and no other repeats: the "
                "sensor froze.",
                "measure these rows (counted from 0) again, or leave them out",
            )
    return None


def _coarse(readings: Array) -> bool:
    """Whether readings (N,) are so few steps of a sensor apart that some repeat."""
    readings = (readings / np.abs(readings).max()).round(12)
    levels = np.unique(readings)
    step = float(np.diff(levels).min(initial=np.inf))
    counts = (levels - levels[0]) / step
    whole = np.abs(counts - counts.round()).max() < 1e-3
    return bool(whole and np.median(np.abs(np.diff(readings))) < _STEPS * step)


def computed(fit: Fit) -> Reason | None:
    """Readings that a formula made: their residuals are rounding, and they have more
    digits than a sensor."""
    size = np.abs(fit.measured).max(axis=0)
    exact = np.abs(fit.residuals).max(axis=0) <= _EXACT * size
    if fit.dof < 0.5 or not exact.all() or not size.any():
        return None
    if resolution(fit.measured)[size > 0.0].all():
        return None
    return Reason(
        "The fit is exact to the last digit: these readings are computed.",
        "use readings of the machine",
    )


def saturated(fit: Fit) -> Reason | None:
    """Readings of many rows that are the largest or the least of all, to the last
    digit, while hardly any other value is read twice."""
    readings = fit.measured
    least = max(_ENDS, _END_SHARE * len(readings))
    low, high = readings.min(axis=0), readings.max(axis=0)
    step = 1e-11 * (abs(low) + abs(high))
    at_ends = np.array([readings <= low + step, readings >= high - step])
    counts = at_ends.sum(axis=1)
    for j in (counts.sum(axis=0) > least).nonzero()[0]:
        ends = [i for i in (0, 1) if counts[i][j] > 1]
        rows = np.asarray(at_ends[ends, :, j].any(axis=0))
        inner = np.unique((readings[~rows, j] / step[j]).round(), return_counts=True)[1]
        if rows.sum() < least or len(inner) < 2 or inner.mean() > _TWICE:
            continue
        said = (readings - fit.residuals)[rows, j]
        if np.ptp(said) > _FLAT * (high - low)[j]:  # where the fit moves
            values = np.array([(low, high)[i][j] for i in ends])
            return Reason(
                f"{fit.output_names[j]} reads {each(values)} in {rows.sum()} of "
                f"{len(rows)} rows, its largest or least: the end of the sensor's "
                "range?",
                "leave these rows out, or measure within the sensor's range",
            )
    return None


def in_order(side: Array, share: float) -> Mask:
    """(columns,) whether one never falls, or never rises, and moves at so many rows."""
    way = np.sign(np.diff(side, axis=0))
    moves = np.abs(way).sum(axis=0) >= share * len(side)
    return np.asarray(moves & (np.ptp(way, axis=0) < 2))
