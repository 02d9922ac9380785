"""Places that the axis check stands at, and rotations between them.

A rotation vector is (3,) degrees in the phone's own frame at the start.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import AXIS_NAMES
from rig.core.attitude import Array


@dataclasses.dataclass(frozen=True)
class Stand:
    """The device measured at one place."""

    pulses: Array  # (3,)
    attitude: Array  # (3, 3) phone to its world
    std_deg: float  # of one reading
    samples: int

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Stand:
        """From what ``Observer.measure`` returns."""
        return cls(
            np.array(record["pulses"], dtype=np.float64),
            np.array(record["attitude"]),
            float(np.max(record["std_deg"])),
            int(record["samples"]),
        )


def turn(base: Array, attitude: Array) -> Array:
    """(3,) rotation vector in degrees from one attitude to another, in the former."""
    return Rotation.from_matrix(base.T @ attitude).as_rotvec(degrees=True)


def rate(start: Stand, end: Stand, drive: int, base: Array) -> Array:
    """(3,) degrees for one pulse of a drive, between two places on one way."""
    way = end.pulses[drive] - start.pulses[drive]
    return (turn(base, end.attitude) - turn(base, start.attitude)) / way


def rates_of(stands: Mapping[str, Stand]) -> tuple[Array, Array]:
    """(3, 3) columns: rotation vector for one pulse of each drive; (3,) play."""
    base = stands["start"].attitude
    rates, backlash = np.empty((3, 3)), np.empty(3)
    for j, name in enumerate(AXIS_NAMES):
        look, plus, back, minus, up = (
            stands[f"{name}:{part}"] for part in ("look", "plus", "back", "minus", "up")
        )
        # On the way up and on the way down the play is taken up: no reversal between.
        ways = ((look, plus), (back, minus))
        weights = [abs(float(b.pulses[j] - a.pulses[j])) for a, b in ways]
        each = [rate(a, b, j, base) for a, b in ways]
        rates[:, j] = np.average(each, axis=0, weights=weights)
        direction = rates[:, j] / np.linalg.norm(rates[:, j])
        backlash[j] = (turn(base, back.attitude) - turn(base, up.attitude)) @ direction
        backlash[j] *= np.sign(plus.pulses[j] - look.pulses[j])
    return rates, backlash
