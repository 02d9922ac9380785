"""A serial arm from its DH table: geometry, gears and joint compliance."""

from __future__ import annotations

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

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
from jaxcal.arms.arm import Arm, Load, apparent_length
from jaxcal.arms.files.urdf import joints_of, read_ur_kinematics, read_urdf
from jaxcal.arms.sensors import Position, Sensor, Several
from jaxcal.arms.sensors.sensor import BASE
from jaxcal.arms.sensors.several import OneTable, stacked
from jaxcal.checks import Array, array_of, axis_names, numbers, one_of
from jaxcal.late import late
from jaxcal.models.model import ErrorGroups, Model, Quantity, as_commands, as_parameters
from jaxcal.models.uncertainty import Noise, Prior

COLUMNS = ("a", "alpha", "d", "theta", "beta")
# Standard deviations of the default prior. On a UR5 (links of 1.19 m in all): 1.8 mm,
# 0.3 degrees of the axes and 0.5 of a joint's zero, which is set by hand; 0.12 m and
# 1.7 degrees of the base and the tool.
_LENGTH, _TWIST, _ZERO = 1.5e-3, 0.3, 0.5  # share of the links' length; degrees
_GEAR, _SAG = 5e-3, 0.5  # ratio; degrees under the largest torque
WAVES, _WAVE = ("sin", "cos", "sin2", "cos2"), 0.045  # of gears; degrees
_MOUNTING, _MOUNTING_ANGLE = 0.1, 1.7
# Of the arm's length: positions so far off are in another frame; so alike, of this arm.
_NEAR, _ALIKE = 0.2, 0.05
# How large the errors of a group are beside the prior's, beforehand: lengths, turns of
# the axes, zeros of the joints, compliance, harmonics. Most arms have little misfit and
# some have much.
_SIZES, _SIZES_SPREAD = (1.0, 1.0, 1.0, 1.0, 0.1), (6.0, 6.0, 6.0, 6.0, 10.0)
# Farther away, or turned by more than 37 degrees (a cosine), no fit of poses finds it.
_AWAY, _ASIDE = 1.5, 0.8


@dataclasses.dataclass(frozen=True, eq=False)
class SerialChain(Arm, Model):
    """n joints; commands and angles in degrees, lengths as in the table.

    A row of the table is ``Rz(theta + u) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` in the
    standard convention and ``Tx(a) Rx(alpha) Ry(beta) Rz(theta + u) Tz(d)`` in the
    modified one (a and alpha of the link before the joint). beta is zero in a DH table:
    between parallel axes the other four cannot describe a small misalignment by small
    numbers (Hayati).

    Parameters, in this order: ``a1 alpha1 d1 theta1 beta1 a2 ...``; ``gear1 ...`` and
    ``compliance1 ...`` of those asked for; ``base x`` to ``rz``; what the sensor sees
    of ``tool x`` to ``rz``; the sensor's own; ``theta1 sin``, ``cos``, ``sin2``,
    ``cos2`` ... of the harmonics asked for. The turns of base and tool are relative to
    their nominal rotation. Commands are the joints, then the columns that the sensor
    asks for.
    """

    # Of modules that know this one.
    prepared = late("jaxcal.arms.plausible:prepared")
    require_commands = late("jaxcal.arms.plausible:require_commands")
    postures = late("jaxcal.arms.postures:postures")
    reachable = late("jaxcal.arms.postures:reachable")
    in_turn = late("jaxcal.arms.postures:in_turn")
    improved = late("jaxcal.arms.effects:improved")
    unexplained = late("jaxcal.arms.effects:unexplained")
    verdict = late("jaxcal.arms.verdict:verdict")
    at_rest = late("jaxcal.arms.files.recordings:at_rest")
    recorded = late("jaxcal.arms.files.recordings:recorded")
    write = late("jaxcal.arms.files.write:write")
    standing_as = late("jaxcal.arms.files.write:standing_as")
    write_servos = late("jaxcal.arms.files.recordings:write_servos")

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
            gears: joints, from 1, whose gear ratio, nominally 1, is a parameter
                ("gear2").
            compliance: revolute joints, from 1, that yield under the loads
                ("compliance2"): degrees per unit of weight times length. By default all
                for contacts, else none.
            yields: (C,) nominal compliance of these joints.
            harmonics: revolute joints, from 1, with eccentric gears: they move by sin
                and cos of their angle, and of twice it, besides.
            waves: (H, 4) these in degrees, nominally.
            loads: (link, weight, centre in the frame of that row); by default a weight
                of one at the end of every link but the first, the last at the tool.
                The torques are those of the nominal arm.
            gravity: direction of weight in the measuring frame; times 9.81 where
                loads are masses.
            joint_names: of the columns of the commands.
            drive: (n, J) how far each joint moves with each of J columns, where they
                are not the same (a joint that mimics another).
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
            axis_names("joint_names", joint_names or _numbered(columns), "", columns),
            moves,
            at_zero,
            limits_of(limits, columns),
            None if source is None else dict(source),
        )

    @classmethod
    def from_urdf(
        cls,
        path: str | os.PathLike[str],
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
            sensor: measures the tip; Position() when not given.
            locked: fixed joints by name, with their values: degrees, metres.
            limits: least and greatest command of joints, by name, instead of the
                file's.
            options: ``gears``, ``compliance``, ``loads``, ``gravity`` of ``from_dh``.
        """
        arm = read_urdf(path, tip, base, locked or {})
        chain = cls.from_dh(**arm, sensor=sensor, **options)
        return chain._limited(limits or {})

    @classmethod
    def from_ur_kinematics(
        cls,
        path: str | os.PathLike[str],
        *,
        sensor: Sensor | None = None,
        **options: Any,
    ) -> Self:
        """The arm of a kinematics file of Universal Robots' ROS description, in metres.

        Args:
            path: the .yaml, as of ``calibration.to_ur_kinematics``; from the robot's
                base to its flange.
            sensor: measures the tip; Position() when not given.
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

    def with_member(self, i: int, sensor: Sensor) -> Self:
        """This arm with another sensor in the place of its member ``i``."""
        members = [*self.sensor.members]
        members[i] = sensor
        return self.measured_with(self.sensor.with_members(members))

    def with_misfit(self) -> Self:
        """This arm with harmonics of its joints: what the parameters do not explain."""
        return self._bent

    def with_effects(
        self,
        *,
        compliance: Sequence[int] | None = None,
        gears: Sequence[int] | None = None,
        harmonics: Sequence[int] | None = None,
    ) -> Self:
        """This arm with these effects of joints, from 1, as of ``from_dh``."""
        arm: dict[str, Any] = {}
        if compliance is not None and not self.compliance:
            arm["compliance"] = tuple(compliance)
            arm["yields"] = np.zeros(len(arm["compliance"]))
            arm["loads"] = self.loads or _usual_loads(len(self.joints), self.tool)
        if gears is not None:
            arm["gears"] = tuple(gears)
        if harmonics is not None and not self.harmonics:
            arm["harmonics"] = tuple(harmonics)
            arm["waves"] = np.zeros((len(arm["harmonics"]), 4))
        return dataclasses.replace(self, **arm)

    @functools.cached_property
    def _bent(self) -> Self:  # kept, and what it keeps with it
        if self.harmonics or "R" not in self.joints:
            return self
        return self.with_effects(harmonics=turning(self.joints))

    @property
    def misfit_std(self) -> float:
        """What harmonics leave of the misfit, which a choice counts as noise."""
        return self.sensor.misfit * self.length

    @property
    def fits_misfit(self) -> bool:
        return not self.sensor.local

    @property
    def sensed(self) -> slice:
        return slice(self.num_joints, self.num_inputs)

    def anew(self, commands: Array, measured: Array) -> Self:
        """This arm located again, what its sensor reads forgotten."""
        names = {field.name for field in dataclasses.fields(self.sensor)}
        places = {name: None for name in ("place", "places") if name in names}
        arm = self.measured_with(dataclasses.replace(self.sensor, **places))
        return arm.located(commands, measured if measured.any() else None)

    def distinct(self, commands: Array, measured: Array) -> NDArray[np.intp]:
        kept = [np.zeros(0, dtype=np.intp)]
        for _, one, rows, _ in self.sensor.parts(commands[:, self.num_joints :]):
            if one.zeros and not measured[rows].any():
                rows = rows[np.unique(commands[rows], axis=0, return_index=True)[1]]
            kept.append(rows)
        return np.sort(np.concatenate(kept))

    def skeleton(self, commands: ArrayLike) -> Array:
        """(N, n + 2, 3) the base, each joint's origin and the tip, to be drawn."""
        commands = as_commands(self, commands)
        frame, _, origins = self._chain(commands, self.nominal)
        at = np.concatenate([[0], self._steps_of_joints])
        points = np.concatenate([origins[at], frame[None, 3]])
        return np.asarray(points.transpose(2, 0, 1))

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
        arm = dataclasses.replace(self, compliance=(), yields=np.zeros(0))
        return dataclasses.replace(arm, harmonics=(), waves=np.zeros((0, 4)))

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
        for i, (one, (given, read)) in enumerate(zip(sensors, tables, strict=True)):
            at = [j + self.sensor.inputs.index(name) for name in one.inputs]
            noise = one.stds(self.length)
            named.append(OneTable(one.kind, i, [*range(j), *at], noise, given, read))
        return stacked(named, j, self.num_inputs, self.num_outputs)

    def located(self, commands: ArrayLike, measured: ArrayLike | None = None) -> Self:
        """This arm with its sensor located by nominal postures and readings.

        Sockets, planes, anchors, boards and cameras have no place, unless it was given,
        until the first readings. Of a tracker that is far from where it was said to be
        the base is found.

        Raises:
            ValueError: the readings fit no such arm, or that of a Pose in another base.
        """
        commands = as_commands(self, commands)
        read = None if measured is None else numbers("measured", measured)
        arm = self.standing_at(self.base_of(commands, read))
        inputs = commands[:, self.num_joints :]
        sensor, new = self.sensor.located(arm.nominal_tip(commands), inputs, read)
        if sensor is self.sensor and new is None:
            return arm
        tool = self.tool if new is None else self.tool @ new
        return dataclasses.replace(arm, sensor=sensor, tool=tool)

    def standing_at(self, base: Array) -> Self:
        """This arm with another base (4, 4); itself where that is its own."""
        return self if base is self.base else dataclasses.replace(self, base=base)

    def base_of(self, commands: Array, measured: Array | None) -> Array:
        """(4, 4) where its first tracker sees the arm if far off, else the base."""
        if measured is None:
            return self.base
        nominal = self.of_each_sensor(commands, self.predict(commands))
        for (one, _, predicted), (_, _, reached) in zip(
            nominal, self.of_each_sensor(commands, measured), strict=True
        ):
            if one.sensor.positions:
                moved = _far(predicted[:, :3], reached[:, :3], self.length)
                base = moved @ self.base
                if not one.sensor.relative:
                    return self.base if (moved == np.eye(4)).all() else base
                shift = np.linalg.norm((base - self.base)[:3, 3])
                turned = np.trace(moved[:3, :3]) < 1.0 + 2.0 * _ASIDE
                if turned or shift > _AWAY * self.length:
                    raise ValueError(
                        "base is missing: with Pose, turns are relative to the "
                        "nominal ones, so give base roughly. The positions fit "
                        f"base={base.round(7).tolist()}; then compute the turns with "
                        "its rotation_vectors"
                    )
                break
        return self.base

    def of_each_sensor(
        self, commands: Array, measured: Array
    ) -> Iterator[tuple[Self, Array, Array]]:
        """The arm with each sensor of ``Several`` that read, its commands, readings."""
        if not self.sensor.joined:
            yield self, commands, measured
            return
        joints, inputs = np.split(commands, [self.num_joints], axis=1)
        for _, one, rows, columns in self.sensor.parts(inputs):
            read = measured[rows, : len(one.outputs)] * one.stds(self.length)
            if len(rows):
                yield self.measured_with(one), np.hstack([joints[rows], columns]), read

    @property
    def inputs(self) -> tuple[str, ...]:
        """n names of the columns of the commands; () where the joints have none."""
        if self.joint_names == _numbered(self.num_joints):
            return ()
        return (*self.joint_names, *self.sensor.inputs)

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
        return self.quantities_of(self.sensor, measured_unit)

    def quantities_of(self, sensor: Sensor, measured_unit: str) -> tuple[Quantity, ...]:
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

    def accuracy_units(self, measured_unit: str) -> tuple[str, ...]:
        of_each = [self.quantities_of(s, measured_unit) for s in self.sensor.members]
        return tuple(
            dict.fromkeys(q.unit for quantities in of_each for q in quantities)
        )

    def own(self, i: int) -> slice:
        """Where what the sensor's member ``i`` has of its own is among the p."""
        at = self.sensor.own_of_members[i]
        before = len(self.names) - self.waves.size - len(self.sensor.names)
        return slice(before + at.start, before + at.stop)

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

    def predict(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        return self._reading(commands, theta).values.copy()

    def jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        columns, by_sensor = self._motion(commands, theta, self._steps_of_parameters)
        first = 5 * len(self.joints)
        last = first + len(self.gears)
        swing, goes = self._swing(commands, theta)
        if self.gears:
            at = [i - 1 for i in self.gears]
            moves = self._moves(commands)[:, at] * goes[at].T
            columns[..., first:last] *= moves[:, None]
        if self.compliance:
            torque = self._torque(commands).T
            columns[..., last : last + len(self.compliance)] *= torque[:, None]
        end = columns.shape[-1] - self.waves.size
        columns, waves = np.split(columns, [end], axis=-1)
        waves *= swing.reshape(self.waves.size, len(commands)).T[:, None]
        return np.concatenate([columns, by_sensor, waves], axis=-1)

    def command_jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
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

    def wrapped(self, off: Array, commands: Array) -> Array:
        return self.sensor.wrapped(off, commands[:, self.num_joints :], self.length)

    def facts(self, parameters: ArrayLike | None = None) -> tuple[Array, Array]:
        parameters = as_parameters(self, parameters)
        of_sensor = self._split(parameters)[2]
        off, rows = self.sensor.facts(of_sensor)
        last = len(parameters) - self.waves.size
        slopes = np.zeros((len(off), len(parameters)))
        slopes[:, last - len(of_sensor) : last] = rows
        return off, slopes

    def default_noise(self) -> Noise:
        return Noise(std=self.sensor.stds(self.length or 1.0))

    def noise_with_play(self, play: ArrayLike) -> Noise:
        """The sensor's noise plus the backlash of the joints, for ``identify`` and
        ``select``.

        Args:
            play: total width of the backlash in degrees (or units of length): one
                number or (J,); about 0.3 for hobby servos. A joint is off by it over
                the square root of 12.
        """
        width = np.broadcast_to(numbers("play", play), (self.num_joints,))
        if not (width >= 0.0).all():
            raise ValueError(f"play must not be negative, got {width.min():g}")
        by_inputs = np.zeros(len(self.sensor.inputs))
        spread = np.concatenate([width / np.sqrt(12.0), by_inputs])
        return dataclasses.replace(self.default_noise(), command_std=spread)

    def from_one_side(self, commands: ArrayLike, by: float) -> Array:
        """Joints (N, J) at which to start each move, so that all arrive from below.

        The backlash is then an error of the joint's zero, not of each reading.

        Args:
            commands: (N, n) postures.
            by: degrees (or units of length) below, more than the play; less where a
                joint's limit is nearer.
        """
        if not numbers("by", by) > 0.0:
            raise ValueError(f"by must be positive, got {by:g}")
        joints = as_commands(self, commands)[:, : self.num_joints]
        return np.maximum(joints - by, np.minimum(self.limits[:, 0], joints))

    def default_prior(self) -> Prior:
        """Loose knowledge of any arm, by the length of its links; see the constants.

        What the sensor cannot see is held; the groups' scales are taken from the
        readings.
        """
        length = self.length or np.inf  # axes of unknown stroke alone
        joint = [_LENGTH * length, _TWIST, _LENGTH * length, _ZERO, _TWIST]
        mounting = [_MOUNTING * length] * 3 + [_MOUNTING_ANGLE] * 3
        tool = [self.sensor.members[0].mounting * length] * 3 + [_MOUNTING_ANGLE] * 3
        torque = length * sum(abs(weight) for _, weight, _ in self.loads)
        std = [
            *joint * len(self.joints),
            *[_GEAR] * len(self.gears),
            *[_SAG / torque if torque else np.inf] * len(self.compliance),
            *mounting,
            *(tool[i] for i in self._tool),
            *self.sensor.prior_std(length),
            *[_WAVE] * self.waves.size,
        ]
        return Prior(std, fixed=self.sensor.unseen(self), by_data=True)

    def parameter_sizes(self) -> Array:
        """(p,) of the default prior; where it says nothing the arm's length, a radian:
        where things stand is no size."""
        sizes = super().parameter_sizes()
        unknown = self.default_prior().resolve(self).precisions == 0.0
        units = np.array(self.units)
        sizes[unknown & (units == "length")] = self.length or np.nan
        sizes[unknown & (units == "deg")] = np.degrees(1.0)
        return sizes

    def error_groups(self) -> ErrorGroups:
        """Lengths, turns of the axes, zeros of the joints, compliance, harmonics."""
        members = np.full(len(self.names), -1)
        members[: self.table.size].reshape(-1, 5)[:] = [0, 1, 0, 2, 1]
        members[np.flatnonzero(np.array(self.units) == "deg per torque")] = 3
        members[len(members) - self.waves.size :] = 4
        return ErrorGroups(members, np.array(_SIZES), np.array(_SIZES_SPREAD))

    @property
    def placed(self) -> tuple[str, ...]:
        return self.sensor.names

    @property
    def slips(self) -> tuple[str, ...]:
        """The joints' zeros."""
        zeros = enumerate(self.joints, 1)
        return tuple(f"{'theta' if kind == 'R' else 'd'}{i}" for i, kind in zeros)

    @property
    def relative(self) -> bool:
        return self.sensor.relative

    def targets(
        self, desired: Array, start: Array | None
    ) -> Callable[[Array, NDArray[np.intp]], Array]:
        """What to reach; of a pose its turns from the nominal orientation there."""
        if not self.relative:
            return super().targets(desired, start)
        if start is None:
            raise ValueError(
                "start is missing: for an arm's pose give joints, at whose nominal "
                "orientation desired is a turn, as in rotation_vectors(start, R)"
            )
        turned = self.rotations(start, desired[:, 3:])

        def goal(commands: Array, rows: NDArray[np.intp]) -> Array:
            turns = self.rotation_vectors(commands, turned[rows])
            return np.hstack([desired[rows, :3], turns])

        return goal

    def to_dict(self) -> dict[str, Any]:
        """What a file holds of the model."""
        fields = (field.name for field in dataclasses.fields(self))
        values = {name: getattr(self, name) for name in fields}
        data = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in values.items()
        }
        # JSON knows no infinity: null is a limit that is not known.
        ends = self.limits.astype(object)
        ends[np.isinf(self.limits)] = None
        rest = {"limits": ends.tolist(), "sensor": self.sensor.to_dict()}
        return {"kind": "serial_chain", **data, **rest}


def _far(points: Array, measured: Array, length: float) -> Array:
    """(4, 4) that takes nominal points (N, 3) to those measured, if those are far off
    and it explains them; else one."""
    moved, off = np.eye(4), np.linalg.norm(measured - points, axis=1)
    if len(points) < 4 or np.median(off) < _NEAR * length:
        return moved
    middle, there = points.mean(axis=0), measured.mean(axis=0)
    turn = Rotation.align_vectors(measured - there, points - middle)[0].as_matrix()
    moved[:3, :3], moved[:3, 3] = turn, there - turn @ middle
    errors = np.linalg.norm(points @ turn.T + moved[:3, 3] - measured, axis=1)
    return moved if np.median(errors) < _ALIKE * length else np.eye(4)


def turning(joints: str) -> list[int]:
    """Joints that turn, counted from 1."""
    return [i + 1 for i, kind in enumerate(joints) if kind == "R"]


def _numbered(columns: int) -> tuple[str, ...]:
    """Names of joints that have none."""
    return tuple(f"joint {i + 1}" for i in range(columns))


def _usual_loads(n: int, tool: Array) -> tuple[Load, ...]:
    """A weight of one at the end of every link but the first, the last at the tool."""
    x, y, z = tool[:3, 3].tolist()
    return (*((i, 1.0, (0.0, 0.0, 0.0)) for i in range(2, n)), (n, 1.0, (x, y, z)))
