"""How noisy a mean of readings is when one reading tells something of the next.

A phone's fused attitude is filtered, so neighbouring readings err alike and n of them
average out less than n independent ones. The noise is taken for a first-order
autoregression, whose correlation after k readings is ``phi ** k``; phi is found from
the scatter of the readings about their means, all records together. Source: Sokal,
Monte Carlo methods in statistical mechanics, 1989, section 3 (integrated
autocorrelation time).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from rig.core.attitude import Array
from rig.journal import Record

MOST = 0.999  # of phi; a thousand readings are then one


def autocorrelation_time(phi: Array) -> Array:
    """Readings that tell as much as one: ``1 + 2 sum phi^k``, all k from 1 on."""
    return (1.0 + phi) / (1.0 - phi)


def mean_share(phi: Array, samples: int) -> Array:
    """Variance of the mean of ``samples`` readings, as a share of one reading's."""
    tail = 2.0 * phi * (1.0 - phi**samples) / (samples * (1.0 - phi) ** 2)
    return (autocorrelation_time(phi) - tail) / samples


def effective_samples(phi: Array, samples: int) -> Array:
    """Independent readings whose mean is as good as that of ``samples``."""
    return 1.0 / mean_share(phi, samples)


def correlation(series: Sequence[Array]) -> Array:
    """phi of each axis, in [0, 0.999].

    Taking each record's mean away hides slow noise. So phi is where the scatter at a
    distance of one reading, relative to that at none, is what a first-order
    autoregression of the same lengths leaves about its means.

    Args:
        series: (n, axes) readings of one record each, of any lengths.
    """
    lengths = np.array([len(values) for values in series])
    rest = [np.asarray(values) - np.mean(values, axis=0) for values in series]
    none = sum((values**2).sum(axis=0) for values in rest)
    one = sum((values[1:] * values[:-1]).sum(axis=0) for values in rest)

    def excess(phi: float, found: float) -> float:
        at_none, at_one = _expected(phi, lengths)
        return float(at_one / at_none - found)

    phis = np.zeros(np.shape(none))
    for axis, (square, product) in enumerate(zip(none, one, strict=True)):
        if square > 0.0 and excess(0.0, product / square) < 0.0:
            found = product / square
            late = excess(MOST, found) <= 0.0
            phis[axis] = MOST if late else brentq(excess, 0.0, MOST, args=(found,))
    return phis


def _expected(phi: float, lengths: Array) -> tuple[float, float]:
    """Sums of squares and of neighbours' products about the means, unit variance."""
    at_none = at_one = 0.0
    for n, times in zip(*np.unique(lengths, return_counts=True), strict=True):
        share = float(mean_share(np.array(phi), n))
        # A first and a last reading, of which each has one neighbour only.
        ends = (1.0 - phi**n) / (1.0 - phi) / n
        at_none += times * n * (1.0 - share)
        at_one += times * ((n - 1) * (phi - share) - 2.0 * share + 2.0 * ends)
    return at_none, at_one


def mean_variance(record: Record, phi: Array) -> Array:
    """(3,) degrees squared, of the mean of a posture's or the zero's readings.

    Args:
        record: ``std_deg`` (3,) of its readings about their mean, and ``samples``.
        phi: (3,) of ``correlation``.
    """
    samples = record["samples"]
    share = mean_share(phi, samples)
    about_mean = np.array(record["std_deg"]) ** 2 * (samples - 1) / samples
    return about_mean * share / (1.0 - share) if samples > 1 else about_mean
