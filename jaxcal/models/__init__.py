"""What a machine does with a command: ``y = f(u; theta)``, its names and derivative."""

from jaxcal.models.affine import Affine

__all__ = ["Affine"]
