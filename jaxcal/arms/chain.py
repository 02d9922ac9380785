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
from jaxcal.arms.sensors import Position, Sensor, Several
from jaxcal.arms.sensors.sensor import BASE
from jaxcal.arms.sensors.several import in_noise
from jaxcal.checks import Array, array_of, axis_names, numbers, one_of
from jaxcal.files import write_over
from jaxcal.models.model import ErrorGroups, Model, Quantity, as_commands, as_parameters
from jaxcal.models.recording import Recording
from jaxcal.models.uncertainty import Noise, Prior

_POSTURES = 500  # that show where an arm stands

COLUMNS = ("a", "alpha", "d", "theta", "beta")
# Standard deviations of the default prior. On a UR5 (links of 1.19 m in all): 1.8 mm,
# 0.3 degrees of the axes and 0.5 of a joint's zero, which is set by hand; 0.12 m and
# 1.7 degrees of the base and the tool.
_LENGTH, _TWIST, _ZERO = 1.5e-3, 0.3, 0.5  # share of the links' length; degrees
_GEAR, _SAG = 5e-3, 0.5  # ratio; degrees under the largest torque
_WAVES, _WAVE = ("sin", "cos", "sin2", "cos2"), 0.045  # of gears; degrees
_MOUNTING, _MOUNTING_ANGLE = 0.1, 1.7
# Of the arm's length: positions so far off are in another frame; so alike, of this arm.
_NEAR, _ALIKE = 0.2, 0.05
# How large the errors of a group are beside the prior's, beforehand: lengths, turns of
# the axes, zeros of the joints, compliance, harmonics. Most arms have little misfit and
# some have much.
_SIZES, _SIZES_SPREAD = (1.0, 1.0, 1.0, 1.0, 0.1), (6.0, 6.0, 6.0, 6.0, 10.0)
_BEYOND_TURNS = 20.0  # degrees: as radians, more turns than a joint makes
_BEYOND = 2.0  # degrees beyond a limit, or percent of a slide's stroke
# Farther away, or turned by more than 37 degrees (a cosine), no fit of poses finds it.
_AWAY, _ASIDE = 1.5, 0.8


@dataclasses.dataclass(frozen=True, eq=False)
class SerialChain(Arm, Model):
    """n joints; commands and angles in degrees, lengths as in the table.

    A row of the table is ``Rz(theta + u) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` in the
    standard convention and ``Tx(a) Rx(alpha) Ry(beta) Rz(theta + u) Tz(d)`` in the
    modified one (a and alpha of the link before the joint). beta is zero in a DH table;
    it is there because between parallel axes the other four cannot describe a small
    misalignment by small numbers (Hayati).

    Parameters, in this order: ``a1 alpha1 d1 theta1 beta1 a2 ...``; ``gear1 ...`` and
    ``compliance1 ...`` of those asked for; ``base x``, ``y``, ``z``, ``rx``, ``ry``,
    ``rz``; what the sensor sees of ``tool x``, ``y``, ``z``, ``rx``, ``ry``, ``rz``;
    the sensor's own; ``theta1 sin``, ``cos``, ``sin2``, ``cos2`` ... of the harmonics
    asked for, always last. The turns of base and tool are relative to their nominal
    rotation. Commands are the joints, then the columns that the sensor asks for.

    Made by ``from_dh`` and ``from_urdf``.
    """

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
            sensor: measures the tip; of ``jaxcal.models``, or its ``to_dict()``;
                Position() when not given.
            gears: joints, counted from 1, whose gear ratio is a parameter ("gear2"):
                the joint moves by the ratio, nominally 1, times its command.
            compliance: revolute joints, counted from 1, that yield under the loads
                ("compliance2"): degrees per unit of weight times length. By default all
                joints for contacts, else none.
            yields: (C,) the compliance of these joints, as far as it is known; 0 when
                not given.
            harmonics: revolute joints, counted from 1, with eccentric gears: they move
                by sin and cos of their angle, and of twice it, besides.
            waves: (H, 4) these in degrees, as far as they are known; 0 when not given.
            loads: (link, weight, centre in the frame of that row); by default a weight
                of one at the end of every link but the first, the last at the tool.
                The torques are those of the nominal arm.
            gravity: direction of weight in the measuring frame; times 9.81 where
                loads are masses.
            joint_names: what the columns of the commands are called.
            drive: (n, J) how far each joint moves with each of J columns, where they
                are not the same (a joint that mimics another).
            offset: (n,) where each joint is at commands of zero.
            limits: (J, 2) least and greatest command of each column.
            source: the URDF file that the arm comes from: its text, the base and tip
                links and the locked joints.
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
            turning = [i + 1 for i in range(n) if joints[i] == "R"]
            compliance = turning if sensor.compliant else ()
        bending = joint_numbers("compliance", compliance, joints, "R")
        bent = joint_numbers("harmonics", harmonics, joints, "R")
        if bending and not len(loads):
            loads = _usual_loads(n, end)
        per_torque = np.zeros(len(bending)) if yields is None else yields
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
            _waves(waves, len(bent)),
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

        Lengths are in metres as in the file, angles in degrees; the tip goes where the
        file puts it at every posture. A joint that mimics another moves with its
        leader's column; limits are read.

        Args:
            path: a URDF file; xacro files must be expanded first.
            base: link that the outputs are relative to, anywhere in the tree; the root
                by default.
            tip: link whose origin is the measured point, anywhere in the tree; the only
                last one by default.
            sensor: measures the tip; Position() when not given.
            locked: fixed joints by name, with their values: degrees, metres.
            limits: least and greatest command of joints, by name, instead of the
                file's.
            options: ``gears``, ``compliance``, ``loads``, ``gravity`` of
                ``from_dh``.
        """
        # scipy.spatial and the XML parser take half a second to load.
        from jaxcal.arms.files.urdf import read_urdf

        arm = read_urdf(path, tip, base, locked or {})
        for name, ends in (limits or {}).items():
            joint = one_of("limits", name, tuple(arm["joint_names"]))
            arm["limits"][arm["joint_names"].index(joint)] = ends
        return cls.from_dh(**arm, sensor=sensor, **options)

    @classmethod
    def from_ur_kinematics(
        cls,
        path: str | os.PathLike[str],
        *,
        sensor: Sensor | None = None,
        **options: Any,
    ) -> Self:
        """The arm of a kinematics file of Universal Robots' ROS description, in metres.

        That which ``calibration.to_ur_kinematics`` writes; the base is the robot's, the
        tip its flange.

        Args:
            path: the .yaml.
            sensor: measures the tip; Position() when not given.
            options: of ``from_dh`` beside the table: ``tool``, ``base``, ``limits``.
        """
        from jaxcal.arms.files.urdf import read_ur_kinematics

        return cls.from_dh(**(read_ur_kinematics(path) | options), sensor=sensor)

    def measured_with(self, sensor: Sensor) -> Self:
        """This arm with another sensor."""
        return dataclasses.replace(self, sensor=sensor)

    def with_member(self, i: int, sensor: Sensor) -> Self:
        """This arm with another sensor in the place of its member ``i``."""
        members = [*self.sensor.members]
        members[i] = sensor
        return self.measured_with(self.sensor.with_members(members))

    def with_misfit(self) -> Self:
        """This arm with harmonics of its joints.

        They are no parameters of the arm: ``identify``, and ``select`` for predictions,
        count on them where no prior is given, as what the parameters do not explain.
        """
        return self._bent

    def with_effects(
        self,
        *,
        compliance: Sequence[int] | None = None,
        gears: Sequence[int] | None = None,
        harmonics: Sequence[int] | None = None,
    ) -> Self:
        """This arm with these effects of joints, counted from 1, as of ``from_dh``."""
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

    def improved(self, fit: Any) -> Any:
        """With what held-out readings ask for, where the noise explains too little."""
        from jaxcal.arms.effects import chosen

        return chosen(fit)

    def unexplained(self, fit: Any, rows: Array) -> Array:
        """Scatter that no noise explains, more beyond the range that was measured."""
        from jaxcal.arms.effects import unexplained

        return unexplained(fit, rows)

    @functools.cached_property
    def _bent(self) -> Self:  # kept, and what it keeps with it
        if self.harmonics or "R" not in self.joints:
            return self
        return self.with_effects(harmonics=self._turning)

    @property
    def _turning(self) -> list[int]:
        """Joints that turn, counted from 1."""
        return [i + 1 for i, kind in enumerate(self.joints) if kind == "R"]

    @property
    def misfit_std(self) -> float:
        """What harmonics leave of the misfit, which a choice counts as noise."""
        return self.sensor.misfit * self.length

    @property
    def fits_misfit(self) -> bool:
        return not self.sensor.local

    def postures(
        self,
        count: int,
        *,
        seed: int = 0,
        near: ArrayLike | None = None,
        allowed: Callable[[NDArray[np.float64]], bool] | None = None,
        camera: ArrayLike | None = None,
        distance: Sequence[float] | None = None,
        tilt: float | None = None,
        side: str | None = None,
        floor: float | None = None,
        approach: ArrayLike | None = None,
        clear: Sequence[ArrayLike] = (),
        radius: float | None = None,
    ) -> Array:
        """Postures that can be measured, to choose from.

        Within the limits (180 degrees where a file has none), two degrees apart at
        least, with the ball in the socket, the probe on the plane or the board in view
        (without ``camera`` from either side): inverse kinematics from random starts, so
        a redundant arm's self-motions are among them.

        Args:
            count: how many.
            seed: of the random starts.
            near: rough places: (S, 3) sockets or (S, 4) planes if the sensor has no
                places; for a sensor that reads everywhere rows (x, y, z, radius), of
                which the tip must be near one; not for a board.
            allowed: function of joints (J,), False where they collide.
            camera: of a board, (width, height, fx, fy, cx, cy) in pixels, or a field of
                view in degrees (horizontal, vertical): every corner is in the picture,
                with a focal length that is known to a tenth.
            distance: least and greatest, of the board's middle from that camera; such
                that the board fills 25 to 80 % of the picture when not given.
            tilt: degrees that the board's face may be turned from the camera; 45 when
                not given.
            side: "+z", the printed side is where the board's z axis points, or "-z";
                known of a board that was found from views, else from either side.
            floor: lowest height (z in the measuring frame) of joints, and of sockets
                within 1 % of the arm's length.
            approach: direction (x, y, z) of the tool's approach, from the last joint to
                the tip, and the largest angle from it in degrees (60).
            clear: planes (normal, offset) whose other side, and boxes (least x, y, z,
                greatest), that the arm does not touch: spheres along straight lines
                between the joints, no shapes of the links. The first link and the tip
                are not looked at, nor is the arm against itself.
            radius: of the spheres that keep clear; 4 % of the arm's length when not
                given.

        Returns:
            (count, n) commands with the sensor's columns, in an order of little travel.

        Raises:
            ValueError: there are fewer, or a socket cannot be reached; the message
                counts the reasons.
        """
        where = self.reachable(
            near=near,
            allowed=allowed,
            camera=camera,
            distance=distance,
            tilt=tilt,
            side=side,
            floor=floor,
            approach=approach,
            clear=clear,
            radius=radius,
        )
        return np.asarray(where.drawn(count, seed))

    def reachable(self, **rules: Any) -> Any:
        """Where the arm can be measured: ``allowed`` of ``Design.refine``.

        Arguments as of ``postures``, from ``near`` on. Commands that a search tries are
        moved to where the sensor reads: the ball into its socket, the board as the
        camera sees it.
        """
        from jaxcal.arms.postures import ReachableSet

        return ReachableSet(self, **rules)

    def require_commands(self, commands: Array) -> None:
        """Refuse radians for degrees, and joints far beyond their limits."""
        low, high = self.limits.T
        units = np.array(self.command_units)
        joints = commands[:, : self.num_joints]
        for _, one, rows, _ in self.sensor.parts(commands[:, self.num_joints :]):
            largest = np.abs(joints[rows][:, units == "deg"]).max(initial=0.0)
            small = self.num_joints > 2 and 1.0 < largest < 7.0
            if small and not one.positions:  # readings tell of these
                raise ValueError(
                    f"commands must be in degrees, but no angle exceeds {largest:.3g}: "
                    "are they radians? Use np.degrees(commands), --radians"
                )
        largest = np.abs(joints[:, units == "deg"]).max(initial=0.0)
        twice = np.degrees(_BEYOND_TURNS)
        if largest > twice and self.num_joints > 2:
            raise ValueError(
                f"commands must be in degrees, but angles reach {largest:.6g}: were "
                "degrees converted as if they were radians? Leave out np.degrees, "
                "--radians"
            )
        slack = np.where(units == "deg", _BEYOND, 0.01 * _BEYOND * (high - low))
        far = np.argwhere((joints < low - slack) | (joints > high + slack))
        for row, joint in far[:1]:
            name, column = self.joint_names[joint], -joints[:, joint]
            least, most = (low - slack)[joint], (high + slack)[joint]
            around = np.where(-column > 180.0, -column - 360.0, -column)
            turning = units[joint] == "deg" and -column.min() >= 0.0
            if turning and ((around >= least) & (around <= most)).all():
                advice = f"{name} seems to be read in 0 to 360: subtract 360 from what "
                advice += "is above 180."
            elif ((column >= least) & (column <= most)).all():
                advice = f"{name} seems reversed: with the other sign all rows are "
                advice += "within the limits. Negate that column."
            elif len(column) > 1 and not np.ptp(column):
                advice = f"it is the same in all {len(column)} rows: was it recorded?"
            else:
                advice = "are the columns in this order: "
                advice += f"{', '.join(self.joint_names)}?"
            raise ValueError(
                f"row {row}: {name} = {joints[row, joint]:g} is outside its limits "
                f"({low[joint]:g} to {high[joint]:g}) by more than {slack[joint]:g}; "
                f"{advice} If the file's limits are wrong, give "
                f"limits={{name: (low, high)}}, --limits"
            )

    def prepared(self, commands: Array, measured: Array | None = None) -> Self:
        """This arm with its sensor where commands (and readings) put it.

        Raises:
            ValueError: readings in another unit, of another arm or place, radians for
                degrees, joints beyond their limits.
        """
        from jaxcal.arms.plausible import require_touched

        self.require_readings(commands, measured)
        arm = self.located(commands, measured)
        if measured is not None:
            tip, inputs = arm.nominal_tip(commands), commands[:, self.num_joints :]
            for part in arm.sensor.of_members(tip, inputs, measured):
                require_touched(part.sensor, part.columns)
        arm.require_places(commands, measured)
        return arm

    @property
    def sensed(self) -> slice:
        """What its sensor asks for: labels of what was touched, the pose of a board."""
        return slice(self.num_joints, self.num_inputs)

    def anew(self, commands: Array, measured: Array) -> Self:
        """This arm located again, what its sensor reads forgotten."""
        names = {field.name for field in dataclasses.fields(self.sensor)}
        places = {name: None for name in ("place", "places") if name in names}
        sensor = dataclasses.replace(self.sensor, **places)
        arm = dataclasses.replace(self, sensor=sensor)
        return arm.located(commands, None if not measured.any() else measured)

    def require_readings(self, commands: Array, measured: Array | None) -> None:
        """Refuse what no arm like this one takes or gives; None, candidates."""
        from jaxcal.arms.plausible import require_readings, warn_of_radians

        if measured is None:
            self.require_commands(commands)
            warn_of_radians(self, commands)
            return
        for part in self.of_each_sensor(commands, measured):
            require_readings(*part)
        self.require_commands(commands)

    def require_places(self, commands: Array, measured: Array | None) -> None:
        """Refuse contacts of other places; warn of views without the board."""
        from jaxcal.arms.plausible import require_sockets, warn_of_picture

        if measured is None:
            warn_of_picture(self, commands)
            return
        for part in self.of_each_sensor(commands, measured):
            require_sockets(*part)

    def distinct(self, commands: Array, measured: Array) -> NDArray[np.intp]:
        """(K,) the rows that count: contacts written twice count once."""
        kept = [np.zeros(0, dtype=np.intp)]
        for _, one, rows, _ in self.sensor.parts(commands[:, self.num_joints :]):
            if one.zeros and not measured[rows].any():
                rows = rows[np.unique(commands[rows], axis=0, return_index=True)[1]]
            kept.append(rows)
        return np.sort(np.concatenate(kept))

    def at_rest(
        self,
        path: str | os.PathLike[str],
        *,
        seconds: float = 0.5,
        within: float | None = None,
    ) -> Array:
        """Postures (N, J) at which a recorded arm stood still, in their order.

        Args:
            path: rosbag2 folder (SQLite or MCAP) with joint states, joints by name in
                any order. Needs the extra ``ros``.
            seconds: of rest, at least.
            within: degrees (or units of length) in which a resting joint stays. When
                not given 0.05, or eight times what the joint's readings jitter by.

        Raises:
            ValueError: the arm never stood still; it says how the joints jitter.
        """
        return self._rests(Recording(path, seconds=seconds, within=within))[0]

    def _rests(
        self, recording: Recording, kind: str = ""
    ) -> tuple[Array, Array | None]:
        from jaxcal.arms.files.recordings import rests_of

        turning = np.array(self.command_units) == "deg"
        return rests_of(recording, self.joint_names, turning, kind)

    def recorded(self, recording: Recording) -> tuple[Array, Array | None]:
        """Commands (N, n) and readings (N, q) of a recording, the mean of each rest.

        Readings are zeros of contacts and of poses of a board, which stand in the
        commands, and None of a sensor whose readings no message holds (corners'
        pixels), or of a LeRobot dataset.

        Raises:
            ValueError: the arm never stood still; ``which`` has not as many as there
                were rests; there are no readings.
        """
        sensor = self.sensor
        views = sensor.views and sensor.zeros
        if not views and tuple(sensor.inputs) not in ((), (sensor.kind,)):
            raise ValueError(
                f"commands of a {sensor.kind} need {', '.join(sensor.inputs)}, which "
                "no recording has; pass the postures of at_rest"
            )
        pixels = sensor.views and not views
        commands, read = self._rests(recording, "" if pixels else sensor.kind)
        if views:
            from scipy.spatial.transform import Rotation

            if read is None:
                raise ValueError(f"{recording.path} has no board poses")
            turns = Rotation.from_matrix(read[:, 3:].reshape(-1, 3, 3).swapaxes(1, 2))
            turns_deg = np.degrees(turns.as_rotvec())
            commands = np.column_stack([commands, read[:, :3], turns_deg])
        elif sensor.inputs:
            which = () if recording.which is None else recording.which
            if len(which) != len(commands):
                raise ValueError(
                    f"which must give the {sensor.kind} of each of the {len(commands)} "
                    f"rests, got {len(which)} numbers"
                )
            commands = np.column_stack([commands, numbers("which", which)])
        if sensor.zeros:
            return commands, np.zeros((len(commands), len(sensor.outputs)))
        if read is not None and self.relative:
            matrices = read[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)
            turned = self.rotation_vectors(commands, matrices)
            read = np.hstack([read[:, :3], turned])
        return commands, read

    def write_servos(
        self,
        path: str | os.PathLike[str],
        parameters: ArrayLike,
        servos: str | os.PathLike[str],
        names: Mapping[str, str],
        *,
        force: bool = False,
    ) -> dict[str, int]:
        """Write LeRobot's calibration file with the joints' zeros of ``parameters``.

        Of a turning joint's zero alone: what lengths and axes do is not in it.

        Args:
            path: the file to write.
            parameters: (p,).
            servos: the file that is corrected.
            names: motors whose names differ from the joints'.
            force: overwrite an existing file.

        Returns:
            Steps by which the middle of each motor's range moved.
        """
        from jaxcal.arms.files.servos import Servos

        theta = as_parameters(self, parameters)
        rows = (theta - self.nominal)[: self.table.size].reshape(self.table.shape)
        ahead = {}
        for column, (name, unit) in enumerate(
            zip(self.joint_names, self.command_units, strict=True)
        ):
            moved = np.flatnonzero(self.drive[:, column])
            if unit == "deg" and len(moved) == 1:
                zero = rows[moved[0], 3] / self.drive[moved[0], column]
                ahead[names.get(name, name)] = float(zero)
        old = Servos.load(servos)
        new = old.moved(ahead)
        new.save(path, force=force)
        return {name: round(new.middle(name) - old.middle(name)) for name in ahead}

    def in_turn(self, commands: ArrayLike) -> NDArray[np.int64]:
        """(N,) the commands' rows in an order of little travel, socket after socket."""
        from jaxcal.arms.postures import in_turn

        return in_turn(as_commands(self, commands), self.num_joints)

    def skeleton(self, commands: ArrayLike) -> Array:
        """(N, n + 2, 3) the base, each joint's origin and the tip, to be drawn."""
        commands = as_commands(self, commands)
        frame, _, origins = self._chain(commands, self.nominal)
        at = np.concatenate([[0], self._steps_of_joints])
        points = np.concatenate([origins[at], frame[None, 3]])
        return np.asarray(points.transpose(2, 0, 1))

    def calibrated(self, parameters: ArrayLike, sensor: Sensor | None = None) -> Self:
        """The arm whose nominal is this one with ``parameters``.

        Args:
            parameters: (p,) as ``identify`` found them.
            sensor: of the new arm; Position() when not given.
        """
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
        return dataclasses.replace(
            self,
            compliance=(),
            yields=np.zeros(0),
            harmonics=(),
            waves=np.zeros((0, 4)),
        )

    def standing_as(self, other: Any, parameters: Array, commands: Array) -> Array:
        """(p,) ``parameters``, the base where the tip is nearest to that of ``other``.

        Over all postures within the limits of the joints; where there are none, within
        a turn or the range of ``commands``.
        """
        from scipy.spatial.transform import Rotation

        joints = commands[:, : self.num_joints]
        turns = np.array(self.command_units)[:, None] == "deg"
        limits = np.where(turns, self.limits.clip(-180.0, 180.0), self.limits)
        ranges = np.column_stack([joints.min(axis=0), joints.max(axis=0)])
        low, high = np.where(np.isfinite(limits), limits, ranges).T
        rng = np.random.default_rng(0)
        postures = rng.uniform(low, high, (_POSTURES, len(low)))
        tips = self.calibrated(parameters).predict(postures)
        targets = np.asarray(other.predict(postures))
        turn, _ = Rotation.align_vectors(
            targets - targets.mean(axis=0), tips - tips.mean(axis=0)
        )
        at = [self.names.index(name) for name in BASE]
        base = pose_matrix(parameters[at])
        moved = parameters.copy()
        place = turn.apply(base[:3, 3] - tips.mean(axis=0)) + targets.mean(axis=0)
        turned = (turn * Rotation.from_matrix(base[:3, :3])).as_euler("XYZ", True)
        moved[at] = np.concatenate([place, turned])
        return moved

    def write(
        self,
        form: str,
        path: str | os.PathLike[str],
        parameters: ArrayLike,
        *,
        force: bool = False,
    ) -> str:
        """Write the arm with ``parameters`` as a file that robots read.

        Such files cannot hold compliance and gear harmonics: these are left out, with a
        warning.

        Args:
            form: "urdf" is the file that the arm came from, its origins corrected:
                meshes, comments and all else stay as they are, and the tip goes where
                ``predict`` of positions puts it, the base in the measuring frame
                included. "dh" is the table as CSV: joint, a, alpha, d, theta (with the
                joint's offset), beta, without base, tool and convention; joints that
                follow others are named in a warning. "ur" is the YAML file of Universal
                Robots' ROS description, for six joints, without base and tool.
            path: the file to write.
            parameters: (p,) as ``identify`` found them.
            force: overwrite an existing file.

        Returns:
            Of "urdf" the tip link, a new one where no fixed joint before it could hold
            the tool; else "".

        Raises:
            ValueError: the arm is not of the form, which of "ur" joints that follow
                others are not; a gear ratio was found, which none can hold.
            FileExistsError: there is a file and ``force`` is not given.
        """
        from jaxcal.arms.files.write import written

        ratios, yields, waves = self._drives(as_parameters(self, parameters))
        for i in np.flatnonzero(ratios != 1.0):
            raise ValueError(
                f"gear{i + 1} is {ratios[i]:.6g}, which this file format cannot hold"
            )
        lost = [f"compliance{self.compliance[i]}" for i in np.flatnonzero(yields)]
        bent = np.flatnonzero(waves.any(axis=1))
        lost += [f"harmonics of joint {self.harmonics[i]}" for i in bent]
        if lost:
            warnings.warn(
                f"{', '.join(lost)} left out: the file cannot hold compliance and gear "
                "harmonics",
                stacklevel=2,
            )
        text, tip = written(form, self, self.calibrated(parameters))
        write_over(path, text, force)
        return tip

    def together(
        self, *tables: tuple[ArrayLike, ArrayLike | None]
    ) -> tuple[Array, Array]:
        """Commands and readings of several sensors as the tables that a fit takes.

        Args:
            tables: for each sensor of ``Several`` a pair: commands (N, n) with the
                columns that it asks for, and what it measured (N, q), or None for
                zeros (contacts) and for candidates.

        Returns:
            Commands (N, n) and readings (N, q), each in units of its sensor's noise.
        """
        if not isinstance(self.sensor, Several):
            raise ValueError("together needs an arm with sensor=Several(...)")
        sensors, j = self.sensor.sensors, self.num_joints
        if len(tables) != len(sensors):
            raise ValueError(
                f"each of the {len(sensors)} sensors needs a pair (commands, "
                f"measured), got {len(tables)} pairs"
            )
        all_commands, all_measured = [], []
        for i, (one, (given, readings)) in enumerate(zip(sensors, tables, strict=True)):
            columns = [j + self.sensor.inputs.index(name) for name in one.inputs]
            columns = [*range(j), *columns]
            given = array_of(f"commands of {one.kind}", given, "N", len(columns))
            commands = np.zeros((len(given), self.num_inputs))
            commands[:, j], commands[:, columns] = i, given
            all_commands.append(commands)
            noise, q = one.stds(self.length), self.num_outputs
            all_measured.append(in_noise(one.kind, readings, len(given), noise, q))
        return np.vstack(all_commands), np.vstack(all_measured)

    def located(self, commands: ArrayLike, measured: ArrayLike | None = None) -> Self:
        """This arm with its sensor located by nominal postures and readings.

        Nothing is changed that was given: sockets, planes, anchors, boards and their
        cameras have no place of their own until the first readings. Of a tracker that
        is far from where it was said to be the base is found.

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
        kinds = []
        for name, column in zip(self.joint_names, self.drive.T, strict=True):
            # A column drives itself by one, its gear ratio apart.
            joint = int(np.abs(np.abs(column) - 1.0).argmin())
            kind = self.joints[joint]
            if column[joint] != 1.0 and self.source is not None:
                from jaxcal.arms.files.urdf import joints_of

                kind = joints_of(self.source["text"])[name].kind
            kinds.append("deg" if kind == "R" else "length")
        return tuple(kinds)

    def quantities(self, measured_unit: str) -> tuple[Quantity, ...]:
        """What its sensor reads, in its units."""
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
        units = (
            quantity.unit
            for one in self.sensor.members
            for quantity in self.quantities_of(one, measured_unit)
        )
        return tuple(dict.fromkeys(units))

    def own(self, i: int) -> slice:
        """Where what the sensor's member ``i`` has of its own is among the p."""
        at = self.sensor.own_of_members[i]
        before = len(self.names) - self.waves.size - len(self.sensor.names)
        return slice(before + at.start, before + at.stop)

    @property
    def num_parameters(self) -> int:
        """p."""
        return len(self.names)

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
            *(f"theta{i} {wave}" for i in self.harmonics for wave in _WAVES),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """p units: "length" (the table's), "deg", "ratio", "deg per torque", ..."""
        mounting = ["length"] * 3 + ["deg"] * 3
        return (
            *["length", "deg", "length", "deg", "deg"] * len(self.joints),
            *["ratio"] * len(self.gears),
            *["deg per torque"] * len(self.compliance),
            *mounting,
            *(mounting[i] for i in self._tool),
            *self.sensor.units,
            *["deg"] * self.waves.size,
        )

    def predict(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """Readings (N, q)."""
        commands = as_commands(self, commands)
        parameters = as_parameters(self, parameters)
        return self._reading(commands, parameters).values.copy()

    def jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """(N, q, p)."""
        commands = as_commands(self, commands)
        parameters = as_parameters(self, parameters)
        columns, by_sensor = self._motion(
            commands, parameters, self._steps_of_parameters
        )
        first = 5 * len(self.joints)
        last = first + len(self.gears)
        if self.harmonics:
            swing, goes = self._swing(commands, parameters)
        if self.gears:
            at = [i - 1 for i in self.gears]
            moves = self._moves(commands)[:, at]
            if self.harmonics:
                moves = moves * goes[at].T
            columns[..., first:last] *= moves[:, None]
        if self.compliance:
            torque = self._torque(commands).T
            columns[..., last : last + len(self.compliance)] *= torque[:, None]
        if not self.harmonics:
            return np.concatenate([columns, by_sensor], axis=-1)
        waves = swing.reshape(self.waves.size, -1).T[:, None]
        waves = waves * columns[..., -self.waves.size :]
        columns = columns[..., : -self.waves.size]
        return np.concatenate([columns, by_sensor, waves], axis=-1)

    def command_jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """(N, q, n), zero by the sensor's columns.

        Of a pose, with the orientation that it is compared with held.
        """
        commands = as_commands(self, commands)
        parameters = as_parameters(self, parameters)
        columns, _ = self._motion(commands, parameters, self._steps_of_joints)
        gears, compliance, _ = self._drives(parameters)
        result = columns * gears
        if self.harmonics:
            result *= self._swing(commands, parameters)[1].T[:, None]
        if self.compliance:
            at = [i - 1 for i in self.compliance]
            rate = compliance[:, None, None] * self._torque_slopes(commands)
            result += np.einsum("nqc,cjn->nqj", columns[..., at], rate)
        by_inputs = np.zeros((*result.shape[:2], len(self.sensor.inputs)))
        return np.concatenate([result @ self.drive, by_inputs], axis=-1)

    def wrapped(self, off: Array, commands: Array) -> Array:
        """(N, q) differences of readings, those of the sensor that wrap within half a
        period."""
        return self.sensor.wrapped(off, commands[:, self.num_joints :], self.length)

    def facts(self, parameters: ArrayLike | None = None) -> tuple[Array, Array]:
        """What is known besides the prior, as readings that need no posture.

        Returns:
            (F,) how far off it is and (F, p) its derivative, in standard deviations.
        """
        parameters = as_parameters(self, parameters)
        of_sensor = self._split(parameters)[2]
        off, rows = self.sensor.facts(of_sensor)
        after = np.zeros((len(off), self.waves.size))
        before = np.zeros(
            (len(off), len(parameters) - len(of_sensor) - self.waves.size)
        )
        return off, np.hstack([before, rows, after])

    def default_noise(self) -> Noise:
        """What ``select`` takes where no noise is given: the sensor's."""
        return Noise(std=self.sensor.stds(self.length or 1.0))

    def noise_with_play(self, play: ArrayLike) -> Noise:
        """The sensor's noise plus the backlash of the joints.

        Args:
            play: total width of the backlash in degrees (or units of length): one
                number or (J,); about 0.3 for hobby servos.

        Returns:
            Noise for ``identify`` and ``select``: a joint is off by its backlash over
            the square root of twelve.
        """
        width = np.broadcast_to(numbers("play", play), (self.num_joints,))
        if not (width >= 0.0).all():
            raise ValueError(f"play must not be negative, got {width.min():g}")
        by_inputs = np.zeros(len(self.sensor.inputs))
        spread = np.concatenate([width / np.sqrt(12.0), by_inputs])
        return dataclasses.replace(self.default_noise(), command_std=spread)

    def from_one_side(self, commands: ArrayLike, by: float) -> Array:
        """Joints (N, J) at which to start each move, so that all arrive from below.

        The backlash is then always on the same side: an error of the joint's zero, not
        of each reading.

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

        What the sensor cannot see is held; the scales of the groups are taken from the
        readings (``Prior.sized``).
        """
        length = self.length or np.inf  # axes of unknown stroke alone
        joint = [_LENGTH * length, _TWIST, _LENGTH * length, _ZERO, _TWIST]
        mounting = [_MOUNTING * length] * 3 + [_MOUNTING_ANGLE] * 3
        tool = [self.sensor.members[0].mounting * length] * 3 + [_MOUNTING_ANGLE] * 3
        torque = length * sum(abs(weight) for _, weight, _ in self.loads)
        return Prior(
            [
                *joint * len(self.joints),
                *[_GEAR] * len(self.gears),
                *[_SAG / torque if torque else np.inf] * len(self.compliance),
                *mounting,
                *(tool[i] for i in self._tool),
                *self.sensor.prior_std(length),
                *[_WAVE] * self.waves.size,
            ],
            fixed=self.sensor.unseen(self),
            by_data=True,
        )

    def parameter_sizes(self) -> Array:
        """(p,) of the default prior; where it says nothing the arm's length, a radian.

        Where things stand is no size: a board may lie at a height of rounding.
        """
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
        """The sensor's own parameters."""
        return self.sensor.names

    @property
    def slips(self) -> tuple[str, ...]:
        """The joints' zeros."""
        zeros = zip(self.joints, range(1, len(self.joints) + 1), strict=True)
        return tuple(f"{'theta' if kind == 'R' else 'd'}{i}" for kind, i in zeros)

    @property
    def relative(self) -> bool:
        """The turns of a pose are from the nominal orientation at the command."""
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

    def verdict(self, fit: Any) -> Any:
        """``jaxcal.arms.verdict.ArmVerdict`` of a calibration."""
        from jaxcal.arms.verdict import verdict

        return verdict(fit)

    def to_dict(self) -> dict[str, Any]:
        """What a file holds of the model."""
        fields = (field.name for field in dataclasses.fields(self))
        data = {name: getattr(self, name) for name in fields if name != "sensor"}
        for name, value in data.items():
            if isinstance(value, np.ndarray):
                data[name] = value.tolist()
        # JSON knows no infinity: null is a limit that is not known.
        ends = [
            [end if np.isfinite(end) else None for end in row] for row in self.limits
        ]
        sensor = self.sensor.to_dict()
        return {"kind": "serial_chain", **data, "limits": ends, "sensor": sensor}


def _far(points: Array, measured: Array, length: float) -> Array:
    """(4, 4) that takes nominal points (N, 3) to those measured, if those are far off.

    It stays one where the fit finds the base by itself, or no other explains them.
    """
    moved, off = np.eye(4), np.linalg.norm(measured - points, axis=1)
    if len(points) < 4 or np.median(off) < _NEAR * length:
        return moved
    from scipy.spatial.transform import Rotation

    middle, there = points.mean(axis=0), measured.mean(axis=0)
    turn = Rotation.align_vectors(measured - there, points - middle)[0].as_matrix()
    moved[:3, :3], moved[:3, 3] = turn, there - turn @ middle
    errors = np.linalg.norm(points @ turn.T + moved[:3, 3] - measured, axis=1)
    return moved if np.median(errors) < _ALIKE * length else np.eye(4)


def _numbered(columns: int) -> tuple[str, ...]:
    """Names of joints that have none."""
    return tuple(f"joint {i + 1}" for i in range(columns))


def _waves(waves: ArrayLike | None, count: int) -> Array:
    """(count, 4) degrees by sin and cos of the angle and of twice it; 0 for None."""
    if waves is None:
        return np.zeros((count, 4))
    swings = numbers("waves", waves)
    if swings.size != 4 * count:
        raise ValueError(f"waves must have shape ({count}, 4)")
    return swings.reshape(-1, 4)


def _usual_loads(n: int, tool: Array) -> tuple[Load, ...]:
    """A weight of one at the end of every link but the first, the last at the tool."""
    x, y, z = tool[:3, 3].tolist()
    return (*((i, 1.0, (0.0, 0.0, 0.0)) for i in range(2, n)), (n, 1.0, (x, y, z)))
