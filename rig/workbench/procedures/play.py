"""The play that a calibration keeps of its axes, and what a command takes to undo it.

A joint with play of width w stands behind its drive by w / 2, on the side it comes
from. A calibration whose postures were reached from both sides stands in the middle:
the command is w / 2 further the way the axis arrives. One whose postures were all
reached from below (``motion.approach_overshoot_deg``) has that side in it: nothing is
added from below, and from above the command is the whole of w less.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES
from rig.core.attitude import Array

CHARACTERISED = "characterised"  # the calibration's note of it
MARGIN_DEG = 0.5  # by which the last move exceeds what it has to take up


@dataclasses.dataclass(frozen=True)
class Play:
    """Of pitch, yaw and roll, in degrees of commands; nothing where none was measured.

    Attributes:
        axes: what ``characterise`` found of an axis, by its name.
        from_below: the calibration's postures were all reached from below.
    """

    axes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    from_below: bool = False

    @classmethod
    def of(cls, notes: Mapping[str, Any]) -> Play:
        """What a calibration's notes say."""
        below = notes.get("approach_overshoot_deg", 0.0) > 0.0
        return cls(notes.get(CHARACTERISED, {}), below)

    @property
    def known(self) -> bool:
        return bool(self.axes)

    @property
    def widths(self) -> Array:
        """(3,) the best values."""
        return np.array([self._of(name, "value") for name in AXIS_NAMES])

    @property
    def most(self) -> Array:
        """(3,) by which a command is changed at most."""
        return self.widths * (1.0 if self.from_below else 0.5)

    @property
    def run_up(self) -> Array:
        """(3,) length of a move that surely takes up play and friction."""
        known = np.array([name in self.axes for name in AXIS_NAMES])
        breakaway = [
            max((each["high"] for each in self._axis(name)["breakaway_deg"]), default=0)
            for name in AXIS_NAMES
        ]
        high = np.array([self._of(name, "high") for name in AXIS_NAMES])
        return np.where(known, high + breakaway + MARGIN_DEG, 0.0)

    def shift(self, direction: Array) -> Array:
        """(3,) what is added to a command that is reached in (3,) directions, +-1."""
        return self.widths / 2.0 * (direction - self.from_below)

    def lines(self, command: Array, direction: Array) -> Iterator[str]:
        """What is done, and what is not, in words."""
        shift = self.shift(direction)
        for i, name in enumerate(AXIS_NAMES):
            if name not in self.axes:
                continue
            yield (
                f"  {name} has {self.widths[i]:.3f} deg of play and arrives "
                f"{'upwards' if direction[i] > 0 else 'downwards'}: command "
                f"{shift[i]:+.3f} deg"
            )
            found = self.axes[name]
            if abs(command[i] - found["dead_zone_at_deg"]) < (
                found["dead_zone_deg"]["low"] / 2.0
            ):
                yield f"  NOTE: {name} does not answer there: its dead zone"

    def _axis(self, name: str) -> Mapping[str, Any]:
        none = {"backlash_deg": {"value": 0.0, "high": 0.0}, "breakaway_deg": []}
        found: Mapping[str, Any] = self.axes.get(name, none)
        return found

    def _of(self, name: str, part: str) -> float:
        return float(self._axis(name)["backlash_deg"][part])
