"""The kinematics of a serial arm, what its sensor reads, and their derivatives."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from jaxcal.arms.chain_kernel import forward, slopes
from jaxcal.arms.sensors import Reading, Sensor, Tip
from jaxcal.arms.sensors.sensor import BASE, Readings
from jaxcal.checks import Array, Indices, Mask, array_of, numbers
from jaxcal.models.model import Quantity, as_commands

_T = TypeVar("_T")
Load = tuple[int, float, tuple[float, float, float]]  # link from 1, weight, its centre

COLUMNS = ("a", "alpha", "d", "theta", "beta")
WAVES = ("sin", "cos", "sin2", "cos2")
# The steps of the base: three shifts, three turns, its nominal rotation; five of each
# row of the table; the tool's three shifts, nominal rotation, three turns. A step is
# 0, 1, 2, a shift along x, y, z, or 3, 4, 5, a turn about it, or 6 and on, a constant.
_BASE, _ROW, _TOOL = (0, 1, 2, 3, 4, 5, 6), (0, 3, 2, 5, 4), (0, 1, 2, 7, 3, 4, 5)
_STILL = 0.02  # of the arm's length: the way of a slide that shows no size
_PARALLEL, _CANCELS = 0.2, 3.0  # sine; times as long as what is left: lengths cancel
_SAME = 1e-9  # of lengths and degrees: one and the same link
_MANY = 20_000  # postures: what is found of so many is not kept
# Where a, alpha, d, theta and beta act among the five steps of a row.
_ORDER = {"standard": (2, 3, 1, 0, 4), "modified": (0, 1, 4, 3, 2)}


def _kept(find: Callable[..., _T]) -> Callable[..., _T]:
    """A method of arrays whose last answer, which a fit asks for again, is kept."""
    name = f"_last{find.__name__}"

    @functools.wraps(find)
    def answer(arm: Arm, *key: Array) -> _T:
        numbers = [array.tobytes() for array in key]
        last = arm.__dict__.get(name)
        if last is None or last[0] != numbers:
            last = numbers, find(arm, *key)
            if len(key[0]) < _MANY:
                arm.__dict__[name] = last
        result: _T = last[1]
        return result

    return answer


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

    @property
    def inputs(self) -> tuple[str, ...]:
        """n names of the columns of the commands; () where the joints have none."""
        if self.joint_names == numbered(self.num_joints):
            return ()
        return (*self.joint_names, *self.sensor.inputs)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        n = len(self.joints)
        return (
            *(f"{column}{i + 1}" for i in range(n) for column in COLUMNS),
            *(f"gear{i}" for i in self.gears),
            *(f"compliance{i}" for i in self.compliance),
            *BASE,
            *(f"tool {axis}" for axis in self.sensor.tool),
            *self.sensor.names,
            *(f"theta{i} {wave}" for i in self.harmonics for wave in WAVES),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """p units: "length" (the table's), "deg", "ratio", "deg per torque", ..."""
        row, mounting = ["length", "deg"] * 2 + ["deg"], ["length"] * 3 + ["deg"] * 3
        driven = ["ratio"] * len(self.gears) + ["deg per torque"] * len(self.compliance)
        tool, waves = [mounting[i] for i in self._tool], ["deg"] * self.waves.size
        table = row * len(self.joints)
        return (*table, *driven, *mounting, *tool, *self.sensor.units, *waves)

    def _quantities_of(
        self, sensor: Sensor, measured_unit: str
    ) -> tuple[Quantity, ...]:
        """What one of its sensors reads, "length" where the unit of that is unknown."""
        first, *others = sensor.quantities
        if not others and first.points == 1 and not self.sensor.joined:
            first = first._replace(unit=measured_unit or first.unit)
        length = self.length_unit(measured_unit) or "length"
        return tuple(
            quantity._replace(unit=quantity.unit.replace("length", length))
            for quantity in (first, *others)
        )

    def length_unit(self, measured_unit: str) -> str:
        """The unit of lengths: the readings' if they are some, a URDF file's, or ""."""
        of_file = "m" if self.source is not None else ""
        others = ("deg", "rad", "m/s", "g", "N", "p", "times")
        return of_file if measured_unit.startswith(others) else measured_unit or of_file

    def _own(self, i: int) -> slice:
        """Where what the sensor's member ``i`` has of its own is among the p."""
        at, before = self.sensor.own_of_members[i], self._at["sensor"].start
        return slice(before + at.start, before + at.stop)

    def readings(self, commands: Array, measured: Array | None) -> Iterator[Readings]:
        """What each of its sensors reads, from where the nominal arm has it."""
        inputs, tip = commands[:, self.num_joints :], self.nominal_tip(commands)
        kinds = [sensor.kind for sensor in self.sensor.members]
        for i, part in enumerate(self.sensor.of_members(tip, inputs, measured)):
            kind = part.sensor.kind
            kind = f"sensor {i}'s {kind}" if kinds.count(kind) > 1 else kind
            yield part._replace(member=i, kind=kind, own=self._own(i))

    def skeleton(self, commands: ArrayLike) -> Array:
        """(N, n + 2, 3) the base, each joint's origin and the tip, to be drawn."""
        commands = as_commands(self, commands)
        frame, _, origins = self._chain(commands, self.nominal)
        at = np.concatenate([[0], self._steps_of_joints])
        points = np.concatenate([origins[at], frame[None, 3]])
        return np.asarray(points.transpose(2, 0, 1))

    def rotation_vectors(self, commands: ArrayLike, rotations: ArrayLike) -> Array:
        """Measured rotations (N, 3, 3) at commands (N, n) as turns from nominal (N, 3).

        In degrees and the measuring frame, as outputs of ``Pose`` are.
        """
        commands = as_commands(self, commands)
        rotations = array_of("rotations", rotations, len(commands), 3, 3)
        nominal = self.nominal_tip(commands).rotation
        turn = rotations @ np.matrix_transpose(nominal)
        return np.asarray(Rotation.from_matrix(turn).as_rotvec(degrees=True))

    def rotations(self, commands: ArrayLike, vectors: ArrayLike) -> Array:
        """Rotation matrices (N, 3, 3) of turns from nominal (N, 3) in degrees."""
        commands = as_commands(self, commands)
        turn = Rotation.from_rotvec(numbers("vectors", vectors), degrees=True)
        return np.asarray(turn.as_matrix() @ self.nominal_tip(commands).rotation)

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

    @functools.cached_property
    def _at(self) -> dict[str, slice]:
        """Where parameters of each kind are among the p, in their order."""
        sizes = {
            "table": self.table.size,
            "gears": len(self.gears),
            "compliance": len(self.compliance),
            "base": 6,
            "tool": len(self._tool),
            "sensor": len(self.sensor.names),
            "harmonics": self.waves.size,
        }
        ends = np.cumsum([0, *sizes.values()]).tolist()
        return dict(zip(sizes, map(slice, ends, ends[1:]), strict=True))

    def _split(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Base (6,), tool (6,) and the sensor's own (s,)."""
        tool = np.concatenate([self.tool[:3, 3], np.zeros(3)])
        tool[self._tool] = parameters[self._at["tool"]]
        return parameters[self._at["base"]], tool, parameters[self._at["sensor"]]

    def _drives(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Gear ratios (n,) of all joints, compliance (C,) and waves (H, 4)."""
        ratios = np.ones(len(self.joints))
        ratios[[i - 1 for i in self.gears]] = parameters[self._at["gears"]]
        waves = parameters[self._at["harmonics"]].reshape(-1, 4)
        return ratios, parameters[self._at["compliance"]], waves

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

    def _driven_by(self, i: int) -> dict[str, float]:
        """The columns that move joint ``i``, from 0, and how far."""
        return {self.joint_names[k]: x for k, x in enumerate(self.drive[i]) if x}

    def _moves(self, commands: Array) -> Array:
        """(N, n) how far each joint moves, before its gear."""
        return commands[:, : self.num_joints] @ self.drive.T + self.offset

    @_kept
    def _chain(self, commands: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """The tool's frame (4, 3, N), axis and origin (S, 3, N) of each step."""
        return self._frames(commands, parameters)[:3]

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
        return self._tip_at(commands, self.nominal)

    def _tip_at(self, commands: Array, parameters: Array) -> Tip:
        frame = self._chain(commands, parameters)[0]
        return Tip(frame, lambda: self.nominal_tip(commands).rotation, self.length)

    @_kept
    def _reading(self, commands: Array, parameters: Array) -> Reading:
        """Readings of the sensor, and their derivatives by the tip."""
        tip, inputs = self._tip_at(commands, parameters), commands[:, self.num_joints :]
        return self.sensor.read(tip, inputs, self._split(parameters)[2])

    def _motion(
        self, commands: Array, parameters: Array, at: Indices
    ) -> tuple[Array, Array]:
        """Derivative (N, q, S) of the readings by the steps ``at`` (S,), and (N, q, s)
        by the sensor's own parameters."""
        reading = self._reading(commands, parameters)
        frame, axes, origins = self._chain(commands, parameters)
        steps = np.stack([at, self._steps[0][at] > 2], axis=1)
        by_steps = slopes(frame[3], axes, origins, steps, reading.by_tip)
        return by_steps, reading.by_own

    @_kept
    def _levers(self, commands: Array, parameters: Array) -> tuple[Array, Array]:
        """(n, 3, N) from the axis of each joint to the tip, (N,) all their squares."""
        frame, axes, origins = self._chain(commands, parameters)
        about = axes[self._steps_of_joints]
        levers = frame[3] - origins[self._steps_of_joints]
        levers -= about * np.einsum("jkn,jkn->jn", about, levers)[:, None]
        levers[~self._revolute] = 0.0
        return levers, np.full(len(commands), np.vdot(levers, levers))

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
    def _revolute(self) -> Mask:
        """(n,)."""
        return np.array([kind == "R" for kind in self.joints])

    def _pulled(self, commands: Array) -> tuple[Array, Array]:
        """(n, 3, N) the nominal arm's axes; how far each joint moves what hangs on it,
        times its weight."""
        stiff = self.nominal
        stiff[self._at["compliance"]] = 0.0
        links = [link for link, _, _ in self.loads]
        _, axes, origins, ends = self._frames(commands, stiff, links)
        axes, origins = axes[self._steps_of_joints], origins[self._steps_of_joints]
        moved = np.zeros_like(axes)
        for (link, weight, centre), end in zip(self.loads, ends, strict=True):
            point = end[3] + np.einsum("k,kcn->cn", centre, end[:3])
            motion = np.cross(axes[:link], point - origins[:link], axis=-2)
            slides = ~self._revolute[:link]
            motion[slides] = axes[:link][slides]
            moved[:link] += weight * motion
        return axes, moved

    @_kept
    def _torque(self, commands: Array) -> Array:
        """(C, N) torques of the loads on the compliant joints of the nominal arm."""
        moved = self._pulled(commands)[1][np.array(self.compliance) - 1]
        return np.asarray(np.einsum("c,jcn->jn", self.gravity, moved))

    def _torque_slopes(self, commands: Array) -> Array:
        """(C, n, N) of the torques by the joints, per degree or unit of length.

        A torque is the work of the loads per radian, so its derivative is a second one
        of their positions: ``w_i x J_j``, i before j, along gravity.
        """
        axes, moved = self._pulled(commands)
        at, joints = np.array(self.compliance)[:, None] - 1, np.arange(len(axes))
        first, second = np.minimum(at, joints), np.maximum(at, joints)
        axes[~self._revolute] = 0.0
        across = np.cross(np.array(self.gravity)[:, None], axes, axis=-2)
        rate = np.einsum("ijcn,ijcn->ijn", across[first], moved[second])
        rate[:, self._revolute] = np.radians(rate[:, self._revolute])
        return rate


def numbered(columns: int) -> tuple[str, ...]:
    """Names of joints that have none."""
    return tuple(f"joint {i + 1}" for i in range(columns))


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


def common(one: Arm, other: Arm) -> int:
    """Leading joints that two chains have in common, with the links before them."""
    stands = np.allclose(one.base, other.base, atol=_SAME)
    if not stands or one.convention != other.convention:
        return 0
    least = min(len(one.joints), len(other.joints))
    for i in range(least):
        link = i == 0 or np.allclose(one.table[i - 1], other.table[i - 1], atol=_SAME)
        moves = one._driven_by(i) == other._driven_by(i)
        if not (link and moves and one.joints[i] == other.joints[i]):
            return i
    return least
