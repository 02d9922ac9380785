"""x from y: the command behind a reading, with its uncertainty.

An interval holds every command at which the reading is no further from the prediction
than the uncertainty of both allows. Of a straight line that is Fieller's (1954); where
the map bends it may have several pieces.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.fit import (
    FAR,
    Fit,
    as_points,
    columns_of,
    linearised,
    noise_of,
    quantile,
    variance_of,
)
from jaxcal.calibration.inverse import Responses, command_for, limits_of
from jaxcal.checks import Array, aligned, numbers, whole_number

_GRID, _HALVINGS = 257, 45


@dataclasses.dataclass(frozen=True, eq=False)
class Inverse:
    """Commands behind P readings; printed, a table."""

    names: tuple[str, ...]  # n inputs
    unit: str  # of the commands, "" where not stated
    commands: Array  # (..., n)
    std: Array  # (..., n) standard uncertainty; inf where the output stands still
    interval: Array  # (..., n, 2) least and greatest command
    # Of each reading the ends (r, 2) of the interval's pieces; where n > 1 none.
    pieces: tuple[Array, ...]
    method: tuple[str, ...]  # (P,) of the interval: "Fieller", "band" or "delta"
    confidence: float

    def __str__(self) -> str:
        unit = f", {self.unit}" if self.unit else ""
        head = ["", "value", "u", f"{self.confidence:.3g} interval", "by"]
        n, rows = len(self.names), []
        flat = zip(
            self.commands.reshape(-1, n), self.std.reshape(-1, n),
            self.interval.reshape(-1, n, 2), strict=True,
        )  # fmt: skip
        for i, (command, std, ends) in enumerate(flat):
            for j, name in enumerate(self.names):
                pieces = self.pieces[i] if n == 1 else ends[j : j + 1]
                words = " or ".join(f"[{low:.6g}, {high:.6g}]" for low, high in pieces)
                cells = f"{command[j]:.6g}", f"{std[j]:.3g}", words, self.method[i]
                rows.append([f"{name} of reading {i}", *cells])
        lines = aligned([head, *rows], "<")
        return "\n".join([f"Commands of readings{unit}", *(f"  {x}" for x in lines)])


def inverse(
    fit: Fit,
    readings: ArrayLike,
    repeats: int = 1,
    *,
    confidence: float = 0.95,
    limits: ArrayLike | None = None,
    start: ArrayLike | None = None,
) -> Inverse:
    """The commands x behind readings y, with u(x) and an interval.

    Args:
        fit: of as many inputs as outputs.
        readings: (..., m) in the measured unit, each the mean of ``repeats`` readings;
            of one output also (...).
        repeats: whole number from 1: the noise of a reading counts 1 / repeats.
        confidence: of the intervals, in (0, 1).
        limits: (n, 2) range of the commands. For a curve by default the measured range,
            extended by a quarter.
        start: (n,) as of ``command_for``, where there are several inputs.

    Returns:
        The command nearest to the measured one with the nearest output. Its interval is
        Fieller's of a line; "band" of a curve, every command whose prediction agrees
        with the reading, in pieces; "delta", symmetric and to first order, of several
        inputs and of a slope that may be zero, where Fieller's is not finite.

    Raises:
        ValueError: the noise is unknown; inputs and outputs differ in number; a reading
            agrees with no command.
    """
    noise = noise_of(fit, "uncertainty of a command")
    n, m = fit.num_inputs, fit.num_outputs
    if n != m:
        raise ValueError(f"inverse needs as many inputs as outputs, got {n} and {m}")
    variance = noise**2 / whole_number("repeats", repeats, 1)
    factor = quantile(fit, confidence)
    given: Any = numbers("readings", columns_of(fit, "readings", readings))
    if m == 1 and (not given.ndim or given.shape[-1] != 1):
        given = given[..., None]
    points = as_points(fit, "readings", given, m)
    flat, shape = points.reshape(-1, m), points.shape[:-1]
    bounds = limits_of(limits, fit.input_names)
    solved: list[tuple[float, Array, str]] = []
    if n > 1:
        commands = command_for(fit, flat, limits, start=start)
    else:
        curve = _Curve(fit, variance, factor, bounds[0], limits is not None)
        solved = [curve.solve(float(reading)) for reading in flat[:, 0]]
        commands = np.array([command for command, _, _ in solved]).reshape(-1, 1)
    std = _first_order(fit, commands, variance)
    half = factor * std
    interval = np.stack([commands - half, commands + half], axis=-1)
    pieces = [ends for _, ends, _ in solved]
    methods = [method for _, _, method in solved] or ["delta"] * len(flat)
    for i, ends in enumerate(pieces):
        if methods[i] == "delta":
            pieces[i] = interval[i]
        else:
            interval[i, 0] = ends.min(), ends.max()
    return Inverse(
        fit.input_names, fit.command_unit, commands.reshape(*shape, n),
        std.reshape(*shape, n), interval.reshape(*shape, n, 2), tuple(pieces),
        tuple(methods), float(confidence),
    )  # fmt: skip


def by_readings(fit: Fit, commands: Array) -> Array:
    """(P, n, m) derivatives of commands (P, n) by the readings they answer; inf where
    an output stands still."""
    responses = Responses(fit)
    slopes = responses.effects(commands) / responses.spread
    with np.errstate(divide="ignore"):
        if fit.num_inputs == 1:
            return np.asarray(1.0 / slopes)
    responses.require_regular(commands)
    return np.asarray(np.linalg.inv(slopes))


def _first_order(fit: Fit, commands: Array, of_readings: Array) -> Array:
    """(P, n) standard uncertainties of commands."""
    turn = by_readings(fit, commands)
    if fit.num_inputs == 1:
        return np.abs(turn[..., 0]) * np.sqrt(variance_of(fit, commands, of_readings))
    Responses(fit).require_determined(commands)
    slopes, covariance = linearised(fit, commands)
    together = slopes @ covariance @ np.matrix_transpose(slopes)
    # What is not of the parameters is independent from output to output.
    single = variance_of(fit, commands, of_readings)
    of_parameters = np.diagonal(together, axis1=1, axis2=2)
    beside = np.maximum(single - of_parameters, 0.0)
    together = together + beside[..., None] * np.eye(fit.num_outputs)
    total = turn @ together @ np.matrix_transpose(turn)
    return np.sqrt(np.diagonal(total, axis1=1, axis2=2))


class _Curve:
    """One output of one input, and how far a reading may be from it."""

    def __init__(
        self, fit: Fit, of_readings: Array, factor: float, bounds: Array, limited: bool
    ) -> None:
        self.fit, self.of_readings, self.factor = fit, of_readings, factor
        self.responses = Responses(fit)
        self.used = fit.commands[fit.loss_weights > 0.0]
        self.low, self.high = bounds
        if fit.affine is None:
            least, most = self.used.min(), self.used.max()
            width = FAR * (most - least)
            if not limited or not np.isfinite(bounds).all():
                self.low = max(self.low, least - width)
                self.high = min(self.high, most + width)
            self.grid = np.linspace(self.low, self.high, _GRID)
            self.there = self.at(self.grid)

    def at(self, commands: Array) -> tuple[Array, Array]:
        """(R,) outputs, and how far readings may be from them; NaN where none is."""
        rows = commands[:, None]
        outputs = self.responses.outputs(rows)[:, 0]
        variance = variance_of(self.fit, rows, self.of_readings)[:, 0]
        return outputs, self.factor * np.sqrt(variance)

    def solve(self, reading: float) -> tuple[float, Array, str]:
        """The command, the ends (r, 2) of its interval's pieces, and by what."""
        if self.fit.affine is not None:
            return self._of_line(reading)
        outputs, allowed = self.there
        grid, off = self.grid, outputs - reading
        at_used = self.responses.outputs(self.used)[:, 0]
        nearest = self.used[np.abs(at_used - reading).argmin(), 0]
        roots = _crossings(grid, off, lambda x: self.at(x)[0] - reading)
        if len(roots):
            command = float(roots[np.abs(roots - nearest).argmin()])
        else:  # past a turn of the curve, or its end
            best = int(np.nanargmin(np.abs(off) / (allowed + 1e-300)))
            around = grid[max(best - 1, 0)], grid[min(best + 1, _GRID - 1)]
            grid = np.union1d(grid, np.linspace(*around, _GRID))
            outputs, allowed = self.at(grid)
            off = outputs - reading
            command = float(grid[np.nanargmin(np.abs(off) / (allowed + 1e-300))])
        order = np.argsort(np.append(grid, roots), kind="stable")
        grid = np.append(grid, roots)[order]
        beyond = np.append(np.abs(off) - allowed, -np.ones(len(roots)))[order]
        beyond = np.where(np.isnan(beyond), np.inf, beyond)

        def beyond_at(commands: Array) -> Array:
            outputs, allowed = self.at(commands)
            return np.abs(outputs - reading) - allowed

        ends = _crossings(grid, beyond, beyond_at)
        inside = beyond <= 0.0
        if not inside.any():
            least, most = np.nanmin(outputs), np.nanmax(outputs)
            name = self.fit.output_names[0]
            raise ValueError(
                f"readings must be those of a command between {self.low:.6g} and "
                f"{self.high:.6g}, where {name} is {least:.6g} to {most:.6g}, got "
                f"{reading:.6g}; give limits"
            )
        ends = np.concatenate([grid[:1][inside[:1]], ends, grid[-1:][inside[-1:]]])
        return command, ends.reshape(-1, 2), "band"

    def _of_line(self, reading: float) -> tuple[float, Array, str]:
        """Fieller's: where a square of the second degree is not positive."""
        middle, spread = self.used.mean(), self.responses.spread[0]
        outputs, allowed = self.at(middle + spread * np.array([-1.0, 0.0, 1.0]))
        slope, square = 0.5 * (outputs[2] - outputs[0]), allowed**2
        bend = 0.5 * (square[2] + square[0]) - square[1]
        tilt = 0.5 * (square[2] - square[0])
        off, name = reading - outputs[1], self.fit.output_names[0]
        if slope == 0.0:
            raise ValueError(
                f"inverse needs {name} to depend on the command: the slope is 0"
            )
        command = float(middle + spread * off / slope)
        # (off - slope z)^2 <= square + tilt z + bend z^2.
        a, half, c = slope**2 - bend, off * slope + 0.5 * tilt, off**2 - square[1]
        if not a > 0.0 or not np.isfinite(square).all():
            return command, np.zeros((0, 2)), "delta"
        root = np.sqrt(max(half**2 - a * c, 0.0))
        ends = middle + spread * np.array([[half - root, half + root]]) / a
        return command, np.clip(ends, self.low, self.high), "Fieller"


def _crossings(grid: Array, values: Array, function: Any) -> Array:
    """Where a function changes its sign between points of the grid, by halving."""
    sign, finite = values <= 0.0, ~np.isnan(values)
    here = np.flatnonzero((sign[1:] != sign[:-1]) & finite[1:] & finite[:-1])
    low, high, first = grid[here], grid[here + 1], sign[here]
    for _ in range(_HALVINGS if len(here) else 0):
        middle = 0.5 * (low + high)
        same = (function(middle) <= 0.0) == first
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)
