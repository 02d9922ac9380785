"""A serial arm from its DH table: geometry, gears and joint compliance."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.arguments import (
    joint_kinds,
    joint_numbers,
    limits_of,
    load,
    pose_matrix,
    rows_of,
    sensor_of,
    transform,
)
from jaxcal.arms.arm import Arm, Load, apparent_length, numbered
from jaxcal.arms.files.urdf import joints_of, read_ur_kinematics, read_urdf
from jaxcal.arms.fitting import ArmFitting
from jaxcal.arms.sensors import Position, Sensor, Several
from jaxcal.arms.sensors.sensor import plain_fields
from jaxcal.arms.sensors.several import OneTable, stacked
from jaxcal.checks import Array, array_of, axis_names, numbers, one_of
from jaxcal.files import AnyPath
from jaxcal.late import late
from jaxcal.models.model import Model, Quantity, Theta, as_commands, as_parameters
from jaxcal.models.uncertainty import Noise


@dataclasses.dataclass(frozen=True, eq=False)
class SerialChain(Arm, Model):
    """n joints; commands and angles in degrees, lengths as in the table.

    A row of the table is ``Rz(theta + u) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` in the
    standard convention and ``Tx(a) Rx(alpha) Ry(beta) Rz(theta + u) Tz(d)`` in the
    modified one (a and alpha of the link before the joint). beta is zero in a DH table.

    Parameters, as docs/arms.md explains them, in this order: ``a1 alpha1 d1 theta1
    beta1 a2 ...``; gears and compliance; ``base x`` to ``rz``; what the sensor sees of
    ``tool x`` to ``rz``; the sensor's own; harmonics. The turns of base and tool are
    relative to their nominal rotation. Commands are the joints, then the columns that
    the sensor asks for.
    """

    # Of modules that know this one.
    located = late("jaxcal.arms.plausible:located")
    postures = late("jaxcal.arms.postures:postures")
    reachable = late("jaxcal.arms.postures:reachable")
    in_turn = late("jaxcal.arms.postures:in_turn")
    default_prior = late("jaxcal.arms.effects:default_prior")
    parameter_sizes = late("jaxcal.arms.effects:parameter_sizes")
    noise_with_play = late("jaxcal.arms.effects:noise_with_play")
    at_rest = late("jaxcal.arms.files.recordings:at_rest")
    recorded = late("jaxcal.arms.files.recordings:recorded")
    write = late("jaxcal.arms.files.write:write")

    fitting = functools.cached_property(ArmFitting)

    @classmethod
    def from_dh(
        cls,
        table: ArrayLike,
        convention: str = "standard",
        *,
        joints: str | None = None,
        base: ArrayLike | None = None,
        tool: ArrayLike | None = None,
        sensor: Sensor | Mapping[str, Any] | None = None,
        gears: Sequence[int] = (),
        compliance: Sequence[int] | None = None,
        yields: ArrayLike | None = None,
        harmonics: Sequence[int] = (),
        waves: ArrayLike | None = None,
        loads: Sequence[tuple[int, float, ArrayLike]] = (),
        gravity: Sequence[float] = (0.0, 0.0, -1.0),
        joint_names: Sequence[str] = (),
        drive: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        limits: ArrayLike | None = None,
        source: Mapping[str, Any] | None = None,
    ) -> Self:
        """The arm of a DH table.

        Args:
            table: (n, 4) rows (a, alpha, d, theta), angles in degrees, lengths in any
                one unit; (n, 5) with a nominal beta.
            convention: "standard" (Denavit and Hartenberg) or "modified" (Craig).
            joints: a letter a joint, R or P; all revolute when not given.
            base: where the arm stands in the measuring frame: (3,) or (4, 4).
            tool: the measured point in the last link's frame: (3,) or (4, 4).
            sensor: measures the tip, or its ``to_dict()``; Position() when not given.
            gears: joints, from 1, whose gear ratio is a parameter ("gear2").
            compliance: revolute joints, from 1, that yield under the loads
                ("compliance2"): degrees per unit of weight times length. By default all
                for contacts, else none.
            yields: (C,) nominal compliance of these joints.
            harmonics: revolute joints, from 1, with eccentric gears; nominally (H, 4)
                ``waves`` in degrees, by sin and cos of their angle, and of twice it.
            loads: (link, weight, centre in the frame of that row); by default a weight
                of one at the end of every link but the first, the last at the tool.
            gravity: direction of weight in the measuring frame; times 9.81 where
                loads are masses.
            joint_names: of the columns of the commands.
            drive: (n, J) how far each joint moves with each of J columns.
            offset: (n,) where each joint is at commands of zero.
            limits: (J, 2) least and greatest command of each column.
            source: the URDF file that the arm comes from: text, base, tip, locked.
        """
        rows = rows_of(table)
        n = len(rows)
        joints = joint_kinds(joints, n)
        moves = np.eye(n) if drive is None else array_of("drive", drive, n, "J")
        columns = moves.shape[1]
        at_zero = np.zeros(n) if offset is None else array_of("offset", offset, n)
        sensor = sensor_of(sensor)
        end = transform("tool", tool)
        if cancels := apparent_length(rows, end)[1]:
            warnings.warn(
                f"d{cancels} = {rows[cancels - 1, 2]:g} cancels with another length, "
                "as in Universal Robots' own calibration of nearly parallel axes; "
                "their sum counts. To read the errors of single lengths, use a plain "
                "table or from_ur_kinematics(file) of their ROS description",
                stacklevel=2,
            )
        if compliance is None:
            compliance = turning(joints) if sensor.compliant else ()
        bending = joint_numbers("compliance", compliance, joints, "R")
        bent = joint_numbers("harmonics", harmonics, joints, "R")
        if bending and not len(loads):
            loads = _usual_loads(n, end)
        per_torque = np.zeros(len(bending)) if yields is None else yields
        swings = np.zeros((len(bent), 4)) if waves is None else numbers("waves", waves)
        if swings.size != 4 * len(bent):
            raise ValueError(
                f"waves must have shape ({len(bent)}, 4), got {swings.shape}"
            )
        return cls(
            rows,
            one_of("convention", convention, ("standard", "modified")),
            joints,
            transform("base", base),
            end,
            sensor,
            joint_numbers("gears", gears, joints),
            bending,
            array_of("yields", per_torque, len(bending)),
            bent,
            array_of("waves", swings.reshape(-1, 4), len(bent), 4),
            tuple(load(one, n) for one in loads),
            tuple(array_of("gravity", gravity, 3).tolist()),
            axis_names("joint_names", joint_names or numbered(columns), "", columns),
            moves,
            at_zero,
            limits_of(limits, columns),
            None if source is None else dict(source),
        )

    @classmethod
    def from_urdf(
        cls,
        path: AnyPath,
        *,
        base: str | None = None,
        tip: str | None = None,
        sensor: Sensor | None = None,
        locked: Mapping[str, float] | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
        **options: Any,
    ) -> Self:
        """The arm between two links of a URDF file, as a standard table with beta.

        Lengths are in metres, angles in degrees; the tip goes where the file puts it at
        every posture. A joint that mimics another moves with its leader's column;
        limits are read.

        Args:
            path: a URDF file; xacro files must be expanded first.
            base: link that the outputs are relative to, anywhere in the tree; else the
                root.
            tip: link whose origin is the measured point; else the only last one.
            locked: fixed joints by name, with their values: degrees, metres.
            limits: of joints, by name, instead of the file's.
            options: ``gears``, ``compliance``, ``loads``, ``gravity`` of ``from_dh``.
        """
        arm = read_urdf(path, tip, base, locked or {})
        chain = cls.from_dh(**arm, sensor=sensor, **options)
        return chain._limited(limits or {})

    @classmethod
    def from_ur_kinematics(
        cls, path: AnyPath, *, sensor: Sensor | None = None, **options: Any
    ) -> Self:
        """The arm of a kinematics file of Universal Robots' ROS description, in metres.

        Args:
            path: the .yaml, as of ``calibration.to_ur_kinematics``; from the robot's
                base to its flange.
            options: of ``from_dh`` beside the table: ``tool``, ``base``, ``limits``.
        """
        return cls.from_dh(**(read_ur_kinematics(path) | options), sensor=sensor)

    def _limited(self, limits: Mapping[str, tuple[float, float]]) -> Self:
        """This arm with other limits of joints by name."""
        pairs = self.limits.copy()
        for name, ends in limits.items():
            joint = one_of("limits", name, self.joint_names)
            pairs[self.joint_names.index(joint)] = ends
        return dataclasses.replace(self, limits=limits_of(pairs, len(pairs)))

    def measured_with(self, sensor: Sensor) -> Self:
        """This arm with another sensor."""
        return dataclasses.replace(self, sensor=sensor)

    def _with_member(self, i: int, sensor: Sensor) -> Self:
        """This arm with another sensor in the place of its member ``i``."""
        return self.measured_with(self.sensor.with_member(i, sensor))

    def _with_effects(
        self,
        *,
        compliance: Sequence[int] = (),
        gears: Sequence[int] = (),
        harmonics: Sequence[int] = (),
    ) -> Self:
        """This arm with these effects of joints, from 1, beside those that it has."""
        new: dict[str, Any] = {"gears": tuple(gears)} if gears else {}
        if compliance and not self.compliance:
            stiff = np.zeros(len(compliance))
            new |= {"compliance": tuple(compliance), "yields": stiff}
            new["loads"] = self.loads or _usual_loads(len(self.joints), self.tool)
        if harmonics and not self.harmonics:
            waves = np.zeros((len(harmonics), 4))
            new |= {"harmonics": tuple(harmonics), "waves": waves}
        return dataclasses.replace(self, **new)

    @functools.cached_property  # kept, and what it keeps with it
    def _bent(self) -> Self:
        """This arm with harmonics of its joints: what the parameters do not explain."""
        if self.harmonics or "R" not in self.joints:
            return self
        return self._with_effects(harmonics=turning(self.joints))

    def calibrated(self, parameters: ArrayLike, sensor: Sensor | None = None) -> Self:
        """The arm whose nominal is this one with ``parameters`` (p,), with a
        ``sensor``, else Position()."""
        theta = as_parameters(self, parameters)
        ratios, compliance, waves = self._drives(theta)
        base, tool, _ = self._split(theta)
        turned = pose_matrix(base)
        turned[:3, :3] = turned[:3, :3] @ self.base[:3, :3]
        end = pose_matrix(tool)
        end[:3, :3] = self.tool[:3, :3] @ end[:3, :3]
        return dataclasses.replace(
            self,
            table=theta[: self.table.size].reshape(self.table.shape),
            base=turned,
            tool=end,
            drive=ratios[:, None] * self.drive,
            offset=ratios * self.offset,
            yields=np.array(compliance),
            waves=np.array(waves),
            sensor=sensor or Position(),
        )

    def writable(self) -> Self:
        """This arm with stiff joints and round gears, as files have them."""
        if not self.compliance and not self.harmonics:
            return self
        stiff: dict[str, Any] = {"compliance": (), "yields": np.zeros(0)}
        return dataclasses.replace(self, **stiff, harmonics=(), waves=np.zeros((0, 4)))

    def together(
        self, *tables: tuple[ArrayLike, ArrayLike | None]
    ) -> tuple[Array, Array]:
        """Commands (N, n) and readings (N, q) in noise of several sensors, for a fit.

        Args:
            tables: for each sensor of ``Several`` a pair: commands with the columns
                that it asks for, and what it measured, or None for zeros (contacts) and
                candidates.
        """
        if not isinstance(self.sensor, Several):
            raise ValueError("together needs an arm with sensor=Several(...)")
        sensors, j = self.sensor.sensors, self.num_joints
        if len(tables) != len(sensors):
            raise ValueError(
                f"each of the {len(sensors)} sensors needs a pair (commands, "
                f"measured), got {len(tables)} pairs"
            )
        named = []
        for i, (one, pair) in enumerate(zip(sensors, tables, strict=True)):
            at = [j + self.sensor.inputs.index(name) for name in one.inputs]
            noise = one.stds(self.length)
            named.append(OneTable(one.kind, i, [*range(j), *at], noise, *pair))
        return stacked(self, j, named)

    @functools.cached_property
    def command_units(self) -> tuple[str, ...]:
        """J units of the joints' columns, "deg" or "length"."""
        # A column drives itself by one, its gear ratio apart.
        at = np.abs(np.abs(self.drive) - 1.0).argmin(axis=0)
        kinds = [self.joints[joint] for joint in at]
        plain = self.drive[at, range(len(at))] == 1.0
        if self.source is not None and not plain.all():
            in_file = joints_of(self.source["text"])
            kinds = [in_file[name].kind for name in self.joint_names]
        return tuple("deg" if kind == "R" else "length" for kind in kinds)

    def quantities(self, measured_unit: str) -> tuple[Quantity, ...]:
        return self._quantities_of(self.sensor, measured_unit)

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        return self._reading(commands, theta).values.copy()

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        columns, by_sensor = self._motion(commands, theta, self._steps_of_parameters)
        at, own = self._at, self._at["sensor"].start
        parts = [columns[..., :own], by_sensor, columns[..., own:]]
        result = np.concatenate(parts, axis=-1) if by_sensor.shape[-1] else columns
        swing, goes = self._swing(commands, theta)
        if self.gears:
            joints = [i - 1 for i in self.gears]
            moves = self._moves(commands)[:, joints] * goes[joints].T
            result[..., at["gears"]] *= moves[:, None]
        if self.compliance:
            result[..., at["compliance"]] *= self._torque(commands).T[:, None]
        waves = swing.reshape(self.waves.size, len(commands)).T
        result[..., at["harmonics"]] *= waves[:, None]
        return result

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, n), zero by the sensor's columns; of a pose, with the orientation that
        it is compared with held."""
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        columns, _ = self._motion(commands, theta, self._steps_of_joints)
        gears, compliance, _ = self._drives(theta)
        result = columns * gears * self._swing(commands, theta)[1].T[:, None]
        if self.compliance:
            at = [i - 1 for i in self.compliance]
            rate = compliance[:, None, None] * self._torque_slopes(commands)
            result += np.einsum("nqc,cjn->nqj", columns[..., at], rate)
        by_inputs = np.zeros((*result.shape[:2], len(self.sensor.inputs)))
        return np.concatenate([result @ self.drive, by_inputs], axis=-1)

    def default_noise(self) -> Noise:
        return Noise(std=self.sensor.stds(self.length or 1.0))

    def to_dict(self) -> dict[str, Any]:
        """What a file holds of the model."""
        # JSON knows no infinity: null is a limit that is not known.
        ends = self.limits.astype(object)
        ends[np.isinf(self.limits)] = None
        rest = {"limits": ends.tolist(), "sensor": self.sensor.to_dict()}
        return {"kind": "serial_chain", **plain_fields(self), **rest}


def turning(joints: str) -> list[int]:
    """Joints that turn, counted from 1."""
    return [i + 1 for i, kind in enumerate(joints) if kind == "R"]


def _usual_loads(n: int, tool: Array) -> tuple[Load, ...]:
    """A weight of one at the end of every link but the first, the last at the tool."""
    x, y, z = tool[:3, 3].tolist()
    return (*((i, 1.0, (0.0, 0.0, 0.0)) for i in range(2, n)), (n, 1.0, (x, y, z)))
