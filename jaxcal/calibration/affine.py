"""The fitted map y = A u + b: its parameters, their uncertainty, its predictions.

The noise is assumed white: independent between postures and between outputs, of one
level for each output. Parameters are in the paper's order (Equation 9): A row by row,
then b. Source: paper, Equations 2 to 4; Seber and Lee, Linear Regression Analysis,
chapter 3.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration.base import Calibration
from jaxcal.checks import axis_letter

__all__ = ["AffineFit"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AffineFit(Calibration):
    """What least squares found."""

    matrix: Array  # (m, n) A, measured unit per command unit
    bias: Array  # (m,) b, measured unit
    residual_std: Array | None  # (m,) from the residuals alone; None without freedom
    residual_std_overall: float | None  # the same over all outputs
    dof: int  # residual degrees of freedom of each output, N - (n + 1)
    condition_number: float  # of the regression matrix; depends on the command unit
    scaled_condition_number: float  # of the centred, scaled one; does not
    centre: Array  # (n,) weighted mean of the commands
    scale: Array  # (n,) root mean square of the commands about it
    slope_covariance: Array  # (n, n) of a row of A * scale, for unit noise
    total_weight: float  # 1 / variance of an output predicted at the centre, unit noise

    # -- parameters ------------------------------------------------------------------

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

    # -- inside ------------------------------------------------------------------------

    def _no_noise(self, what: str) -> str:
        return (
            f"no {what}: {self.num_measurements} measurements leave no residual degree "
            f"of freedom for {self.num_inputs + 1} regressors, so the noise is "
            "unknown; measure more postures or give noise_std"
        )
