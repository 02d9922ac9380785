"""A model and what it leaves out.

Of an arm the harmonics of its joints. Of any model a smooth function of the commands,
unknown a priori: random Fourier features (Rahimi and Recht, 2007) of a Matern-3/2
process as wide as the commands: ``y = f(u; theta) + sum of c_k sqrt(2 / D) cos(w_k u +
b_k)``, the same D features with coefficients of their own for every output. The
coefficients are normal with one size, which is estimated; where the size is small the
model is good.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from jaxcal.models import Model, SerialChain
from jaxcal.models.checked import facts

__all__ = ["WithDiscrepancy", "WithHarmonics"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class WithDiscrepancy:
    """A model with p parameters as one with p + q D, as far as a fit needs it."""

    model: Model
    frequencies: Array  # (n, D) per command unit
    phases: Array  # (D,)

    @classmethod
    def over(cls, model: Model, commands: Array, count: int) -> WithDiscrepancy:
        """``count`` features drawn for commands (N, n); the same draw every time."""
        rng = np.random.default_rng(0)
        n = commands.shape[1]
        spread = commands.std(axis=0) * np.sqrt(n)
        heavy = np.sqrt(rng.chisquare(3.0, count) / 3.0)
        draws = rng.normal(size=(n, count)) / heavy
        inverse = np.where(spread > 0.0, 1.0 / np.where(spread > 0.0, spread, 1.0), 0.0)
        phases = rng.uniform(0.0, 2.0 * np.pi, count)
        return cls(model, draws * inverse[:, None], phases)

    @property
    def num_outputs(self) -> int:
        return self.model.num_outputs

    @property
    def names(self) -> tuple[str, ...]:
        extra = range(self.num_outputs * len(self.phases))
        return (*self.model.names, *(f"discrepancy {i + 1}" for i in extra))

    def predict(self, commands: Array, parameters: Array) -> Array:
        own, size = self._split(parameters)
        phase = commands @ self.frequencies + self.phases
        return self.model.predict(commands, own) + self._scale * np.cos(phase) @ size.T

    def jacobian(self, commands: Array, parameters: Array) -> Array:
        own, _ = self._split(parameters)
        phase = commands @ self.frequencies + self.phases
        features = self._scale * np.cos(phase)
        extra = np.einsum("ij,nd->nijd", np.eye(self.num_outputs), features)
        extra = extra.reshape(len(phase), self.num_outputs, -1)
        return np.concatenate([self.model.jacobian(commands, own), extra], axis=-1)

    def command_jacobian(self, commands: Array, parameters: Array) -> Array:
        own, size = self._split(parameters)
        phase = commands @ self.frequencies + self.phases
        slopes = -self._scale * np.sin(phase)
        extra = np.einsum("nd,qd,id->nqi", slopes, size, self.frequencies)
        return self.model.command_jacobian(commands, own) + extra

    def facts(self, parameters: Array) -> tuple[Array, Array]:
        own, size = self._split(parameters)
        off, rows = facts(self.model, own)
        return off, np.hstack([rows, np.zeros((len(off), size.size))])

    @property
    def _scale(self) -> float:
        return float(np.sqrt(2.0 / len(self.phases)))

    def _split(self, parameters: Array) -> tuple[Array, Array]:
        """Parameters (p,) of the model and coefficients (q, D)."""
        p = len(self.model.names)
        return parameters[:p], parameters[p:].reshape(self.num_outputs, -1)


@dataclasses.dataclass(frozen=True, eq=False)
class WithHarmonics:
    """An arm with p parameters as one whose joints have harmonics too, after them."""

    model: SerialChain

    @functools.cached_property
    def arm(self) -> SerialChain:
        """Which has them among its parameters."""
        return self.model.with_misfit()

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        own = self.model.names
        return (*own, *(name for name in self.arm.names if name not in own))

    @functools.cached_property
    def _order(self) -> list[int]:
        return [self.names.index(name) for name in self.arm.names]

    @property
    def std(self) -> Array:
        """(H,) of the harmonics, beforehand."""
        std = np.asarray(self.arm.default_prior().std)
        return std[np.argsort(self._order)][len(self.model.names) :]

    @property
    def num_outputs(self) -> int:
        return self.model.num_outputs

    def predict(self, commands: Array, parameters: Array) -> Array:
        return self.arm.predict(commands, parameters[self._order])

    def jacobian(self, commands: Array, parameters: Array) -> Array:
        slopes = self.arm.jacobian(commands, parameters[self._order])
        return slopes[..., np.argsort(self._order)]

    def command_jacobian(self, commands: Array, parameters: Array) -> Array:
        return self.arm.command_jacobian(commands, parameters[self._order])

    def facts(self, parameters: Array) -> tuple[Array, Array]:
        off, rows = facts(self.arm, parameters[self._order])
        return off, rows[:, np.argsort(self._order)]

    def calibrated(self, parameters: Array) -> SerialChain:
        """The arm with all of them."""
        return self.arm.calibrated(parameters[self._order])
