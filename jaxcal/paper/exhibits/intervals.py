"""Confidence intervals and paired comparisons, all at 95 %.

Means: Student's t over independent episodes. Medians: order statistics. Shares:
Wilson's. Anything else: the percentile bootstrap over episodes, with the same episodes
drawn for both sides of a comparison. Four random postures can lie arbitrarily near a
plane, so errors that come from them have no finite mean: there medians are compared.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Interval",
    "Paired",
    "bootstrap",
    "bootstrap_interval",
    "mean_interval",
    "median_interval",
    "paired",
    "share_interval",
]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval and how many stand behind it."""

    value: float
    low: float
    high: float
    n: int

    def __format__(self, spec: str) -> str:
        spec = spec or ".3g"
        return f"{self.value:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"

    def as_dict(self) -> dict[str, float]:
        """For the JSON."""
        return dataclasses.asdict(self)


def mean_interval(values: ArrayLike, most: float = np.inf) -> Interval:
    """Mean of independent values, with Student's t.

    Args:
        values: (E,) one an episode, at least two.
        most: the largest value there can be; the interval ends there.
    """
    from scipy import stats

    sample = np.asarray(values, dtype=np.float64)
    mean = float(sample.mean())
    error = float(sample.std(ddof=1)) / np.sqrt(len(sample))
    half = float(stats.t.ppf(0.975, len(sample) - 1)) * error
    return Interval(mean, mean - half, min(mean + half, most), len(sample))


def median_interval(values: ArrayLike) -> Interval:
    """Median of independent values, between two order statistics.

    Args:
        values: (E,) one an episode, at least six.
    """
    from scipy import stats

    sample = np.sort(np.asarray(values, dtype=np.float64))
    n = len(sample)
    below = max(int(stats.binom.ppf(0.025, n, 0.5)), 1)
    return Interval(
        float(np.median(sample)), float(sample[below - 1]), float(sample[n - below]), n
    )


def share_interval(hits: ArrayLike) -> Interval:
    """Share of true values, with Wilson's interval.

    Args:
        hits: (E,) bool.
    """
    sample = np.asarray(hits, dtype=bool)
    n, share, z = len(sample), float(sample.mean()), 1.959963984540054
    centre = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    spread = share * (1 - share) / n + z**2 / (4 * n**2)
    half = z * float(np.sqrt(spread)) / (1 + z**2 / n)
    return Interval(share, max(centre - half, 0.0), min(centre + half, 1.0), n)


def bootstrap(
    statistic: Callable[..., Any],
    samples: tuple[NDArray[Any], ...],
    rng: np.random.Generator,
    resamples: int = 2_000,
) -> tuple[Array, Array, Array]:
    """A statistic of whole episodes with its percentile interval.

    Args:
        statistic: of arrays like ``samples``; a number or an array.
        samples: each (E, ...); the same episodes are drawn from all.
        rng: of the draws.
        resamples: how many.

    Returns:
        The statistic of the samples, lower and upper end, each of its shape.
    """
    count = len(samples[0])
    if any(len(sample) != count for sample in samples):
        raise ValueError("samples must hold the same episodes")
    value = np.asarray(statistic(*samples), dtype=np.float64)
    draws = np.empty((resamples, *value.shape))
    for i in range(resamples):
        again = rng.integers(0, count, count)
        draws[i] = statistic(*(sample[again] for sample in samples))
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    return value, low, high


def bootstrap_interval(
    statistic: Callable[..., Any],
    samples: tuple[NDArray[Any], ...],
    rng: np.random.Generator,
    resamples: int = 2_000,
) -> Interval:
    """``bootstrap`` of a single number."""
    value, low, high = bootstrap(statistic, samples, rng, resamples)
    return Interval(float(value), float(low), float(high), len(samples[0]))


@dataclasses.dataclass(frozen=True)
class Paired:
    """One method against another on the same episodes."""

    difference: Interval  # mean of a - b
    a_lower: Interval  # share of episodes in which a is the smaller
    ratio_of_means: Interval  # mean a / mean b
    ratio_of_medians: Interval

    def as_dict(self) -> dict[str, Any]:
        """For the JSON."""
        return dataclasses.asdict(self)


def paired(
    a: ArrayLike, b: ArrayLike, rng: np.random.Generator, resamples: int = 2_000
) -> Paired:
    """Compare two values an episode.

    Args:
        a: (E,) of one method.
        b: (E,) of the other, on the same episodes.
        rng: of the bootstrap behind the ratios.
        resamples: of it.
    """
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if first.shape != second.shape or first.ndim != 1:
        raise ValueError(
            f"a and b must hold the same episodes, got {first.shape}, {second.shape}"
        )
    means, medians = (
        bootstrap_interval(
            lambda x, y, of=of: of(x) / of(y), (first, second), rng, resamples
        )
        for of in (np.mean, np.median)
    )
    return Paired(
        mean_interval(first - second), share_interval(first < second), means, medians
    )
