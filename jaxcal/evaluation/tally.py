"""What one method achieved over any number of episodes, in a few numbers that add.

The sum over a block of episodes is rounded once (``math.fsum``); sums of blocks are
kept as fractions, which add without rounding. So totals do not depend on the order in
which blocks are added, to the last digit. Medians cannot be added: they are read off a
histogram of log det S.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.results import HIT_TOLERANCE

__all__ = ["BINS_PER_UNIT", "Tally", "tally_of"]

Array = NDArray[np.float64]

BINS_PER_UNIT = 64  # of log det S: a median is within 1/64, 1.6 % of det S
_COUNTS = ("episodes", "selections", "hits", "singular")


@dataclasses.dataclass
class Tally:
    """One method over some episodes; ``add`` changes it in place."""

    episodes: int = 0
    selections: int = 0  # episodes times draws
    hits: int = 0  # that are the proven optimum
    singular: int = 0  # with det S = 0; they are in no sum of logs
    seconds: float = 0.0  # spent choosing; the only field that is measured
    sums: dict[str, Fraction] = dataclasses.field(default_factory=dict)  # by name
    bins: Counter[int] = dataclasses.field(default_factory=Counter)  # of log det S

    def add(self, other: Tally) -> None:
        """Count the episodes of another tally as well."""
        for name in _COUNTS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.seconds += other.seconds
        for name, value in other.sums.items():
            self.sums[name] = self.sums.get(name, Fraction(0)) + value
        self.bins.update(other.bins)

    def as_json(self) -> dict[str, Any]:
        """Plain values; ``from_json`` reads them back without loss."""
        row = {name: getattr(self, name) for name in (*_COUNTS, "seconds")}
        row["sums"] = {name: str(value) for name, value in self.sums.items()}
        return row | {"bins": sorted(self.bins.items())}

    @staticmethod
    def from_json(row: dict[str, Any]) -> Tally:
        """What ``as_json`` wrote."""
        return Tally(
            **{name: int(row[name]) for name in _COUNTS},
            seconds=float(row["seconds"]),
            sums={name: Fraction(text) for name, text in row["sums"].items()},
            bins=Counter({int(number): int(count) for number, count in row["bins"]}),
        )

    def summary(self, random: Tally) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md.

        Args:
            random: the baseline behind ``ratio_to_random``.
        """
        baseline = random.sums["det"] / random.selections
        mean = {name: value / self.selections for name, value in self.sums.items()}
        log_det: dict[str, float | None] = {"mean": None, "std": None}
        if not self.singular:
            log_det = _moments(mean["log_det"], mean["log_det_squared"])
        middle = self.median_log_det()
        return {
            "det_s": _moments(mean["det"], mean["det_squared"])
            | {"median": math.exp(middle)},
            "log_det_s": log_det | {"median": middle if middle > -math.inf else None},
            "ratio_to_exact": float(mean["ratio"]),
            "hit_rate": self.hits / self.selections,
            "d_efficiency": float(mean["efficiency"]),
            "ratio_to_random": float(mean["det"] / baseline) if baseline else None,
            "seconds_per_selection": self.seconds / self.episodes,
            "draws_per_episode": self.selections // self.episodes,
        }

    def median_log_det(self) -> float:
        """Median of log det S, from the histogram; ``-inf`` where most are singular."""
        half = self.selections / 2
        below = self.singular
        if below > half:
            return -math.inf
        for number, count in sorted(self.bins.items()):
            if below + count >= half:
                return (number + (half - below) / count) / BINS_PER_UNIT
            below += count
        raise ValueError("a tally of nothing has no median")


def _moments(mean: Fraction, mean_square: Fraction) -> dict[str, float | None]:
    # Each square was rounded once: of equal values the difference may fall below 0.
    variance = max(mean_square - mean * mean, Fraction(0))
    return {"mean": float(mean), "std": math.sqrt(variance)}


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
    behind = log_det - reference[:, None]
    hits = proven[:, None] & (behind >= -HIT_TOLERANCE * num_outputs)
    behind = np.minimum(behind, 0.0)
    finite = log_det[np.isfinite(log_det)]
    det = np.exp(log_det)
    values = {
        "det": det,
        "det_squared": det * det,
        "log_det": finite,
        "log_det_squared": finite * finite,
        "ratio": np.exp(behind),
        "efficiency": np.exp(behind / num_parameters),
    }
    numbers, counts = np.unique(
        np.floor(finite * BINS_PER_UNIT).astype(np.int64), return_counts=True
    )
    return Tally(
        episodes=len(log_det),
        selections=log_det.size,
        hits=int(hits.sum()),
        singular=log_det.size - finite.size,
        seconds=seconds,
        sums={name: Fraction(math.fsum(v.ravel())) for name, v in values.items()},
        bins=Counter(dict(zip(numbers.tolist(), counts.tolist(), strict=True))),
    )
