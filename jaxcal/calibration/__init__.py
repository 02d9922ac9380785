"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

One direction: ``fit`` (data, uncertainty, prediction) <- ``inverse``, ``table``,
``file`` <- ``result`` (the class) <- ``identify``.
"""

from jaxcal.calibration.identify import identify
from jaxcal.calibration.result import Calibration

__all__ = ["Calibration", "identify"]
