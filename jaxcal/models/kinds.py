"""Models from JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from jaxcal.checks import one_of
from jaxcal.models.affine import Affine
from jaxcal.models.linear import Linear
from jaxcal.models.model import Model
from jaxcal.models.polynomial import Polynomial
from jaxcal.models.serial import SerialChain

__all__ = ["from_dict"]


def _of_function(data: Mapping[str, Any]) -> Model:
    raise ValueError(
        f"a model of kind {data['kind']} holds a function, which a file cannot: "
        "give the model itself, model=..."
    )


def _affine(data: Mapping[str, Any]) -> Affine:
    return Affine(data["num_inputs"], data["num_outputs"])


def _linear(data: Mapping[str, Any]) -> Model:
    if data["features"] is None:
        return _of_function(data)
    return Linear(data["features"], data["num_outputs"], inputs=data["inputs"])


def _polynomial(data: Mapping[str, Any]) -> Polynomial:
    return Polynomial(data["degree"], data["num_inputs"], data["num_outputs"])


_KINDS: dict[str, Callable[[Mapping[str, Any]], Model]] = {
    "affine": _affine,
    "jax": _of_function,
    "linear": _linear,
    "polynomial": _polynomial,
    "serial_chain": SerialChain.from_dict,
}


def from_dict(data: Mapping[str, Any]) -> Model:
    """The model that ``to_dict`` wrote.

    Raises:
        ValueError: the kind is unknown, or a function made the model.
    """
    kind = one_of("kind of the model", data.get("kind"), tuple(_KINDS))
    try:
        return _KINDS[kind](data)
    except KeyError as error:
        raise ValueError(f"a model of kind {kind} must hold {error}") from error
