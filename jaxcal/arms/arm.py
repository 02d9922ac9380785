"""The kinematics of a serial arm, what its sensor reads, and their derivatives."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from jaxcal.arms.chain_kernel import forward
from jaxcal.arms.sensors import Reading, Sensor, Tip
from jaxcal.checks import Array, array_of, numbers
from jaxcal.models.model import as_commands

Load = tuple[int, float, tuple[float, float, float]]  # link from 1, weight, its centre

# The steps of the base: three shifts, three turns, its nominal rotation; five of each
# row of the table; the tool's three shifts, nominal rotation, three turns. A step is
# 0, 1, 2, a shift along x, y, z, or 3, 4, 5, a turn about it, or 6 and on, a constant.
_BASE, _ROW, _TOOL = (0, 1, 2, 3, 4, 5, 6), (0, 3, 2, 5, 4), (0, 1, 2, 7, 3, 4, 5)
_STILL = 0.02  # of the arm's length: the way of a slide that shows no size
_PARALLEL, _CANCELS = 0.2, 3.0  # sine; times as long as what is left: lengths cancel
_MANY = 2_000  # postures: what is found of so many is not kept
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
    sensor: Sensor  # what its tip is measured with
    gears: tuple[int, ...]  # joints, from 1, whose gear ratio is a parameter
    compliance: tuple[int, ...]  # joints, from 1, whose compliance is one
    yields: Array  # (C,) what it is nominally, degrees per torque
    harmonics: tuple[int, ...]  # joints, from 1, whose gears are eccentric
    waves: Array  # (H, 4) nominally, degrees by sin, cos of the joint and of twice it
    loads: tuple[Load, ...]  # link, weight, its centre
    gravity: tuple[float, float, float]  # direction in the measuring frame
    joint_names: tuple[str, ...]  # J of them, the first columns of the commands
    drive: Array  # (n, J) how far each joint moves with each column
    offset: Array  # (n,) where each joint is at commands of zero
    limits: Array  # (J, 2) least and greatest command, infinite where not known
    source: Mapping[str, Any] | None  # the URDF file: text, base, tip, locked

    @property
    def num_joints(self) -> int:
        """J, columns of the commands that move the arm."""
        return len(self.joint_names)

    @property
    def num_inputs(self) -> int:
        """n, the joints and what the sensor asks for."""
        return self.num_joints + len(self.sensor.inputs)

    @property
    def num_outputs(self) -> int:
        """q."""
        return len(self.sensor.outputs)

    @functools.cached_property
    def length(self) -> float:
        """Length of the links and the tool; 0 where the table holds none.

        Lengths along parallel axes that cancel are counted together.
        """
        return apparent_length(self.table, self.tool)[0]

    @property
    def nominal(self) -> Array:
        """(p,) table, gears, compliance, base, tool, the sensor's own, harmonics."""
        tool = np.append(self.tool[:3, 3], np.zeros(3))[self._tool]
        base = np.append(self.base[:3, 3], np.zeros(3))
        driven = np.append(np.ones(len(self.gears)), self.yields)
        own, waves = self.sensor.nominal, self.waves.ravel()
        return np.concatenate([self.table.ravel(), driven, base, tool, own, waves])

    def rotation_vectors(self, commands: ArrayLike, rotations: ArrayLike) -> Array:
        """Measured rotations (N, 3, 3) at commands (N, n) as turns from nominal (N, 3).

        In degrees and the measuring frame, as outputs of ``Pose`` are.
        """
        commands = as_commands(self, commands)
        rotations = array_of("rotations", rotations, len(commands), 3, 3)
        nominal = self._nominal_rotations(commands)
        turn = rotations @ np.matrix_transpose(nominal)
        return np.asarray(Rotation.from_matrix(turn).as_rotvec(degrees=True))

    def rotations(self, commands: ArrayLike, vectors: ArrayLike) -> Array:
        """Rotation matrices (N, 3, 3) of turns from nominal (N, 3) in degrees."""
        commands = as_commands(self, commands)
        turn = Rotation.from_rotvec(numbers("vectors", vectors), degrees=True)
        return np.asarray(turn.as_matrix() @ self._nominal_rotations(commands))

    def nominal_tips(self, commands: Array) -> Array:
        """(N, 3) the measured point of the nominal arm."""
        return np.ascontiguousarray(self._chain(commands, self.nominal)[0][3].T)

    def _nominal_rotations(self, commands: Array) -> Array:
        """(N, 3, 3) from the tool to the measuring frame."""
        frame = self._chain(commands, self.nominal)[0]
        return np.ascontiguousarray(frame[:3].transpose(2, 1, 0))

    @functools.cached_property
    def _tool(self) -> list[int]:
        """Which of the tool's shifts and turns are parameters."""
        return ["x y z rx ry rz".split().index(axis) for axis in self.sensor.tool]

    @functools.cached_property
    def _order(self) -> NDArray[np.intp]:
        """Columns of the table in the order of the steps of a row."""
        return np.argsort(_ORDER[self.convention])

    @functools.cached_property
    def _steps(self) -> tuple[NDArray[np.intp], Array]:
        """(S,) kinds of the steps of the chain, and constant rotations (2, 3, 3)."""
        rows = [*np.array(_ROW)[self._order]] * len(self.joints)
        kinds = np.array([*_BASE, *rows, *_TOOL], dtype=np.intp)
        return kinds, np.stack([self.base[:3, :3], self.tool[:3, :3]])

    @functools.cached_property
    def _steps_of_joints(self) -> NDArray[np.intp]:
        """(n,) the step that moves each joint."""
        order = _ORDER[self.convention]
        moved = [order[3 if kind == "R" else 2] for kind in self.joints]
        return len(_BASE) + len(_ROW) * np.arange(len(self.joints)) + moved

    @functools.cached_property
    def _steps_of_parameters(self) -> NDArray[np.intp]:
        """The step that each parameter moves; the sensor's own move none."""
        moved = self._steps_of_joints
        *rows, tool = len(_BASE) + len(_ROW) * np.arange(len(self.joints) + 1)
        parts = (
            np.add.outer(rows, _ORDER[self.convention]).ravel(),
            moved[[i - 1 for i in (*self.gears, *self.compliance)]],
            np.arange(6),
            tool + np.array([0, 1, 2, 4, 5, 6])[self._tool],
            np.repeat(moved[[i - 1 for i in self.harmonics]], 4),
        )
        return np.concatenate(parts)

    def _split(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Base (6,), tool (6,) and the sensor's own (s,)."""
        end = len(parameters) - self.waves.size
        last = end - len(self.sensor.names)
        first = last - len(self._tool)
        tool = np.concatenate([self.tool[:3, 3], np.zeros(3)])
        tool[self._tool] = parameters[first:last]
        return parameters[first - 6 : first], tool, parameters[last:end]

    def _drives(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Gear ratios (n,) of all joints, compliance (C,) and waves (H, 4)."""
        first = 5 * len(self.joints)
        last = first + len(self.gears)
        ratios = np.ones(len(self.joints))
        ratios[[i - 1 for i in self.gears]] = parameters[first:last]
        waves = parameters[len(parameters) - self.waves.size :].reshape(-1, 4)
        return ratios, parameters[last : last + len(self.compliance)], waves

    def _swing(self, commands: Array, parameters: Array) -> tuple[Array, Array]:
        """(H, 4, N) sin, cos of the joints and of twice them; (n, N) how far each joint
        goes for one degree behind its gear."""
        goes = np.ones((len(self.joints), len(commands)))
        if not self.harmonics:
            return np.zeros((0, 4, len(commands))), goes
        ratios, _, waves = self._drives(parameters)
        at = [i - 1 for i in self.harmonics]
        turns = np.radians((ratios * self._moves(commands)).T[at])
        angles = turns[:, None] * np.array([[1.0], [2.0]])
        sine, cosine = np.sin(angles), np.cos(angles)
        rate = np.radians([[[1.0]], [[2.0]]])
        shape = (len(at), 4, len(commands))
        by_waves = np.stack([sine, cosine], axis=2).reshape(shape)
        rates = (rate * np.stack([cosine, -sine], axis=2)).reshape(shape)
        goes[at] += np.einsum("hk,hkn->hn", waves, rates)
        return by_waves, goes

    def _moves(self, commands: Array) -> Array:
        """(N, n) how far each joint moves, before its gear."""
        return commands[:, : self.num_joints] @ self.drive.T + self.offset

    def _kept(
        self, name: str, key: tuple[Array, ...], find: Callable[[], tuple[Array, ...]]
    ) -> tuple[Array, ...]:
        """What ``find`` gives; the last answer, which a fit asks for again, is kept."""
        numbers = [array.tobytes() for array in key]
        kept = self.__dict__.get(name)
        if kept is None or kept[0] != numbers:
            kept = numbers, find()
            if len(key[0]) < _MANY:
                self.__dict__[name] = kept
        arrays: tuple[Array, ...] = kept[1]
        return arrays

    def _chain(self, commands: Array, parameters: Array) -> tuple[Array, ...]:
        """The tool's frame (4, 3, N), axis and origin (S, 3, N) of each step."""
        return self._kept(
            "_last_chain",
            (commands, parameters),
            lambda: self._frames(commands, parameters)[:3],
        )

    def _frames(
        self, commands: Array, parameters: Array, links: Sequence[int] = ()
    ) -> tuple[Array, Array, Array, Array]:
        """What ``_chain`` has, and the frames (L, 4, 3, N) at the ends of ``links``."""
        n = len(self.joints)
        gears, compliance, waves = self._drives(parameters)
        moves = gears[:, None] * self._moves(commands).T
        if compliance.any():
            at = [i - 1 for i in self.compliance]
            moves[at] += compliance[:, None] * self._torque(commands)
        if waves.any():
            at = [i - 1 for i in self.harmonics]
            moves[at] += np.einsum(
                "hk,hkn->hn", waves, self._swing(commands, parameters)[0]
            )
        base, tool, _ = self._split(parameters)
        rows = parameters[: 5 * n].reshape(n, 5)[:, self._order]
        one = np.concatenate([base, [0.0], rows.ravel(), tool[:3], [0.0], tool[3:]])
        values = np.repeat(one[:, None], len(commands), axis=1)
        values[self._steps_of_joints] += moves
        kinds, fixed = self._steps
        ends = [*(len(_BASE) + len(_ROW) * link for link in links), len(kinds)]
        frames, axes, origins = forward(kinds, values, fixed, np.array(ends, np.intp))
        return frames[-1], axes, origins, frames[:-1]

    def nominal_tip(self, commands: Array) -> Tip:
        """What sensors read of the nominal arm."""
        return self._tip_at(commands, self._chain(commands, self.nominal)[0])

    def _tip_at(self, commands: Array, frame: Array) -> Tip:
        return Tip(frame, lambda: self._nominal_rotations(commands), self.length)

    def _reading(self, commands: Array, parameters: Array) -> Reading:
        """Readings of the sensor, and their derivatives by the tip."""

        def find() -> Reading:
            tip = self._tip_at(commands, self._chain(commands, parameters)[0])
            inputs = commands[:, self.num_joints :]
            return self.sensor.read(tip, inputs, self._split(parameters)[2])

        return Reading(*self._kept("_last_reading", (commands, parameters), find))

    def _motion(
        self, commands: Array, parameters: Array, at: NDArray[np.int64]
    ) -> tuple[Array, Array]:
        """Derivative (N, q, S) of the readings by the steps ``at`` (S,), and (N, q, s)
        by the sensor's own parameters."""
        reading = self._reading(commands, parameters)
        frame, axes, origins = self._chain(commands, parameters)
        motion = np.zeros((len(at), 6, len(commands)))  # shift and turn of the tip
        turns = self._steps[0][at] > 2
        about = np.radians(1.0) * axes[at[turns]]
        motion[turns, :3] = _cross(about, frame[3] - origins[at[turns]])
        motion[turns, 3:] = about
        motion[~turns, :3] = axes[at[~turns]]
        by_steps = np.ascontiguousarray(motion.transpose(2, 1, 0))
        return reading.by_tip @ by_steps, reading.by_own

    def log_size(self, commands: Array, parameters: Array) -> Array | None:
        """Logarithm of how far the joints move the tip (N,).

        Of contacts of turning joints, which touch as well with an arm of any size: the
        root of the sum of squares, of all postures, of how far the tip is from each
        axis. By turns it is held. The way of a slide that moves shows the size: None.
        """
        if not self._grows(commands):
            return None
        _, square = self._levers(commands, parameters)
        return 0.5 * np.log(square)

    def log_size_jacobian(self, commands: Array, parameters: Array) -> Array:
        if not self._grows(commands):
            return np.zeros((len(commands), len(parameters)))
        levers, square = self._levers(commands, parameters)
        axes = self._chain(commands, parameters)[1]
        # A shift moves the tip away from the axes before it.
        shifts, at, joints = self._shifts
        before = np.concatenate([np.zeros((1, *levers[0].shape)), levers.cumsum(0)])
        slopes = np.zeros(len(parameters))
        slopes[shifts] = np.einsum("skn,skn->s", before[joints], axes[at]) / square[0]
        return np.broadcast_to(slopes, (len(commands), len(slopes)))

    def _levers(self, commands: Array, parameters: Array) -> tuple[Array, ...]:
        """(n, 3, N) from the axis of each joint to the tip, (N,) all their squares."""

        def find() -> tuple[Array, Array]:
            frame, axes, origins = self._chain(commands, parameters)
            about = axes[self._steps_of_joints]
            levers = frame[3] - origins[self._steps_of_joints]
            levers -= about * np.einsum("jkn,jkn->jn", about, levers)[:, None]
            levers[~self._revolute] = 0.0
            return levers, np.full(len(commands), np.vdot(levers, levers))

        return self._kept("_last_levers", (commands, parameters), find)

    def _grows(self, commands: Array) -> bool:
        """Whether some of what it reads is zero, and grows with the arm."""
        if not any(one.zeros and one.lengths for one in self.sensor.members):
            return False
        slides = np.flatnonzero(self.drive[~self._revolute].any(axis=0))
        ways = np.ptp(commands[:, slides], axis=0) if slides.size else np.zeros(0)
        return bool((ways < _STILL * self.length).all())

    @functools.cached_property
    def _shifts(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Lengths of the chain among the parameters, their steps, joints before."""
        at = self._steps_of_parameters
        shifts = np.flatnonzero(self._steps[0][at] < 3)
        at = at[shifts]
        return shifts, at, (self._steps_of_joints < at[:, None]).sum(axis=1)

    @functools.cached_property
    def _revolute(self) -> NDArray[np.bool_]:
        """(n,)."""
        return np.array([kind == "R" for kind in self.joints])

    def _pulled(self, commands: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        """The nominal arm's axes (n, 3, N); of each load its force (3,), and how its
        point moves by each joint (n, 3, N)."""
        first = self.table.size + len(self.gears)
        stiff = self.nominal
        stiff[first : first + len(self.compliance)] = 0.0
        links = [link for link, _, _ in self.loads]
        _, axes, origins, ends = self._frames(commands, stiff, links)
        axes, origins = axes[self._steps_of_joints], origins[self._steps_of_joints]
        pulls = []
        for (link, weight, centre), end in zip(self.loads, ends, strict=True):
            point = end[3] + np.einsum("k,kcn->cn", centre, end[:3])
            motion = _cross(axes, point - origins)
            motion[~self._revolute] = axes[~self._revolute]
            motion[link:] = 0.0
            pulls.append((weight * np.array(self.gravity), motion))
        return axes, pulls

    def _torque(self, commands: Array) -> Array:
        """(C, N) torques of the loads on the compliant joints of the nominal arm."""

        def find() -> tuple[Array]:
            at = np.array(self.compliance) - 1
            torque = np.zeros((len(at), len(commands)))
            for force, motion in self._pulled(commands)[1]:
                torque += np.einsum("c,jcn->jn", force, motion[at])
            return (torque,)

        return self._kept("_last_torque", (commands,), find)[0]

    def _torque_slopes(self, commands: Array) -> Array:
        """(C, n, N) of the torques by the joints, per degree or unit of length.

        A torque is the work of the loads per radian, so its derivative is a second one
        of their positions: ``w_i x J_j``, i before j.
        """
        axes, pulls = self._pulled(commands)
        at, joints = np.array(self.compliance)[:, None] - 1, np.arange(len(axes))
        first, second = np.minimum(at, joints), np.maximum(at, joints)
        axes[~self._revolute] = 0.0
        rate = np.zeros((len(at), len(joints), len(commands)))
        for force, motion in pulls:
            bent = _cross(axes[first], motion[second])
            rate += np.einsum("c,ijcn->ijn", force, bent)
        rate[:, self._revolute] = np.radians(rate[:, self._revolute])
        return rate


def apparent_length(table: Array, tool: Array) -> tuple[float, int]:
    """Length of links (n, 5) and a tool, and which row's ``d``, from 1, cancels with
    others out of all proportion; 0 for none."""
    rest = np.linalg.norm(tool[:3, 3])
    plain = float(np.hypot(table[:, 0], table[:, 2]).sum() + rest)
    along, between = table[:, 2].copy(), np.radians(table[:, 1])
    for i in np.flatnonzero(np.abs(np.sin(between[:-1])) < _PARALLEL):
        along[i + 1] += np.sign(np.cos(between[i])) * along[i]
        along[i] = 0.0
    together = float(np.hypot(table[:, 0], along).sum() + rest)
    if plain <= _CANCELS * together:
        return plain, 0
    return together, 1 + int(np.abs(table[:, 2]).argmax())


def _cross(left: Array, right: Array) -> Array:
    """Cross products of (..., 3, N): over the axis before the last."""
    x, y, z = (left[..., k, :] for k in range(3))
    u, v, w = (right[..., k, :] for k in range(3))
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-2)
