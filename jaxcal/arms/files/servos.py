"""LeRobot's calibration file of a servo arm: its motors' zeros, in steps."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.checks import Array
from jaxcal.files import write_over
from jaxcal.models.model import as_parameters

_KEYS = ("id", "drive_mode", "homing_offset", "range_min", "range_max")


@dataclasses.dataclass(frozen=True)
class Servos:
    """Motors of an arm as LeRobot calibrates them (SO-100, SO-101, Koch, ...).

    A motor at ``position`` steps (its encoder less ``homing_offset``) is at ``(position
    - (range_min + range_max) / 2) 360 / (resolution - 1)`` degrees, or at -100 to 100
    of its range, reversed where ``drive_mode`` is 1, as in LeRobot's ``MotorsBus``.

    Attributes:
        motors: by name, ``id``, ``drive_mode``, ``homing_offset``, ``range_min`` and
            ``range_max``, whole numbers.
        resolution: steps in a turn, 4096 of Feetech's STS3215.
    """

    motors: Mapping[str, Mapping[str, int]]
    resolution: int = 4096

    def __post_init__(self) -> None:
        if not self.motors:
            raise ValueError("motors must hold at least one motor")
        for name, motor in self.motors.items():
            whole = isinstance(motor, Mapping) and all(
                isinstance(motor.get(key), int) for key in _KEYS
            )
            if not whole:
                raise ValueError(
                    f"motor {name} must have {', '.join(_KEYS)}, whole numbers, "
                    f"got {motor!r}"
                )
            if motor["range_min"] >= motor["range_max"]:
                raise ValueError(
                    f"range_min of motor {name} must be below range_max, got "
                    f"{motor['range_min']} and {motor['range_max']}"
                )

    @classmethod
    def load(cls, path: str | os.PathLike[str], resolution: int = 4096) -> Self:
        """Read the file that ``lerobot-calibrate`` wrote."""
        text = pathlib.Path(path).read_text(encoding="utf-8-sig")
        try:
            content = json.loads(text)
            if not isinstance(content, dict):
                raise ValueError("it must hold motors by name")
            return cls(content, resolution)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the file that LeRobot reads; over one that is there with ``force``."""
        content = {name: dict(motor) for name, motor in self.motors.items()}
        write_over(path, json.dumps(content, indent=4) + "\n", force)

    def degrees(self, names: Sequence[str], values: Array) -> Array:
        """(N, J) degrees of motors by name, of values (N, J) in -100 to 100, else a
        ValueError."""
        most = float(np.abs(values).max(initial=0.0))
        if most > 100.0 + 1e-3:
            raise ValueError(
                "with servos, values must be in -100 to 100 of each motor's range, got "
                f"{most:g}. If they are degrees, leave out servos=, or give "
                "--in-degrees"
            )
        spans = [self._motor(name) for name in names]
        half = [0.5 * (m["range_max"] - m["range_min"]) for m in spans]
        sign = [-1.0 if m["drive_mode"] else 1.0 for m in spans]
        steps = values / 100.0 * np.array(half) * np.array(sign)
        return np.asarray(steps * 360.0 / (self.resolution - 1))

    def middle(self, name: str) -> float:
        """Position of a motor's zero, in steps."""
        motor = self._motor(name)
        return 0.5 * (motor["range_min"] + motor["range_max"])

    def moved(self, by: Mapping[str, float]) -> Self:
        """These motors where joints are ``by`` degrees ahead of what they read.

        The middle of the range moves back by as many steps, and the range is narrowed
        to be even about it: no motor is sent where it was not before. All else stays.
        """
        motors: dict[str, Any] = {name: dict(m) for name, m in self.motors.items()}
        for name, degrees in by.items():
            motor = self._motor(name)
            low, high = motor["range_min"], motor["range_max"]
            ends = low + high - round(2.0 * degrees * (self.resolution - 1) / 360.0)
            least, most = max(low, ends - high), min(high, ends - low)
            if most - least < 0.5 * (high - low):
                raise ValueError(
                    f"zero of motor {name} must be near the middle of its range, got "
                    f"{degrees:.3g} degrees: calibrate the motor with LeRobot again"
                )
            motors[name] |= {"range_min": least, "range_max": most}
        return dataclasses.replace(self, motors=motors)

    def _motor(self, name: str) -> Mapping[str, int]:
        if name not in self.motors:
            raise ValueError(f"motors must hold {name}, got {', '.join(self.motors)}")
        return self.motors[name]


def write_servos(
    arm: Chain,
    path: str | os.PathLike[str],
    parameters: ArrayLike,
    servos: str | os.PathLike[str],
    names: Mapping[str, str],
    *,
    force: bool = False,
) -> dict[str, int]:
    """Write LeRobot's calibration file with the joints' zeros of ``parameters`` (p,).

    Of turning joints alone. ``servos`` is the file that is corrected, ``names`` are
    motors whose names differ from the joints'.

    Returns:
        Steps by which the middle of each motor's range moved.
    """
    theta = as_parameters(arm, parameters)
    rows = (theta - arm.nominal)[: arm.table.size].reshape(arm.table.shape)
    ahead = {}
    for k, (name, unit) in enumerate(
        zip(arm.joint_names, arm.command_units, strict=True)
    ):
        moved = np.flatnonzero(arm.drive[:, k])
        if unit == "deg" and len(moved) == 1:
            ahead[names.get(name, name)] = rows[moved[0], 3] / arm.drive[moved[0], k]
    old = Servos.load(servos)
    new = old.moved(ahead)
    new.save(path, force=force)
    return {name: round(new.middle(name) - old.middle(name)) for name in ahead}
