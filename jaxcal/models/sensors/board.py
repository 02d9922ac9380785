"""A camera and a board, one on the tip and one that stands still (hand and eye)."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, one_of
from jaxcal.models.sensors.pose import rotation_vector_rate
from jaxcal.models.sensors.sensor import BASE, Named, Reading, Sensor, Tip, hats

__all__ = ["Board"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Board(Sensor):
    """Six zeros a view: the board's pose in the camera, predicted less seen.

    Commands have six more columns, the board's pose in the camera as it was seen:
    ``seen x``, ``y``, ``z`` and its rotation vector ``seen rx``, ``ry``, ``rz`` in
    degrees (OpenCV's tvec and rvec, that in degrees). What is measured is zero. Where
    the arm stands is not shown, so ``base`` is held; ``stand`` is the pose of what
    stands still, ``tool`` of what moves, and both are found without a guess. Noise
    0.1 % of the arm's length and 0.1 degrees.

    Attributes:
        moves: "camera" or "board", which is on the tip.
        place: (4, 4) of the other in the measuring frame; found when not given.
    """

    moves: str = "camera"
    place: Array | None = None

    kind = "board"
    zeros = True
    tool = ("x", "y", "z", "rx", "ry", "rz")
    _seen: ClassVar[tuple[str, ...]] = tuple(f"seen {axis}" for axis in tool)

    def __post_init__(self) -> None:
        one_of("moves", self.moves, ("camera", "board"))
        if self.place is not None:
            place = numbers("place", self.place)
            if place.shape != (4, 4):
                raise ValueError(f"place must have shape (4, 4), got {place.shape}")
            object.__setattr__(self, "place", place)

    @property
    def inputs(self) -> tuple[str, ...]:
        return self._seen

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(f"off {axis}" for axis in self.tool)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"stand {axis}" for axis in self.tool)

    @property
    def units(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("deg",) * 3

    @property
    def nominal(self) -> Array:
        place = np.eye(4) if self.place is None else self.place
        return np.concatenate([place[:3, 3], np.zeros(3)])

    def usual_noise(self, length: float) -> ArrayLike:
        return [1e-3 * length] * 3 + [0.1] * 3

    def unseen(self, arm: Named) -> tuple[str, ...]:
        return BASE

    def read(self, tip: Tip, inputs: Array, own: Array) -> Reading:
        from scipy.spatial.transform import Rotation

        place = np.eye(3) if self.place is None else self.place[:3, :3]
        turns = [
            Rotation.from_euler(a, t, True) for a, t in zip("xyz", own[3:], strict=True)
        ]
        stand = (turns[0] * turns[1] * turns[2]).as_matrix() @ place
        axes = [np.eye(3)[0], turns[0].apply(np.eye(3)[1])]
        axes.append((turns[0] * turns[1]).apply(np.eye(3)[2]))
        turn = np.radians(np.stack(axes, axis=1))  # of the stand, by its angles
        count, moved = len(inputs), tip.position - own[:3]
        seen = Rotation.from_rotvec(inputs[:, 3:], degrees=True).as_matrix()
        if self.moves == "board":  # its pose in a camera that stands
            eye = np.broadcast_to(stand.T, (count, 3, 3))
            board, where = stand.T @ tip.rotation, moved @ stand
            by_shift, sign = eye, 1.0
            by_turn = -eye @ hats(moved)  # of the camera about its own place, reversed
        else:  # the pose of a board that stands, in a camera on the tip
            eye = np.matrix_transpose(tip.rotation)
            board, where = eye @ stand, -(eye @ moved[..., None])[..., 0]
            by_shift, sign = -eye, -1.0
            by_turn = -eye @ hats(moved)
        off = np.asarray(
            Rotation.from_matrix(board @ np.matrix_transpose(seen)).as_rotvec()
        )
        rate = np.degrees(rotation_vector_rate(off)) @ eye
        by_tip, by_own = np.zeros((2, count, 6, 6))
        by_tip[:, :3, :3], by_own[:, :3, :3] = by_shift, -by_shift
        by_tip[:, 3:, 3:], by_own[:, 3:, 3:] = sign * rate, -sign * (rate @ turn)
        if self.moves == "board":
            by_own[:, :3, 3:] = -by_turn @ turn
        else:
            by_tip[:, :3, 3:] = by_turn
        values = np.hstack([where - inputs[:, :3], np.degrees(off)])
        return Reading(values, by_tip, by_own)

    def located(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> tuple[Self, Array | None]:
        """Tool X and place Z of ``A X = Z B`` in closed form (Shah, 2013)."""
        from scipy.spatial.transform import Rotation

        if self.place is not None:
            return self, None
        if len(inputs) < 3:
            raise ValueError(f"place must be given for {len(inputs)} views, 3 find it")
        turn = Rotation.from_rotvec(inputs[:, 3:], degrees=True).as_matrix()
        shift = inputs[:, :3]
        if self.moves == "camera":
            turn = np.matrix_transpose(turn)
            shift = -(turn @ shift[..., None])[..., 0]
        arm = tip.rotation
        # R_X = R_A' R_Z R_B, summed over the views, as a matrix on the nine of R_Z.
        mix = np.einsum("nki,nlj->ijkl", arm, turn).reshape(9, 9)
        left, size, right = np.linalg.svd(mix)
        if size[1] > 0.999 * size[0]:
            raise ValueError(
                "views must turn the tip about two axes at least: with these the board "
                "and the camera cannot be told apart"
            )
        tool, stand = (_nearest(v.reshape(3, 3)) for v in (left[:, 0], right[0]))
        eye = np.broadcast_to(-np.eye(3), arm.shape)
        rows = np.concatenate([arm, eye], axis=-1).reshape(-1, 6)
        offset = (shift @ stand.T - tip.position).ravel()
        shifts = np.linalg.lstsq(rows, offset, rcond=None)[0]
        place, new = np.eye(4), np.eye(4)
        new[:3, :3], new[:3, 3] = tool, shifts[:3]
        place[:3, :3], place[:3, 3] = stand, shifts[3:]
        return dataclasses.replace(self, place=place), new


def _nearest(matrix: Array) -> Array:
    """The rotation nearest to a multiple of a matrix, that of either sign."""
    left, _, right = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(left @ right)
