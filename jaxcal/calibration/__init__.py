"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``base`` is what every calibration answers, ``file`` its format. The affine fit in
closed form: ``least_squares``; ``affine`` (data, uncertainty, prediction) with
``affine_inverse``, ``affine_table``, ``affine_file``; ``result`` puts them together.
Every other model: ``solve`` (the search), ``estimate`` (from arguments to the fit),
``model`` (the calibration), ``reach`` (its inverse), ``discrepancy``.
"""

from jaxcal.calibration.base import Calibration
from jaxcal.calibration.identify import identify
from jaxcal.calibration.model import ModelCalibration
from jaxcal.calibration.result import AffineCalibration

__all__ = ["AffineCalibration", "Calibration", "ModelCalibration", "identify"]
