"""Models from JSON."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jaxcal.checks import one_of
from jaxcal.models.affine import Affine
from jaxcal.models.linear import Linear, Polynomial
from jaxcal.models.model import Model
from jaxcal.models.serial import SerialChain

__all__ = ["from_dict"]


def _linear(
    features: str | None, num_outputs: int, inputs: Sequence[str], terms: Sequence[str]
) -> Linear:
    if features is None:
        raise ValueError(_FUNCTION)
    return Linear(features, num_outputs, inputs=inputs)


def _jax(names: Sequence[str] = (), nominal: Sequence[float] = ()) -> Model:
    raise ValueError(_FUNCTION)


_FUNCTION = (
    "the model holds a function, which a file cannot: give the model itself, model=..."
)

# What makes a model of each kind; its arguments are the keys of the file.
_KINDS: dict[str, Callable[..., Model]] = {
    "affine": Affine,
    "jax": _jax,
    "linear": _linear,
    "polynomial": Polynomial,
    "serial_chain": SerialChain.from_dh,
}


def from_dict(data: Mapping[str, Any]) -> Model:
    """The model that ``to_dict`` wrote.

    Raises:
        ValueError: the kind is unknown, a key is missing, unknown or of another type,
            or a function made the model.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"a model must be a JSON object with a kind, got {data!r}")
    kind = one_of("kind of the model", data.get("kind"), tuple(_KINDS))
    given = {key: value for key, value in data.items() if key != "kind"}
    keys = inspect.signature(_KINDS[kind]).parameters
    for key in given:
        if key not in keys:
            raise ValueError(
                f"a model of kind {kind} must hold no other keys than "
                f"{', '.join(keys)}, got {key!r}"
            )
    for key, parameter in keys.items():
        if parameter.default is inspect.Parameter.empty and key not in given:
            raise ValueError(f"a model of kind {kind} must hold {key!r}")
    try:
        return _KINDS[kind](**given)
    except TypeError as error:
        raise ValueError(
            f"a model of kind {kind} must hold values as to_dict writes them: {error}"
        ) from error
