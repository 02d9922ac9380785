"""What one method achieved over any number of episodes, in a few numbers that add.

A tally holds counts and sums by name. The sum over a block of episodes is rounded once
(``math.fsum``); sums of blocks are fractions, which add without rounding. So totals do
not depend on the order in which blocks are added, to the last digit. Medians cannot be
added: they are read off a histogram of log det S.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.results import HIT_TOLERANCE

__all__ = [
    "BINS_PER_UNIT",
    "Tally",
    "add",
    "as_json",
    "from_json",
    "summary",
    "tally_of",
]

Array = NDArray[np.float64]
Tally = dict[str, Any]
"""int counts: episodes, selections (episodes times draws), hits (proven optima),
singular (det S = 0; in no sum of logs), and one for each bin of log det S. Fraction
sums: det, log_det, their squares, ratio (det S / det S*), efficiency (its p-th root),
seconds."""

BINS_PER_UNIT = 64  # of log det S: a median is within 1/64, 1.6 % of det S


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
    sums = {
        "det": det,
        "det_squared": det * det,
        "log_det": finite,
        "log_det_squared": finite * finite,
        "ratio": np.exp(behind),
        "efficiency": np.exp(behind / num_parameters),
    }
    bins, counts = np.unique(np.floor(finite * BINS_PER_UNIT), return_counts=True)
    return {
        "episodes": len(log_det),
        "selections": log_det.size,
        "hits": int(hits.sum()),
        "singular": log_det.size - finite.size,
        "seconds": Fraction(seconds),
        **{name: Fraction(math.fsum(v.ravel())) for name, v in sums.items()},
        **{f"bin {int(b)}": int(n) for b, n in zip(bins, counts, strict=True)},
    }


def add(total: Tally, part: Tally) -> None:
    """Count a part as well: ``total`` changes in place."""
    for name, value in part.items():
        total[name] = total.get(name, 0) + value


def as_json(tally: Tally) -> dict[str, int | str]:
    """Counts as numbers, sums as text: ``from_json`` reads both without loss."""
    return {n: v if isinstance(v, int) else str(v) for n, v in tally.items()}


def from_json(row: Mapping[str, int | str]) -> Tally:
    """What ``as_json`` wrote."""
    return {n: v if isinstance(v, int) else Fraction(v) for n, v in row.items()}


def summary(tally: Tally, random: Tally) -> dict[str, Any]:
    """The numbers of one method against the baseline, see docs/evaluation.md."""
    count, episodes = tally["selections"], tally["episodes"]
    log_det: dict[str, float | None] = {"mean": None, "std": None}
    if not tally["singular"]:
        log_det = _moments(tally, "log_det")
    middle = _median_log_det(tally)
    mean, baseline = tally["det"] / count, random["det"] / random["selections"]
    return {
        "det_s": _moments(tally, "det") | {"median": math.exp(middle)},
        "log_det_s": log_det | {"median": middle if middle > -math.inf else None},
        "ratio_to_exact": float(tally["ratio"] / count),
        "hit_rate": tally["hits"] / count,
        "d_efficiency": float(tally["efficiency"] / count),
        "ratio_to_random": float(mean / baseline) if baseline else None,
        "seconds_per_selection": float(tally["seconds"] / episodes),
        "draws_per_episode": count // episodes,
    }


def _moments(tally: Tally, name: str) -> dict[str, float | None]:
    mean = tally[name] / tally["selections"]
    variance = tally[f"{name}_squared"] / tally["selections"] - mean * mean
    # Each square was rounded once: of equal values the difference may fall below 0.
    return {"mean": float(mean), "std": math.sqrt(max(variance, Fraction(0)))}


def _median_log_det(tally: Tally) -> float:
    """Median of log det S, from the histogram; ``-inf`` where most are singular."""
    half, below = tally["selections"] / 2, tally["singular"]
    if below > half:
        return -math.inf
    bins = {int(n[4:]): v for n, v in tally.items() if n.startswith("bin ")}
    for number, count in sorted(bins.items()):
        if below + count >= half:
            return (number + (half - below) / count) / BINS_PER_UNIT
        below += count
    raise ValueError("a tally of nothing has no median")
