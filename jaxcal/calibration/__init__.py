"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``base`` is what every calibration answers. The affine fit in closed form: ``affine``
(data, uncertainty, prediction), ``affine_inverse``, ``affine_table``, ``affine_file``
and ``result``, which puts them together. Every other model: ``solve`` (the search),
``estimate`` (from arguments to the fit), ``model`` (the calibration), ``reach`` (its
inverse), ``discrepancy``. ``file`` is the format of both.
"""

from jaxcal.calibration.base import Calibration
from jaxcal.calibration.identify import identify
from jaxcal.calibration.result import AffineCalibration

__all__ = ["AffineCalibration", "Calibration", "identify"]
