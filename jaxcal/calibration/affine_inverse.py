"""The inverse map: commands that reach desired postures, or why there are none."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration.affine import AffineFit
from jaxcal.checks import in_words, numbers
from jaxcal.information.excitation import direction_in_words

__all__ = ["command_for", "limits_of"]

Array = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)
_ROUNDING = 1e-12  # a response below this share of the output is rounding


def command_for(
    self: AffineFit,
    desired: ArrayLike,
    limits: ArrayLike | None = None,
    *,
    clip: bool = False,
    max_condition: float = 1e6,
) -> Array:
    """Commands that reach desired postures, ``A^-1 (desired - b)``.

    Args:
        desired: (..., m) in the measured unit.
        limits: (n, 2) least and greatest command of each input, if any; ``-inf`` and
            ``inf`` leave an end open.
        clip: move a command beyond its limit onto it instead of refusing; the device
            then does not reach ``desired`` (``predict`` says where it goes).
        max_condition: greatest condition number of A, in units of the spread of the
            commands and with rows of equal size, that is still inverted.

    Returns:
        (..., n) in the command unit.

    Raises:
        ValueError: A is not square, singular, or cannot be told from singular within
            its own uncertainty; a command lies beyond its limits; a desired posture or
            limit is not finite or has the wrong shape.
    """
    wanted = self._points("desired", desired, self.num_outputs)
    bounds = None if limits is None else limits_of(limits, self.input_names)
    at_centre = self.matrix @ self.centre + self.bias
    effect = self.matrix * self.scale  # (m, n) of one spread of each command
    rows = np.linalg.norm(effect, axis=1)
    least = _require_invertible(self, effect, rows, at_centre, max_condition)
    with np.errstate(over="ignore", invalid="ignore"):
        offset = np.linalg.solve(
            effect / rows[:, None], ((wanted - at_centre) / rows)[..., None]
        )[..., 0]
        command = self.centre + self.scale * offset
        # What rounding may have added to a command that lies exactly on its limit.
        size = ((np.abs(wanted) + np.abs(at_centre)) / rows).max(-1, keepdims=True)
        slack = 8 * _EPS * (np.abs(self.centre) + self.scale * size / least)
    if not np.isfinite(command + slack).all():
        raise ValueError("desired must be within reach of finite commands, got larger")
    if bounds is None:
        return command
    low, high = bounds.T
    beyond = (command < low - slack) | (command > high + slack)
    if beyond.any() and not clip:
        *point, axis = (int(i) for i in np.argwhere(beyond)[0])
        raise ValueError(
            f"desired {in_words(wanted[tuple(point)])} needs {self.input_names[axis]} "
            f"= {command[(*point, axis)]:.6g}, outside its limits "
            f"[{low[axis]:.6g}, {high[axis]:.6g}]"
        )
    return np.clip(command, low, high)


def limits_of(limits: ArrayLike, names: tuple[str, ...]) -> Array:
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


def _require_invertible(
    fit: AffineFit, effect: Array, rows: Array, at_centre: Array, max_condition: float
) -> float:
    """Least singular value of ``effect`` (m, n) with rows (m,) of unit length."""
    if fit.num_outputs != fit.num_inputs:
        raise ValueError(
            "command_for needs as many outputs as inputs, got a matrix A of shape "
            f"{effect.shape}"
        )
    silent = np.flatnonzero(rows <= _ROUNDING * np.abs(at_centre))
    if silent.size:
        name = fit.output_names[int(silent[0])]
        raise ValueError(f"matrix A is singular: {name} does not respond to any input")
    left, singular, right = np.linalg.svd(effect / rows[:, None])
    unseen = direction_in_words(right[-1] * fit.scale, fit.input_names)
    insensitive = f"no output responds to the direction {unseen} of the commands"
    if singular[-1] * max_condition < singular[0]:
        ratio = singular[0] / singular[-1] if singular[-1] > 0 else np.inf
        raise ValueError(
            f"matrix A is near singular (condition number {ratio:.3g}, at most "
            f"{max_condition:.3g} is inverted): {insensitive}"
        )
    if fit.noise_std is not None:
        # Spread of left . B right, whose value is the smallest singular value.
        noise = np.linalg.norm(left[:, -1] * fit.noise_std / rows)
        spread = noise * np.sqrt(right[-1] @ fit.slope_covariance @ right[-1])
        if singular[-1] < 3.0 * spread:
            raise ValueError(
                "matrix A cannot be told from a singular one: its smallest singular "
                f"value is {singular[-1] / spread:.2g} standard deviations from zero, "
                f"so within the noise {insensitive}"
            )
    return float(singular[-1])
