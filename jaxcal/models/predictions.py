"""What a model predicts, its derivatives, and where it has none: checked answers."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, in_words
from jaxcal.information.singular import flat

if TYPE_CHECKING:
    from jaxcal.models.model import Model, Rows

_NAMED = 5  # candidates that a warning names


def predict(
    model: Model, commands: Array, parameters: Array, *, finite: bool = True
) -> Array:
    """(N, q) outputs; with ``finite`` a ValueError names the first that is not. Without
    it, as for trial steps, NaN stands for what the model refuses to answer."""
    shape = (len(commands), model.num_outputs)
    with np.errstate(all="ignore"):
        try:
            outputs = np.asarray(model.predict(commands, parameters), dtype=np.float64)
        except ValueError:
            if finite:
                raise
            return np.full(shape, np.nan)
    _require_shape("predict", outputs, shape)
    if finite and not np.isfinite(outputs).all():
        bad = np.isfinite(outputs).all(axis=1).argmin()
        raise ValueError(
            f"model.predict must be finite, got {in_words(outputs[bad])} for the "
            f"command {in_words(commands[bad])}"
        )
    return outputs


def derivative(
    model: Model, commands: Array, parameters: Array, names: tuple[str, ...] = ()
) -> Array:
    """(N, q, p) by the parameters, or (N, q, n) by commands with these ``names``."""
    method = "command_jacobian" if names else "jacobian"
    names = names or model.names
    with np.errstate(all="ignore"):
        slopes = getattr(model, method)(commands, parameters)
    slopes = np.asarray(slopes, dtype=np.float64)
    _require_shape(method, slopes, (len(commands), model.num_outputs, len(names)))
    if not np.isfinite(slopes).all():
        bad = ~np.isfinite(slopes)
        row, output, column = np.argwhere(bad)[0]
        # A forward derivative may spoil the columns beside that of the one to blame.
        by = ", ".join(np.array(names)[bad[row, output]])
        raise ValueError(
            f"model.{method} must be finite, got {slopes[row, output, column]} by {by} "
            f"for the command {in_words(commands[row])}"
        )
    return slopes


def answered(
    model: Model,
    commands: Array,
    parameters: Array | None,
    rows: Rows | None = None,
    names: Sequence[str] | None = None,
) -> NDArray[np.bool_]:
    """(N,) where the model has a prediction; a warning names the others, by the numbers
    of their ``rows`` (N,), or ``names`` of all rows."""
    lost = model.fitting.unanswered(commands, parameters) if len(commands) else {}
    mask = np.ones(len(commands), dtype=np.bool_)
    if lost:
        mask[list(lost)] = False
        named = []
        for i, reason in lost.items():
            row = i if rows is None else int(rows[i])
            named.append(f"{row if names is None else names[row]} ({reason})")
        more = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
        warnings.warn(
            f"{len(lost)} of {len(commands)} candidates are left out because the model "
            f"fails there: {', '.join(named[:_NAMED])}{more}",
            stacklevel=4,
        )
    return mask


def without_effect(jacobian: Array, sizes: Array) -> NDArray[np.bool_]:
    """(p,) parameters by which a derivative (N, q, p) is zero, or rounding. Outputs are
    judged one by one; ``sizes`` (p,) are ``Model.parameter_sizes``."""
    largest = np.abs(jacobian).max(axis=0, initial=0.0)
    zero = ~largest.any(axis=0)
    sized = np.isfinite(sizes)
    if not sized.any():
        return np.asarray(zero)
    effect = largest * np.where(sized, sizes, 0.0)
    beside = effect.max(axis=1, keepdims=True)
    return np.asarray(zero | (sized & flat(effect, beside).all(axis=0)))


def _require_shape(method: str, found: Array, shape: tuple[int, ...]) -> None:
    if found.shape != shape:
        raise ValueError(f"model.{method} must return {shape}, got {found.shape}")
