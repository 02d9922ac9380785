"""The fitted map y = A u + b: its parameters, their uncertainty, its predictions.

The noise is assumed white: independent between postures and between outputs, of one
level for each output. Parameters are in the paper's order (Equation 9): A row by row,
then b. Source: paper, Equations 2 to 4; Seber and Lee, Linear Regression Analysis,
chapter 3.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import axis_letter, numbers

__all__ = ["AffineFit"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AffineFit:
    """What least squares found; arrays are copied and frozen on entry."""

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

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = np.array(value, dtype=np.float64)
                value.setflags(write=False)
                object.__setattr__(self, field.name, value)
        object.__setattr__(self, "provenance", copy.deepcopy(self.provenance))

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
        slopes = self.slope_covariance / np.outer(self.scale, self.scale)
        shared = -slopes @ self.centre
        bias = 1.0 / self.total_weight - self.centre @ shared
        return np.block([[slopes, shared[:, None]], [shared, bias]])

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
        half = self._quantile(confidence) * np.asarray(self.standard_errors)
        return np.stack([self.parameters - half, self.parameters + half], axis=-1)

    def lack_of_fit(self) -> float | None:
        """p-value of residuals at least this large under the noise that was given.

        A small one (below 0.01, say) means that the device is not linear, that an
        outlier is among the measurements, or that the noise stated is too small. None
        where no noise was given or no residual degree of freedom is left.
        """
        if not self.noise_known or self.noise_std is None or self.residual_std is None:
            return None
        from scipy import special

        square = self.dof * float(np.sum((self.residual_std / self.noise_std) ** 2))
        return float(special.chdtrc(self.dof * self.num_outputs, square))

    # -- prediction ------------------------------------------------------------------

    def predict(self, commands: ArrayLike) -> Array:
        """Postures reached.

        Args:
            commands: (..., n) in the command unit.

        Returns:
            (..., m) in the measured unit.
        """
        points = self._points("commands", commands, self.num_inputs)
        return points @ self.matrix.T + self.bias

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

    # -- inside ------------------------------------------------------------------------

    def _points(self, name: str, values: ArrayLike, width: int) -> Array:
        points = numbers(name, values)
        if points.ndim < 1 or points.shape[-1] != width:
            raise ValueError(
                f"{name} must have shape (..., {width}), got {points.shape}"
            )
        return points

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
        """Half-width of an interval in standard errors."""
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"confidence must be in (0, 1), got {confidence}")
        from scipy import special  # loads in half the time of scipy.stats

        upper = 0.5 + 0.5 * confidence
        if self.noise_known:
            return float(special.ndtri(upper))
        return float(special.stdtrit(self.noise_dof, upper))
