"""Identify ``y = A u + b`` from measured postures, with honest uncertainty.

``identify`` is weighted least squares by a singular value decomposition of centred and
scaled regressors, so encoder pulses and degrees fit equally well. The noise is assumed
white: independent between postures and between outputs, of one level for each output.
With as many postures as regressors (four for three inputs) the model fits exactly, no
residual is left and no noise can be estimated; the calibration then says so and has no
covariance, unless the noise was given.

Parameters are in the paper's order (Equation 9): A row by row, then b.
Source: paper, Equations 2 to 4; Seber and Lee, Linear Regression Analysis, chapter 3.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import os
import platform
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import (
    axis_letter,
    axis_names,
    in_words,
    noise_levels,
    numbers,
    relative_weights,
    table,
    text,
)
from jaxcal.information.excitation import direction_in_words, require_excited

if TYPE_CHECKING:
    from typing import Self

__all__ = ["Calibration", "identify"]

Array = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)
_ROUNDING = 1e-12  # a response below this share of the output is rounding


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """The identified map from commands u (n inputs) to postures y (m outputs)."""

    matrix: Array  # (m, n) A, measured unit per command unit
    bias: Array  # (m,) b, measured unit
    residuals: Array  # (N, m) measured less predicted, measured unit
    noise_std: Array | None  # (m,) at weight 1, behind every uncertainty
    noise_known: bool  # True: noise_std was given; False: it comes from the residuals
    noise_dof: int  # degrees of freedom of each noise_std estimated, 0 where known
    residual_std: Array | None  # (m,) from the residuals alone; None without freedom
    residual_std_overall: float | None  # the same over all outputs
    dof: int  # residual degrees of freedom of each output, N - (n + 1)
    condition_number: float  # of the regression matrix; depends on the command unit
    scaled_condition_number: float  # of the centred, scaled one; does not
    num_measurements: int  # postures of positive weight
    centre: Array  # (n,) weighted mean of the commands
    scale: Array  # (n,) root mean square of the commands about it
    slope_covariance: Array  # (n, n) of a row of A * scale, for unit noise
    total_weight: float  # 1 / variance of an output predicted at the centre, unit noise
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    command_unit: str  # "" where not stated
    measured_unit: str
    provenance: Mapping[str, Any]  # created, packages, data_sha256, notes

    # -- parameters ------------------------------------------------------------------

    @property
    def num_inputs(self) -> int:
        """n."""
        return self.matrix.shape[1]

    @property
    def num_outputs(self) -> int:
        """m."""
        return self.matrix.shape[0]

    @property
    def parameters(self) -> Array:
        """(m (n + 1),) A row by row, then b."""
        return np.concatenate([self.matrix.ravel(), self.bias])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``a11 a12 ... amn b1 ... bm``, with bx by bz for three outputs."""
        m, n = self.matrix.shape
        comma = "," if max(m, n) > 9 else ""
        slopes = [f"a{i + 1}{comma}{j + 1}" for i in range(m) for j in range(n)]
        return (*slopes, *(f"b{axis_letter(i, m)}" for i in range(m)))

    @property
    def unit_covariance(self) -> Array:
        """(n + 1, n + 1) covariance of [a row of A, its b] for noise of unit variance.

        Equals ``inv(Z.T @ W @ Z)`` with Z = [commands, 1].
        """
        n = self.num_inputs
        transform = np.zeros((n + 1, n + 1))
        transform[:n, :n] = np.diag(1.0 / self.scale)
        transform[n, :n] = -self.centre / self.scale
        transform[n, n] = 1.0
        inner = np.zeros((n + 1, n + 1))
        inner[:n, :n] = self.slope_covariance
        inner[n, n] = 1.0 / self.total_weight
        return transform @ inner @ transform.T

    @property
    def covariance(self) -> Array | None:
        """(m (n + 1), m (n + 1)) of ``parameters``; None where the noise is unknown.

        Outputs are independent, so entries between two outputs are zero.
        """
        if self.noise_std is None:
            return None
        m, n = self.matrix.shape
        blocks = np.kron(np.diag(self.noise_std**2), self.unit_covariance)
        per_output = np.arange(m * (n + 1)).reshape(m, n + 1)
        order = np.concatenate([per_output[:, :n].ravel(), per_output[:, n]])
        return blocks[np.ix_(order, order)]

    @property
    def standard_errors(self) -> Array | None:
        """(m (n + 1),) standard deviation of each parameter; None as ``covariance``."""
        covariance = self.covariance
        return None if covariance is None else np.sqrt(np.diag(covariance))

    def confidence_intervals(self, confidence: float = 0.95) -> Array:
        """(m (n + 1), 2) lower and upper end for each parameter, one at a time.

        Student's t where the noise was estimated, the normal where it was given.

        Args:
            confidence: probability in (0, 1).

        Raises:
            ValueError: the noise is unknown, or ``confidence`` is not in (0, 1).
        """
        self._require_noise("confidence intervals")
        errors = self.standard_errors
        assert errors is not None
        half = self._quantile(confidence) * errors
        return np.stack([self.parameters - half, self.parameters + half], axis=-1)

    def lack_of_fit(self) -> float | None:
        """p-value of residuals at least this large under the noise that was given.

        A small one (below 0.01, say) means that the device is not linear, that an
        outlier is among the measurements, or that the noise stated is too small. None
        where no noise was given or no residual degree of freedom is left.
        """
        if not self.noise_known or self.dof < 1:
            return None
        assert self.noise_std is not None and self.residual_std is not None
        from scipy import stats

        square = self.dof * float(np.sum((self.residual_std / self.noise_std) ** 2))
        return float(stats.chi2.sf(square, self.dof * self.num_outputs))

    # -- prediction ------------------------------------------------------------------

    def predict(self, commands: ArrayLike) -> Array:
        """Postures reached.

        Args:
            commands: (..., n) in the command unit.

        Returns:
            (..., m) in the measured unit.
        """
        return self._points("commands", commands, self.num_inputs) @ self.matrix.T + (
            self.bias
        )

    def predict_std(
        self, commands: ArrayLike, *, new_measurement: bool = False
    ) -> Array:
        """Standard deviation of ``predict``.

        Args:
            commands: (..., n).
            new_measurement: add the noise of one more measurement of weight 1, for
                comparison with a measured posture.

        Returns:
            (..., m) in the measured unit.

        Raises:
            ValueError: the noise is unknown.
        """
        commands = self._points("commands", commands, self.num_inputs)
        noise = self._require_noise("prediction uncertainty")
        offset = (commands - self.centre) / self.scale
        variance = 1.0 / self.total_weight + np.einsum(
            "...i,ij,...j->...", offset, self.slope_covariance, offset
        )
        return np.sqrt(variance + float(new_measurement))[..., None] * noise

    def predict_interval(
        self,
        commands: ArrayLike,
        confidence: float = 0.95,
        *,
        new_measurement: bool = False,
    ) -> tuple[Array, Array]:
        """Lower and upper end, (..., m) each; arguments as for ``predict_std``."""
        centre = self.predict(commands)
        half = self._quantile(confidence) * self.predict_std(
            commands, new_measurement=new_measurement
        )
        return centre - half, centre + half

    def command_for(
        self,
        desired: ArrayLike,
        limits: ArrayLike | None = None,
        *,
        clip: bool = False,
        max_condition: float = 1e6,
    ) -> Array:
        """Commands that reach desired postures, ``A^-1 (desired - b)``.

        Args:
            desired: (..., m) in the measured unit.
            limits: (n, 2) least and greatest command of each input, if any.
            clip: move a command beyond its limit onto it instead of refusing; the
                device then does not reach ``desired`` (``predict`` says where it goes).
            max_condition: greatest condition number of A, in units of the spread of
                the commands and with rows of equal size, that is still inverted.

        Returns:
            (..., n) in the command unit.

        Raises:
            ValueError: A is not square, singular, or cannot be told from singular
                within its own uncertainty; a command lies beyond its limits; a desired
                posture or limit is not finite or has the wrong shape.
        """
        desired = self._points("desired", desired, self.num_outputs)
        bounds = None if limits is None else self._limits(limits)
        effect = self._invertible_effect(max_condition)
        rows = np.linalg.norm(effect, axis=1)
        at_centre = self.matrix @ self.centre + self.bias
        offset = np.linalg.solve(
            effect / rows[:, None], ((desired - at_centre) / rows)[..., None]
        )[..., 0]
        command = self.centre + self.scale * offset
        if bounds is None:
            return command
        if clip:
            return np.clip(command, bounds[:, 0], bounds[:, 1])
        slack = 8 * _EPS * np.abs(bounds).max(axis=1)
        beyond = (command < bounds[:, 0] - slack) | (command > bounds[:, 1] + slack)
        if beyond.any():
            where = tuple(int(i) for i in np.argwhere(beyond)[0])
            low, high = bounds[where[-1]]
            raise ValueError(
                f"desired {in_words(desired[where[:-1]])} needs "
                f"{self.input_names[where[-1]]} = {command[where]:.6g}, outside its "
                f"limits [{low:.6g}, {high:.6g}]"
            )
        return np.clip(command, bounds[:, 0], bounds[:, 1])

    # -- files and words ---------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a versioned JSON file atomically; see ``docs/calibration.md``.

        Raises:
            OSError: the folder is missing, not writable or full; the old file stays.
        """
        from jaxcal.calibration import file as calibration_file

        calibration_file.save(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that ``save`` wrote.

        Raises:
            OSError: it cannot be read.
            ValueError: it is not a calibration, or one of another version, or damaged;
                the message names the file and the key.
        """
        from jaxcal.calibration import file as calibration_file

        return cls(**calibration_file.load(path))

    def summary(self) -> str:
        """A, b and how far to trust them, in a few lines of text."""
        unit = f" {self.measured_unit}" if self.measured_unit else ""
        errors = self.standard_errors
        m, n = self.matrix.shape
        lines = [
            f"y = A u + b, {n} inputs ({', '.join(self.input_names)}), "
            f"{m} outputs ({', '.join(self.output_names)}), "
            f"{self.num_measurements} measurements"
        ]
        for i, (name, value) in enumerate(
            zip(self.parameter_names, self.parameters, strict=True)
        ):
            spread = "" if errors is None else f" +- {errors[i]:.3g} (1 s.d.)"
            lines.append(f"  {name:>4} = {value: .6g}{spread}")
        if self.noise_std is None:
            lines.append(self._no_noise("uncertainties"))
        else:
            source = (
                "as given"
                if self.noise_known
                else f"from the residuals, {self.noise_dof} degrees of freedom"
            )
            lines.append(f"noise {in_words(self.noise_std)}{unit} ({source})")
        if self.noise_known and self.residual_std is not None:
            lines.append(
                f"residuals {in_words(self.residual_std)}{unit}, "
                f"lack-of-fit p = {self.lack_of_fit():.3g}"
            )
        elif self.noise_known:
            lines.append("no residual degree of freedom: the noise cannot be checked")
        lines.append(f"condition number {self.condition_number:.4g}")
        return "\n".join(lines)

    # -- inside ------------------------------------------------------------------------

    def _points(self, name: str, values: ArrayLike, width: int) -> Array:
        points = numbers(name, values)
        if points.ndim < 1 or points.shape[-1] != width:
            raise ValueError(
                f"{name} must have shape (..., {width}), got {points.shape}"
            )
        return points

    def _limits(self, limits: ArrayLike) -> Array:
        n = self.num_inputs
        bounds = numbers("limits", limits, finite=False)
        if bounds.shape != (n, 2):
            raise ValueError(f"limits must have shape ({n}, 2), got {bounds.shape}")
        bad = np.flatnonzero(~(bounds[:, 0] <= bounds[:, 1]))
        if bad.size:
            raise ValueError(
                f"limits of {self.input_names[bad[0]]} must be a least and a greatest "
                f"value, got {in_words(bounds[bad[0]])}"
            )
        return bounds

    def _invertible_effect(self, max_condition: float) -> Array:
        """(m, m) A times the spread of each command, if it can be inverted."""
        m, n = self.matrix.shape
        if m != n:
            raise ValueError(
                "command_for needs as many outputs as inputs, got a matrix A of shape "
                f"({m}, {n})"
            )
        effect = self.matrix * self.scale
        rows = np.linalg.norm(effect, axis=1)
        at_centre = self.matrix @ self.centre + self.bias
        silent = np.flatnonzero(rows <= _ROUNDING * np.abs(at_centre))
        if silent.size:
            name = self.output_names[int(silent[0])]
            raise ValueError(
                f"matrix A is singular: {name} does not respond to any input"
            )
        balanced = effect / rows[:, None]
        left, singular, right = np.linalg.svd(balanced)
        unseen = direction_in_words(right[-1] * self.scale, self.input_names)
        insensitive = f"no output responds to the direction {unseen} of the commands"
        if singular[-1] * max_condition < singular[0]:
            ratio = singular[0] / singular[-1] if singular[-1] > 0 else np.inf
            raise ValueError(
                f"matrix A is near singular (condition number {ratio:.3g}, at most "
                f"{max_condition:.3g} is inverted): {insensitive}"
            )
        if self.noise_std is not None:
            # Spread of left . B right, whose value is the smallest singular value.
            noise = np.linalg.norm(left[:, -1] * self.noise_std / rows)
            spread = noise * np.sqrt(right[-1] @ self.slope_covariance @ right[-1])
            if singular[-1] < 3.0 * spread:
                raise ValueError(
                    "matrix A cannot be told from a singular one: its smallest "
                    f"singular value is {singular[-1] / spread:.2g} standard "
                    f"deviations from zero, so within the noise {insensitive}"
                )
        return effect

    def _require_noise(self, what: str) -> Array:
        if self.noise_std is None:
            raise ValueError(self._no_noise(what))
        return self.noise_std

    def _no_noise(self, what: str) -> str:
        return (
            f"no {what}: {self.num_measurements} measurements leave no residual degree "
            f"of freedom for {self.num_inputs + 1} regressors, so the noise is "
            "unknown; measure more postures or give noise_std"
        )

    def _quantile(self, confidence: float) -> float:
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"confidence must be in (0, 1), got {confidence}")
        from scipy import special

        upper = 0.5 + 0.5 * confidence
        if self.noise_known:
            return float(special.ndtri(upper))
        return float(special.stdtrit(self.noise_dof, upper))


def identify(
    commands: ArrayLike,
    measured: ArrayLike,
    *,
    noise_std: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    common_noise: bool = False,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    command_unit: str = "",
    measured_unit: str = "",
    notes: Mapping[str, Any] | None = None,
) -> Calibration:
    """Fit ``y = A u + b`` by weighted least squares.

    Args:
        commands: (N, n) what the device was told, in any unit; N >= n + 1.
        measured: (N, m) what it reached, in any unit.
        noise_std: () or (m,) known standard deviation of a measurement of weight 1, in
            the measured unit; estimated from the residuals when not given.
        weights: (N,) a measurement of weight w has variance noise_std^2 / w (the number
            of readings averaged, say); 0 leaves it out. All 1 when not given.
        common_noise: estimate one noise level for all outputs (they must share a unit),
            which has m times the degrees of freedom. With five postures of three axes
            a 95 % interval is 3.2 standard errors wide instead of 12.7.
        input_names: n names; u_x, u_y, u_z or u_1 ... u_n when not given.
        output_names: m names, likewise y_x or y_1.
        command_unit: stored with the result.
        measured_unit: stored with the result.
        notes: anything JSON can hold, stored under ``provenance["notes"]``.

    Returns:
        The calibration; its covariance is None where N = n + 1 and no noise was given.

    Raises:
        ValueError: naming the argument, the rule and the value; for commands that leave
            a direction unexcited, naming that direction.
    """
    commands = table("commands", commands)
    measured = table("measured", measured)
    if len(commands) != len(measured):
        raise ValueError(
            "commands and measured must have as many rows, got "
            f"{len(commands)} and {len(measured)}"
        )
    n, m = commands.shape[1], measured.shape[1]
    inputs = axis_names("input_names", input_names, "u", n)
    outputs = axis_names("output_names", output_names, "y", m)
    weight = relative_weights(weights, len(commands))
    noise = noise_levels(noise_std, m)
    if noise is not None and common_noise:
        raise ValueError(
            "common_noise says how to estimate the noise and noise_std what it is: "
            "give one of them"
        )
    used = weight > 0.0
    u, y, w = commands[used], measured[used], weight[used]
    require_excited(u, inputs)

    total = float(w.sum())
    share = w / total
    centre = share @ u
    offset = u - centre
    scale = np.sqrt(share @ offset**2)
    at_centre = share @ y
    root = np.sqrt(w)[:, None]
    left, singular, right = np.linalg.svd(root * (offset / scale), full_matrices=False)
    inverse = right.T / singular
    slopes = inverse @ (left.T @ (root * (y - at_centre)))
    matrix = (slopes / scale[:, None]).T
    fitted = at_centre + ((commands - centre) / scale) @ slopes
    residuals = measured - fitted

    dof = len(u) - (n + 1)
    squares = share @ residuals[used] ** 2 * total
    residual_std = np.sqrt(squares / dof) if dof else None
    overall = float(np.sqrt(squares.sum() / (m * dof))) if dof else None
    known = noise is not None
    noise_dof = 0
    if noise is None and dof:
        assert residual_std is not None and overall is not None
        noise = np.full(m, overall) if common_noise else residual_std
        noise_dof = m * dof if common_noise else dof

    weighted_rows = root * np.column_stack([u, np.ones(len(u))])
    scaled = np.append(singular, np.sqrt(total))
    return Calibration(
        matrix=_frozen(matrix),
        bias=_frozen(at_centre - matrix @ centre),
        residuals=_frozen(residuals),
        noise_std=None if noise is None else _frozen(noise),
        noise_known=known,
        noise_dof=noise_dof,
        residual_std=None if residual_std is None else _frozen(residual_std),
        residual_std_overall=overall,
        dof=dof,
        condition_number=float(np.linalg.cond(weighted_rows)),
        scaled_condition_number=float(scaled.max() / scaled.min()),
        num_measurements=len(u),
        centre=_frozen(centre),
        scale=_frozen(scale),
        slope_covariance=_frozen(inverse @ inverse.T),
        total_weight=total,
        input_names=inputs,
        output_names=outputs,
        command_unit=text("command_unit", command_unit),
        measured_unit=text("measured_unit", measured_unit),
        provenance=_provenance(commands, measured, weight, notes),
    )


def _provenance(
    commands: Array, measured: Array, weight: Array, notes: Mapping[str, Any] | None
) -> dict[str, Any]:
    import json

    import jaxcal

    try:
        noted = json.loads(json.dumps(dict(notes or {}), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"notes must be what JSON can hold: {error}") from None
    digest = hashlib.sha256()
    for array in (commands, measured, weight):
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "packages": {
            "jaxcal": jaxcal.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "data_sha256": digest.hexdigest(),
        "notes": noted,
    }


def _frozen(array: Array) -> Array:
    copy = np.array(array, dtype=np.float64)
    copy.setflags(write=False)
    return copy
