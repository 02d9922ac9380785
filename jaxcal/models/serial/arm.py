"""The kinematics of a serial arm and their derivative."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers
from jaxcal.models.model import as_commands
from jaxcal.models.serial.kinematics import (
    OF_BASE,
    OF_ROW,
    Step,
    cross,
    forward,
    rotation_vector_rate,
)
from jaxcal.models.serial.torque import Load, torque

__all__ = ["Arm"]

Array = NDArray[np.float64]

# Where a, alpha, d, theta and beta act among the five steps of a row.
_ORDER = {"standard": (2, 3, 1, 0, 4), "modified": (0, 1, 4, 3, 2)}


@dataclasses.dataclass(frozen=True, eq=False)
class Arm:
    """What an arm is nominally, and how its tool moves with any parameters."""

    table: Array  # (n, 5) a, alpha, d, theta, beta
    convention: str  # "standard" or "modified"
    joints: str  # "RRPRRR": revolute or prismatic
    base: Array  # (4, 4) from the measuring frame to the first joint's
    tool: Array  # (4, 4) from the last link to the measured point
    output: str  # "position": x, y, z; "pose": and the turn from nominal, in degrees
    gears: tuple[int, ...]  # joints, from 1, whose gear ratio is a parameter
    compliance: tuple[int, ...]  # joints, from 1, whose compliance is one
    loads: tuple[Load, ...]  # link, weight, its centre
    gravity: tuple[float, float, float]  # direction in the measuring frame
    joint_names: tuple[str, ...]

    @property
    def num_inputs(self) -> int:
        return len(self.table)

    @property
    def num_outputs(self) -> int:
        return 3 if self.output == "position" else 6

    @property
    def nominal(self) -> Array:
        """(p,) the table, gear ratios of 1, stiff joints, base and tool as given."""
        return np.concatenate(
            [
                self.table.ravel(),
                np.ones(len(self.gears)),
                np.zeros(len(self.compliance)),
                self.base[:3, 3],
                np.zeros(3),
                self.tool[:3, 3],
                np.zeros(self.num_outputs - 3),
            ]
        )

    def rotation_vectors(self, commands: ArrayLike, rotations: ArrayLike) -> Array:
        """Measured orientations as this model's outputs: turns from nominal (N, 3).

        Args:
            commands: (N, n) where they were measured.
            rotations: (N, 3, 3) measured rotation matrices in the measuring frame.

        Returns:
            (N, 3) degrees, in the measuring frame.
        """
        from scipy.spatial.transform import Rotation

        commands = as_commands(commands, self.num_inputs)
        rotations = numbers("rotations", rotations)
        if rotations.shape != (len(commands), 3, 3):
            raise ValueError(
                f"rotations must have shape ({len(commands)}, 3, 3), "
                f"got {rotations.shape}"
            )
        nominal = self._nominal_rotations(commands)
        turn = rotations @ np.matrix_transpose(nominal)
        return np.asarray(Rotation.from_matrix(turn).as_rotvec(degrees=True))

    def rotations(self, commands: ArrayLike, vectors: ArrayLike) -> Array:
        """Rotation matrices (N, 3, 3) of turns from nominal (N, 3) in degrees.

        The inverse of :meth:`rotation_vectors`.
        """
        from scipy.spatial.transform import Rotation

        commands = as_commands(commands, self.num_inputs)
        turn = Rotation.from_rotvec(numbers("vectors", vectors), degrees=True)
        return np.asarray(turn.as_matrix() @ self._nominal_rotations(commands))

    def _nominal_rotations(self, commands: Array) -> Array:
        """(N, 3, 3) from the tool to the measuring frame."""
        steps = self._steps(commands, self.nominal)
        return forward(len(commands), steps)[0][:3].transpose(2, 1, 0)

    @property
    def _steps_of_joints(self) -> NDArray[np.int64]:
        """(n,) the step that each joint's command moves."""
        order = _ORDER[self.convention]
        moved = [order[3 if kind == "R" else 2] for kind in self.joints]
        return OF_BASE + OF_ROW * np.arange(self.num_inputs) + moved

    @functools.cached_property
    def _steps_of_parameters(self) -> NDArray[np.int64]:
        """(p,) the step that each parameter moves."""
        n = self.num_inputs
        moved = self._steps_of_joints
        first = OF_BASE + OF_ROW * np.arange(n)
        tool = OF_BASE + OF_ROW * n
        return np.concatenate(
            [
                (first[:, None] + _ORDER[self.convention]).ravel(),
                moved[[i - 1 for i in (*self.gears, *self.compliance)]],
                np.arange(6),
                (tool + np.array([0, 1, 2, 4, 5, 6]))[: self.num_outputs],
            ]
        )

    def _drives(self, parameters: Array) -> tuple[Array, Array]:
        """Gear ratio (n,) of all joints, and compliance of those that have one."""
        first = 5 * self.num_inputs
        last = first + len(self.gears)
        ratios = np.ones(self.num_inputs)
        ratios[[i - 1 for i in self.gears]] = parameters[first:last]
        return ratios, parameters[last : last + len(self.compliance)]

    def _steps(self, commands: Array, parameters: Array) -> list[Step]:
        """The whole chain, from the measuring frame to the tool."""
        n = self.num_inputs
        gears, compliance = self._drives(parameters)
        moves = gears[:, None] * commands.T
        if compliance.any():
            at = [i - 1 for i in self.compliance]
            moves[at] += compliance[:, None] * self._torque(commands)[0]
        mounting = parameters[-6 - self.num_outputs :]
        steps = [Step(k > 2, k % 3, mounting[k]) for k in range(6)]
        steps.append(Step(True, None, self.base[:3, :3]))
        for row, move, kind in zip(
            parameters[: 5 * n].reshape(n, 5), moves, self.joints, strict=True
        ):
            a, alpha, d, theta, beta = row
            turn = Step(True, 2, theta + move if kind == "R" else theta)
            slide = Step(False, 2, d + move if kind == "P" else d)
            link = [Step(False, 0, a), Step(True, 0, alpha), Step(True, 1, beta)]
            if self.convention == "standard":
                steps += [turn, slide, *link]
            else:
                steps += [*link, turn, slide]
        tool = [Step(k > 2, k % 3, mounting[6 + k]) for k in range(self.num_outputs)]
        steps += [*tool[:3], Step(True, None, self.tool[:3, :3]), *tool[3:]]
        return steps

    def _motion(
        self, commands: Array, parameters: Array, at: NDArray[np.int64]
    ) -> Array:
        """(N, q, S) derivative of the outputs by the steps ``at`` (S,)."""
        steps = self._steps(commands, parameters)
        frame, axes, origins = forward(len(commands), steps)
        motion = np.empty((len(at), 3, len(commands)))
        for k, i in enumerate(at):
            if steps[i].turns:
                cross(axes[i], np.radians(frame[3] - origins[i]), motion[k])
            else:
                motion[k] = axes[i]
        position = np.ascontiguousarray(motion.transpose(2, 1, 0))
        if self.output == "position":
            return position
        vector = np.radians(self._outputs(commands, frame)[:, 3:])
        turn = np.zeros_like(position)
        for k, i in enumerate(at):
            if steps[i].turns:
                turn[..., k] = axes[i].T
        return np.concatenate([position, rotation_vector_rate(vector) @ turn], axis=1)

    def _outputs(self, commands: Array, frame: Array) -> Array:
        position = np.ascontiguousarray(frame[3].T)
        if self.output == "position":
            return position
        rotations = frame[:3].transpose(2, 1, 0)
        return np.hstack([position, self.rotation_vectors(commands, rotations)])

    def _torque(self, commands: Array) -> tuple[Array, Array]:
        """Of the compliant joints of the nominal arm (C, N), and its rate (C, n, N)."""
        return torque(
            commands,
            self._steps(commands, self.nominal),
            self._steps_of_joints,
            np.array([kind == "R" for kind in self.joints]),
            np.array(self.compliance) - 1,
            self.loads,
            np.array(self.gravity),
        )
