"""An accelerometer at the tip while the arm is at rest."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.sensors.sensor import AtRest, Reading, Tip, hats
from jaxcal.checks import Array, in_words
from jaxcal.models.model import Quantity

_ASIDE = 0.7  # cosine: readings farther from up have another up
_TURNED = 27.0  # degrees on the tool, from which the fit does not find them


@dataclasses.dataclass(frozen=True, eq=False)
class Gravity(AtRest):
    """Acceleration x, y, z in the tip's frame at rest: up, as accelerometers read it.

    Lengths, and a turn about the vertical, are not shown and held. A joint's zero
    cannot be told from the turns of the next axes: the prior shares the error out. The
    scale of the sensor is known to 2 %, its bias to 5 %; noise 0.1 % of ``magnitude``.

    Attributes:
        magnitude: what a level sensor reads, 9.81 for m/s^2 or 1 for g.
        up: (3,) direction in the measuring frame.
    """

    magnitude: float = 9.81
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    kind = "gravity"
    outputs = ("acceleration x", "acceleration y", "acceleration z")
    names = ("gravity scale", "bias x", "bias y", "bias z")
    units = ("ratio", *["acceleration"] * 3)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        return (Quantity("g" if self.magnitude == 1.0 else "m/s^2"),)

    @property
    def nominal(self) -> Array:
        return np.array([1.0, 0.0, 0.0, 0.0])

    def prior_std(self, length: float) -> Array:
        return np.array([0.02, *[0.05 * self.magnitude] * 3])

    def usual_noise(self, length: float) -> ArrayLike:
        return 1e-3 * self.magnitude

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        up = self.magnitude * np.array(self.up)
        felt = up @ tip.rotation  # (N, 3) in the tip's frame
        count = len(felt)
        by_tip = np.zeros((count, 3, 6))
        by_tip[:, :, 3:] = parameters[0] * np.matrix_transpose(tip.rotation) @ hats(up)
        bias = np.broadcast_to(np.eye(3), (count, 3, 3))
        by_own = np.concatenate([felt[..., None], bias], axis=-1)
        return Reading(parameters[0] * felt + parameters[1:], by_tip, by_own)

    def located(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> tuple[Self, Array | None]:
        """Itself. Refused are another unit or up, and a sensor that is turned."""
        if measured is None:
            return self, None
        size = float(np.median(np.linalg.norm(measured, axis=1)))
        if abs(size / self.magnitude - 1.0) > 0.2:
            raise ValueError(
                f"gravity readings must have magnitude {self.magnitude:g} within 20 %, "
                f"got {size:.4g} (median); for readings in g use Gravity(magnitude=1)"
            )
        directions = measured / size
        up = np.einsum("nij,nj->i", tip.rotation, directions) / len(directions)
        if np.linalg.norm(up) > 0.8 and up @ self.up < _ASIDE * np.linalg.norm(up):
            raise ValueError(
                "gravity readings must point along up, "
                f"{in_words(np.round(self.up, 2))}, got "
                f"{in_words((up / np.linalg.norm(up)).round(2) + 0.0)} on average: "
                "give that as up=, or negate them if the sensor reads down"
            )
        felt = np.array(self.up) @ tip.rotation
        left, spread, right = np.linalg.svd(felt.T @ directions)
        left[:, 2] *= np.linalg.det(left @ right)
        turn = Rotation.from_matrix(left @ right)
        off, other = (
            np.median(np.linalg.norm(felt - one, axis=1))
            for one in (directions, turn.apply(directions))
        )
        angle, vector = np.degrees(turn.magnitude()), turn.as_rotvec(degrees=True)
        told = spread[1] > 0.1 * spread[0]  # by more than one direction
        if told and angle > _TURNED and off > 0.1 and other < off / 3.0:
            raise ValueError(
                f"gravity readings fit a sensor turned by {angle:.0f} degrees on the "
                "tool. Multiply the rotation of tool= (of mounts= in Several) from "
                "the right by the rotation with the vector "
                f"{in_words(vector.round() + 0.0)} in degrees"
            )
        return self, None
