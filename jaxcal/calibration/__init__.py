"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``calibration`` is what it answers, ``inverse`` how it is inverted, ``file`` its format.
``closed_form`` fits the affine model; ``estimate`` (from arguments to the fit),
``solve`` (the search) and ``discrepancy`` every other one.
"""

from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.identify import identify

__all__ = ["Calibration", "identify"]
