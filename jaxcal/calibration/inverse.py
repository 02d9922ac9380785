"""The inverse map: commands that reach desired outputs, or why there are none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration.fit import Fit
from jaxcal.checks import in_words, numbers
from jaxcal.information.excitation import direction_in_words
from jaxcal.models import Affine, Model, Pose, SerialChain
from jaxcal.models.model import derivative, predict

__all__ = ["command_for"]

Array = NDArray[np.float64]
Carry = Callable[[Array, NDArray[np.intp]], Array]

_STARTS, _STEPS, _REACHED = 6, 60, 1e-9  # of the outputs' spread over the measurements
_ROUNDING = 1e-12  # a response below this share of the output is rounding
# Greatest condition number of the derivative by the commands, in units of their spread
# and with rows of equal size, that is inverted.
_CONDITION = 1e6


def command_for(
    fit: Fit,
    desired: ArrayLike,
    limits: ArrayLike | None = None,
    *,
    start: ArrayLike | None = None,
    clip: bool = False,
) -> Array:
    """Commands that reach desired outputs.

    Of a square affine map its inverse, else Newton's method from several starts; within
    limits the nearest output.

    Args:
        fit: the calibration.
        desired: (..., m) in the measured unit; m at most n. Where m is less than n the
            command is the one that Newton's method finds near the start. Of an arm's
            pose, position and turn from the nominal orientation at ``start``, which
            then must be given, as ``model.rotation_vectors(start, R)``.
        limits: (n, 2) least and greatest command of each input, if any.
        start: (n,) or (..., n) where the search begins; the measured command whose
            output is nearest when not given.
        clip: where the limits leave no exact command, the one within them whose output
            is nearest, instead of refusing.

    Returns:
        (..., n) in the command unit.

    Raises:
        ValueError: a desired output is out of reach, or needs a command beyond its
            limits; an output does not respond there; m exceeds n.
    """
    n, m = fit.num_inputs, fit.num_outputs
    points = fit.points("desired", desired, m)
    wanted = points.reshape(-1, m)
    if m > n:
        raise ValueError(
            f"command_for needs at most as many outputs as inputs, got {m} and {n}"
        )
    bounds = None if limits is None else _limits(limits, fit.input_names)
    begin = None
    if isinstance(fit.model, Affine) and m == n:
        begin = _solve_affine(fit, wanted)
    elif start is not None:
        given = fit.points("start", start, n)
        begin = np.broadcast_to(given, (*points.shape[:-1], n)).reshape(-1, n)
    search = _Search(fit, wanted, _carry(fit.model, wanted, begin))
    commands, reached = search.newton(search.nearest[:, 0] if begin is None else begin)
    for k in range(search.nearest.shape[1]):
        if reached.all():
            break
        again, now = search.newton(search.nearest[:, k])
        commands = np.where((now & ~reached)[:, None], again, commands)
        reached |= now
    if bounds is None:
        for i in np.flatnonzero(~reached):
            raise ValueError(
                f"desired {in_words(wanted[i])} is out of reach; the nearest output "
                f"found is {in_words(search.outputs(commands)[i])}"
            )
    else:
        low, high = bounds.T
        slack = 1e-9 * search.spread
        inside = ((commands >= low - slack) & (commands <= high + slack)).all(axis=1)
        for i in np.flatnonzero(~(reached & inside)):
            commands[i] = search.bounded(int(i), commands[i], reached[i], bounds, clip)
        commands = np.clip(commands, low, high)
    if not clip:
        search.require_regular(commands)
    return commands.reshape(*points.shape[:-1], n)


def _carry(model: Model, wanted: Array, start: Array | None) -> Carry | None:
    """What an arm would answer at commands (R, n) if points (R,) were reached there.

    Its orientations are relative to the commands; other outputs are absolute.
    """
    if not (isinstance(model, SerialChain) and isinstance(model.sensor, Pose)):
        return None
    if start is None:
        raise ValueError(
            "start must be given for an arm's pose: the joints at whose nominal "
            "orientation desired is a turn, as rotation_vectors(start, R) makes it"
        )
    arm, rotations = model, model.rotations(start, wanted[:, 3:])

    def carry(commands: Array, rows: NDArray[np.intp]) -> Array:
        turns = arm.rotation_vectors(commands, rotations[rows])
        return np.hstack([wanted[rows, :3], turns])

    return carry


def _limits(limits: ArrayLike, names: tuple[str, ...]) -> Array:
    """(n, 2), least below greatest, with at least one finite command between them."""
    bounds = numbers("limits", limits, finite=False)
    if bounds.shape != (len(names), 2):
        raise ValueError(
            f"limits must have shape ({len(names)}, 2), got {bounds.shape}"
        )
    low, high = bounds.T
    bad = np.flatnonzero(~((low <= high) & (low < np.inf) & (high > -np.inf)))
    if bad.size:
        raise ValueError(
            f"limits of {names[bad[0]]} must be a least and a greatest value, "
            f"got {in_words(bounds[bad[0]])}"
        )
    return bounds


def _solve_affine(fit: Fit, wanted: Array) -> Array:
    """(P, n) the inverse of a square affine ``Calibration`` at outputs (P, n).

    Raises:
        ValueError: A is singular, or cannot be told from singular within its own
            uncertainty; or no finite command reaches an output.
    """
    centre = fit.commands.mean(axis=0)
    scale = np.where(np.ptp(fit.commands, axis=0) > 0.0, fit.commands.std(axis=0), 1.0)
    at_centre = fit.matrix @ centre + fit.bias
    effect = fit.matrix * scale  # (n, n) of one spread of each command
    rows = np.linalg.norm(effect, axis=1)
    silent = np.flatnonzero(rows <= _ROUNDING * np.abs(at_centre))
    if silent.size:
        name = fit.output_names[int(silent[0])]
        raise ValueError(f"matrix A is singular: {name} does not respond to any input")
    left, singular, right = np.linalg.svd(effect / rows[:, None])
    unseen = direction_in_words(right[-1] * scale, fit.input_names)
    insensitive = f"no output responds to the direction {unseen} of the commands"
    if singular[-1] * _CONDITION < singular[0]:
        ratio = singular[0] / singular[-1] if singular[-1] > 0 else np.inf
        raise ValueError(
            f"matrix A is near singular (condition number {ratio:.3g}, at most "
            f"{_CONDITION:.3g} is inverted): {insensitive}"
        )
    if fit.joint_covariance is not None:
        # Standard deviation of left . B right, whose value is the smallest one.
        along = np.kron(left[:, -1] / rows, right[-1] * scale)
        of_slopes = fit.joint_covariance[: along.size, : along.size]
        spread = float(np.sqrt(along @ of_slopes @ along))
        if singular[-1] < 3.0 * spread:
            raise ValueError(
                "matrix A cannot be told from a singular one: its smallest singular "
                f"value is {singular[-1] / spread:.2g} standard deviations from zero, "
                f"so within the noise {insensitive}"
            )
    with np.errstate(over="ignore", invalid="ignore"):
        off = ((wanted - at_centre) / rows).T
        command = centre + scale * np.linalg.solve(effect / rows[:, None], off).T
    if not np.isfinite(command).all():
        raise ValueError("desired must be within reach of finite commands, got larger")
    return command


class _Search:
    """Outputs and derivatives in units of their spread over the measurements."""

    def __init__(self, fit: Fit, wanted: Array, carry: Carry | None) -> None:
        self.model, self.theta, self.names = fit.whole, fit.estimate, fit.input_names
        self.wanted, known = wanted, fit.commands
        self.carry: Carry = carry or (lambda commands, rows: wanted[rows])
        outputs = predict(self.model, known, self.theta)
        self.spread = np.where(np.ptp(known, axis=0) > 0.0, known.std(axis=0), 1.0)
        points, count = np.arange(len(wanted)), len(known)
        there = self.carry(np.tile(known, (len(wanted), 1)), np.repeat(points, count))
        there = there.reshape(len(wanted), count, -1) - outputs
        # Relative outputs spread as what is wanted, seen from where it was measured.
        seen = outputs if carry is None else np.concatenate(there)
        self.size = np.where(np.ptp(seen, axis=0) > 0.0, seen.std(axis=0), 1.0)
        order = np.argsort(((there / self.size) ** 2).sum(axis=-1), axis=1)
        self.nearest = known[order[:, :_STARTS]]  # (P, starts, n)

    def outputs(self, commands: Array) -> Array:
        return predict(self.model, commands, self.theta, finite=False)

    def gap(self, commands: Array, rows: NDArray[np.intp]) -> Array:
        """(R, q) of points ``rows`` from the outputs at ``commands``, in sizes."""
        gap = self.carry(commands, rows) - self.outputs(commands)
        return np.asarray(gap / self.size)

    def slopes(self, commands: Array) -> Array:
        """(P, q, n) in units of the spreads."""
        by = derivative(self.model, commands, self.theta, self.names)
        return by * self.spread / self.size[:, None]

    def newton(self, begin: Array) -> tuple[Array, NDArray[np.bool_]]:
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

    def _arrived(self, gap: Array) -> NDArray[np.bool_]:
        tolerance = _REACHED + 1e-14 * np.abs(self.wanted / self.size).max(axis=1)
        return np.asarray(np.abs(gap).max(axis=1) <= tolerance)

    def bounded(
        self, i: int, free: Array, reached: bool, bounds: Array, clip: bool
    ) -> Array:
        """(n,) within the bounds for point i, or the refusal."""
        from scipy import optimize

        low, high = bounds.T
        high = np.maximum(high, low + 1e-12 * self.spread)
        wanted, names = self.wanted[i], self.names

        def off(command: Array) -> Array:
            return -self.gap(command[None], np.array([i]))[0]

        nearest, least = np.clip(free, low, high), np.inf
        # Of a square affine map there is one command: a controller holds it there.
        unique = isinstance(self.model, Affine) and len(wanted) == len(free)
        for begin in () if unique else (free, *self.nearest[i]):
            found = optimize.least_squares(
                off,
                np.clip(begin, low, high),
                lambda command: self.slopes(command[None])[0] / self.spread,
                (low, high),
                x_scale=self.spread,
                **{key: 1e-15 for key in ("ftol", "xtol", "gtol")},
            )
            if self._arrived(found.fun[None])[0]:
                return np.asarray(found.x)
            if found.cost < least:
                nearest, least = np.asarray(found.x), found.cost
        if clip:
            return nearest
        beyond = np.maximum(low - free, free - high) / self.spread
        if reached:
            axis = int(beyond.argmax())
            raise ValueError(
                f"desired {in_words(wanted)} needs {names[axis]} = {free[axis]:.6g}, "
                f"outside its limits [{bounds[axis, 0]:.6g}, {bounds[axis, 1]:.6g}]"
            )
        close = np.minimum(nearest - low, high - nearest) < 1e-4 * self.spread
        active = [name for name, at in zip(names, close, strict=True) if at]
        raise ValueError(
            f"desired {in_words(wanted)} is out of reach; the nearest output found is "
            f"{in_words(self.outputs(nearest[None])[0])}"
            + (f", at the limit of {', '.join(active)}" if active else "")
        )

    def require_regular(self, commands: Array) -> None:
        """Refuse commands at which a direction of the outputs does not respond."""
        slopes = self.slopes(commands)
        rows = np.linalg.norm(slopes, axis=-1, keepdims=True)
        _, size, right = np.linalg.svd(slopes / np.where(rows > 0.0, rows, 1.0))
        for i in np.flatnonzero(~(size[:, -1] * _CONDITION >= size[:, 0])):
            unseen = direction_in_words(
                right[i, size.shape[1] - 1] * self.spread, self.names
            )
            raise ValueError(
                f"the model is near singular at the command {in_words(commands[i])}: "
                f"the outputs hardly respond to the direction {unseen} of the commands"
            )
