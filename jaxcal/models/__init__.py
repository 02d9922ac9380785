"""What a machine does with a command: ``y = f(u; theta)``, its names and derivative.

Arms and their sensors are ``jaxcal.arms``; their names are here too, and load it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from jaxcal.models.affine import Affine
from jaxcal.models.from_dict import from_dict
from jaxcal.models.identifiability import Direction, Identifiability, identifiability
from jaxcal.models.model import Model
from jaxcal.models.recording import Recording
from jaxcal.models.uncertainty import Noise, Prior, ResolvedPrior

if TYPE_CHECKING:
    from jaxcal.models.differences import Differences
    from jaxcal.models.from_jax import FromJax
    from jaxcal.models.function import FromFunction
    from jaxcal.models.linear import Linear, Polynomial

__all__ = [
    "Affine",
    "Differences",
    "Direction",
    "FromFunction",
    "FromJax",
    "Identifiability",
    "Linear",
    "Model",
    "Noise",
    "Polynomial",
    "Prior",
    "Recording",
    "ResolvedPrior",
    "from_dict",
    "identifiability",
]

_HOME = {
    "Differences": "differences",
    "FromFunction": "function",
    "FromJax": "from_jax",
    "Linear": "linear",
    "Polynomial": "linear",
}


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # asked of every module, as by inspect
        raise AttributeError(name)
    near = f"jaxcal.models.{_HOME.get(name)}"
    home = importlib.import_module(near if name in _HOME else "jaxcal.arms")
    if name not in home.__all__:
        raise AttributeError(f"module 'jaxcal.models' has no attribute {name!r}")
    globals()[name] = value = getattr(home, name)
    return value
