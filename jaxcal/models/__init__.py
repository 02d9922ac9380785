"""What a machine does with a command: ``y = f(u; theta)``, its names and derivative."""

from jaxcal.models.affine import Affine
from jaxcal.models.identifiability import identifiability
from jaxcal.models.kinds import from_dict
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Noise, Prior, ResolvedPrior

__all__ = [
    "Affine",
    "Model",
    "Noise",
    "Prior",
    "ResolvedPrior",
    "from_dict",
    "identifiability",
]
