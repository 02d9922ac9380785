"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``fit`` holds what was found and predicts; ``calibration`` adds the judges (``verdict``,
``check``), the ``inverse``, the ``summary`` and the ``file``.
``closed_form`` fits the affine model; ``estimate`` (from arguments to the fit),
``solve`` (the search) every other one.
"""

from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.identify import identify

__all__ = ["Calibration", "identify"]
