"""An arm and what its kinematics leave out: the harmonics of its joints."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from jaxcal.models import SerialChain
from jaxcal.models.model import facts

__all__ = ["WithHarmonics"]

Array = NDArray[np.float64]


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
