"""Test by a few new readings whether a machine is still as it was calibrated."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special
from scipy.linalg import lapack

from jaxcal.calibration.fit import Fit, columns_of, linearised, noise_of, outputs_at
from jaxcal.calibration.pairing import of_new_readings
from jaxcal.checks import Array, Indices, Mask, array_of, by_unit, whole_number
from jaxcal.files import AnyPath
from jaxcal.information.blocks import without
from jaxcal.models.model import Recording, recorded
from jaxcal.tables import say_order

_ALARMS = 0.05  # share of false alarms
_POWER = 0.8
_KNOWN = 1e9  # degrees of freedom of noise that was given
_RATIOS = 16  # quantiles of how far noise that was estimated is off
_HALVINGS = 26  # of a search for the smallest change
_DRIFT = 10.0  # standard deviations of the prior: no parameter drifts by more
_MANY = 1000.0  # rows; advice to measure as many or more is not given
_BLIND = 0.01  # of a parameter's effect, what is left of it where it cannot be seen
_SWEEPS = 20  # of swaps, at most
_UNITS = {  # factors between units that are mistaken for each other
    1000.0: "metres for millimetres",
    0.001: "millimetres for metres",
    180.0 / np.pi: "radians for degrees",
    np.pi / 180.0: "degrees for radians",
}


@dataclasses.dataclass(frozen=True)
class Check:
    """Printed, a sentence."""

    says: str  # "holds", "does not hold" or "cannot be told"
    p_value: float  # of readings at least this far off while it holds
    power: float  # of a change of one parameter by ``tolerance``, mean of them all
    drift: dict[str, float]  # smallest change of each parameter seen with power 0.8
    unseen: tuple[str, ...]  # parameters whose drift by ``tolerance`` could hide
    tolerance: float  # root mean square of the outputs' change that matters
    unit: str = ""  # of the tolerance, where the calibration or its sensor has one
    tolerances: Mapping[str, float] = dataclasses.field(default_factory=dict)  # by unit
    slipped: str = ""  # what alone would explain it, and by how much
    enough: int = 0  # rows like these by which it could be told, about; 0 if not so
    blind: tuple[str, ...] = ()  # parameters that nothing placed anew shows
    mispairing: str = ""  # of the readings that were checked, and how

    @property
    def good(self) -> bool:
        """Whether the calibration holds."""
        return self.says == "holds"

    @property
    def reasons(self) -> tuple[str, ...]:
        """The finding, in a sentence."""
        text = f"the calibration {self.says}"
        if self.says == "cannot be told":
            text = "inconclusive: too few readings"
        tolerances = (self.tolerances or {self.unit: self.tolerance}).items()
        change = " or ".join(f"{size:.3g} {unit}".strip() for unit, size in tolerances)
        text += (
            f" (p = {self.p_value:.3g}, false alarms 5 %); the check would detect a "
            f"change of {change} (power {self.power:.0%})"
        )
        if self.mispairing:
            text += f"; {self.mispairing}"
        elif self.slipped:
            text += f"; a change of {self.slipped} would explain it"
        if self.unseen and not self.good:
            text += f"; a change could be hidden in {', '.join(self.unseen)}"
        if self.blind:
            text += f"; not checked, because parts were moved: {', '.join(self.blind)}"
        return (text,)

    @property
    def next_step(self) -> str:
        """What to do next, in a sentence."""
        if self.good:
            return "keep using it"
        if self.mispairing:
            return "correct the table, or repeat these rows, then check again"
        if self.says == "does not hold":
            return (
                "repeat one of these rows to rule out a wrong reading, then calibrate "
                "again (identify)"
            )
        text = "measure more"
        if self.enough:
            text += f", about {self.enough} rows like these in total"
        return f"{text}: calibration.verification(candidates, k) chooses them"

    def __str__(self) -> str:
        return f"{self.reasons[0]}; next: {self.next_step}"


def check(
    calibration: Fit,
    commands: ArrayLike | Recording | AnyPath,
    measured: ArrayLike | None = None,
    *,
    tolerance: float | Mapping[str, float] | None = None,
    placed_anew: bool = False,
) -> Check:
    """Test by a few new measurements whether the calibration still holds.

    A chi-square test (F where the noise was estimated, one for each level of it) of the
    readings against the predictions, with the uncertainty of both, at 5 % false alarms.
    For an arm half of these go to a test of each joint's zero (Sidak).

    Args:
        calibration: what is checked.
        commands: (N, n), or for an arm a ``Recording`` or its path.
        measured: (N, m) readings; not needed for contacts and recordings with readings.
        tolerance: how far, root mean square over the calibration's commands, the
            outputs may drift: a number in the unit of the first (lengths of a pose), or
            of each unit, {"mm": 0.5, "deg": 0.1}. By default three standard deviations
            of these measurements.
        placed_anew: for an arm: sockets, planes, anchors or the board were moved since
            the calibration. Parameters that cannot be separated from that, such as the
            first joint's zero, are named (``blind``) and not checked.

    Returns:
        "holds", "does not hold", or "cannot be told": a drift of one parameter by the
        tolerance is detected with less than 80 %; ``enough`` says how many rows would.
    """
    all_commands, measured, _ = recorded(calibration.model, commands, measured)
    say_order(all_commands, measured)
    postures = _postures(calibration, "commands", all_commands)
    shape, rule = (len(postures), calibration.num_outputs), ": as many rows as commands"
    quiet = measured is all_commands
    measured = columns_of(calibration, "measured", measured, quiet=quiet)
    every = postures, array_of("measured", measured, *shape, rule=rule)
    rows = calibration.model.fitting.distinct(*every)
    commands, measured = (side[rows] for side in every)
    off = _deviations(calibration, commands, measured, placed_anew)
    names, free, counts = calibration.names, off.free, off.of_level.sum(axis=1)
    signal = (off.of_level @ off.by**2).T
    slips = free & np.isin(names, calibration.model.fitting.slips) & signal.any(axis=1)
    tests = ChangeTests(counts, calibration, int(slips.sum()), off.least)
    slopes_of_slips = np.linalg.norm(off.by[:, slips], axis=0)
    ways = off.by[:, slips] / slopes_of_slips  # (R, S) unit vectors
    along = ((off.by.T @ ways) ** 2).max(axis=1, initial=0.0)  # seen by the best
    changes_of_slips = off.white @ ways
    p_value, p_slip = tests.p_values(off.of_level @ off.white**2, changes_of_slips**2)
    size = tests.smallest(signal, along)
    tolerances = _tolerances(calibration, commands, tolerance)
    change = _changes(calibration, tolerances)
    judged = free & np.isfinite(change)
    hidden = judged & (size > change)
    squares = change[judged] ** 2
    powers = tests.power(squares[:, None] * signal[judged], squares * along[judged])
    power = powers.mean() if judged.any() else free.any()  # nothing drifts so far
    # What is seen grows with the root of the rows.
    enough = len(commands) * float((size[hidden] / change[hidden]).max(initial=0)) ** 2
    slipped = ""
    if p_slip < _ALARMS:
        most = int(np.abs(changes_of_slips).argmax())
        rest = np.array([off.white @ off.white - changes_of_slips[most] ** 2])
        others = LevelTests(np.array([len(off.white) - 1]), tests.whole.dof)
        if len(off.white) > 1 and others.p_value(rest) >= _ALARMS:
            slip = changes_of_slips[most] / slopes_of_slips[most]
            at = np.flatnonzero(slips)[most]
            fitting = calibration.model.fitting
            unit = fitting.units_for("", calibration.measured_unit)[at]
            slipped = f"{names[at]} by {slip:.2g} {unit}"
    says, mispaired = "holds", None
    if p_value < _ALARMS:
        says = "does not hold"
        mispaired = None if placed_anew else of_new_readings(calibration, *every)
    elif hidden.any() or not free.any():
        says = "cannot be told"
    units = ["" if unit == "length" else unit for unit in tolerances]
    return Check(
        says=says,
        p_value=p_value,
        power=float(power),
        drift={names[i]: float(size[i]) for i in np.flatnonzero(free)},
        unseen=tuple(names[i] for i in np.flatnonzero(hidden)),
        tolerance=next(iter(tolerances.values())),
        unit=units[0],
        tolerances=dict(zip(units, tolerances.values(), strict=True)),
        slipped=slipped,
        enough=int(np.ceil(enough)) if enough < _MANY else 0,
        blind=tuple(names[i] for i in np.flatnonzero(off.blind)),
        mispairing=mispaired.reason if mispaired else "",
    )


@dataclasses.dataclass(frozen=True)
class LevelTests:
    """An F test of whitened readings for each of G levels of noise (chi-square where it
    is known), of which the least p-value counts (Sidak); and their power."""

    counts: NDArray[np.intp]  # (G,) readings of each level
    dof: float  # of the noise of a level
    least: float = 1.0  # mean square of a reading without a change; 1 in the test
    alarms: float = _ALARMS  # share of false alarms

    def p_value(self, squares: Array) -> float:
        """Chance of sums (G,) of squared readings at least this large, unchanged."""
        of_levels = special.fdtrc(self.counts, self.dof, squares / self.counts)
        return float(-np.expm1(len(self.counts) * special.log1p(-of_levels.min())))

    def power(self, shifts: Array) -> Array:
        """(...,) chance that changes with noncentralities (..., G) are seen. The
        squared estimate of a noise over the true variance is a chi-square / dof."""
        alarms = -np.expm1(np.log1p(-self.alarms) / len(self.counts))  # of each level
        limit = special.fdtri(self.counts, self.dof, 1.0 - alarms) / self.least
        ratio = np.ones(1)
        if self.dof < _KNOWN:
            chance = (np.arange(_RATIOS) + 0.5) / _RATIOS
            ratio = special.gammaincinv(self.dof / 2.0, chance) * 2.0 / self.dof
        shifts = np.asarray(shifts) / self.least
        counts, limit = (np.broadcast_to(v, shifts.shape) for v in (self.counts, limit))
        missed = np.full(shifts.shape, 1.0 - alarms)
        moved = (shifts > 0.0) | (self.least != 1.0)
        of_ratios = special.chndtr(
            (limit * counts)[moved, None] * ratio,
            counts[moved, None],
            shifts[moved, None] * ratio,
        )
        missed[moved] = np.nan_to_num(of_ratios, nan=0.0).mean(axis=-1)  # too large
        return np.asarray(1.0 - missed.prod(axis=-1))

    def smallest(self, seen: Array) -> Array:
        """(p,) changes that are seen with the power asked for, inf where none is, by
        noncentralities ``seen`` (p, G) of a change by one."""
        total = seen.sum(axis=1, keepdims=True)
        shares = np.divide(seen, total, out=np.ones_like(seen), where=total > 0.0)
        shares, of_share = np.unique(shares.round(12), axis=0, return_inverse=True)
        low, high = np.zeros((2, len(shares), 1))
        high += 1.0
        while (
            short := (self.power(high * shares) < _POWER)[:, None] & (high < 1e12)
        ).any():
            low, high = np.where(short, high, low), np.where(short, 4.0 * high, high)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            short = (self.power(middle * shares) < _POWER)[:, None]
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        with np.errstate(divide="ignore"):
            return np.asarray(np.sqrt(high[of_share.ravel()] / total)[:, 0])


class ChangeTests:
    """A test of all readings, and one of each slip, the largest of which counts; each
    kind has half of the false alarms."""

    def __init__(
        self, counts: NDArray[np.intp], calibration: Fit, slips: int, least: float = 1.0
    ) -> None:
        half = -np.expm1(np.log1p(-_ALARMS) / 2.0)
        dof, one = calibration.noise_dof or _KNOWN, np.ones(1, dtype=np.intp)
        of_each = -np.expm1(np.log1p(-half) / max(1, slips))
        self.whole = LevelTests(counts, dof, least, half if slips else _ALARMS)
        self.slip = LevelTests(one, dof, least, of_each)
        self.count = slips

    def p_values(self, squares: Array, of_slips: Array) -> tuple[float, float]:
        """Chances of both kinds and of slips alone, by sums (G,), squares (S,)."""
        whole = self.whole.p_value(squares)
        if not self.count:
            return whole, 1.0
        of_one = self.slip.p_value(of_slips.max(keepdims=True))
        of_any = 1.0 - (1.0 - of_one) ** self.count
        return 1.0 - (1.0 - min(whole, of_any)) ** 2, 1.0 - (1.0 - of_any) ** 2

    def power(self, shifts: Array, along: Array) -> Array:
        """(...,) at least, of noncentralities (..., G) in all, (...,) along a slip."""
        whole, slip = self.whole.power(shifts), along[..., None]
        return np.maximum(whole, self.slip.power(slip)) if self.count else whole

    def smallest(self, seen: Array, along: Array) -> Array:
        """(p,) changes that are seen with the power asked for, by either."""
        whole, slip = self.whole.smallest(seen), along[:, None]
        return np.minimum(whole, self.slip.smallest(slip)) if self.count else whole


class _Deviations(NamedTuple):
    """R readings less their predictions, whitened for the uncertainty of both."""

    white: Array  # (R,)
    by: Array  # (R, p) their derivatives by the parameters
    of_level: Mask  # (G, R) which of them have one level of noise
    free: Mask  # (p,) parameters that may have drifted and are judged
    blind: Mask  # (p,) those that what was placed anew takes up
    least: float  # variance, of 1, without the misfit that they allow for


def _deviations(
    calibration: Fit, commands: Array, measured: Array, placed_anew: bool
) -> _Deviations:
    """The deviations of measurements, of which ``check`` has the arguments."""
    noise, model = noise_of(calibration, "check"), calibration.model
    predicted = outputs_at(calibration, commands)
    off = model.fitting.wrapped(measured - predicted, commands)
    _require_unit(calibration, predicted + off, predicted, noise)
    slopes = np.asarray(model.jacobian(commands, calibration.parameters))
    p = slopes.shape[-1]
    root, least = _whitening(calibration, commands, noise)
    white, by = root @ off.ravel(), root @ slopes.reshape(-1, p)
    level = np.tile(_levels(calibration), len(commands))  # of each reading
    free, blind = calibration.free[:p] > 0.0, np.zeros(p, dtype=np.bool_)
    if placed_anew:
        if not model.fitting.placed:
            raise ValueError("placed_anew needs sockets, planes, wires or a board")
        # Of what was placed anew, and of what does only what moving it does, the
        # readings say nothing now.
        placed = np.isin(calibration.names, model.fitting.placed)
        white, by = without(by[:, placed], white, by)
        if not len(white):
            raise ValueError("measured has too few readings to locate the moved parts")
        level, free = np.zeros(len(white), dtype=np.intp), free & ~placed
        slopes = np.asarray(
            model.jacobian(calibration.commands, calibration.parameters)
        )
        was = (slopes / noise[:, None]).reshape(-1, p)
        rest = was - was[:, placed] @ np.linalg.lstsq(was[:, placed], was)[0]
        blind = np.linalg.norm(rest, axis=0) < _BLIND * np.linalg.norm(was, axis=0)
        free, blind = free & ~blind, free & blind
    of_level = level == np.unique(level)[:, None]
    return _Deviations(white, by, of_level, free, blind, least)


def _whitening(calibration: Fit, commands: Array, noise: Array) -> tuple[Array, float]:
    """(N m, N m) what whitens differences from predictions, for noise and their own
    uncertainty; the variance, of 1, without the misfit that they allow for."""
    variances = np.tile(noise**2, len(commands))
    slopes, parameters = linearised(calibration, commands)
    slopes = slopes.reshape(len(variances), -1)
    try:
        factor = np.linalg.cholesky(np.diag(variances) + slopes @ parameters @ slopes.T)
    except np.linalg.LinAlgError:
        raise ValueError(
            "the calibration cannot predict these rows: its uncertainty there is too "
            "large for double precision; see calibration.verdict"
        ) from None
    root = np.asarray(lapack.dtrtri(factor, lower=1)[0])  # rest of factor: zeros
    # Misfit that is allowed for may not be there, and hides a drift all the same.
    slopes, parameters = linearised(calibration, commands, misfit=False)
    by = root @ slopes.reshape(len(variances), -1)
    least = (root**2 @ variances).sum() + ((by @ parameters) * by).sum()
    return root, float(least) / len(root)


def _require_unit(
    calibration: Fit, measured: Array, predicted: Array, noise: Array
) -> None:
    """Refuse readings that fit when they are taken as being in another unit."""
    far = _size(measured - predicted, axis=0) > 10.0 * noise
    if not far.any():
        return
    measured, predicted = measured[:, far], predicted[:, far]
    least = min(0.2 * _size(predicted), 0.05 * _size(measured - predicted))
    for factor, what in _UNITS.items():
        if _size(factor * measured - predicted) < least:
            unit = calibration.measured_unit and f" ({calibration.measured_unit})"
            raise ValueError(
                f"measured must be in the calibration's unit{unit}: "
                f"{', '.join(np.array(calibration.output_names)[far])} fit when "
                f"multiplied by {factor:.6g}. Are they {what}?"
            )


def _size(values: Array, axis: int | None = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(values**2, axis=axis))


def _postures(calibration: Fit, name: str, given: ArrayLike) -> Array:
    """(N, n) commands that the calibration's machine can take."""
    given = columns_of(calibration, name, given)
    rows = array_of(name, given, "N", calibration.num_inputs)
    if not len(rows):
        raise ValueError(f"{name} must hold at least one row, got none")
    calibration.model.fitting.require_commands(rows)
    return rows


def _tolerances(
    calibration: Fit, where: Array, given: float | Mapping[str, float] | None
) -> dict[str, float]:
    """By unit: as given, else three standard deviations of one at ``where`` (R, n)."""
    quantities = calibration.model.quantities(calibration.measured_unit)
    units = tuple(quantity.unit for quantity in quantities)
    if given is not None:
        return by_unit("tolerance", given, units)
    std = calibration.predict_std(where, new_measurement=True)
    std = np.where(np.isfinite(std), std, np.asarray(calibration.noise_std))
    return {q.unit: float(3.0 * _size(q.size(std))) for q in quantities}


def _changes(calibration: Fit, tolerances: Mapping[str, float]) -> Array:
    """(p,) by which of each parameter the readings of one unit at the calibration's
    commands change by its tolerance; inf where the prior lets no machine drift so."""
    model = calibration.model
    slopes = np.asarray(model.jacobian(calibration.commands, calibration.parameters))
    by_parameter = slopes.transpose(0, 2, 1)  # (N, p, q)
    with np.errstate(divide="ignore"):
        changes = [
            tolerances[quantity.unit] / _size(quantity.size(by_parameter), axis=0)
            for quantity in model.quantities(calibration.measured_unit)
            if quantity.unit in tolerances
        ]
        change = np.min(changes, axis=0)
        most = _DRIFT / np.sqrt(calibration.prior_precision[: len(change)])
    return np.where(change > most, np.inf, change)


def _levels(calibration: Fit) -> NDArray[np.intp]:
    """(m,) from 0: outputs of the same number share an estimate of their noise."""
    noise, dof = noise_of(calibration, "check"), calibration.noise_dof
    if not dof or dof >= (1.0 - 1e-9) * calibration.dof:  # given, or one estimate
        return np.zeros(len(noise), dtype=np.intp)
    return np.unique(noise, return_inverse=True)[1]


def verification(
    calibration: Fit,
    candidates: ArrayLike,
    k: int,
    *,
    tolerance: float | Mapping[str, float] | None = None,
) -> Indices:
    """(k,) indices of the candidates that best detect a wrong calibration: greedy, then
    swaps, for the mean power of the check that follows.

    Args:
        calibration: what is checked.
        candidates: (M, n) commands that could be measured.
        k: three or four are as good as six random ones.
        tolerance: the drift to detect, as in ``check``.
    """
    points = _postures(calibration, "candidates", candidates)
    if not 1 <= whole_number("k", k, 1) <= len(points):
        raise ValueError(f"k must be in [1, {len(points)}], got {k}")
    noise = noise_of(calibration, "verification")
    slopes, covariance = linearised(calibration, points)
    spread = slopes @ covariance @ np.matrix_transpose(slopes) + np.diag(noise**2)
    slopes = np.asarray(calibration.model.jacobian(points, calibration.parameters))
    white = np.linalg.inv(np.linalg.cholesky(spread)) @ slopes
    levels = _levels(calibration)
    of_level = (levels == np.unique(levels)[:, None]).astype(np.float64)
    signal = (of_level @ white**2).transpose(0, 2, 1)  # (M, p, G) by a drift of one
    tolerances = _tolerances(calibration, calibration.commands, tolerance)
    change = _changes(calibration, tolerances)
    judged = (calibration.free[: len(change)] > 0.0) & np.isfinite(change)
    shifts = signal[:, judged] * change[judged, None] ** 2  # of one posture
    counts = of_level.sum(axis=1)
    slips = np.isin(calibration.names, calibration.model.fitting.slips)[judged]

    chosen: list[int] = []
    for turn in range(1 + _SWEEPS):
        before = list(chosen)
        for at in range(k):
            rest = chosen[:at] + chosen[at + 1 :]
            shift = shifts[rest].sum(axis=0) + shifts  # of these and each candidate
            tests = ChangeTests(counts * (len(rest) + 1), calibration, int(slips.sum()))
            power = tests.power(shift, slips * shift.sum(axis=-1))
            gains = np.asarray(power.mean(axis=-1))
            gains[rest] = -np.inf
            if not turn:
                chosen.append(int(gains.argmax()))
            elif gains.max() > gains[chosen[at]] + 1e-12:
                chosen[at] = int(gains.argmax())
        if chosen == before:
            break
    return np.array(chosen)
