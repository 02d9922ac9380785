"""The play that a calibration keeps of its axes, and what a command takes to undo it.

A joint with play of width w stands behind its drive by w / 2, on the side it comes
from. A calibration whose postures were reached from both sides stands in the middle:
the command is w / 2 further the way the axis arrives. One whose postures were all
reached from below (``motion.approach_overshoot_deg``) has that side in it: nothing is
added from below, and from above the command is the whole of w less.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rig.config import AXIS_NAMES
from rig.core.attitude import Array

CHARACTERISED = "characterised"  # the calibration's note of it
MARGIN_DEG = 0.5  # by which the last move exceeds what it has to take up


class Play(NamedTuple):
    """Of pitch, yaw and roll, in degrees of commands; 0 where none was measured."""

    axes: Mapping[str, Any]  # what ``characterise`` found of an axis, by its name
    from_below: bool  # the calibration's postures were all reached from below
    widths: Array  # (3,) the best values
    run_up: Array  # (3,) length of a move that surely takes up play and friction

    @classmethod
    def of(cls, notes: Mapping[str, Any]) -> Play:
        """What a calibration's notes say."""
        axes, widths, run_up = notes.get(CHARACTERISED, {}), np.zeros(3), np.zeros(3)
        for i, name in enumerate(AXIS_NAMES):
            if found := axes.get(name):
                widths[i] = found["backlash_deg"]["value"]
                most = max(each["high"] for each in found["breakaway_deg"])
                run_up[i] = found["backlash_deg"]["high"] + most + MARGIN_DEG
        below = notes.get("approach_overshoot_deg", 0.0) > 0.0
        return cls(axes, below, widths, run_up)

    @property
    def most(self) -> Array:
        """(3,) by which a command is changed at most."""
        return self.widths * (1.0 if self.from_below else 0.5)

    def shift(self, direction: Array) -> Array:
        """(3,) what is added to a command that is reached in (3,) directions, +-1."""
        return self.widths / 2.0 * (direction - self.from_below)

    def lines(self, command: Array, direction: Array) -> Iterator[str]:
        """What is done, and what is not, in words."""
        for i, name in enumerate(AXIS_NAMES):
            if not (found := self.axes.get(name)):
                continue
            yield (
                f"  {name} has {self.widths[i]:.3f} deg of play and arrives "
                f"{'upwards' if direction[i] > 0 else 'downwards'}: command "
                f"{self.shift(direction)[i]:+.3f} deg"
            )
            zone = found["dead_zone_deg"]["low"] / 2.0
            if abs(command[i] - found["dead_zone_at_deg"]) < zone:
                yield f"  NOTE: {name} does not answer there: its dead zone"
