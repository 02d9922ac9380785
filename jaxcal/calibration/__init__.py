"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``identify`` checks the arguments, ``fit_model`` makes a problem of them and of its
solution the fields of a calibration; ``least_squares`` is the search, for every model,
``losses`` what an outlier counts, ``prior_scales`` how large a machine's errors are.
``fit`` holds the fields and predicts; ``calibration`` adds ``check``, the ``inverse``,
the summary and the ``file``.
"""

from jaxcal.calibration.budget import Budget, Source
from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.check import Check
from jaxcal.calibration.identify import identify
from jaxcal.calibration.pairing import Mispairing
from jaxcal.models.verdict import Verdict

__all__ = [
    "Budget",
    "Calibration",
    "Check",
    "Mispairing",
    "Source",
    "Verdict",
    "identify",
]
