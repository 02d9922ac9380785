"""From measurements to a calibration: ``identify`` and the ``Calibration`` it returns.

``identify`` checks the arguments, ``fit_model`` makes a problem of them, which
``least_squares`` solves for every model, and of its solution the fields of a ``fit``;
``calibration`` adds ``check``, the ``inverse``, the summary and the ``file``.
"""

from __future__ import annotations

import importlib
from typing import Any

from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.fit import CalibrationWarning
from jaxcal.calibration.identify import identify
from jaxcal.calibration.verdict import Verdict

__all__ = [
    "Budget",
    "Calibration",
    "CalibrationWarning",
    "Check",
    "Source",
    "Verdict",
    "identify",
]


_HOME = {
    "Budget": "jaxcal.reports.budget",
    "Check": "jaxcal.calibration.check",
    "Mispairing": "jaxcal.calibration.pairing",
    "Source": "jaxcal.reports.budget",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal.calibration' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)
