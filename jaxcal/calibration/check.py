"""Is a machine still as it was calibrated: a few new readings, what they can tell."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration.fit import Fit
from jaxcal.checks import numbers, table, whole_number
from jaxcal.information.blocks import without
from jaxcal.models import SerialChain

__all__ = ["Check", "check", "verification"]

Array = NDArray[np.float64]

_POWER = 0.8
_SWEEPS = 20  # of swaps, at most


@dataclasses.dataclass(frozen=True)
class Check:
    """Printed, a sentence."""

    says: str  # "holds", "does not hold" or "cannot be told"
    p_value: float  # of readings at least this far off while it holds
    power: float  # of a change of one parameter by ``tolerance``, mean of them all
    drift: dict[str, float]  # smallest change of each parameter seen with power 0.8
    unseen: tuple[str, ...]  # parameters whose drift by ``tolerance`` could hide
    tolerance: float  # root mean square of the outputs' change that matters

    def __str__(self) -> str:
        text = (
            f"the calibration {self.says}"
            if self.says != "cannot be told"
            else ("whether the calibration holds cannot be told")
        )
        text += (
            f" (p = {self.p_value:.3g}, false alarms 5 %); a change by "
            f"{self.tolerance:.3g} is seen with {self.power:.0%} on average"
        )
        if self.says == "cannot be told":
            text += f", and could hide in {', '.join(self.unseen)}"
        return text


def check(
    calibration: Fit,
    commands: ArrayLike,
    measured: ArrayLike,
    *,
    tolerance: float | None = None,
    placed_anew: bool = False,
) -> Check:
    """Does the calibration still hold, by a few new measurements.

    A chi-square test (F where the noise was estimated) of the readings against the
    predictions, with the uncertainty of both, at 5 % false alarms.

    Args:
        calibration: what is checked.
        commands: (N, n).
        measured: (N, m) readings there.
        tolerance: how far, root mean square over the calibration's commands, the
            outputs may drift; three times the noise when not given.
        placed_anew: of an arm, what its sensor reads (sockets, planes, anchors) stands
            elsewhere than at the calibration.

    Returns:
        "holds", "does not hold", or "cannot be told": a drift of one parameter by more
        than the tolerance would be seen with less than 80 % probability.
    """
    from scipy import special

    commands, measured = table("commands", commands), table("measured", measured)
    if len(commands) != len(measured) or not len(commands):
        raise ValueError(
            "commands and measured must have as many rows, at least one, got "
            f"{len(commands)} and {len(measured)}"
        )
    noise = calibration.noise_std
    if noise is None:
        raise ValueError("no check: the noise of the calibration is not known")
    model, theta = calibration.model, calibration.parameters
    slopes = np.asarray(model.jacobian(commands, theta))
    p, q = slopes.shape[-1], slopes.shape[1]
    if measured.shape[1] != q:
        raise ValueError(f"measured must have {q} columns, got {measured.shape[1]}")
    off = (measured - calibration.predict(commands)).ravel()
    rows = slopes.reshape(-1, p)
    known, covariance = calibration.linear(commands)
    known = known.reshape(len(rows), -1)
    whole = np.diag(np.tile(noise**2, len(commands))) + known @ covariance @ known.T
    root = np.linalg.inv(np.linalg.cholesky(whole))
    white, by = root @ off, root @ rows
    names = calibration.names
    own = np.zeros(p, dtype=np.bool_)
    if placed_anew:
        if not (isinstance(model, SerialChain) and len(model.sensor.names)):
            raise ValueError("placed_anew is of an arm whose sensor stands somewhere")
        own[:] = np.isin(names, model.sensor.names)
    if own.any():  # what stands elsewhere now says nothing
        white, by = without(by[:, own], white, by)
    freedom = len(white)
    if not freedom:
        raise ValueError("measured leaves no reading beside what was placed anew")
    square = float(white @ white)
    if calibration.noise_known:
        p_value = float(special.chdtrc(freedom, square))
    else:
        p_value = float(special.fdtrc(freedom, calibration.noise_dof, square / freedom))
    limit = float(special.chdtri(freedom, 0.05))
    needed = _noncentrality(freedom, limit)
    free = (calibration.free[:p] > 0.0) & ~own
    seen = np.sqrt((by**2).sum(axis=0))
    size = np.sqrt(needed) / np.where(seen > 0.0, seen, np.nan)
    matters = _tolerance(tolerance, noise)
    used = np.asarray(model.jacobian(calibration.commands, theta))
    per_unit = np.sqrt((used**2).mean(axis=(0, 1)) * q)
    moved = np.where(np.isnan(size), np.inf, np.nan_to_num(size)) * per_unit
    judged = free & (per_unit > 0.0)
    hidden = judged & (moved > matters)
    power = _mean_power(freedom, (matters * seen[judged] / per_unit[judged]) ** 2)
    if p_value < 0.05:
        says = "does not hold"
    else:
        says = "cannot be told" if hidden.any() else "holds"
    return Check(
        says=says,
        p_value=p_value,
        power=float(power),
        drift={
            name: float(value) if np.isfinite(value) else np.inf
            for name, value, is_free in zip(names, size, free, strict=True)
            if is_free
        },
        unseen=tuple(name for name, lost in zip(names, hidden, strict=True) if lost),
        tolerance=matters,
    )


def _tolerance(given: float | None, noise: Array) -> float:
    matters = float(3.0 * np.sqrt(np.mean(noise**2))) if given is None else given
    if not numbers("tolerance", matters) > 0.0:
        raise ValueError(f"tolerance must be positive, got {given}")
    return matters


def _mean_power(freedom: int, shifts: Array) -> Array:
    """(...,) of changes with noncentralities (..., p), at 5 % false alarms."""
    from scipy import special

    missed = special.chndtr(special.chdtri(freedom, 0.05), freedom, shifts)
    seen = 1.0 - np.nan_to_num(missed, nan=0.0)  # NaN where far too large
    return np.asarray(seen.mean(axis=-1))


def _noncentrality(freedom: int, limit: float) -> float:
    """Of a chi-square that exceeds ``limit`` with the power that is asked for."""
    from scipy import optimize, special

    return float(
        optimize.brentq(
            lambda size: 1.0 - special.chndtr(limit, freedom, size) - _POWER, 1e-3, 1e4
        )
    )


def verification(
    calibration: Fit,
    candidates: ArrayLike,
    k: int,
    *,
    region: ArrayLike | None = None,
    tolerance: float | None = None,
) -> NDArray[np.int64]:
    """The k of the candidates that show best that the calibration is wrong.

    Greedy, then swaps, for the mean power of the check that follows.

    Args:
        calibration: what is checked.
        candidates: (M, n) commands that could be measured.
        k: three or four see what six random ones see.
        region: (R, n) commands where it is used, which say how much a drift of a
            parameter matters; those of the calibration when not given.
        tolerance: the drift to be seen, as of ``check``.

    Returns:
        (k,) indices.
    """
    points = table("candidates", candidates)
    if not 1 <= whole_number("k", k, 1) <= len(points):
        raise ValueError(f"k must be in [1, {len(points)}], got {k}")
    noise = calibration.noise_std
    if noise is None:
        raise ValueError("no verification: the noise of the calibration is not known")
    model, theta = calibration.model, calibration.parameters
    slopes = np.asarray(model.jacobian(points, theta))
    known, covariance = calibration.linear(points)
    spread = known @ covariance @ np.matrix_transpose(known) + np.diag(noise**2)
    white = np.linalg.inv(np.linalg.cholesky(spread)) @ slopes
    seen = (white**2).sum(axis=1)  # (M, p) by a drift of one
    where = calibration.commands if region is None else table("region", region)
    used = np.asarray(model.jacobian(where, theta))
    q = used.shape[1]
    per_unit = (used**2).mean(axis=(0, 1)) * q
    matters = (calibration.free[: len(theta)] > 0.0) & (per_unit > 0.0)
    by_change = _tolerance(tolerance, noise) ** 2 / per_unit[matters]
    shifts = seen[:, matters] * by_change  # noncentralities of one posture

    def value(rows: list[int]) -> Array:
        """(M,) of the rows and each candidate."""
        return _mean_power(q * (len(rows) + 1), shifts[rows].sum(axis=0) + shifts)

    chosen: list[int] = []
    for _ in range(k):
        gains = value(chosen)
        gains[chosen] = -np.inf
        chosen.append(int(gains.argmax()))
    for _ in range(_SWEEPS):
        before = list(chosen)
        for at in range(k):
            rest = chosen[:at] + chosen[at + 1 :]
            gains = value(rest)
            gains[rest] = -np.inf
            if gains.max() > gains[chosen[at]] + 1e-12:
                chosen[at] = int(gains.argmax())
        if chosen == before:
            break
    return np.array(chosen)
