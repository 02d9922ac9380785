"""What one method achieved over any number of episodes, in a few numbers that add.

Sums are exact (``jaxcal.evaluation.exact_sums``) and counts are whole, so a tally does not
depend on how its episodes were cut into parts. Medians cannot be added: they are read
off a histogram of log det S.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.exact_sums import ExactSum, exact_sum
from jaxcal.evaluation.results import HIT_TOLERANCE

__all__ = ["BINS_PER_UNIT", "RunningTally", "Tally", "tally_of"]

Array = NDArray[np.float64]

BINS_PER_UNIT = 64  # of log det S: a median is within 1/64, 1.6 % of det S
_NOTHING = ExactSum()
_SUMS = ("det", "det_squared", "log_det", "log_det_squared", "ratio", "efficiency")


@dataclasses.dataclass(frozen=True)
class Tally:
    """One method over some episodes."""

    selections: int = 0  # episodes times draws
    hits: int = 0  # that are the proven optimum
    singular: int = 0  # in one plane: det S = 0
    det: ExactSum = _NOTHING
    det_squared: ExactSum = _NOTHING  # each square rounded once, then summed exactly
    log_det: ExactSum = _NOTHING  # singular ones left out
    log_det_squared: ExactSum = _NOTHING
    ratio: ExactSum = _NOTHING  # det S / det S*
    efficiency: ExactSum = _NOTHING  # its p-th root
    histogram: tuple[tuple[int, int], ...] = ()  # (bin of log det S, selections)
    seconds: float = 0.0  # spent choosing; the only field that is measured

    def __add__(self, other: Tally) -> Tally:
        """Both together."""
        bins = Counter(dict(self.histogram))
        bins.update(dict(other.histogram))
        return Tally(
            selections=self.selections + other.selections,
            hits=self.hits + other.hits,
            singular=self.singular + other.singular,
            histogram=tuple(sorted(bins.items())),
            seconds=self.seconds + other.seconds,
            **{name: getattr(self, name) + getattr(other, name) for name in _SUMS},
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values; ``from_json`` reads them back."""
        row = {
            name: [getattr(self, name).mantissa, getattr(self, name).exponent]
            for name in _SUMS
        }
        return row | {
            "selections": self.selections,
            "hits": self.hits,
            "singular": self.singular,
            "histogram": [list(pair) for pair in self.histogram],
            "seconds": self.seconds,
        }

    @staticmethod
    def from_json(row: dict[str, Any]) -> Tally:
        """What ``as_json`` wrote."""
        return Tally(
            selections=int(row["selections"]),
            hits=int(row["hits"]),
            singular=int(row["singular"]),
            histogram=tuple((int(b), int(c)) for b, c in row["histogram"]),
            seconds=float(row["seconds"]),
            **{name: ExactSum(*map(int, row[name])) for name in _SUMS},
        )

    def mean_det(self) -> Fraction:
        """Mean det S."""
        return self.det.fraction() / self.selections

    def summary(self, random: Tally, episodes: int) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md.

        Args:
            random: the baseline behind ``ratio_to_random``.
            episodes: how many there were.
        """
        baseline = random.mean_det()
        log_det: dict[str, float | None] = {"mean": None, "std": None}
        if not self.singular:
            log_det = self._moments(self.log_det, self.log_det_squared)
        middle = self.median_log_det()
        with np.errstate(under="ignore"):
            median = float(np.exp(middle))
        return {
            "det_s": self._moments(self.det, self.det_squared) | {"median": median},
            "log_det_s": log_det | {"median": middle if np.isfinite(middle) else None},
            "ratio_to_exact": float(self.ratio.fraction() / self.selections),
            "hit_rate": self.hits / self.selections,
            "d_efficiency": float(self.efficiency.fraction() / self.selections),
            "ratio_to_random": float(self.mean_det() / baseline) if baseline else None,
            "seconds_per_selection": self.seconds / episodes,
            "draws_per_episode": self.selections // episodes,
        }

    def _moments(self, total: ExactSum, squares: ExactSum) -> dict[str, float | None]:
        mean = total.fraction() / self.selections
        variance = squares.fraction() / self.selections - mean**2
        return {"mean": float(mean), "std": math.sqrt(max(variance, Fraction(0)))}

    def median_log_det(self) -> float:
        """Median of log det S, from the histogram; ``-inf`` where most are singular."""
        half = Fraction(self.selections, 2)
        below = self.singular
        if below > half:
            return -math.inf
        for number, count in self.histogram:
            if below + count >= half:
                inside = (half - below) / count
                return float((number + inside) / BINS_PER_UNIT)
            below += count
        raise ValueError("a tally of nothing has no median")


class RunningTally:
    """Tallies added one after another; their histograms are merged in place."""

    def __init__(self) -> None:
        self._sums = Tally()
        self._bins: Counter[int] = Counter()

    def add(self, tally: Tally) -> None:
        """One more."""
        self._sums += dataclasses.replace(tally, histogram=())
        self._bins.update(dict(tally.histogram))

    def total(self) -> Tally:
        """All of them together."""
        return dataclasses.replace(
            self._sums, histogram=tuple(sorted(self._bins.items()))
        )


def tally_of(
    log_det: Array,
    reference: Array,
    proven: NDArray[np.bool_],
    num_outputs: int,
    num_parameters: int,
    seconds: float,
) -> Tally:
    """The tally of some selections.

    Args:
        log_det: (E, R) natural log det S of what was chosen.
        reference: (E,) that of the optimum, or a bound on it.
        proven: (E,) which of them are proven.
        num_outputs: m.
        num_parameters: p.
        seconds: spent choosing.
    """
    behind = np.minimum(log_det - reference[:, None], 0.0)
    hits = proven[:, None] & (
        log_det - reference[:, None] >= -HIT_TOLERANCE * num_outputs
    )
    finite = log_det[np.isfinite(log_det)]
    det = np.exp(log_det)
    bins, counts = np.unique(
        np.floor(finite * BINS_PER_UNIT).astype(np.int64), return_counts=True
    )
    return Tally(
        selections=log_det.size,
        hits=int(hits.sum()),
        singular=log_det.size - finite.size,
        det=exact_sum(det),
        det_squared=exact_sum(det * det),
        log_det=exact_sum(finite),
        log_det_squared=exact_sum(finite * finite),
        ratio=exact_sum(np.exp(behind)),
        efficiency=exact_sum(np.exp(behind / num_parameters)),
        histogram=tuple(zip(bins.tolist(), counts.tolist(), strict=True)),
        seconds=seconds,
    )
