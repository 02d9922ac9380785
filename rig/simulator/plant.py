"""The mechanism: what the joints do when the drives stand where they stand."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from rig.attitude import Array, euler_to_matrix
from rig.config.config import RigConfig
from rig.simulator.drive import SimDrive


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
    drift_deg_per_min: float = 0.0  # of the phone's heading
    heading_deg: float = 170.0  # of the base in the phone's world
    seed: int = 0

    @property
    def jig_deg(self) -> Array:
        """(3,) commands at which every joint stands at zero."""
        return np.linalg.solve(np.array(self.matrix), -np.array(self.bias))


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

    def tighten(self) -> None:
        """Put slipped joints back to where their drives say."""
        self._slip[:] = 0.0

    def _commanded(self) -> Array:
        return self._config.to_deg([drive.position for drive in self._drives])

    def joints(self) -> Array:
        """(3,) joint angles in degrees now: ``A u + b`` behind the play."""
        for drive in self._drives:
            drive.advance()
        now = self._commanded()
        for axis in range(3):
            if self._slipping(axis):
                self._slip[axis] += now[axis] - self._drive_deg[axis]
        self._drive_deg = now
        turned = now - self._slip
        half = self.truth.backlash_deg / 2.0
        self._loose = np.clip(self._loose, turned - half, turned + half)
        return self._matrix @ self._loose + self._bias

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
            @ euler_to_matrix(config.imu.mounting_deg, "ZYX")
        )
        if self.truth.noise_deg:
            noise = self._rng.normal(0.0, self.truth.noise_deg, 3)
            attitude = attitude @ Rotation.from_rotvec(noise, degrees=True).as_matrix()
        return attitude
