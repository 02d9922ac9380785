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
from scipy import stats


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


def mean_interval(values: ArrayLike, upper_limit: float = np.inf) -> Interval:
    """Mean of (E,) independent values, two or more; no end above ``upper_limit``."""
    sample = np.asarray(values, dtype=np.float64)
    mean, count = float(sample.mean()), len(sample)
    half = float(stats.t.ppf(0.975, count - 1) * stats.sem(sample))
    return Interval(mean, mean - half, min(mean + half, upper_limit), count)


def median_interval(values: ArrayLike) -> Interval:
    """Median of (E,) independent values, six or more, between two order statistics."""
    sample = np.asarray(values, dtype=np.float64)
    ends = stats.quantile_test(sample).confidence_interval(0.95)
    middle = float(np.median(sample))
    return Interval(middle, float(ends.low), float(ends.high), len(sample))


def share_interval(hits: ArrayLike) -> Interval:
    """Share of true values among (E,) bool, with Wilson's interval."""
    sample = np.asarray(hits, dtype=bool)
    found = stats.binomtest(int(sample.sum()), len(sample))
    ends = found.proportion_ci(0.95, "wilson")
    return Interval(found.statistic, float(ends.low), float(ends.high), len(sample))


def bootstrap_interval(
    statistic: Callable[..., Any],
    samples: tuple[NDArray[Any], ...],
    rng: np.random.Generator,
    resamples: int = 2_000,
) -> Interval:
    """A number computed from whole episodes, with its percentile interval.

    Args:
        statistic: of arrays like ``samples``.
        samples: each (E, ...); the same episodes are drawn from all.
        rng: of the draws.
        resamples: how many.
    """
    count = len(samples[0])
    if any(len(sample) != count for sample in samples):
        raise ValueError("samples must hold the same episodes")
    ends = stats.bootstrap(
        (np.arange(count),),
        lambda drawn: statistic(*(sample[drawn] for sample in samples)),
        vectorized=False,
        n_resamples=resamples,
        method="percentile",
        rng=rng,
    ).confidence_interval
    value = float(statistic(*samples))
    return Interval(value, float(ends.low), float(ends.high), count)


def ratio_interval(
    of: Callable[..., Any],
    a: NDArray[Any],
    b: NDArray[Any],
    rng: np.random.Generator,
    resamples: int = 2_000,
) -> Interval:
    """``of(a) / of(b)``, such as of means, of (E,) values on the same episodes."""
    return bootstrap_interval(lambda x, y: of(x) / of(y), (a, b), rng, resamples)


def band(axes: Any, x: Any, value: Any, low: Any, high: Any, **look: Any) -> None:
    """A curve (N,) with its interval shaded; ``look`` is that of the curve."""
    axes.fill_between(x, low, high, color=look["color"], alpha=0.25, linewidth=0)
    axes.plot(x, value, **look)
