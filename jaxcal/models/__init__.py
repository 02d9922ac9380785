"""What a machine does with a command: ``y = f(u; theta)``, its names and derivative."""

from jaxcal.models.affine import Affine
from jaxcal.models.from_jax import FromJax
from jaxcal.models.identifiability import Direction, Identifiability, identifiability
from jaxcal.models.kinds import from_dict
from jaxcal.models.linear import Linear
from jaxcal.models.model import Model
from jaxcal.models.polynomial import Polynomial
from jaxcal.models.serial import SerialChain
from jaxcal.models.uncertainty import Noise, Prior, ResolvedPrior

__all__ = [
    "Affine",
    "Direction",
    "FromJax",
    "Identifiability",
    "Linear",
    "Model",
    "Noise",
    "Polynomial",
    "Prior",
    "ResolvedPrior",
    "SerialChain",
    "from_dict",
    "identifiability",
]
