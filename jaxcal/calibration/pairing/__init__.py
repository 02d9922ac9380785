"""Whether a table's readings belong to the commands beside them; how they do if not."""

from jaxcal.calibration.pairing.judge import (
    Mispairing,
    mispairing,
    of_new_readings,
    of_unfitted,
)
from jaxcal.calibration.pairing.verdict import against

__all__ = ["Mispairing", "against", "mispairing", "of_new_readings", "of_unfitted"]
