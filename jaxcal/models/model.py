"""What every model answers: ``y = f(u; theta)``, its derivatives, names and prior.

``predict``, ``derivative`` and ``facts`` ask it and check the answer.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, in_words
from jaxcal.models.uncertainty import Prior

__all__ = [
    "Model",
    "as_commands",
    "as_parameters",
    "by_name",
    "derivative",
    "facts",
    "predict",
    "require_model",
]

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


def require_model(model: Any) -> None:
    """Refuse a class, and what has not the methods of a model."""
    methods = ("predict", "jacobian", "command_jacobian", "default_prior")
    missing = [name for name in methods if not callable(getattr(model, name, None))]
    if missing or isinstance(model, type):
        got = repr(model) if isinstance(model, type) else type(model).__name__
        raise ValueError(
            "model must be of jaxcal.models, or an object with the methods of "
            f"jaxcal.models.Model, got {got}"
            + (f" without {missing[0]}" if missing else "")
        )


def as_commands(model: Any, commands: ArrayLike) -> Array:
    """``commands`` as finite float64 (N, n); of a data frame the model's columns."""
    commands = by_name(model, commands)
    rule = " for this model"
    return array_of("commands", commands, "N", model.num_inputs, rule=rule)


def as_parameters(model: Model, parameters: ArrayLike | None) -> Array:
    """``parameters`` as finite float64 (p,); the nominal ones for None."""
    if parameters is None:
        return model.nominal
    size = model.num_parameters
    return array_of("parameters", parameters, size, rule=" for this model")


def by_name(model: Any, commands: Any) -> Any:
    """Of a data frame the columns that the model names, in its order; else as given."""
    inputs = getattr(model, "inputs", ()) if hasattr(commands, "columns") else ()
    if not inputs:
        return commands
    missing = [name for name in inputs if name not in commands.columns]
    if missing:
        raise ValueError(
            f"commands must have the columns {', '.join(inputs)}, "
            f"{missing[0]!r} is missing"
        )
    return commands[list(inputs)]


def predict(
    model: Model, commands: Array, parameters: Array, *, finite: bool = True
) -> Array:
    """(N, q) outputs; with ``finite`` a ValueError names the first that is not.

    Without it, as for trial steps, NaN stands for what the model refuses to answer.
    """
    shape = (len(commands), model.num_outputs)
    with np.errstate(all="ignore"):
        try:
            found = np.asarray(model.predict(commands, parameters), dtype=np.float64)
        except ValueError:
            if finite:
                raise
            return np.full(shape, np.nan)
    _require_shape("predict", found, shape)
    bad = np.flatnonzero(~np.isfinite(found).all(axis=1))
    if finite and bad.size:
        raise ValueError(
            f"model.predict must be finite, got {in_words(found[bad[0]])} for the "
            f"command {in_words(commands[bad[0]])}"
        )
    return found


def derivative(
    model: Model, commands: Array, parameters: Array, names: tuple[str, ...] = ()
) -> Array:
    """(N, q, p) by the parameters, or (N, q, n) by commands with these ``names``."""
    method = "command_jacobian" if names else "jacobian"
    names = names or model.names
    with np.errstate(all="ignore"):
        found = getattr(model, method)(commands, parameters)
    found = np.asarray(found, dtype=np.float64)
    _require_shape(method, found, (len(commands), model.num_outputs, len(names)))
    bad = ~np.isfinite(found)
    for row, output, column in np.argwhere(bad)[:1] if bad.any() else ():
        # A forward derivative may spoil the columns beside that of the one to blame.
        by = ", ".join(np.array(names)[bad[row, output]])
        raise ValueError(
            f"model.{method} must be finite, got {found[row, output, column]} by {by} "
            f"for the command {in_words(commands[row])}"
        )
    return found


def facts(model: Model, parameters: Array) -> tuple[Array, Array]:
    """What a model knows besides the prior: (F,) off, (F, P) derivative, whitened."""
    if not hasattr(model, "facts"):
        return np.zeros(0), np.zeros((0, len(parameters)))
    off, rows = model.facts(parameters)
    return np.asarray(off), np.asarray(rows)


def _require_shape(method: str, found: Array, shape: tuple[int, ...]) -> None:
    if found.shape != shape:
        raise ValueError(f"model.{method} must return {shape}, got {found.shape}")
