"""Serial arms: from a DH table or a URDF file."""

from jaxcal.models.serial.chain import SerialChain

__all__ = ["SerialChain"]
