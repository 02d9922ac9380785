"""What a machine does with a command: ``y = f(u; theta)``, its names and derivative."""

from jaxcal.models.affine import Affine
from jaxcal.models.differences import Differences
from jaxcal.models.from_dict import from_dict
from jaxcal.models.from_jax import FromJax
from jaxcal.models.function import FromFunction
from jaxcal.models.identifiability import Direction, Identifiability, identifiability
from jaxcal.models.linear import Linear, Polynomial
from jaxcal.models.model import Model
from jaxcal.models.recording import Recording
from jaxcal.models.sensors import (
    Board,
    Distance,
    Gravity,
    Plane,
    Pose,
    Position,
    Reading,
    Sensor,
    Several,
    Socket,
    Tip,
    Wrench,
)
from jaxcal.models.serial import Chains, SerialChain, Servos
from jaxcal.models.uncertainty import Noise, Prior, ResolvedPrior

__all__ = [
    "Affine",
    "Board",
    "Chains",
    "Differences",
    "Direction",
    "Distance",
    "FromFunction",
    "FromJax",
    "Gravity",
    "Identifiability",
    "Linear",
    "Model",
    "Noise",
    "Plane",
    "Polynomial",
    "Pose",
    "Position",
    "Prior",
    "Reading",
    "Recording",
    "ResolvedPrior",
    "Sensor",
    "SerialChain",
    "Servos",
    "Several",
    "Socket",
    "Tip",
    "Wrench",
    "from_dict",
    "identifiability",
]
