"""A calibration's inverse map in the languages of controllers."""

from rig.workbench.outputs.export.inverse import InverseMap, load_inverse
from rig.workbench.outputs.export.languages import LANGUAGES

__all__ = ["LANGUAGES", "InverseMap", "load_inverse"]
