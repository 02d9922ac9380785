"""A ball at the tip, put by hand into sockets that stand still."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.sensors.sensor import Landmarks, Reading, Tip
from jaxcal.checks import Array, numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Socket(Landmarks):
    """Three zeros a contact: the ball's centre less that of its socket.

    Contacts do not show where the arm stands, so ``base`` is held; without a known
    distance they do not show its scale, which is the prior's: a fit compares misses
    with the size of the arm (``Model.log_size``). ``places`` are the centres (S, 3);
    noise, the play of the ball, 0.02 % of the arm's length.

    Attributes:
        distances: rows (first, second, distance, std) of two sockets.
    """

    distances: Sequence[Sequence[float]] = ()

    kind = "socket"
    lengths = True
    outputs = ("off x", "off y", "off z")
    zeros = True
    local = True
    compliant = True
    axes = ("x", "y", "z")
    axis_units = ("length",) * 3
    width = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = numbers("distances", self.distances or np.zeros((0, 4)))
        if rows.ndim != 2 or rows.shape[1] != 4 or not (rows[:, 2:] > 0.0).all():
            raise ValueError(
                "distances must be rows (first socket, second, distance, std), the "
                f"last two positive, got {self.distances!r}"
            )
        one, two = pairs = rows[:, :2].T
        exists = (pairs == pairs.round()) & (pairs >= 0.0) & (pairs < self.count)
        if not exists.all() or (one == two).any():
            raise ValueError(
                f"distances must name two of {self.count} sockets, counted from 0 (in "
                f"a recording --which numbers them), got {self.distances!r}"
            )
        object.__setattr__(self, "distances", tuple(map(tuple, rows.tolist())))

    def usual_noise(self, length: float) -> ArrayLike:
        return 2e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        which = self.of_rows(inputs)
        count = len(which)
        by_tip = np.broadcast_to(np.eye(3, 6), (count, 3, 6))
        by_one = np.broadcast_to(-np.eye(3), (count, 3, 3))
        values = tip.position - parameters.reshape(-1, 3)[which]
        return Reading(values, by_tip, self.spread(which, by_one))

    def located(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> tuple[Self, Array | None]:
        """Sockets in the middle of the nominal contacts."""
        if self.places is not None:
            return self, None
        which, points = self.of_rows(inputs), tip.position
        middle = points.mean(axis=0)
        places = [
            points[which == i].mean(axis=0) if (which == i).any() else middle
            for i in range(self.count)
        ]
        return dataclasses.replace(self, places=np.array(places)), None

    def lacking(self, inputs: Array) -> tuple[int, ...]:
        named = {int(i) for pair in self.distances for i in pair[:2]}
        return tuple(sorted(named.difference(self.of_rows(inputs).tolist())))

    def facts(self, parameters: Array) -> tuple[Array, Array]:
        places = parameters.reshape(-1, 3)
        off = np.zeros(len(self.distances))
        rows = np.zeros((len(self.distances), self.count, 3))
        for k, (first, second, distance, std) in enumerate(self.distances):
            i, j = int(first), int(second)
            apart = places[j] - places[i]
            far = float(np.linalg.norm(apart))
            off[k] = (distance - far) / std
            rows[k, j] = (apart / far if far else np.eye(3)[0]) / std
            rows[k, i] = -rows[k, j]
        return off, rows.reshape(len(off), parameters.size)
