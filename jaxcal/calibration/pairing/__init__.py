"""Whether a table's readings belong to the commands beside them; how they do if not."""

from jaxcal.calibration.pairing.judge import (
    Mispairing,
    against,
    mispairing,
    of_new_readings,
    of_unfitted,
)

__all__ = [
    "Mispairing",
    "against",
    "mispairing",
    "of_new_readings",
    "of_unfitted",
]
