"""The affine model ``y = A u + b``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, axis_letter, whole_number
from jaxcal.information.regression import regressors
from jaxcal.models.model import Model, Theta, as_commands, as_parameters


@dataclasses.dataclass(frozen=True)
class Affine(Model):
    """n inputs, m outputs; parameters are A row by row, then b (paper, Equation 9).

    The outputs share one regressor ``[u, 1]``: with unit noise the information of a
    posture is m equal diagonal blocks, so one block [u, 1] counted m times holds it.
    """

    num_inputs: int  # n
    num_outputs: int  # m

    def __post_init__(self) -> None:
        whole_number("num_inputs", self.num_inputs, 1)
        whole_number("num_outputs", self.num_outputs, 1)

    @property
    def multiplicity(self) -> int:
        """How often log det of the blocks counts: once per output."""
        return self.num_outputs

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """``a11 a12 ... bx by bz``; ``a1,10`` where there are more than nine."""
        n, m = self.num_inputs, self.num_outputs
        comma = "," if max(m, n) > 9 else ""
        slopes = [f"a{i + 1}{comma}{j + 1}" for i in range(m) for j in range(n)]
        return (*slopes, *(f"b{axis_letter(i, m)}" for i in range(m)))

    @property
    def nominal(self) -> Array:
        """(m (n + 1),) the outputs are the inputs: A is the identity, b is zero."""
        slopes = np.eye(self.num_outputs, self.num_inputs)
        return np.concatenate([slopes.ravel(), np.zeros(self.num_outputs)])

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Outputs (N, m) at commands (N, n) for parameters (m (n + 1),)."""
        matrix, bias = self.affine(as_parameters(self, parameters))
        return as_commands(self, commands) @ matrix.T + bias

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, m, m (n + 1)) derivative of the outputs; ``parameters`` do not matter."""
        commands = as_commands(self, commands)
        (count, n), m = commands.shape, self.num_outputs
        slopes = np.zeros((count, m, m * (n + 1)))
        for i in range(m):
            slopes[:, i, i * n : (i + 1) * n] = commands
        slopes[:, :, m * n :] = np.eye(m)
        return slopes

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, m, n): the matrix A for every command."""
        matrix, _ = self.affine(as_parameters(self, parameters))
        return np.broadcast_to(
            matrix, (len(as_commands(self, commands)), *matrix.shape)
        )

    def blocks(self, commands: ArrayLike) -> Array:
        """(..., N, 1, n + 1) information blocks [u, 1] of commands (..., N, n)."""
        return regressors(commands)[..., None, :]

    @property
    def linear(self) -> bool:
        return True

    def centred(self, centre: Array) -> Array:
        """(p, p): the outputs at the centre stand for b."""
        m, n = self.num_outputs, self.num_inputs
        to_centred = np.eye(m * (n + 1))
        for i in range(m):
            to_centred[m * n + i, i * n : (i + 1) * n] = centre
        return to_centred

    def affine(self, parameters: Array) -> tuple[Array, Array]:
        """A (m, n) and b (m,)."""
        m, n = self.num_outputs, self.num_inputs
        return parameters[: m * n].reshape(m, n), parameters[m * n :]

    @property
    def title(self) -> str:
        return "y = A u + b"

    def units_for(self, command_unit: str, measured_unit: str) -> tuple[str, ...]:
        slope = measured_unit
        if command_unit:
            slope = f"{measured_unit or '1'}/{command_unit}"
        m = self.num_outputs
        return (slope,) * (m * self.num_inputs) + (measured_unit,) * m

    def meanings(self, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
        return [
            *(f"{y} per {u}" for y in outputs for u in inputs),
            *(f"{y} at u = 0" for y in outputs),
        ]

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "affine", **dataclasses.asdict(self)}
