"""The uncertainty budget of a calibration, as the GUM asks for it.

Contributions to the standard uncertainty of every parameter, or of every predicted
output: the noise of the readings, what was known before (the prior), what the model
cannot follow (misfit), and sources that the user states, such as the zero of the
machine and the certificate of the reference instrument. Source: JCGM 100:2008, 5.1
(combination), G.4 (Welch-Satterthwaite) and G.6 (expanded uncertainty).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from jaxcal.calibration.fit import (
    Fit,
    as_points,
    linearised,
    noise_of,
    outputs_at,
    quantile,
    to_parameters,
    unseen_directions,
)
from jaxcal.calibration.of_readings import by_readings, inverse
from jaxcal.checks import Array, aligned, one_or_each
from jaxcal.information.singular import depends

_READING = "noise of the reading"


@dataclasses.dataclass(frozen=True)
class Source:
    """A cause of error that all readings share, which their scatter does not show.

    Type B. Errors of the outputs are taken as independent of one another.

    Args:
        name: in the budget, such as "laser tracker, certificate 1234".
        offset: () or (m,) standard uncertainty of an offset of every reading, in the
            measured unit: a zero, or U / k of a certificate.
        scale: () or (m,) relative standard uncertainty of the scale of the readings.
        dof: degrees of freedom of these; infinite where they are taken as known.
    """

    name: str
    offset: ArrayLike = 0.0
    scale: ArrayLike = 0.0
    dof: float = np.inf

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"name must be text, got {self.name!r}")
        sizes = [np.asarray(self.offset, float), np.asarray(self.scale, float)]
        if any(not np.isfinite(size).all() or (size < 0.0).any() for size in sizes):
            raise ValueError(
                f"offset and scale of {self.name} must be 0 or more, got "
                f"{self.offset} and {self.scale}"
            )
        if not any(size.any() for size in sizes):
            raise ValueError(f"{self.name} needs an offset or a scale, both are 0")
        if not self.dof > 0.0:
            raise ValueError(f"dof of {self.name} must be positive, got {self.dof}")


@dataclasses.dataclass(frozen=True)
class Budget:
    """Contributions to R results from S sources; printed, a table."""

    names: tuple[str, ...]  # R: parameters, or outputs at commands
    values: Array  # (R,)
    sources: tuple[str, ...]  # S
    source_dof: Array  # (S,) degrees of freedom; inf where taken as known
    contributions: Array  # (R, S) standard uncertainties
    confidence: float  # of the expanded uncertainty
    unit: str  # of the values where they share one, else ""

    @property
    def combined(self) -> Array:
        """(R,) combined standard uncertainty."""
        return np.sqrt((self.contributions**2).sum(axis=1))

    @property
    def dof(self) -> Array:
        """(R,) effective degrees of freedom by Welch and Satterthwaite."""
        parts, dof = self.contributions, self.source_dof
        if _READING in self.sources:  # of one estimate with the first, which is noise
            last = self.sources.index(_READING)
            parts, dof = np.delete(parts, last, axis=1), np.delete(dof, last)
            parts[:, 0] = np.hypot(parts[:, 0], self.contributions[:, last])
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = parts**4 / dof
            dofs = self.combined**4 / terms.sum(axis=1)
        return np.where(np.isnan(dofs), np.inf, dofs)

    @property
    def coverage_factor(self) -> Array:
        """(R,) Student's t of the effective degrees of freedom."""
        upper, dof = 0.5 + 0.5 * self.confidence, self.dof
        known = np.isinf(dof)
        factor = special.stdtrit(np.where(known, 1.0, dof), upper)
        return np.where(known, special.ndtri(upper), factor)

    @property
    def expanded(self) -> Array:
        """(R,) half-width of the interval of ``confidence``: k times combined."""
        return self.coverage_factor * self.combined

    def rows(self) -> list[list[str]]:
        """Cells of the table, its head first."""
        head = ["", "value", f"U ({self.confidence:.3g})"]
        head += [*self.sources, "combined", "dof", "k"]
        dof = np.where(self.dof > 1e6, np.inf, self.dof)
        columns = self.expanded, self.contributions, self.combined, dof
        numbers = np.column_stack([*columns, self.coverage_factor])
        rows = zip(self.names, self.values, numbers, strict=True)
        return [head] + [
            [name, f"{value:.6g}", *(f"{x:.3g}" for x in row)]
            for name, value, row in rows
        ]

    def __str__(self) -> str:
        unit = f", {self.unit}" if self.unit else ""
        title = f"Uncertainty budget: standard uncertainties{unit}"
        return "\n".join([title, *(f"  {line}" for line in aligned(self.rows()))])

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; infinite ones are None."""
        return {
            "confidence": self.confidence,
            "unit": self.unit,
            "sources": by_row(name=self.sources, dof=or_none(self.source_dof)),
            "results": by_row(
                name=self.names,
                value=self.values.tolist(),
                contributions=[or_none(parts) for parts in self.contributions],
                combined=or_none(self.combined),
                dof=or_none(self.dof),
                coverage_factor=self.coverage_factor.tolist(),
                expanded=or_none(self.expanded),
            ),
        }


def or_none(values: Array) -> list[float | None]:
    """Numbers that JSON can hold, None for those that are not finite."""
    return [float(value) if np.isfinite(value) else None for value in values]


def by_row(**columns: Sequence[Any]) -> list[dict[str, Any]]:
    """An object for each row of columns, as JSON has tables."""
    rows = zip(*columns.values(), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def budget(
    calibration: Fit,
    commands: ArrayLike | None = None,
    *,
    readings: ArrayLike | None = None,
    repeats: int = 1,
    sources: Sequence[Source] = (),
    confidence: float = 0.95,
) -> Budget:
    """The uncertainty budget of the parameters, of outputs, or of commands.

    Without ``sources`` the combined uncertainty is that of ``standard_errors`` and of
    ``predict_std``. A source reaches a result as the fit lets it: an offset of the
    readings moves b of an affine model by itself, and A not at all.

    Args:
        calibration: with a known or an estimated noise.
        commands: (N, n), of which the true outputs are predicted; the parameters when
            not given.
        readings: (P, m) instead, of which the commands are found, and ``repeats``, as
            of ``Calibration.inverse``. A source moves them as it moved the readings of
            the calibration, so an offset that both share cancels.
        sources: what the scatter of the readings does not show: zero, certificate.
        confidence: of the expanded uncertainty, in (0, 1).
    """
    noise_of(calibration, "uncertainty budget")
    quantile(calibration, confidence)  # must be in (0, 1)
    if wrong := [one for one in sources if not isinstance(one, Source)]:
        raise ValueError(
            f"sources must hold jaxcal.calibration.Source, got {wrong[0]!r}"
        )
    if readings is None:
        results = _results(calibration, commands)
    elif commands is None:
        results = _of_readings(calibration, readings, repeats)
    else:
        raise ValueError("budget takes commands or readings, not both")
    slopes, parts = results.slopes, _parts(calibration, results.slopes)
    if results.turn is not None:
        noise = noise_of(calibration, "budget") ** 2 / repeats
        parts[_READING] = results.turn**2 @ noise, calibration.noise_dof or np.inf
    gain = _gain(calibration, slopes.shape[-1]) if sources else None
    for source in sources:
        if source.name in parts:
            raise ValueError(f"sources must have different names: {source.name!r}")
        parts[source.name] = _squares(calibration, source, results, gain), source.dof
    contributions = np.sqrt(np.stack([square for square, _ in parts.values()], 1))
    finite = np.where(np.isfinite(contributions), contributions, 0.0)
    least = 1e-9 * finite.max(axis=1, keepdims=True)  # below is rounding
    return Budget(
        names=results.names,
        values=np.asarray(results.values),
        sources=tuple(parts),
        source_dof=np.array([float(dof) for _, dof in parts.values()]),
        contributions=np.where(contributions > least, contributions, 0.0),
        confidence=float(confidence),
        unit=results.unit,
    )


class _Results(NamedTuple):
    """What a budget is of: the parameters, outputs, or commands."""

    names: tuple[str, ...]  # R
    values: Array  # (R,)
    unit: str
    slopes: Array  # (R, P) by all parameters, as joint_covariance has them
    turn: Array | None = None  # (R, m) by the readings that commands answer
    readings: Array | None = None  # (R, m)


def _results(calibration: Fit, commands: ArrayLike | None) -> _Results:
    if commands is None:
        p = len(calibration.names)
        slopes = np.eye(p, len(np.asarray(calibration.joint_covariance)))
        slopes[:, :p] = to_parameters(calibration)
        return _Results(calibration.names, calibration.parameters, "", slopes)
    points = as_points(calibration, "commands", commands, calibration.num_inputs)
    points = points.reshape(-1, calibration.num_inputs)
    slopes = linearised(calibration, points)[0]
    outputs = calibration.output_names
    return _Results(
        tuple(f"{output} at row {i}" for i in range(len(points)) for output in outputs),
        outputs_at(calibration, points).ravel(),
        calibration.measured_unit,
        slopes.reshape(-1, slopes.shape[-1]),
    )


def _of_readings(calibration: Fit, readings: ArrayLike, repeats: int) -> _Results:
    """The commands of readings (P, m): P n results."""
    answer = inverse(calibration, readings, repeats)
    n, m = calibration.num_inputs, calibration.num_outputs
    commands, names = answer.commands.reshape(-1, n), calibration.input_names
    turn = by_readings(calibration, commands)
    slopes = -turn @ linearised(calibration, commands)[0]
    return _Results(
        tuple(f"{name} of reading {i}" for i in range(len(commands)) for name in names),
        commands.ravel(),
        calibration.command_unit,
        slopes.reshape(-1, slopes.shape[-1]),
        turn.reshape(-1, m),
        np.asarray(readings, float).reshape(-1, m).repeat(n, axis=0),
    )


def _parts(calibration: Fit, slopes: Array) -> dict[str, tuple[Array, float]]:
    """Variances (R,) of the results, and their degrees of freedom, by what the fit has:
    noise, what was known before, misfit."""
    p, width = len(calibration.names), slopes.shape[-1]
    covariance = np.asarray(calibration.joint_covariance)[:width, :width]
    prior = (calibration.prior_precision * (calibration.free > 0.0))[:width]
    by = slopes @ covariance
    total = np.maximum((by * slopes).sum(axis=1), 0.0)
    before, misfit = (by[:, :p] ** 2) @ prior[:p], (by[:, p:] ** 2) @ prior[p:]
    # Sizes of the errors that are estimates widen what was known before.
    share = total / np.maximum(before + misfit, np.maximum(total, 1e-300))
    before, misfit = share * before, share * misfit
    noise = np.maximum(total - before - misfit, 0.0)
    if calibration.unidentified is not None:
        undetermined = depends(slopes, unseen_directions(calibration)[:, :width])
        noise = np.where(undetermined, np.inf, noise)
    parts = {"noise": (noise, calibration.noise_dof or np.inf)}
    others = {"known before": before, "misfit": misfit}
    return parts | {name: (part, np.inf) for name, part in others.items() if part.any()}


def _gain(calibration: Fit, width: int) -> Array:
    """(P, N, m) how far the parameters move with each reading, to first order."""
    estimated = calibration.estimated_commands
    at = calibration.commands if estimated is None else estimated
    free = calibration.free[:width] > 0.0
    slopes = linearised(calibration, at)[0][..., :width] * free
    variance = np.maximum(noise_of(calibration, "budget") ** 2, 1e-300)
    root = np.sqrt(calibration.loss_weights[:, None] / variance)
    rows = (slopes * root[..., None]).reshape(-1, width)
    prior_root = np.sqrt(calibration.prior_precision[:width] * free)
    whole = np.concatenate([rows, np.diag(prior_root)])
    size = np.sqrt((whole**2).sum(axis=0))
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(whole / size)[:, : len(rows)] / size[:, None]
    return np.asarray(inverse.reshape(width, *root.shape) * root)


def _squares(calibration: Fit, source: Source, results: _Results, gain: Any) -> Array:
    """(R,) variances of the results by one source."""
    m, measured = calibration.num_outputs, calibration.measured
    moved = np.zeros(len(results.slopes))
    shapes: dict[str, Any] = {"offset": (np.ones_like(measured), 1.0)}
    shapes["scale"] = measured, results.readings
    for name, (shape, scaled) in shapes.items():
        size = one_or_each(f"{name} of {source.name}", getattr(source, name), m)
        # Of each output by itself: (R, m).
        moves = results.slopes @ np.einsum("pnm,nm->pm", gain, shape * size)
        if results.turn is not None:
            moves = moves + results.turn * size * scaled
        moved = moved + (moves**2).sum(axis=1)
    return moved
