"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``fit`` holds what was found and predicts; ``calibration`` adds ``check``, the
``inverse``, the summary and the ``file``. ``identify`` checks arguments, ``estimate``
makes the fit of them, ``solve`` is its search, for every model.
"""

from jaxcal.calibration.budget import Budget, Source
from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.identify import identify

__all__ = ["Budget", "Calibration", "Source", "identify"]
