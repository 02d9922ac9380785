"""The step by which readings differ, where a display or a converter rounded them."""

from __future__ import annotations

import math

import numpy as np

from jaxcal.checks import Array

COARSE = 50.0  # steps that readings must span to show one
_FINEST, _ROUNDED = 1e-6, 1e-9  # of the largest reading: a sensor's step; its rounding


def resolution(readings: Array, least: float = 0.0) -> Array:
    """(m,) of which differences of readings (N, m) are multiples, by Euclid; 0 where
    these have more digits than a sensor shows, or lie fewer than ``least`` apart."""
    size = np.abs(readings).max(axis=0)
    steps = np.zeros(readings.shape[1])
    for j in size.nonzero()[0]:
        for gap in (np.diff(np.unique(readings[:, j])) / size[j]).tolist():
            while gap > _ROUNDED:
                steps[j], gap = gap, abs(math.remainder(steps[j], gap))
            if steps[j] < _FINEST:
                steps[j] = 0.0
                break
    steps *= size
    return np.where(np.ptp(readings, axis=0) < least * steps, 0.0, steps)
