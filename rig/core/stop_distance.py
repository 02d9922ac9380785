"""How far a joint goes on after its stop, and how fast it may be near a limit.

``d(v) = v t + k v^2`` with ``k = 1 / (2 a)``: a drive obeys ``t`` after its stop was
sent, and brakes by ``a``. `axes` measures both, by stops at two speeds.

Without a stop a drive brakes by the ramp ``b`` of its move and ends at its target. One
that is stopped while it moves at ``u`` ends beyond that by at most
``u t + u^2 (k - 1 / (2 b))``. The largest of these, for any ``u`` up to the speed of
the move, has to fit between the target and the soft limit.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.journal.device import STOP_PROVED, DeviceRecord

if TYPE_CHECKING:
    from rig.config.axis import Axis

UNKNOWN_S = 1.0  # from a stop of which nothing is known to its drive's obeying
FASTER = 1.25  # times the slower speed: less tells nothing of the ramp
MARGIN = 1.2  # times the ramp that was measured
LEAST_ROOM_DEG = 0.1  # a target on the limit itself is gone to


class StopDistance(NamedTuple):
    """The stopping distance of an axis, in degrees or millimetres."""

    delay_s: float
    per_square: float  # degrees for (deg/s)^2: 1 / (2 a)
    accel: float  # deg/s^2 of the moves that were stopped

    @classmethod
    def of(
        cls, speeds: list[float], distances: list[float], accel: float
    ) -> StopDistance:
        """From stops at one or two speeds; of one all is ascribed to the ramp."""
        points = sorted(zip(speeds, distances, strict=True))
        (v1, d1), (v2, d2) = points[0], points[-1]
        delay, square = 0.0, max(d / v**2 for v, d in points)
        if v2 >= FASTER * v1:
            square = min(square, max(0.0, (d2 / v2 - d1 / v1) / (v2 - v1)))
            delay = max(0.0, *(d / v - square * v for v, d in points))
        return cls(delay, square, accel)

    def at(self, speed: float) -> float:
        """Degrees from where the stop was sent to where it stands."""
        return speed * self.delay_s + speed**2 * self.per_square

    def fastest(self, axis: Axis, room: float) -> float:
        """Speed of a move that ends so far before a soft limit, whenever it is stopped.

        A quick stop may brake by the ramp of the move: where that is set gentler than
        it was when it was measured, so is this.
        """
        speed, accel = axis.drive_motion
        square = MARGIN * self.per_square * max(1.0, self.accel / accel)
        excess, room = square - 0.5 / accel, max(room, LEAST_ROOM_DEG)
        root = self.delay_s**2 + 4.0 * excess * room
        if root < 0.0 or self.delay_s + math.sqrt(root) <= 0.0:
            return speed  # it never goes so far beyond its target
        return min(speed, 2.0 * room / (self.delay_s + math.sqrt(root)))


def stop_distances(record: DeviceRecord, axes: tuple[Axis, ...]) -> dict[str, Any]:
    """Axis to StopDistance, as the record of the device says.

    An axis whose stop was proved, and of which it says nothing, may take UNKNOWN_S.
    """
    evidence = record.state(STOP_PROVED)
    if evidence is None:
        return {}
    measured = evidence.get("distances", {})
    distances = {}
    for axis in axes:
        _, accel = axis.drive_motion
        if fit := measured.get(axis.name):
            distances[axis.name] = StopDistance.of(**fit)
        else:
            distances[axis.name] = StopDistance(UNKNOWN_S, 0.5 / accel, accel)
    return distances
