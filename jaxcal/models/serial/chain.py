"""A serial arm from its DH table: geometry, gears and joint compliance."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, one_of
from jaxcal.models.model import as_commands, as_parameters
from jaxcal.models.serial.arguments import (
    joint_numbers,
    load,
    require_degrees,
    transform,
    triple,
)
from jaxcal.models.serial.arm import Arm
from jaxcal.models.serial.kinematics import forward
from jaxcal.models.uncertainty import Noise, Prior

__all__ = ["SerialChain"]

Array = NDArray[np.float64]

_COLUMNS = ("a", "alpha", "d", "theta", "beta")
# Standard deviations of the default prior. On a UR5 (links of 1.19 m in all): 3 mm and
# 0.5 degrees a joint, 0.12 m and 1.7 degrees of the base and the tool.
_LENGTH, _ANGLE, _GEAR = 2.5e-3, 0.5, 5e-3  # share of the links' length; degrees; ratio
_MOUNTING, _MOUNTING_ANGLE = 0.1, 1.7
_NOISE = 1e-4  # of the links' length, radians: 0.12 mm on a UR5


@dataclasses.dataclass(frozen=True, eq=False)
class SerialChain(Arm):
    """n joints; commands and angles in degrees, lengths as in the table.

    A row of the table is ``Rz(theta + u) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` in the
    standard convention and ``Tx(a) Rx(alpha) Ry(beta) Rz(theta + u) Tz(d)`` in the
    modified one (a and alpha of the link before the joint). beta is zero in a DH table;
    it is there because between parallel axes the other four cannot describe a small
    misalignment by small numbers (Hayati).

    Parameters, in this order: ``a1 alpha1 d1 theta1 beta1 a2 ...``; ``gear1 ...`` and
    ``compliance1 ...`` of the joints asked for; ``base x``, ``y``, ``z``, ``rx``,
    ``ry``, ``rz``; ``tool x``, ``y``, ``z`` and, where the output is a pose, ``rx``,
    ``ry``, ``rz``. The turns of base and tool are relative to their nominal rotation.

    Made by :meth:`from_dh` and :meth:`from_urdf`.
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
        output: str = "position",
        gears: Sequence[int] = (),
        compliance: Sequence[int] = (),
        loads: Sequence[tuple[int, float, ArrayLike]] = (),
        gravity: Sequence[float] = (0.0, 0.0, -1.0),
        joint_names: Sequence[str] = (),
    ) -> Self:
        """The arm of a DH table.

        Args:
            table: (n, 4) rows (a, alpha, d, theta), angles in degrees, lengths in any
                one unit; (n, 5) with a nominal beta.
            convention: "standard" (Denavit and Hartenberg) or "modified" (Craig).
            joints: a letter a joint, R or P; all revolute when not given.
            base: where the arm stands in the measuring frame: (3,) or (4, 4).
            tool: the measured point in the last link's frame: (3,) or (4, 4).
            output: "position" of the tool's point, q = 3, or "pose", q = 6.
            gears: joints, counted from 1, whose gear ratio is a parameter ("gear2"):
                the joint moves by the ratio, nominally 1, times its command.
            compliance: revolute joints, counted from 1, that yield under the loads
                ("compliance2"): degrees per unit of weight times length.
            loads: (link, weight, centre in the frame of that row); by default a weight
                of one at the tool. The torques are those of the nominal arm.
            gravity: direction of weight in the measuring frame; times 9.81 where
                loads are masses.
            joint_names: what the joints are called, for the reader.
        """
        rows = numbers("table", table)
        if rows.ndim != 2 or rows.shape[1] not in (4, 5) or not len(rows):
            raise ValueError(
                "table must have shape (n, 4), rows (a, alpha, d, theta), or (n, 5) "
                f"with beta, got {rows.shape}"
            )
        n = len(rows)
        rows = np.column_stack([rows, np.zeros((n, 5 - rows.shape[1]))])
        require_degrees(rows)
        joints = "R" * n if joints is None else joints
        if len(joints) != n or set(joints) - set("RP"):
            raise ValueError(
                f"joints must be {n} letters R (revolute) or P (prismatic), "
                f"got {joints!r}"
            )
        if joint_names and len(joint_names) != n:
            raise ValueError(f"joint_names must hold {n} names, got {joint_names!r}")
        end = transform("tool", tool)
        for joint in (number := joint_numbers("compliance", compliance, n)):
            if joints[joint - 1] == "P":
                raise ValueError(
                    f"compliance must name revolute joints, joint {joint} is prismatic"
                )
        given = loads or ([(n, 1.0, end[:3, 3])] if number else [])
        return cls(
            rows,
            one_of("convention", convention, ("standard", "modified")),
            joints,
            transform("base", base),
            end,
            one_of("output", output, ("position", "pose")),
            joint_numbers("gears", gears, n),
            number,
            tuple(load(each, n) for each in given),
            triple("gravity", gravity),
            tuple(joint_names) or tuple(f"joint {i + 1}" for i in range(n)),
        )

    @classmethod
    def from_urdf(
        cls,
        path: str | os.PathLike[str],
        tip: str | None = None,
        base: str | None = None,
        **options: Any,
    ) -> Self:
        """The arm between two links of a URDF file, as a standard table with beta.

        Lengths are in metres as in the file, angles in degrees; the tip goes where the
        file puts it at every posture.

        Args:
            path: a URDF file; xacro files must be expanded first.
            tip: link whose origin is the measured point; the only last one by default.
            base: link that the outputs are relative to; the root by default.
            options: ``output``, ``gears``, ``compliance``, ``loads``, ``gravity`` of
                :meth:`from_dh`.
        """
        # scipy.spatial and the XML parser take half a second to load.
        from jaxcal.models.serial.urdf import read_urdf

        arm = read_urdf(path, tip, base)
        return cls.from_dh(
            arm.table,
            joints=arm.joints,
            base=arm.base,
            tool=arm.tool,
            joint_names=arm.names,
            **options,
        )

    @property
    def num_parameters(self) -> int:
        """p."""
        return len(self.names)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        n = self.num_inputs
        mounting = ("x", "y", "z", "rx", "ry", "rz")
        return (
            *(f"{column}{i + 1}" for i in range(n) for column in _COLUMNS),
            *(f"gear{i}" for i in self.gears),
            *(f"compliance{i}" for i in self.compliance),
            *(f"base {axis}" for axis in mounting),
            *(f"tool {axis}" for axis in mounting[: self.num_outputs]),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """p units: "length" (the table's), "deg", "ratio", "deg per torque"."""
        mounting = ["length"] * 3 + ["deg"] * 3
        return (
            *["length", "deg", "length", "deg", "deg"] * self.num_inputs,
            *["ratio"] * len(self.gears),
            *["deg per torque"] * len(self.compliance),
            *mounting,
            *mounting[: self.num_outputs],
        )

    def predict(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """Outputs (N, 3), or (N, 6) with the turn from nominal in degrees."""
        commands = as_commands(commands, self.num_inputs)
        parameters = as_parameters(self, parameters)
        frame = forward(len(commands), self._steps(commands, parameters))[0]
        return self._outputs(commands, frame)

    def jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """(N, q, p)."""
        commands = as_commands(commands, self.num_inputs)
        parameters = as_parameters(self, parameters)
        columns = self._motion(commands, parameters, self._steps_of_parameters)
        first = 5 * self.num_inputs
        last = first + len(self.gears)
        columns[..., first:last] *= commands[:, None, [i - 1 for i in self.gears]]
        if self.compliance:
            torque = self._torque(commands)[0].T
            columns[..., last : last + len(self.compliance)] *= torque[:, None]
        return columns

    def command_jacobian(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """(N, q, n); of a pose, with the orientation it is compared with held."""
        commands = as_commands(commands, self.num_inputs)
        parameters = as_parameters(self, parameters)
        columns = self._motion(commands, parameters, self._steps_of_joints)
        gears, compliance = self._drives(parameters)
        result = columns * gears
        if self.compliance:
            at = [i - 1 for i in self.compliance]
            rate = compliance[:, None, None] * self._torque(commands)[1]
            result += np.einsum("nqc,cjn->nqj", columns[..., at], rate)
        return result

    @functools.cached_property
    def length(self) -> float:
        """Of the links and the tool together; 0 where the table holds no length."""
        links = np.hypot(self.table[:, 0], self.table[:, 2]).sum()
        return float(links + np.linalg.norm(self.tool[:3, 3]))

    def default_noise(self) -> Noise:
        """What ``select`` takes where no noise is given, in the unit of the arm."""
        angle = np.degrees(_NOISE)
        std = [_NOISE * (self.length or 1.0)] * 3 + [angle] * 3
        return Noise(std=std[: self.num_outputs])

    def default_prior(self) -> Prior:
        """Loose knowledge of any arm, by the length of its links; see the constants."""
        length = self.length or np.inf  # axes of unknown stroke alone
        joint = [_LENGTH * length, _ANGLE, _LENGTH * length, _ANGLE, _ANGLE]
        mounting = [_MOUNTING * length] * 3 + [_MOUNTING_ANGLE] * 3
        torque = length * sum(abs(weight) for _, weight, _ in self.loads)
        return Prior(
            [
                *joint * self.num_inputs,
                *[_GEAR] * len(self.gears),
                *[_ANGLE / torque if torque else np.inf] * len(self.compliance),
                *mounting,
                *mounting[: self.num_outputs],
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """What a file holds of the model."""
        data = dataclasses.asdict(self)
        for name in ("table", "base", "tool"):
            data[name] = data[name].tolist()
        return {"kind": "serial_chain", **data}
