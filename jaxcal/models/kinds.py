"""Models from JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from jaxcal.checks import one_of
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model

__all__ = ["from_dict"]


def _affine(data: Mapping[str, Any]) -> Affine:
    return Affine(data["num_inputs"], data["num_outputs"])


_KINDS: dict[str, Callable[[Mapping[str, Any]], Model]] = {"affine": _affine}


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
