"""jaxcal: which few postures to measure, and the calibration that follows.

``select`` picks the D-optimal few of many candidate postures, ``identify`` fits
``y = A u + b`` to what was measured there. Names load on first use, so importing
jaxcal costs no more than numpy.
"""

from __future__ import annotations

import importlib
import pathlib
import sys
from typing import TYPE_CHECKING, Any

from jaxcal import compiled, moved

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration, CalibrationWarning
    from jaxcal.calibration.identify import identify
    from jaxcal.designs import Motion, optimise
    from jaxcal.information.regression import log_det_information, regression_matrix
    from jaxcal.models import Noise, Prior
    from jaxcal.models.identifiability import identifiability
    from jaxcal.selection import As, Design, Ds, I, Mean, Selection, Worst, select
    from jaxcal.tables import read_table

__all__ = [
    "As",
    "Calibration",
    "CalibrationWarning",
    "Design",
    "Ds",
    "I",
    "Mean",
    "Motion",
    "Noise",
    "Prior",
    "Selection",
    "Worst",
    "identifiability",
    "identify",
    "log_det_information",
    "optimise",
    "read_table",
    "regression_matrix",
    "select",
]

__version__ = "0.2.0"

sys.meta_path.insert(0, moved.Finder)  # type: ignore[arg-type]  # its class serves
_PACKAGE = pathlib.Path(__file__).parent
if (_PACKAGE.parent / "pyproject.toml").exists():
    compiled.check(_PACKAGE)

_HOME = {  # the others are in jaxcal.information.regression
    "jaxcal.calibration": ("Calibration", "CalibrationWarning", "identify"),
    "jaxcal.designs": ("Motion", "optimise"),
    "jaxcal.models": ("Noise", "Prior", "identifiability"),
    "jaxcal.selection": (
        *("As", "Design", "Ds", "I", "Mean", "Selection", "Worst", "select"),
    ),
    "jaxcal.tables": ("read_table",),
}
_ROOMS = (
    *("adaptive", "arms", "calibration", "candidates", "designs", "learning", "models"),
    *("reports", "selection", "tables"),
)


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"jaxcal.{name}")
    if name not in __all__:
        raise AttributeError(f"module 'jaxcal' has no attribute {name!r}")
    homes = (home for home, names in _HOME.items() if name in names)
    home = next(homes, "jaxcal.information.regression")
    globals()[name] = value = getattr(importlib.import_module(home), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS})
