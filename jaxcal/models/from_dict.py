"""Models from JSON."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, cast

from jaxcal.checks import one_of
from jaxcal.extras import installed
from jaxcal.models.model import Model

_GROUP = "jaxcal.models"  # entry points by which others, as jaxcal.arms, add kinds
_KINDS = {"affine": "Affine", "linear": "Linear", "polynomial": "Polynomial"}
_UNWRITTEN = ("function", "jax")  # kinds that hold a function


def from_dict(data: Mapping[str, Any]) -> Model:
    """The model that ``to_dict`` wrote.

    Raises:
        ValueError: the kind is unknown, a key is missing, unknown or of another type,
            or a function made the model.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"a model must be a JSON object with a kind, got {data!r}")
    fields = dict(data)
    kind = fields.pop("kind", None)
    kinds = (*_KINDS, *_UNWRITTEN)
    others = {} if kind in kinds else installed(_GROUP)
    kind = one_of("kind of the model", kind, (*kinds, *others))
    if kind in _UNWRITTEN or fields.get("features", "") is None:
        raise ValueError(
            "the model contains a function, which cannot be saved: pass the model, "
            "model=..."
        )
    if kind == "linear":  # a formula names its own
        fields.pop("terms", None)
    if kind in others:
        make = others[kind].load()
    else:  # of the room, which loads it when asked
        make = getattr(sys.modules["jaxcal.models"], _KINDS[kind])
    try:
        return cast("Model", make(**fields))
    except TypeError as error:
        raise ValueError(
            f"a model of kind {kind} must hold values as to_dict writes them: {error}"
        ) from error
