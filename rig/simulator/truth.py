"""What a simulated device is: what a calibration should find, and what disturbs it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.config.axis import AXIS_NAMES
from rig.core.attitude import Array


@dataclasses.dataclass(frozen=True)
class Truth:
    """What a calibration should find, and what disturbs it.

    The defaults are the set values of the paper's Table 1 (pitch, yaw, roll) with a
    little cross-coupling.
    """

    matrix: tuple[tuple[float, ...], ...] = (
        (0.43, 0.012, -0.008),
        (-0.010, 0.71, 0.015),
        (0.006, -0.014, 0.87),
    )
    bias: tuple[float, float, float] = (3.1, -5.8, 2.41)  # degrees
    noise_deg: float = 0.02  # white, each reading
    backlash_deg: float = 0.0  # play of each joint
    breakaway_deg: float = 0.0  # of its drive, until a joint at rest yields
    dead_zone_deg: float = 0.0  # of each joint, about where it stands at the start
    dead_centre_deg: float = 0.0  # of the zone, away from there
    drift_deg_per_min: float = 0.0  # of the phone's heading
    heading_deg: float = 170.0  # of the base in the phone's world
    seed: int = 0
    # What is wired, set or lost otherwise than the configuration says:
    reversed: tuple[bool, ...] = (False, False, False)  # turns the other way
    swapped: tuple[int, ...] = (0, 1, 2)  # joint i is turned by drive swapped[i]
    drive_pulses_per_rev: tuple[int, ...] | None = None  # None: as configured
    lost_origin_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the counters
    # What real drives do besides what their registers say:
    latency_s: float = 0.0  # of every reply
    enable_delay_s: float = 0.0  # > 0: it starts disabled, and takes so long to enable
    reset_delay_s: float = 0.0  # until an alarm is gone after its reset
    jitter_counts: int = 0  # of the position read while it stands
    idle_watchdog: bool = False  # the comm timeout also acts while it stands

    @property
    def jig_deg(self) -> Array:
        """(3,) turns of the motors, by axis, at which every joint stands at zero."""
        joints = np.linalg.solve(np.array(self.matrix), -np.array(self.bias))
        motors = np.empty(3)
        motors[list(self.swapped)] = joints
        return motors * self.signs

    @property
    def signs(self) -> Array:
        """(3,) -1 where a motor turns the other way."""
        return np.where(self.reversed, -1.0, 1.0)


REALISTIC: dict[str, Any] = {
    "latency_s": 0.004,
    "enable_delay_s": 0.5,
    "reset_delay_s": 0.3,
    "jitter_counts": 1,
    "idle_watchdog": True,
}


def truth_of(options: dict[str, Any], seed: int) -> Truth:
    """The simulated device that the options of a command line describe.

    Raises:
        ValueError: ``swapped`` does not name two axes.
    """
    order = [0, 1, 2]
    if names := options["swapped"]:
        if len(set(names)) != 2:
            raise ValueError(f"--swapped must name two axes, got {','.join(names)}")
        a, b = map(AXIS_NAMES.index, names)
        order[a], order[b] = b, a
    degrees = ("noise", "backlash", "breakaway", "dead_zone")
    pulses, turned = options["gearing"], options["reversed"] or ()
    return Truth(
        drift_deg_per_min=options["drift"],
        seed=seed,
        reversed=tuple(name in turned for name in AXIS_NAMES),
        swapped=tuple(order),
        drive_pulses_per_rev=pulses and (pulses,) * 3,
        lost_origin_deg=(options["lost_origin"],) * 3,
        **{f"{name}_deg": options[name] for name in degrees},
        **(REALISTIC if options["realistic"] else {}),
    )
