"""How long moves take, and the order of least time through some postures.

A move is a trapezoid profile on every axis (accelerate, cruise, brake), all axes start
together and the slowest sets the time. Each axis' time is a concave function of its
distance that is zero at zero, so the travel time is a metric. Loads numpy alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers

__all__ = [
    "MOST_EXACT",
    "Motion",
    "fastest_tour",
    "improved_tour",
    "tour_seconds",
    "travel_times",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MOST_EXACT = 12  # postures whose order Held and Karp find in a moment


@dataclasses.dataclass(frozen=True)
class Motion:
    """How the device moves; in the unit of the candidates and seconds."""

    speed: tuple[float, ...]  # (n,) or one for all axes, unit/s
    acceleration: tuple[float, ...]  # likewise, unit/s^2; also the deceleration
    settle: float = 0.0  # s at every posture, before and while measuring

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration"):
            given = numbers(name, getattr(self, name))
            if given.ndim > 1 or not given.size or (given <= 0.0).any():
                raise ValueError(
                    f"{name} must be positive numbers, one or one an axis, "
                    f"got {getattr(self, name)!r}"
                )
            object.__setattr__(self, name, tuple(np.atleast_1d(given).tolist()))
        settle = numbers("settle", self.settle)
        if settle.ndim or settle < 0.0:
            raise ValueError(f"settle must be at least 0 seconds, got {self.settle!r}")


def travel_times(points: ArrayLike, others: ArrayLike, motion: Motion) -> Array:
    """Seconds from each of some postures to each of others, without settling.

    An axis that moves d at speed v and acceleration a takes ``d / v + v / a``, or
    ``2 sqrt(d / a)`` where it never reaches v (d < v^2 / a); the slowest axis counts.

    Args:
        points: (A, n).
        others: (B, n) in the same unit.
        motion: limits of the axes.

    Returns:
        (A, B).
    """
    a, b = numbers("points", points), numbers("others", others)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ValueError(
            f"points and others must be (A, n) and (B, n), got {a.shape} and {b.shape}"
        )
    n = a.shape[1]
    limits = []
    for name in ("speed", "acceleration"):
        value = np.asarray(getattr(motion, name))
        if len(value) not in (1, n):
            raise ValueError(f"motion.{name} must hold 1 or {n}, got {len(value)}")
        limits.append(np.broadcast_to(value, (n,)))
    speed, ramp = limits
    way = np.abs(a[:, None] - b[None])
    cruise = way >= speed**2 / ramp
    seconds = np.where(cruise, way / speed + speed / ramp, 2.0 * np.sqrt(way / ramp))
    return seconds.max(axis=2)


def fastest_tour(times: ArrayLike, start: ArrayLike | None = None) -> tuple[Any, float]:
    """The order of least time through all postures, ending anywhere.

    Exact up to 12 postures (Held and Karp 1962); beyond that 2-opt and moving single
    postures from each nearest-neighbour tour, which proves nothing.

    Args:
        times: (K, K) symmetric travel times.
        start: (K,) times from where the device stands; it begins anywhere when None.

    Returns:
        (K,) order, and the seconds of travel.
    """
    t = numbers("times", times)
    k = len(t)
    if t.shape != (k, k) or not k:
        raise ValueError(f"times must have shape (K, K), got {t.shape}")
    begin = np.zeros(k) if start is None else numbers("start", start)
    if begin.shape != (k,):
        raise ValueError(f"start must have shape ({k},), got {begin.shape}")
    if k <= MOST_EXACT:
        return _held_karp(t, begin)
    tours = [improved_tour(_nearest(t, begin, first), t, begin) for first in range(k)]
    seconds = [tour_seconds(order, t, begin) for order in tours]
    best = int(np.argmin(seconds))
    return tours[best], seconds[best]


def tour_seconds(order: Any, times: Array, start: Array) -> float:
    """Seconds of travel in the order given; arguments as of ``fastest_tour``."""
    return float(start[order[0]] + times[order[:-1], order[1:]].sum())


def _held_karp(times: Array, start: Array) -> tuple[Indices, float]:
    """Best open tour by dynamic programming over subsets."""
    k = len(times)
    best = np.full((1 << k, k), np.inf)
    before = np.full((1 << k, k), -1)
    best[1 << np.arange(k), np.arange(k)] = start
    for mask in range(1, 1 << k):
        inside = [i for i in range(k) if mask >> i & 1]
        if len(inside) < 2:
            continue
        for last in inside:
            rest = mask & ~(1 << last)
            reached = best[rest] + times[:, last]
            before[mask, last] = reached.argmin()
            best[mask, last] = reached.min()
    mask, order = (1 << k) - 1, []
    last = int(best[mask].argmin())
    seconds = float(best[mask, last])
    while last >= 0:
        order.append(last)
        mask, last = mask & ~(1 << last), int(before[mask, last])
    return np.array(order[::-1]), seconds


def _nearest(times: Array, start: Array, first: int) -> Indices:
    order, left = [first], set(range(len(times))) - {first}
    while left:
        order.append(min(left, key=lambda j: times[order[-1], j]))
        left.remove(order[-1])
    return np.array(order)


def improved_tour(order: Indices, times: Array, start: Array) -> Indices:
    """2-opt and moves of one posture until neither shortens the tour."""
    k = len(order)
    length = tour_seconds(order, times, start)
    again = True
    while again:
        again = False
        for i in range(k - 1):
            for j in range(i + 1, k):
                flipped = np.r_[order[:i], order[i : j + 1][::-1], order[j + 1 :]]
                moved = np.insert(np.delete(order, i), j, order[i])
                for tried in (flipped, moved):
                    reached = tour_seconds(tried, times, start)
                    if reached < length - 1e-12:
                        order, length, again = tried, reached, True
    return order
