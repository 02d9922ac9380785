"""Models of a machine: ``y = f(u; theta)``, its names and derivative.

Arms and their sensors are ``jaxcal.arms``; their names are here too, and load it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from jaxcal.models.identifiability import Identifiability, identifiability
from jaxcal.models.linear import Affine, Linear, Polynomial
from jaxcal.models.model import Model, Recording, from_dict
from jaxcal.models.uncertainty import Noise, Prior

if TYPE_CHECKING:
    from jaxcal.models.from_jax import FromJax
    from jaxcal.models.function import FromFunction

__all__ = [
    "Affine",
    "FromFunction",
    "FromJax",
    "Identifiability",
    "Linear",
    "Model",
    "Noise",
    "Polynomial",
    "Prior",
    "Recording",
    "from_dict",
    "identifiability",
]

_HOME = {
    "FromFunction": "jaxcal.models.function",
    "FromJax": "jaxcal.models.from_jax",
}


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # asked of every module, as by inspect
        raise AttributeError(name)
    home = importlib.import_module(_HOME.get(name, "jaxcal.arms"))
    if name not in (*_HOME, *getattr(home, "__all__", ())):
        raise AttributeError(f"module 'jaxcal.models' has no attribute {name!r}")
    globals()[name] = value = getattr(home, name)
    return value
