"""Candidate postures: joint ranges, normalised coordinates, sampling.

Selection by D-optimality does not depend on the unit (an affine map multiplies det S
of every subset by one constant), so postures may stay in degrees; ``normalise`` is for
the paper's [0, 1] inputs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import axis_names, numbers, whole_number

__all__ = ["JointRanges", "draw_from_pool", "uniform_candidates"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class JointRanges:
    """Least and greatest command of each axis; both ends are copied and frozen."""

    low: Array  # (n,)
    high: Array  # (n,)
    names: tuple[str, ...] = ()  # n names; u_x, u_y, u_z or u_1 ... when not given

    def __init__(
        self, low: ArrayLike, high: ArrayLike, names: Sequence[str] | None = None
    ) -> None:
        lower = np.atleast_1d(numbers("low", low))
        upper = np.atleast_1d(numbers("high", high))
        if lower.ndim != 1 or lower.shape != upper.shape or lower.size < 1:
            raise ValueError(
                "low and high must hold one number for each axis, got shapes "
                f"{lower.shape} and {upper.shape}"
            )
        axes = axis_names("names", names, "u", len(lower))
        for i in np.flatnonzero(lower >= upper):
            raise ValueError(
                f"low must be below high on every axis, got [{lower[i]:.6g}, "
                f"{upper[i]:.6g}] on {axes[i]}"
            )
        lower, upper = lower.copy(), upper.copy()
        for name, value in (("low", lower), ("high", upper)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "names", axes)

    @property
    def num_inputs(self) -> int:
        """n."""
        return len(self.low)

    @property
    def span(self) -> Array:
        """(n,) high - low."""
        return self.high - self.low

    @property
    def log_det_scale(self) -> float:
        """log det S in the ranges' unit less log det S in [0, 1], for m = n outputs.

        ``2 n log(prod(span))``: the same constant for every subset of n inputs.
        """
        return 2.0 * self.num_inputs * float(np.log(self.span).sum())

    def normalise(self, commands: ArrayLike) -> Array:
        """(..., n) commands with the ranges mapped onto [0, 1]."""
        return (self._points(commands) - self.low) / self.span

    def denormalise(self, unit_commands: ArrayLike) -> Array:
        """(..., n) the inverse of ``normalise``."""
        return self.low + self._points(unit_commands) * self.span

    def contains(self, commands: ArrayLike) -> Mask | np.bool_:
        """(...,) True where every axis lies in its range, ends included."""
        points = self._points(commands)
        return np.all((points >= self.low) & (points <= self.high), axis=-1)

    def _points(self, commands: ArrayLike) -> Array:
        points = numbers("commands", commands)
        if points.ndim < 1 or points.shape[-1] != self.num_inputs:
            raise ValueError(
                f"commands must have shape (..., {self.num_inputs}), got {points.shape}"
            )
        return points


def uniform_candidates(
    rng: np.random.Generator, num_sets: int, num_candidates: int, num_inputs: int = 3
) -> Array:
    """(B, M, n) candidate sets drawn uniformly in [0, 1] on every axis."""
    whole_number("num_sets", num_sets, 1)
    whole_number("num_candidates", num_candidates, 1)
    return rng.random((num_sets, num_candidates, num_inputs))


def draw_from_pool(
    rng: np.random.Generator, pool_size: int, num_sets: int, num_candidates: int
) -> NDArray[np.int64]:
    """(B, M) indices of candidate sets drawn from one pool of recorded postures.

    Within a set no posture comes twice; between sets it may. ``pool[indices]`` are the
    candidates, and ``measured[indices]`` what was measured there.

    Args:
        rng: source of the draw.
        pool_size: postures in the pool.
        num_sets: B.
        num_candidates: M, at most ``pool_size``.
    """
    if not 1 <= num_candidates <= pool_size:
        raise ValueError(
            f"num_candidates must be in [1, {pool_size}], the size of the pool, "
            f"got {num_candidates}"
        )
    whole_number("num_sets", num_sets, 1)
    draws = [
        rng.choice(pool_size, num_candidates, replace=False) for _ in range(num_sets)
    ]
    return np.stack(draws).astype(np.int64)
