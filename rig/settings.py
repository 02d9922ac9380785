"""What a configuration holds, as frozen dataclasses; ``rig.config`` fills them."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
from typing import Any

import numpy as np

from rig.attitude import Array, euler_to_matrix
from rig.registers import RegisterMap
from rig.units import Scale

__all__ = [
    "AXIS_NAMES",
    "Axis",
    "BusSettings",
    "ImuSettings",
    "MotionSettings",
    "RigConfig",
    "SessionSettings",
    "SettleSettings",
]

AXIS_NAMES = ("pitch", "yaw", "roll")  # the order of every (3,) in this package


@dataclasses.dataclass(frozen=True)
class BusSettings:
    """One Modbus line for the three drives."""

    transport: str  # tcp, rtu_tcp, rtu
    host: str = ""
    port: int = 502
    device: str = ""  # serial port of an rtu bus
    baudrate: int = 115200
    parity: str = "N"
    stopbits: int = 1
    bytesize: int = 8
    timeout_s: float = 0.3  # for one reply
    read_retries: int = 2  # reads only; a motion write is sent once

    @property
    def where(self) -> str:
        """The bus in words."""
        if self.transport == "rtu":
            return f"{self.device} at {self.baudrate} baud"
        return f"{self.host}:{self.port} ({self.transport})"


@dataclasses.dataclass(frozen=True)
class Axis:
    """One joint and the drive that moves it."""

    name: str  # pitch, yaw, roll
    letter: str  # axis the joint turns about: X, Y, Z
    unit: int  # Modbus unit id
    map: RegisterMap
    scale: Scale
    min_deg: float
    max_deg: float
    min_pulses: int
    max_pulses: int
    speed_deg_s: float
    accel_deg_s2: float
    comm_timeout_s: float | None  # written to the drive when its map has a register

    def pulses_within(self, angle_deg: float) -> int:
        """A tolerance in degrees as whole pulses, at least one."""
        return max(1, round(angle_deg * abs(self.scale.pulses_per_deg)))


@dataclasses.dataclass(frozen=True)
class ImuSettings:
    """The phone's stream."""

    format: str  # hyperimu, lines, sensorlogger
    transport: str  # listen, connect
    host: str
    port: int
    columns: tuple[int, int, int]  # of the angles, in the sequence of order
    quaternion: tuple[int, int, int, int] | None  # columns of x, y, z, w instead
    stamp_column: int | None  # column of the phone's clock in ms
    column_count: int | None  # None: as many as the first good line has
    separator: str
    angle_unit: str  # deg, rad
    order: str  # sequence of the phone's Euler angles
    signs: tuple[int, int, int]  # in the sequence of order
    mounting_deg: tuple[float, float, float]  # Z, Y, X of the phone on the end-effector
    stale_s: float
    max_jump_deg: float

    @property
    def mounting(self) -> Array:
        """(3, 3) R_EP."""
        return euler_to_matrix(self.mounting_deg, "ZYX")


@dataclasses.dataclass(frozen=True)
class SettleSettings:
    """When a posture counts as settled, and how long it is measured."""

    window_s: float
    min_samples: int
    std_deg: float
    slope_deg_s: float
    timeout_s: float
    samples: int  # readings averaged for one measurement


@dataclasses.dataclass(frozen=True)
class MotionSettings:
    """How the device is moved."""

    max_step_deg: float
    approach_overshoot_deg: float
    position_tolerance_deg: float
    poll_s: float
    deadline_factor: float
    deadline_slack_s: float
    stall_s: float
    following_deg: float
    envelope_margin_deg: float
    max_disagreement_deg: float
    heartbeat_s: float
    mirror_limits: bool


@dataclasses.dataclass(frozen=True)
class SessionSettings:
    """What a calibration session does."""

    candidates: int  # M
    k: int  # K
    method: str
    min_efficiency: float  # D-efficiency under which exact takes the policy's place
    seed: int
    ranges: tuple[tuple[float, float], ...]  # degrees, pitch, yaw, roll
    verify_postures: int
    verify_limit_deg: float  # error after compensation above which to recalibrate
    reference_tolerance_deg: float
    max_unreachable: int
    zero: str  # here, drive


@dataclasses.dataclass(frozen=True)
class RigConfig:
    """A whole, valid configuration."""

    bus: BusSettings
    axes: tuple[Axis, Axis, Axis]
    imu: ImuSettings
    mechanism_order: str
    settle: SettleSettings
    motion: MotionSettings
    session: SessionSettings
    output: pathlib.Path
    text: str  # the TOML it came from

    @property
    def letters(self) -> tuple[str, str, str]:
        """Axis letters of pitch, yaw and roll."""
        a, b, c = self.axes
        return a.letter, b.letter, c.letter

    def to_pulses(self, angles_deg: Any) -> tuple[int, int, int]:
        """Whole pulses of (3,) degrees."""
        a, b, c = (
            axis.scale.to_pulses(float(angle))
            for axis, angle in zip(self.axes, angles_deg, strict=True)
        )
        return a, b, c

    def to_deg(self, pulses: Any) -> Array:
        """(3,) degrees of (3,) pulses."""
        return np.array(
            [
                axis.scale.to_deg(float(count))
                for axis, count in zip(self.axes, pulses, strict=True)
            ]
        )

    def described(self) -> dict[str, Any]:
        """Everything, as plain values that JSON can hold."""
        data = dataclasses.asdict(
            dataclasses.replace(self, text="", output=pathlib.Path())
        )
        del data["text"], data["output"]
        for axis, described in zip(self.axes, data["axes"], strict=True):
            described["map"] = {"name": axis.map.name, "digest": axis.map.digest}
        return data

    def fingerprint(self) -> str:
        """SHA-256 of what a measurement depends on.

        Where the bus and the phone are reached may change between a run and its
        resumption; how the device moves and is measured may not.
        """
        data = self.described()
        del data["bus"]
        for key in ("host", "port", "transport", "stale_s"):
            del data["imu"][key]
        text = json.dumps(data, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()
