"""Serial arms: from a DH table or a URDF file."""

from jaxcal.models.serial.chain import SerialChain
from jaxcal.models.serial.chains import Chains
from jaxcal.models.serial.servos import Servos

__all__ = ["Chains", "SerialChain", "Servos"]
