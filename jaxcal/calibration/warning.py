"""A warning that is given once for each line of a program, whatever it says."""

from __future__ import annotations

import warnings


class CalibrationWarning(UserWarning):
    """A calibration is not good, and why; or it is used far from its measurements.

    Python shows the first of each kind for a line of a program, whatever it says, and
    none after ``warnings.simplefilter("ignore", jaxcal.CalibrationWarning)``.
    """

    kind = ""

    def __str__(self) -> str:
        # Python shows a text once for each line: at its first look it is the kind.
        return vars(self).pop("kind", "") or super().__str__()


def warn(text: str, kind: str, stacklevel: int) -> None:
    """Issue a CalibrationWarning of a kind, for which texts of calls differ."""
    warning = CalibrationWarning(text)
    warning.kind = kind
    warnings.warn(warning, stacklevel=stacklevel + 1)
