"""A draw wire or a ball bar: the distance of the tip from an anchor."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.sensors.sensor import Landmarks, Reading, Tip
from jaxcal.checks import Array


@dataclasses.dataclass(frozen=True, eq=False)
class Distance(Landmarks):
    """One length: the tip's distance from its anchor, less the zero of the wire.

    Where the arm stands is not shown, so ``base`` is held. ``places`` are rows (x, y,
    z, zero); the zero is known to 1 % of the arm's length. Noise 0.05 % of it.
    """

    kind = "distance"
    lengths = True
    outputs = ("length",)
    axes = ("x", "y", "z", "zero")
    axis_units = ("length",) * 4
    needed = 4
    width = 4

    def prior_std(self, length: float) -> Array:
        return np.tile([np.inf, np.inf, np.inf, 0.01 * length], self.count)

    def usual_noise(self, length: float) -> ArrayLike:
        return 5e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        which = self.of_rows(inputs)
        places = parameters.reshape(-1, 4)[which]
        apart = tip.position - places[:, :3]
        far = np.linalg.norm(apart, axis=1, keepdims=True)
        unit = apart / np.where(far > 0.0, far, 1.0)
        by_tip = np.hstack([unit, np.zeros_like(unit)])[:, None]
        by_one = np.hstack([-unit, -np.ones_like(far)])[:, None]
        return Reading(far - places[:, 3:], by_tip, self.spread(which, by_one))

    def located(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> tuple[Self, Array | None]:
        """Anchors nearest to nominal points and lengths, from linear starts.

        One is linear in the anchor and its square; of one that is far the lengths are.
        The zero too, where lengths fit three times as well with another one (twice from
        30 lengths on), and to 2 % of the arm.
        """
        from scipy import optimize

        if self.places is not None or measured is None:
            return self, None
        which, places = self.of_rows(inputs), np.zeros((self.count, 4))
        for i in range(self.count):
            points, far = tip.position[which == i], measured[which == i, 0]
            if len(points) < self.needed:
                raise ValueError(
                    f"places are missing: anchor {i} has {len(points)} lengths, four "
                    "are needed to find it"
                )
            middle = points.mean(axis=0)
            points = points - middle
            rows = np.column_stack([points, np.full(len(points), 0.5), far])
            square = ((points**2).sum(axis=1) - far**2) / 2.0
            both = np.column_stack([square, -far])
            near, along = np.linalg.lstsq(rows[:, :4], both, rcond=1e-6)[0][:3].T
            size = float(np.linalg.norm(along)) or 1.0
            loose = np.linalg.lstsq(rows, square, rcond=1e-6)[0][[0, 1, 2, 4]]

            def apart(at: Array, p: Array = points, r: Array = far) -> Array:
                gaps = np.linalg.norm(p - at[:3], axis=1) - r - at[3:].sum()
                return np.asarray(gaps, dtype=float)

            def fit(*starts: Array) -> Array:
                fits = [
                    optimize.least_squares(apart, one, method="lm") for one in starts
                ]
                return min(fits, key=lambda one: one.cost).x

            starts = near, along / size * far.mean()
            best = fit(*starts)
            loose = fit(loose, *(np.append(one, 0.0) for one in (*starts, best)))
            off, other = (np.median(np.abs(apart(at))) for at in (best, loose))
            better = min(off / (2.0 if len(points) > 29 else 3.0), 0.02 * tip.length)
            if other < better and len(points) > 10:
                best, off = loose, other
            anchor, zero = best[:3], best[3:].sum()
            if off > 0.2 * tip.length:
                raise ValueError(
                    f"lengths to anchor {i} do not fit by {off:.3g}: measured must be "
                    f"in the unit of the arm, whose length is {tip.length:.3g}, and "
                    "commands in degrees"
                )
            places[i] = *(anchor + middle), zero
        return dataclasses.replace(self, places=places), None
