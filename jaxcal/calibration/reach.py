"""Commands that reach desired outputs of any model, or why there are none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration.affine_inverse import limits_of
from jaxcal.calibration.checked import derivative, predict
from jaxcal.checks import in_words
from jaxcal.information.excitation import direction_in_words

if TYPE_CHECKING:
    from jaxcal.calibration.model import ModelCalibration

__all__ = ["command_for"]

Array = NDArray[np.float64]

_STARTS, _STEPS, _REACHED = 6, 60, 1e-9  # of the outputs' spread over the measurements


def command_for(
    self: ModelCalibration,
    desired: ArrayLike,
    limits: ArrayLike | None = None,
    *,
    start: ArrayLike | None = None,
    clip: bool = False,
    max_condition: float = 1e6,
) -> Array:
    """Commands that reach desired outputs, by Newton's method from several starts.

    Args:
        desired: (..., m) in the measured unit; m at most n. Where m is less than n the
            command is the one that Newton's method finds near the start.
        limits: (n, 2) least and greatest command of each input, if any.
        start: (n,) or (..., n) where the search begins; the measured command whose
            output is nearest when not given.
        clip: where the limits leave no exact command, the one within them whose output
            is nearest, instead of refusing.
        max_condition: greatest condition number of the derivative by the commands, in
            units of their spread and with rows of equal size, that is accepted.

    Returns:
        (..., n) in the command unit.

    Raises:
        ValueError: a desired output is out of reach, or needs a command beyond its
            limits; an output does not respond there; m exceeds n.
    """
    wanted = self._points("desired", desired, self.num_outputs)
    if self.num_outputs > self.num_inputs:
        raise ValueError(
            "command_for needs at most as many outputs as inputs, got "
            f"{self.num_outputs} and {self.num_inputs}"
        )
    bounds = None if limits is None else limits_of(limits, self.input_names)
    search = _Search(self, wanted.reshape(-1, self.num_outputs))
    begin = search.nearest[:, 0]
    if start is not None:
        points = self._points("start", start, self.num_inputs)
        begin = np.broadcast_to(points, (*wanted.shape[:-1], self.num_inputs))
        begin = begin.reshape(-1, self.num_inputs)
    commands, reached = search.newton(begin)
    for k in range(search.nearest.shape[1]):
        if reached.all():
            break
        again, now = search.newton(search.nearest[:, k])
        commands = np.where((now & ~reached)[:, None], again, commands)
        reached |= now
    if bounds is None:
        for i in np.flatnonzero(~reached):
            raise ValueError(
                f"desired {in_words(search.wanted[i])} is out of reach; the nearest "
                f"output found is {in_words(search.outputs(commands)[i])}"
            )
    else:
        low, high = bounds.T
        slack = 1e-9 * search.spread
        inside = ((commands >= low - slack) & (commands <= high + slack)).all(axis=1)
        for i in np.flatnonzero(~(reached & inside)):
            commands[i] = search.bounded(int(i), commands[i], reached[i], bounds, clip)
        commands = np.clip(commands, low, high)
    if not clip:
        search.require_regular(commands, max_condition)
    return commands.reshape(*wanted.shape[:-1], self.num_inputs)


class _Search:
    """Outputs and derivatives in units of their spread over the measurements."""

    def __init__(self, calibration: ModelCalibration, wanted: Array) -> None:
        self.calibration, self.wanted = calibration, wanted
        self.model, self.theta = calibration._whole, calibration.estimate
        known = calibration.commands
        outputs = predict(self.model, known, self.theta)
        self.spread = np.where(np.ptp(known, axis=0) > 0.0, known.std(axis=0), 1.0)
        moved = np.ptp(outputs, axis=0) > 0.0
        self.size = np.where(moved, outputs.std(axis=0), 1.0)
        gap = (wanted[:, None] - outputs) / self.size
        order = np.argsort((gap**2).sum(axis=-1), axis=1)[:, :_STARTS]
        self.nearest = known[order]  # (P, starts, n)

    def outputs(self, commands: Array) -> Array:
        return predict(self.model, commands, self.theta, finite=False)

    def slopes(self, commands: Array) -> Array:
        """(P, q, n) in units of the spreads."""
        names = self.calibration.input_names
        by = derivative(self.model, commands, self.theta, names)
        return by * self.spread / self.size[:, None]

    def newton(self, begin: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Damped steps of least length for all points together, and which arrived."""
        commands = begin.copy()
        gap = (self.wanted - self.outputs(commands)) / self.size
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
            after = (self.wanted - self.outputs(trial)) / self.size
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
        wanted, names = self.wanted[i], self.calibration.input_names

        def off(command: Array) -> Array:
            return (self.outputs(command[None])[0] - wanted) / self.size

        best = None
        for begin in (free, *self.nearest[i]):
            found = optimize.least_squares(
                off,
                np.clip(begin, low, high),
                lambda command: self.slopes(command[None])[0] / self.spread,
                (low, high),
                x_scale=self.spread,
                **{key: 1e-15 for key in ("ftol", "xtol", "gtol")},
            )
            if best is None or found.cost < best.cost:
                best = found
            if self._arrived(found.fun[None])[0]:
                return np.asarray(found.x)
        assert best is not None  # there is a start
        if clip:
            return np.asarray(best.x)
        beyond = np.maximum(low - free, free - high) / self.spread
        if reached:
            axis = int(beyond.argmax())
            raise ValueError(
                f"desired {in_words(wanted)} needs {names[axis]} = {free[axis]:.6g}, "
                f"outside its limits [{bounds[axis, 0]:.6g}, {bounds[axis, 1]:.6g}]"
            )
        gap = np.minimum(best.x - low, high - best.x) < 1e-4 * self.spread
        active = [name for name, at in zip(names, gap, strict=True) if at]
        raise ValueError(
            f"desired {in_words(wanted)} is out of reach; the nearest output found is "
            f"{in_words(self.outputs(best.x[None])[0])}"
            + (f", at the limit of {', '.join(active)}" if active else "")
        )

    def require_regular(self, commands: Array, max_condition: float) -> None:
        """Refuse commands at which a direction of the outputs does not respond."""
        slopes = self.slopes(commands)
        rows = np.linalg.norm(slopes, axis=-1, keepdims=True)
        _, size, right = np.linalg.svd(slopes / np.where(rows > 0.0, rows, 1.0))
        for i in np.flatnonzero(~(size[:, -1] * max_condition >= size[:, 0])):
            unseen = direction_in_words(
                right[i, size.shape[1] - 1] * self.spread, self.calibration.input_names
            )
            raise ValueError(
                f"the model is near singular at the command {in_words(commands[i])}: "
                f"the outputs hardly respond to the direction {unseen} of the commands"
            )
