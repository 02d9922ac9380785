"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``fit`` holds what was found and predicts; ``calibration`` adds the judges (``verdict``,
``check``), the ``inverse``, the summary and the ``file``. ``identify`` fits the affine
model itself; ``estimate`` (from arguments to the fit) and ``solve`` (the search) every
other one.
"""

from jaxcal.calibration.budget import Budget, Source
from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.identify import identify

__all__ = ["Budget", "Calibration", "Source", "identify"]
