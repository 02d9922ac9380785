"""Models from JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from jaxcal.checks import one_of
from jaxcal.models.affine import Affine
from jaxcal.models.from_jax import FromJax
from jaxcal.models.function import FromFunction
from jaxcal.models.linear import Linear, Polynomial
from jaxcal.models.model import Model
from jaxcal.models.serial import Chains, SerialChain

__all__ = ["from_dict"]

# What makes a model of each kind; its arguments are the keys of the file.
_KINDS: dict[str, Callable[..., Model]] = {
    "affine": Affine,
    "chains": Chains.from_dict,
    "function": FromFunction,
    "jax": FromJax,
    "linear": Linear,
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
    fields = dict(data)
    kind = one_of("kind of the model", fields.pop("kind", None), tuple(_KINDS))
    if kind in ("jax", "function") or fields.get("features", "") is None:
        raise ValueError(
            "the model holds a function, which a file cannot: give the model itself, "
            "model=..."
        )
    if kind == "linear":  # a formula names its own
        fields.pop("terms", None)
    try:
        return _KINDS[kind](**fields)
    except TypeError as error:
        raise ValueError(
            f"a model of kind {kind} must hold values as to_dict writes them: {error}"
        ) from error
