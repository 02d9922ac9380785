"""The inverse map: commands that reach desired outputs, or why there are none."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.fit import (
    Fit,
    as_points,
    linearised,
    say_far,
    unseen_directions,
    warn,
)
from jaxcal.checks import Array, Mask, array_of, in_words
from jaxcal.information.singular import (
    depends,
    direction_in_words,
    exact_zeros,
    flat,
    significant,
)
from jaxcal.models.identifiability import unknown
from jaxcal.models.model import Rows
from jaxcal.models.predictions import derivative, predict
from jaxcal.tables import limits_of_frame

_NAMED = 3  # targets in a warning
_STARTS, _STEPS, _REACHED = 6, 60, 1e-9  # of the outputs' spread over the measurements
_SURE = 3.0  # standard deviations from zero: a direction that the outputs respond to


def command_for(
    fit: Fit,
    desired: ArrayLike,
    limits: ArrayLike | None = None,
    *,
    start: ArrayLike | None = None,
    clip: bool = False,
) -> Array:
    """Commands (..., n), in their unit, that reach desired outputs.

    A square affine map is inverted; else Newton's method runs from several starts. With
    limits it finds the nearest output.

    Args:
        fit: the calibration.
        desired: (..., m) in the measured unit; m at most n. If m is less than n, the
            command is that which Newton's method finds near the start. For an arm's
            pose: position and turn from the nominal orientation at ``start`` (then
            required), as ``model.rotation_vectors(start, R)``.
        limits: (n, 2) least and greatest command of each input, if any.
        start: (n,) or (..., n) where the search begins; by default the measured command
            with the nearest output.
        clip: if no command within the limits is exact, return that with the nearest
            output instead of an error. Distance is in the measured unit for a square
            affine map, else in each output's spread over the measurements.

    Raises:
        ValueError: a desired output is out of reach, or needs a command beyond its
            limits; an output does not respond there, or depends there on what nothing
            determines; m exceeds n.
    """
    n, m = fit.num_inputs, fit.num_outputs
    points = as_points(fit, "desired", desired, m)
    if not points.size:
        return np.zeros((*points.shape[:-1], n))
    if m > n:
        raise ValueError(
            f"command_for needs at most as many outputs as inputs, got {m} and {n}"
        )
    bounds = limits_of(limits, fit.input_names)
    begin = None
    if start is not None:
        first = as_points(fit, "start", start, n)
        begin = np.broadcast_to(first, (*points.shape[:-1], n)).reshape(-1, n)
    search = _Search(fit, points.reshape(-1, m), begin)
    if search.affine:
        begin = search.solved()
    elif fit.affine is not None:
        search.require_sure(fit.commands.mean(axis=0)[None])
    commands, reached = search.newton(search.nearest[:, 0] if begin is None else begin)
    slack = 1e-9 * search.spread
    low, high = bounds.T
    inside = ((commands >= low - slack) & (commands <= high + slack)).all(axis=1)
    free = commands.copy()
    for i in np.flatnonzero(~(reached & inside)):
        commands[i] = search.bounded(int(i), commands[i], reached[i], bounds, clip)
    commands = np.clip(commands, low, high)
    if clip:
        search.say_clipped(free, commands)
    search.say_far(commands)
    if not (clip or search.affine):
        search.require_regular(commands)
    search.require_determined(commands)
    return commands.reshape(*points.shape[:-1], n)


def no_inverse(fit: Fit) -> str:
    """Why ``command_for`` refuses whatever is desired; "" where it may find a command.
    Of a linear model with as many inputs as outputs or more; others are not asked."""
    if fit.num_outputs > fit.num_inputs or not fit.model.linear:
        return ""
    responses, of_map = Responses(fit), fit.affine is not None
    plain = of_map and fit.unidentified is None
    if plain and _sureness(fit, responses.spread)[0] >= _SURE:
        return ""
    require = responses.require_sure if of_map else responses.require_regular
    refusal = ""
    for command in fit.commands.mean(axis=0)[None] if of_map else fit.commands:
        try:
            require(command[None])
            responses.require_determined(command[None])
            return ""
        except ValueError as error:
            refusal = refusal or str(error)
    return refusal


def limits_of(limits: ArrayLike | None, names: tuple[str, ...]) -> Array:
    """(n, 2), least below greatest, with at least one finite command between them."""
    if limits is None:
        return np.tile([-np.inf, np.inf], (len(names), 1))
    limits = limits_of_frame(limits, names)
    bounds = array_of("limits", limits, len(names), 2, finite=False)
    low, high = bounds.T
    bad = np.flatnonzero(~((low <= high) & (low < np.inf) & (high > -np.inf)))
    if bad.size:
        raise ValueError(
            f"limits of {names[bad[0]]} must be LOW, HIGH, got "
            f"{in_words(bounds[bad[0]])}"
        )
    return bounds


def _sureness(fit: Fit, spread: Array) -> tuple[float, Array]:
    """Least singular value of an affine map's matrix, in standard deviations (inf
    without noise); (n,) its direction of the commands in their ``spread``."""
    scaled = fit.matrix * spread
    rows = np.linalg.norm(scaled, axis=1)
    turn, size, right = np.linalg.svd(scaled / np.where(rows > 0.0, rows, 1.0)[:, None])
    last = right[len(size) - 1]
    if fit.joint_covariance is None:
        return np.inf if significant(size).all() else 0.0, last
    # Its derivative is that of turn . B last, the outputs' at two commands.
    ends = fit.model.jacobian(np.stack([last * spread, 0.0 * spread]), fit.parameters)
    along = (turn[:, -1] / np.where(rows > 0.0, rows, 1.0)) @ (ends[0] - ends[1])
    variance = along @ fit.joint_covariance @ along
    return size[-1] / float(np.sqrt(variance) or 1e-300), last


class Responses:
    """How outputs respond to commands, these in their spread over the measurements."""

    def __init__(self, fit: Fit) -> None:
        self.fit, self.model = fit, fit.whole
        self.spread = np.where(
            np.ptp(fit.commands, axis=0) > 0.0, fit.commands.std(axis=0), 1.0
        )

    def outputs(self, commands: Array) -> Array:
        return predict(self.model, commands, self.fit.estimate, finite=False)

    def effects(self, commands: Array) -> Array:
        """(P, q, n) derivatives by the commands in their spread."""
        fit = self.fit
        by = derivative(self.model, commands, fit.estimate, fit.input_names)
        return by * self.spread

    def require_sure(self, centre: Array) -> tuple[Array, Array, Array, Array]:
        """``require_regular`` of an affine map, and by more than its noise."""
        parts = self.require_regular(centre)
        sure, last = _sureness(self.fit, self.spread)
        if sure < _SURE:
            raise ValueError(
                f"matrix A may be singular: its smallest singular value is {sure:.2g} "
                "standard deviations from zero. Within the noise, "
                f"{self._insensitive(last)}"
            )
        return parts

    def require_regular(self, commands: Array) -> tuple[Array, Array, Array, Array]:
        """Refuse commands at which a direction of the outputs does not respond; the
        singular value decomposition of the last one's derivative, its columns in
        spreads and its rows divided by their length, and this."""
        effect = self.effects(commands)
        rows = np.linalg.norm(effect, axis=-1)
        for i, j in np.argwhere(flat(rows, np.abs(self.outputs(commands))))[:1]:
            raise ValueError(
                f"the model is singular at the command {in_words(commands[i])}: "
                f"{self.fit.output_names[j]} does not respond to any input"
            )
        turn, size, right = np.linalg.svd(effect / rows[..., None])
        for i in np.flatnonzero(~significant(size)[:, -1])[:1]:
            raise ValueError(
                f"the model is singular at the command {in_words(commands[i])}: "
                + self._insensitive(right[i, size.shape[1] - 1])
            )
        return turn[-1], size[-1], right[-1], rows[-1]

    def require_determined(self, commands: Array) -> None:
        """Refuse commands whose outputs depend on what nothing determines."""
        fit = self.fit
        if fit.unidentified is None:
            return
        slopes = linearised(fit, commands)[0]
        for i, j in np.argwhere(depends(slopes, unseen_directions(fit)))[:1]:
            used = fit.commands[fit.loss_weights > 0.0]
            where = fit.estimate, fit.prior_precision, fit.free > 0.0
            words = [
                direction.words
                for direction in unknown(self.model, used, *where)
                if depends(slopes[i, j], direction.vectors)
            ]
            raise ValueError(
                f"{fit.output_names[j]} at the command {in_words(commands[i])} depends "
                f"on unmeasured parameters: {'; '.join(words)}. Measure there, or give "
                "a prior"
            )

    def _insensitive(self, direction: Array) -> str:
        direction = exact_zeros(direction) * self.spread
        unseen = direction_in_words(direction, self.fit.input_names)
        return f"the outputs do not respond to the direction {unseen} of the commands"


class _Search(Responses):
    """Outputs and derivatives in units of their spread over the measurements."""

    def __init__(self, fit: Fit, wanted: Array, start: Array | None) -> None:
        super().__init__(fit)
        self.wanted = wanted
        square = fit.num_inputs == wanted.shape[1]
        self.affine = square and fit.affine is not None
        # What the machine answers at commands (R, n) if points ``rows`` are reached.
        self.goal = fit.model.fitting.targets(wanted, start)
        measured_at = fit.commands
        points, count = np.arange(len(wanted)), len(measured_at)
        tiled = np.tile(measured_at, (len(wanted), 1))
        there = self.goal(tiled, np.repeat(points, count))
        outputs = predict(self.model, measured_at, fit.estimate)
        there = there.reshape(len(wanted), count, -1) - outputs
        there = self.model.fitting.wrapped(there, measured_at)
        # Relative outputs spread as what is wanted, seen from where it was measured.
        spread = np.concatenate(there) if fit.model.fitting.relative else outputs
        self.size = np.where(np.ptp(spread, axis=0) > 0.0, spread.std(axis=0), 1.0)
        with np.errstate(over="ignore"):
            order = np.argsort(((there / self.size) ** 2).sum(axis=-1), axis=1)
        self.nearest = measured_at[order[:, :_STARTS]]  # (P, starts, n)

    def say_clipped(self, free: Array, commands: Array) -> None:
        """Warn of the targets (P, n) that the limits keep from being reached."""
        arrived = self._arrived(self.gap(commands, np.arange(len(commands))))
        moved = (np.abs(commands - free) / self.spread).argmax(axis=1)
        clipped = [
            f"target {i + 1}, {self.fit.input_names[j]} = {free[i, j]:.6g} to "
            f"{commands[i, j]:.6g}"
            for i, j in enumerate(moved)
            if not arrived[i]
        ]
        if clipped:
            some = "; ".join(clipped[:_NAMED]) + "; ..." * (len(clipped) > _NAMED)
            count = f"{len(clipped)} of {len(commands)} targets are clipped"
            warn(f"{count}: {some}", "targets are clipped", stacklevel=3)

    def say_far(self, commands: Array) -> None:
        """Warn of targets that are reached (P, n) far from what was measured."""
        fit = self.fit
        sides = [(fit.input_names, commands, fit.commands)]
        if not fit.model.fitting.relative:
            readings = predict(self.model, fit.commands, fit.estimate) + fit.residuals
            sides.insert(0, (fit.output_names, self.wanted, readings))
        say_far("target", fit.loss_weights > 0.0, sides, stacklevel=4)

    def gap(self, commands: Array, rows: Rows) -> Array:
        """(R, q) of points ``rows`` from the outputs at ``commands``, in sizes."""
        off = self.goal(commands, rows) - self.outputs(commands)
        return np.asarray(self.model.fitting.wrapped(off, commands) / self.size)

    def slopes(self, commands: Array) -> Array:
        """(P, q, n) in units of the spreads."""
        return self.effects(commands) / self.size[:, None]

    def solved(self) -> Array:
        """(P, n) the commands of a square affine map, which must not be singular."""
        centre = self.fit.commands.mean(axis=0)[None]
        turn, singular, right, rows = self.require_sure(centre)
        with np.errstate(over="ignore", invalid="ignore"):
            off = ((self.wanted - self.outputs(centre)) / rows).T
            step = right.T @ ((turn.T @ off) / singular[:, None])
            command = np.asarray(centre + self.spread * step.T)
        if not np.isfinite(command).all():
            raise ValueError(
                "desired values are too large: no finite command reaches them"
            )
        return command

    def newton(self, begin: Array) -> tuple[Array, Mask]:
        """Damped steps of least length for all points together, and which arrived."""
        commands, rows = begin.copy(), np.arange(len(begin))
        gap = self.gap(commands, rows)
        damping = np.full(len(commands), 1e-6)
        eye = np.eye(self.wanted.shape[1])
        for _ in range(_STEPS):
            if self._arrived(gap).all():
                break
            slopes = self.slopes(commands)
            gram = slopes @ np.matrix_transpose(slopes)
            trace = np.trace(gram, axis1=1, axis2=2) + 1e-300
            gram = gram + (damping * trace)[:, None, None] * eye
            step = np.linalg.solve(gram, gap[..., None])
            step = (np.matrix_transpose(slopes) @ step)[..., 0] * self.spread
            trial = commands + step
            after = self.gap(trial, rows)
            better = (after**2).sum(axis=1) < (gap**2).sum(axis=1)
            commands = np.where(better[:, None], trial, commands)
            gap = np.where(better[:, None], after, gap)
            damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-15, 1e9)
        return commands, self._arrived(gap)

    def _arrived(self, gap: Array) -> Mask:
        tolerance = _REACHED + 1e-14 * np.abs(self.wanted / self.size).max(axis=1)
        return np.asarray(np.abs(gap).max(axis=1) <= tolerance)

    def bounded(
        self, i: int, free: Array, reached: bool, bounds: Array, clip: bool
    ) -> Array:
        """(n,) within the bounds for point i, or the refusal."""
        from scipy import optimize

        low, high = bounds.T
        high = np.maximum(high, low + 1e-12 * self.spread)
        desired, names, at = self.wanted[i], self.fit.input_names, np.array([i])
        nearest, least = np.clip(free, low, high), np.inf
        target = f"target {i + 1} {in_words(desired)}"
        if self.affine:
            scaled, span = self.fit.matrix * self.spread, (low, high) / self.spread
            unit = np.abs(scaled).max()
            aim = (desired - self.fit.bias) / unit
            nearest = optimize.lsq_linear(scaled / unit, aim, span, "bvls", 1e-14).x
            nearest = np.clip(nearest * self.spread, low, high)
        for begin in () if self.affine else (free, *self.nearest[i]):
            solution = optimize.least_squares(
                lambda command: -self.gap(command[None], at)[0],
                np.clip(begin, low, high),
                lambda command: self.slopes(command[None])[0] / self.spread,
                (low, high),
                x_scale=self.spread,
                **dict.fromkeys(("ftol", "xtol", "gtol"), 1e-15),
            )
            if self._arrived(solution.fun[None])[0]:
                return np.asarray(solution.x)
            if solution.cost < least:
                nearest, least = np.asarray(solution.x), solution.cost
        if clip:
            return nearest
        beyond = np.maximum(low - free, free - high) / self.spread
        if reached:
            axis = int(beyond.argmax())
            raise ValueError(
                f"{target} cannot be reached: {names[axis]} would have to be "
                f"{free[axis]:.6g} (limits {bounds[axis, 0]:.6g} to "
                f"{bounds[axis, 1]:.6g})"
            )
        close = np.minimum(nearest - low, high - nearest) < 1e-4 * self.spread
        active = [name for name, at in zip(names, close, strict=True) if at]
        raise ValueError(
            f"{target} cannot be reached; the nearest output found is "
            f"{in_words(self.outputs(nearest[None])[0])}"
            + (f", at the limit of {', '.join(active)}" if active else "")
        )
