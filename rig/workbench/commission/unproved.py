"""How far and how fast an axis may be sent whose gearing is not proved.

What is not proved limits pulses and the drive's own speed, never degrees: degrees are
what is not known. The first move turns the motor by FIRST_MOTOR_DEG. Each next one is
at most GROWTH times as long, and no longer than it takes to turn the phone as far as
it may, by what the phone was seen to turn for each pulse. Where the phone's unit is not
proved either, it may have turned by 57.3 times what was seen.
"""

from __future__ import annotations

import math

import numpy as np

from rig.config.axis import Axis
from rig.config.settings import ImuSettings
from rig.core.attitude import Array, matrix_to_euler

FIRST_MOTOR_DEG = 0.36
GROWTH = 4.0  # play of a third of a move can hide it
LOOK_S = 0.5  # time that a move takes at least, of which little is known
SLOW_DEG_S = 5.0  # of the joint, once the phone has shown what a pulse turns
RADIANS = 180.0 / math.pi
LARGEST_RAD = 2.0 * math.pi + 0.1  # no larger number is an angle in radians


def unit_proved(imu: ImuSettings, attitude: Array) -> bool:
    """Whether a phone's (3, 3) attitude can only have come in the configured unit.

    A quaternion has none. A number over 2 pi is no angle in radians. Degrees that are
    read as radians turn 57.3 times too far, which the first move shows.
    """
    if imu.format == "sensorlogger" or imu.quaternion_columns or imu.unit == "rad":
        return True
    sent = matrix_to_euler(attitude, str(imu.order))
    return bool(np.abs(sent).max() > LARGEST_RAD)


class Reach:
    """What one axis may be sent, in pulses, by the moves so far from one place."""

    def __init__(self, axis: Axis, unit_is_proved: bool = True) -> None:
        self.axis = axis
        self.factor = 1.0 if unit_is_proved else RADIANS
        self.longest = 0  # pulses of the longest move so far
        self.deg_per_pulse = 0.0  # that the phone turned at most, in that move

    @property
    def turned_deg(self) -> float:
        """How far the longest move may have turned the joint."""
        return self.longest * self.deg_per_pulse

    def pulses(self, wanted: float, most_deg: float) -> int:
        """Pulses, at least 1, of the next move towards a wanted count.

        Where that or ``most_deg`` of the joint takes several moves, they grow evenly.
        """
        if not self.longest:
            first = FIRST_MOTOR_DEG / 360.0 * self.axis.pulses_per_rev
            return max(1, math.floor(min(abs(wanted), first)))
        goal = abs(wanted)
        if self.deg_per_pulse:
            goal = min(goal, most_deg / self.deg_per_pulse)
        ratio = goal / self.longest
        steps = max(1, math.ceil(math.log(ratio) / math.log(GROWTH) - 1e-9))
        return max(1, math.floor(self.longest * ratio ** (1.0 / steps)))

    def saw(self, pulses: float, turned_deg: float, noise_deg: float) -> None:
        """A move by so many pulses turned the phone so far, give or take the noise."""
        if abs(pulses) >= self.longest:
            self.longest = int(abs(pulses))
            # Of a unit that is not proved only what surely turned counts 57 times.
            sign = 1.0 if self.factor == 1.0 else -1.0
            most = self.factor * max(0.0, turned_deg + sign * noise_deg)
            self.deg_per_pulse = most / self.longest

    def paced(self, pulses: float) -> Axis:
        """The axis at the speed of a move by so many pulses."""
        per_s = abs(pulses) / LOOK_S
        if self.deg_per_pulse:
            per_s = min(
                max(per_s, self.longest / LOOK_S), SLOW_DEG_S / self.deg_per_pulse
            )
        return slowed(self.axis, per_s / abs(self.axis.pulses_per_deg))


def slowed(axis: Axis, speed_deg_s: float | None = None) -> Axis:
    """An axis no faster than that (SLOW_DEG_S), as far as its drive's registers go."""
    speed = min(SLOW_DEG_S if speed_deg_s is None else speed_deg_s, axis.speed_deg_s)
    while speed < axis.speed_deg_s:
        slow = axis.model_copy(update={"speed_deg_s": speed})
        try:
            slow.motion_counts()
            return slow
        except ValueError:  # slower than the drive's register can say
            speed *= 1.5
    return axis
