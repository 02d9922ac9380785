"""The mechanism: what the joints do when the drives stand where they stand."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config.axis import AXIS_NAMES, Axis
from rig.config.config import RigConfig
from rig.core.attitude import Array, euler_to_matrix
from rig.simulator.drive import Habits, SimDrive


@dataclasses.dataclass(frozen=True)
class Truth(Habits):
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
    latency_s: float = 0.0  # of every reply

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
    pulses = options["gearing"]
    lost = options["lost_origin"]
    turned = options["reversed"] or ()
    return Truth(
        noise_deg=options["noise"],
        backlash_deg=options["backlash"],
        breakaway_deg=options["breakaway"],
        dead_zone_deg=options["dead_zone"],
        drift_deg_per_min=options["drift"],
        seed=seed,
        reversed=tuple(name in turned for name in AXIS_NAMES),
        swapped=tuple(order),
        drive_pulses_per_rev=pulses and (pulses,) * 3,
        lost_origin_deg=(lost,) * 3,
        **(REALISTIC if options["realistic"] else {}),
    )


def gearing(axis: Axis, pulses_per_rev: int) -> float:
    """Signed pulses for one degree of a joint whose drive is set otherwise."""
    return axis.model_copy(update={"pulses_per_rev": pulses_per_rev}).pulses_per_deg


class Plant:
    """From drive positions to the phone's attitude, with play, noise and drift."""

    def __init__(
        self,
        config: RigConfig,
        truth: Truth,
        drives: list[SimDrive],
        slipping: Callable[[int], object] = lambda axis: False,
    ) -> None:
        self.truth = truth
        self._config = config
        self._drives = drives
        self._slipping = slipping
        self._start = time.monotonic()
        self._rng = np.random.default_rng(truth.seed)
        self._matrix = np.array(truth.matrix)
        self._bias = np.array(truth.bias)
        self._drive_deg = self._commanded()
        self._loose = self._drive_deg.copy()  # behind the play
        self._slip = np.zeros(3)
        self._joint = self._drive_deg.copy()  # behind the friction too
        self._sliding = np.zeros(3, dtype=bool)
        self._centre = self._drive_deg + truth.dead_centre_deg
        self._mounting = euler_to_matrix(config.imu.mounting_deg, "ZYX")

    def tighten(self) -> None:
        """Put slipped joints back to where their drives say."""
        self._slip[:] = 0.0

    def _commanded(self) -> Array:
        """(3,) degrees by which the motors turn the joints."""
        turned = [
            (drive.position - drive.offset) / gearing(axis, drive.pulses_per_rev)
            for axis, drive in zip(self._config.axes, self._drives, strict=True)
        ]
        return (np.array(turned) * self.truth.signs)[list(self.truth.swapped)]

    def joints(self) -> Array:
        """(3,) joint angles in degrees now.

        ``A u + b`` behind the play, the friction (a joint at rest stays until its drive
        is ``breakaway_deg`` away, then follows it until that stands) and the dead zone.
        """
        for drive in self._drives:
            drive.advance()
        now = self._commanded()
        for axis in range(3):
            if self._slipping(axis):
                self._slip[axis] += now[axis] - self._drive_deg[axis]
        self._drive_deg = now
        turned = now - self._slip
        half = self.truth.backlash_deg / 2.0
        loose = np.clip(self._loose, turned - half, turned + half)
        self._sliding &= loose != self._loose
        self._loose = loose
        self._sliding |= np.abs(loose - self._joint) > self.truth.breakaway_deg
        self._joint = np.where(self._sliding, loose, self._joint)
        off = self._joint - self._centre
        zone = self.truth.dead_zone_deg / 2.0
        past = np.sign(off) * np.maximum(np.abs(off) - zone, 0.0)
        return self._matrix @ (self._centre + past) + self._bias

    def attitude(self) -> Array:
        """(3, 3) attitude of the phone in its world, as its sensors see it."""
        joints = self.joints()
        config = self._config
        order = config.mechanism.order
        sequence = [joints[config.letters.index(letter)] for letter in order]
        minutes = (time.monotonic() - self._start) / 60.0
        heading = self.truth.heading_deg + self.truth.drift_deg_per_min * minutes
        attitude = (
            euler_to_matrix([heading, 0.0, 0.0], "ZYX")
            @ euler_to_matrix(sequence, order)
            @ self._mounting
        )
        if self.truth.noise_deg:
            noise = self._rng.normal(0.0, self.truth.noise_deg, 3)
            attitude = attitude @ Rotation.from_rotvec(noise, degrees=True).as_matrix()
        return attitude
