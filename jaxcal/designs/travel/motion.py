"""How long moves take, and the order in which they take least.

A move is a trapezoid profile on every axis (accelerate, cruise, brake), all axes start
together and the slowest sets the time, which is a metric. Loads numpy alone until an
order is asked for.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, array_of, numbers
from jaxcal.tables import require_unnamed


@dataclasses.dataclass(frozen=True)
class Motion:
    """How the device moves; in the unit of the candidates and seconds."""

    speed: tuple[float, ...]  # (n,) or one for all axes, unit/s
    acceleration: tuple[float, ...]  # likewise, unit/s^2; also the deceleration
    settle: float = 0.0  # s at every posture, before and while measuring

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration"):
            require_unnamed(name, getattr(self, name))
            values = numbers(name, getattr(self, name))
            if values.ndim > 1 or not values.size or (values <= 0.0).any():
                raise ValueError(
                    f"{name} must be positive: one number, or one per axis, got "
                    f"{getattr(self, name)!r}"
                )
            object.__setattr__(self, name, tuple(np.atleast_1d(values).tolist()))
        settle = numbers("settle", self.settle)
        if settle.ndim or settle < 0.0:
            raise ValueError(f"settle must be at least 0 seconds, got {self.settle!r}")


def travel_times(points: ArrayLike, others: ArrayLike, motion: Motion) -> Array:
    """(A, B) seconds from each of postures (A, n) to others (B, n), not settling.

    An axis that moves d at speed v and acceleration a takes ``d / v + v / a``, or ``2
    sqrt(d / a)`` where it never reaches v (d < v^2 / a); the slowest axis counts.
    """
    a, b = numbers("points", points), numbers("others", others)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ValueError(
            f"points and others must be (A, n) and (B, n), got {a.shape} and {b.shape}"
        )
    speed, ramp = np.array(motion.speed), np.array(motion.acceleration)
    for name, limit in (("speed", speed), ("acceleration", ramp)):
        if len(limit) not in (1, n := a.shape[1]):
            raise ValueError(f"motion.{name} must hold 1 or {n}, got {len(limit)}")
    way = np.abs(a[:, None] - b[None])
    cruise = way >= speed**2 / ramp
    seconds = np.where(cruise, way / speed + speed / ramp, 2.0 * np.sqrt(way / ramp))
    return seconds.max(axis=2)


def fastest_tour(
    times: ArrayLike, start: ArrayLike | None = None
) -> tuple[NDArray[np.int64], float]:
    """(K,) order of least time through all postures, ending anywhere, and its seconds.

    Optimal up to 12 postures (Held and Karp 1962); beyond, the shortest
    nearest-neighbour tours are improved by 2-opt and moves of single postures.

    Args:
        times: (K, K) seconds from each posture to each, symmetric.
        start: (K,) seconds to each from where the device stands; any when not given.
    """
    between = np.ascontiguousarray(numbers("times", times))
    k = len(between) if between.ndim else 0
    if between.shape != (k, k) or not k:
        raise ValueError(f"times must have shape (K, K), got {between.shape}")
    uneven = np.abs(between - between.T)
    if uneven.max() > 1e-9 * max(float(np.abs(between).max()), 1.0):
        i, j = np.unravel_index(uneven.argmax(), uneven.shape)
        raise ValueError(
            "times must be symmetric, got "
            f"{between[i, j]:g} from {i} to {j} and {between[j, i]:g} back"
        )
    begin = np.zeros(k) if start is None else array_of("start", start, k)
    from jaxcal.designs.travel.tour_kernel import best_order

    order, seconds = best_order(between, begin)
    return order, float(seconds)
