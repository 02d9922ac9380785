"""A draw wire or a ball bar: the distance of the tip from an anchor."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.models.sensors.sensor import Placed, Reading, Tip

__all__ = ["Distance"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Distance(Placed):
    """One length: the tip's distance from its anchor, less the zero of the wire.

    Where the arm stands is not shown, so ``base`` is held. ``places`` are rows (x, y,
    z, zero); the zero is known to 1 % of the arm's length. Noise 0.05 % of it.
    """

    kind = "distance"
    outputs = ("length",)
    axes = ("x", "y", "z", "zero")
    axis_units = ("length",) * 4
    width = 4

    def prior_std(self, length: float) -> Array:
        return np.tile([np.inf, np.inf, np.inf, 0.01 * length], self.count)

    def usual_noise(self, length: float) -> ArrayLike:
        return 5e-4 * length

    def read(self, tip: Tip, inputs: Array, own: Array) -> Reading:
        which = self.of_rows(inputs)
        places = own.reshape(-1, 4)[which]
        apart = tip.position - places[:, :3]
        far = np.linalg.norm(apart, axis=1, keepdims=True)
        unit = apart / np.where(far > 0.0, far, 1.0)
        by_tip = np.hstack([unit, np.zeros_like(unit)])[:, None]
        by_one = np.hstack([-unit, -np.ones_like(far)])[:, None]
        return Reading(far - places[:, 3:], by_tip, self.spread(which, by_one))

    def located(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> tuple[Self, Array | None]:
        """Anchors from nominal points and lengths, linear in (anchor, a constant).

        And in the zero, where lengths fit three times as well with another one.
        """
        if self.places is not None or measured is None:
            return self, None
        which, places = self.of_rows(inputs), np.zeros((self.count, 4))
        for i in range(self.count):
            points, far = tip.position[which == i], measured[which == i, 0]
            if len(points) < 4:
                raise ValueError(
                    f"places must be given: anchor {i} has {len(points)} lengths, and "
                    "four are needed to find it"
                )
            middle = points.mean(axis=0)
            points = points - middle
            rows = np.column_stack([2.0 * points, np.ones(len(points)), 2.0 * far])
            right = (points**2).sum(axis=1) - far**2
            off, anchor, zero = np.inf, np.zeros(3), 0.0
            for width in (4, 5):
                found = np.linalg.lstsq(rows[:, :width], right, rcond=1e-6)[0]
                wire = far + found[4:].sum()
                each = np.linalg.norm(points - found[:3], axis=1) - wire
                left = np.median(np.abs(each))
                if width == 4 or (left < off / 3.0 and len(points) > 10):
                    off, anchor, zero = left, found[:3], found[4:].sum()
            if off > 0.2 * tip.length:
                raise ValueError(
                    f"lengths to anchor {i} fit no anchor to {off:.3g}: measured must "
                    f"be in the unit of the arm, whose length is {tip.length:.3g}, and "
                    "commands in degrees"
                )
            places[i] = *(anchor + middle), zero
        return dataclasses.replace(self, places=places), None
