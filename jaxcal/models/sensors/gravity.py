"""An accelerometer at the tip while the arm is at rest."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import in_words, numbers
from jaxcal.models.sensors.sensor import Named, Reading, Sensor, Tip, hats

__all__ = ["Gravity"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Gravity(Sensor):
    """Acceleration x, y, z in the tip's frame at rest: up, as accelerometers read it.

    Lengths, and a turn about the vertical, are not shown and held. So are the turns of
    the axes, alpha and beta: a joint's zero cannot be told from its neighbours', which
    are known better. The scale of the sensor is known to 2 %, its bias to 5 %; noise
    0.1 % of ``magnitude``.

    Attributes:
        magnitude: what a level sensor reads, 9.81 for m/s^2 or 1 for g.
        up: (3,) direction in the measuring frame.
    """

    magnitude: float = 9.81
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    kind = "gravity"
    tool = ("rx", "ry", "rz")
    outputs = ("acceleration x", "acceleration y", "acceleration z")
    names = ("gravity scale", "bias x", "bias y", "bias z")
    units = ("ratio", *["acceleration"] * 3)

    def __post_init__(self) -> None:
        up = numbers("up", self.up)
        if up.shape != (3,) or not np.linalg.norm(up) > 0.0:
            raise ValueError(f"up must be a direction (3,), got {in_words(up)}")
        if not numbers("magnitude", self.magnitude) > 0.0:
            raise ValueError(f"magnitude must be positive, got {self.magnitude}")
        object.__setattr__(self, "up", tuple((up / np.linalg.norm(up)).tolist()))

    @property
    def nominal(self) -> Array:
        return np.array([1.0, 0.0, 0.0, 0.0])

    def prior_std(self, length: float) -> Array:
        return np.array([0.02, *[0.05 * self.magnitude] * 3])

    def usual_noise(self, length: float) -> ArrayLike:
        return 1e-3 * self.magnitude

    def unseen(self, arm: Named) -> tuple[str, ...]:
        about = "xyz"[int(np.abs(self.up).argmax())]
        hidden = [
            name
            for name, unit in zip(arm.names, arm.units, strict=True)
            if unit == "length" or name.startswith(("alpha", "beta"))
        ]
        return (*hidden, f"base r{about}")

    def read(self, tip: Tip, inputs: Array, own: Array) -> Reading:
        up = self.magnitude * np.array(self.up)
        felt = up @ tip.rotation  # (N, 3) in the tip's frame
        count = len(felt)
        by_tip = np.zeros((count, 3, 6))
        by_tip[:, :, 3:] = own[0] * np.matrix_transpose(tip.rotation) @ hats(up)
        bias = np.broadcast_to(np.eye(3), (count, 3, 3))
        by_own = np.concatenate([felt[..., None], bias], axis=-1)
        return Reading(own[0] * felt + own[1:], by_tip, by_own)
