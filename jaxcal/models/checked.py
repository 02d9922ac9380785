"""What a model answers, checked: the right shape, and finite where it has to be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import in_words
from jaxcal.models.model import Model

__all__ = ["derivative", "facts", "predict"]

Array = NDArray[np.float64]


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
    bad = np.argwhere(~np.isfinite(found))
    if len(bad):
        row, _, column = (int(i) for i in bad[0])
        raise ValueError(
            f"model.{method} must be finite, got {found[tuple(bad[0])]} by "
            f"{names[column]} for the command {in_words(commands[row])}"
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
