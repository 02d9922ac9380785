"""Sensors at the tip that feel gravity at rest: accelerometers, force and torque."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.sensors.sensor import Located, Reading, Sensor, Tip, hats
from jaxcal.checks import Array, array_of, in_words, numbers
from jaxcal.models.model import Quantity

_ASIDE = 0.7  # cosine: readings farther from up have another up
_TURNED = 27.0  # degrees on the tool, from which the fit does not find them
_FEW = 4  # postures that show how the sensor is mounted
_SPREAD = 0.1  # of the largest: forces along more than a line, and off a plane
_MASS, _CENTRE = 0.5, 0.1  # of a load: of its mass, of the arm's length
_TILTED = 0.01  # of the forces' squares: what a base 5 degrees from level leaves
_UPRIGHT = 0.97  # cosine: nearer to up than 14 degrees, the fit finds the base
_ROUNDS = 20
_ASKEW = 0.45  # radians on the tool, from which the fit does not find them


class AtRest(Sensor):
    """A sensor at the tip that feels gravity while the arm is at rest."""

    magnitude: float  # of gravity
    up: tuple[float, float, float]  # in the measuring frame

    tool = ("rx", "ry", "rz")

    def __post_init__(self) -> None:
        up = array_of("up", self.up, 3)
        if not np.linalg.norm(up) > 0.0:
            raise ValueError(f"up must be a direction (3,), got {in_words(up)}")
        if not numbers("magnitude", self.magnitude) > 0.0:
            raise ValueError(f"magnitude must be positive, got {self.magnitude}")
        object.__setattr__(self, "up", tuple((up / np.linalg.norm(up)).tolist()))

    def unseen(self, arm: Any) -> tuple[str, ...]:
        lengths = zip(arm.names, arm.units, strict=True)
        hidden = [n for n, u in lengths if u == "length" and n not in self.names]
        return (*hidden, f"base r{'xyz'[int(np.abs(self.up).argmax())]}")


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

    nominal = np.array([1.0, 0.0, 0.0, 0.0])

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

    def located(self, tip: Tip, inputs: Array, measured: Array | None) -> Located:
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
        agreement, up = np.linalg.norm(up), up / (np.linalg.norm(up) or 1.0)
        if agreement > 0.8 and up @ self.up < _ASIDE:
            raise ValueError(
                "gravity readings must point along up, "
                f"{in_words(np.round(self.up, 2))}, got {in_words(up.round(2) + 0.0)} "
                "on average: give that as up=, or negate them if the sensor reads down"
            )
        felt = np.array(self.up) @ tip.rotation
        spread = np.linalg.svd(felt.T @ directions, compute_uv=False)
        turn = Rotation.from_matrix(_turn(felt, directions)[0])
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


@dataclasses.dataclass(frozen=True, eq=False)
class Wrench(AtRest):
    """Force and torque x, y, z in the tip's frame at rest: its load's weight and zeros.

    With R from the tip to the measuring frame and the load's mass m and centre c in the
    tip's frame, ``force = m magnitude R' down + zero`` and ``torque = c x (the same) +
    zero``: the load pulls on the sensor. A sensor that reads what holds the load has
    the other sign; negate its readings. An arm that hangs needs its base, or ``up``.

    Lengths, and a turn about the vertical, are not shown and held. How the sensor is
    turned on the tool (``tool rx``, ``ry``, ``rz``, found without a guess from four
    readings) and which way is down (``base rx``, ``ry``) are known as those of any tool
    and base. A load that no posture tells from the zeros, as on a SCARA, is known to
    half its mass and a tenth of the arm's length. Torques are in newtons times the
    arm's unit of length. Noise 0.1 N, and as much at 5 % of the arm's length.

    Attributes:
        mass: of the load with what of the sensor moves with it, kg, roughly.
        centre: (3,) of the load in the tip's frame, roughly.
        magnitude: of gravity, 9.81 for newtons.
        up: (3,) direction in the measuring frame.
    """

    mass: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    magnitude: float = 9.81
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    kind = "wrench"
    local = True
    outputs = tuple(f"{what} {axis}" for what in ("force", "torque") for axis in "xyz")
    names = (
        *("mass", "centre x", "centre y", "centre z"),
        *(f"zero {output}" for output in outputs),
    )
    quantities = (Quantity("N", slice(3)), Quantity("N length", slice(3, 6)))
    units = ("kg", *["length"] * 3, *["N"] * 3, *["N length"] * 3)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not numbers("mass", self.mass) > 0.0:
            raise ValueError(f"mass must be positive, got {self.mass}")
        centre = array_of("centre", self.centre, 3)
        object.__setattr__(self, "centre", tuple(centre.tolist()))

    @property
    def nominal(self) -> Array:
        return np.array([self.mass, *self.centre, *[0.0] * 6])

    def prior_std(self, length: float) -> Array:
        return np.array([_MASS * self.mass, *[_CENTRE * length] * 3, *[np.inf] * 6])

    def usual_noise(self, length: float) -> ArrayLike:
        return [0.1] * 3 + [0.1 * 0.05 * length] * 3

    def _pull(self, tip: Tip) -> Array:
        """(N, 3) force of one kilogram in the tip's frame."""
        return -self.magnitude * np.array(self.up) @ tip.rotation

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        mass, lever = parameters[0], hats(parameters[1:4])
        unit, down = self._pull(tip), -self.magnitude * np.array(self.up)
        force = mass * unit
        count = len(force)
        by_tip = np.zeros((count, 6, 6))
        by_tip[:, :3, 3:] = mass * np.matrix_transpose(tip.rotation) @ hats(down)
        by_tip[:, 3:, 3:] = lever @ by_tip[:, :3, 3:]
        by_own = np.zeros((count, 6, 10))
        by_own[:, :3, 0], by_own[:, 3:, 0] = unit, unit @ lever.T
        by_own[:, 3:, 1:4] = -hats(force)
        by_own[:, :, 4:] = np.eye(6)
        values = np.hstack([force, force @ lever.T]) + parameters[4:]
        return Reading(values, by_tip, by_own)

    def located(self, tip: Tip, inputs: Array, measured: Array | None) -> Located:
        """Itself, and how it is turned on the tool where that is far from nominal.

        From differences of the forces: zeros do not matter. Refused are torques in
        another unit, forces against gravity, and an arm that stands otherwise.
        """
        if measured is None or len(measured) < _FEW:
            return self, None
        force, torque = np.split(measured - measured.mean(axis=0), 2, axis=1)
        arm = float(np.linalg.norm(torque) / (np.linalg.norm(force) + 1e-300))
        if arm > tip.length:
            raise ValueError(
                "torques must be in newtons times the arm's unit of length, but the "
                f"load seems {arm:.3g} from the sensor; the arm has {tip.length:.3g}"
            )
        pull = self._pull(tip)
        pull = pull - pull.mean(axis=0)
        spread = np.linalg.svd(pull.T @ force, compute_uv=False)
        turned = np.linalg.svd(pull, compute_uv=False) / np.sqrt(len(pull))
        alike = turned[1] < _SPREAD * self.magnitude  # as on a SCARA, always upright
        if alike or spread[1] < _SPREAD * spread[0]:
            return self, None
        (turn, off), against = _turn(pull, force), _turn(pull, -force)[1]
        if off > _TILTED and against < off / 4.0:
            other = in_words(0.0 - np.array(self.up))
            raise ValueError(
                "forces point against gravity. Three causes are possible: the arm "
                f"hangs from the ceiling (give its base, or Wrench(up={other})); the "
                "sensor reads the holding force (negate forces and torques); the "
                "controller subtracts a payload heavier than the load (set it to zero "
                "and read again). Find the cause, then run identify again"
            )
        if off > _TILTED:
            self._require_upright(tip, force, off)
        if Rotation.from_matrix(turn).magnitude() < _ASKEW:
            return self, None
        frame = np.eye(4)
        frame[:3, :3] = turn
        return self, frame

    def _require_upright(self, tip: Tip, force: Array, off: float) -> None:
        """Refuse forces that fit another direction of gravity far better."""
        best, up = off, np.zeros(3)
        for start in np.vstack([np.eye(3), -np.eye(3)]):
            down = -start
            for _ in range(_ROUNDS):
                pull = down @ tip.rotation
                turn, misfit = _turn(pull - pull.mean(axis=0), force)
                if misfit < best:
                    best, up = misfit, -down / np.linalg.norm(down)
                rows = tip.rotation - tip.rotation.mean(axis=0)  # (N, 3, 3), down @ it
                rows = np.matrix_transpose(rows).reshape(-1, 3)
                down = np.linalg.lstsq(rows, (force @ turn.T).ravel(), rcond=None)[0]
        if best < off / 10.0 and up @ self.up < _UPRIGHT:
            there, other = (in_words(x.round(2) + 0.0) for x in (up, -up))
            raise ValueError(
                f"forces fit an arm with up = {there}, or with up = {other} if the "
                "sensor reads the holding force, not up = "
                f"{in_words(np.round(self.up, 2))}: give its base, or Wrench(up=...)"
            )


def _turn(pull: Array, force: Array) -> tuple[Array, float]:
    """The rotation of the sensor that takes pulls (N, 3) nearest to forces (N, 3) but
    for the mass, and the share of the forces' squares that is left."""
    left, spread, right = np.linalg.svd(pull.T @ force)
    handed = np.linalg.det(left @ right)
    left[:, 2] *= handed
    trace = spread[0] + spread[1] + handed * spread[2]
    size = float((pull**2).sum() * (force**2).sum())
    return left @ right, float(max(1.0 - trace**2 / size, 0.0))
