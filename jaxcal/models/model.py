"""What every model answers: ``y = f(u; theta)``, its derivatives, names and prior."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of
from jaxcal.models.uncertainty import Prior

__all__ = ["Model", "as_commands", "as_parameters", "by_name"]

Array = NDArray[np.float64]


@runtime_checkable
class Model(Protocol):
    """n commands, p parameters, q outputs; everything is float64 in the caller's units.

    ``parameters=None`` stands for ``nominal`` in every method.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """p names of the parameters."""

    @property
    def nominal(self) -> Array:
        """(p,) parameters of the machine as it was designed."""

    @property
    def num_inputs(self) -> int:
        """n."""

    @property
    def num_outputs(self) -> int:
        """q."""

    @property
    def num_parameters(self) -> int:
        """p."""

    def predict(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """Outputs (N, q) at commands (N, n)."""

    def jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """(N, q, p) derivative of the outputs by the parameters."""

    def command_jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """(N, q, n) derivative of the outputs by the commands."""

    def default_prior(self) -> Prior:
        """What is known before measuring; infinite std where nothing is."""

    def to_dict(self) -> dict[str, Any]:
        """JSON with a ``kind``; :func:`jaxcal.models.from_dict` reads it."""


def as_commands(commands: ArrayLike, num_inputs: int) -> Array:
    """``commands`` as finite float64 (N, n)."""
    return array_of("commands", commands, "N", num_inputs, rule=" for this model")


def as_parameters(model: Model, parameters: ArrayLike | None) -> Array:
    """``parameters`` as finite float64 (p,); the nominal ones for None."""
    if parameters is None:
        return model.nominal
    size = model.num_parameters
    return array_of("parameters", parameters, size, rule=" for this model")


def by_name(model: Any, commands: Any) -> Any:
    """Of a data frame the columns that the model names, in its order; else as given."""
    inputs = getattr(model, "inputs", None)
    if not inputs or not hasattr(commands, "columns"):
        return commands
    missing = [name for name in inputs if name not in commands.columns]
    if missing:
        raise ValueError(
            f"commands must have the columns {', '.join(inputs)}, "
            f"{missing[0]!r} is missing"
        )
    return commands[list(inputs)]
