"""What a configuration holds: one class a table, one field a key."""

import hashlib
import json
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, PrivateAttr, ValidationInfo, WithJsonSchema

from rig.attitude import Array, euler_to_matrix
from rig.config.registers import MapError, RegisterMap, encode, load_map
from rig.config.schema import BrokenRules, Section, key

__all__ = [
    "AXIS_NAMES",
    "Axis",
    "BusSettings",
    "ImuSettings",
    "MotionSettings",
    "Pulses",
    "RigConfig",
    "Scale",
    "SessionSettings",
    "SettleSettings",
]

AXIS_NAMES = ("pitch", "yaw", "roll")  # the order of every (3,) in this package
DEFAULT_ROTATES = {"pitch": "X", "yaw": "Z", "roll": "Y"}
LOWEST, HIGHEST = -(2**31), 2**31 - 1

Pulses = tuple[int, int, int]  # of pitch, yaw and roll
Order = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
Sign = Literal[1, -1]
Column = Annotated[int, Field(ge=0, le=200)]
Angle = Annotated[float, Field(ge=-360, le=360)]
JointAngle = Annotated[float, Field(ge=-180, le=180)]
Range = tuple[JointAngle, JointAngle]

# key(what it means, default (... where required), lowest, highest)


class BusSettings(Section):
    """One Modbus line for the three drives."""

    transport: Literal["tcp", "rtu_tcp", "rtu"] = key(
        "rtu: serial port; tcp: Modbus TCP; rtu_tcp: RTU frames over TCP"
    )
    host: str = key("address of a tcp or rtu_tcp bus", "")
    port: int = key("TCP port of the same", 502, 1, 65535)
    device: str = key("serial port of an rtu bus", "")
    baudrate: int = key("of an rtu bus", 115200, 1200, 3_000_000)
    parity: Literal["N", "E", "O"] = key("of an rtu bus", "N")
    stopbits: int = key("of an rtu bus", 1, 1, 2)
    bytesize: int = key("of an rtu bus", 8, 7, 8)
    timeout_s: float = key("for one reply", 0.3, 0.01, 5)
    read_retries: int = key("of reads only; a motion write is sent once", 2, 0, 10)

    @property
    def where(self) -> str:
        """The bus in words."""
        if self.transport == "rtu":
            return f"{self.device} at {self.baudrate} baud"
        return f"{self.host}:{self.port} ({self.transport})"

    def broken_rules(self) -> Iterator[tuple[str, str]]:
        wanted = "device" if self.transport == "rtu" else "host"
        if not getattr(self, wanted):
            yield wanted, f"missing; transport {self.transport!r} needs one"


class Scale(Section):
    """Pulses and degrees of one axis: ``theta = 360 p / (omega kappa)``."""

    pulses_per_rev: int = key(
        "omega: pulses for one motor turn, as set in the drive", ..., 1, 100_000_000
    )
    reduction: float = key("kappa: motor turns for one joint turn", 1.0, 1e-3, 1e5)
    direction: Sign = key("-1: positive pulses turn the joint the negative way", 1)

    @property
    def pulses_per_deg(self) -> float:
        """Signed pulses for one degree of the joint."""
        return self.direction * self.pulses_per_rev * self.reduction / 360.0

    def to_pulses(self, angle_deg: float) -> int:
        """Nearest whole pulse; the angle that counts is ``to_deg`` of it."""
        return round(angle_deg * self.pulses_per_deg)

    def to_deg(self, pulses: float) -> float:
        """Joint angle in degrees of a pulse count."""
        return pulses / self.pulses_per_deg


def _limit(pick: Callable[..., int]) -> Callable[[dict[str, Any]], int]:
    def pulses(made: dict[str, Any]) -> int:
        scale = Scale(**{name: made[name] for name in Scale.model_fields})
        return pick(scale.to_pulses(made["min_deg"]), scale.to_pulses(made["max_deg"]))

    return pulses


def _map(name: Any, info: ValidationInfo) -> RegisterMap:
    if not isinstance(name, str) or not name:
        raise ValueError(f"must be the name of a map or of a file, got {name!r}")
    try:
        return load_map(name, (info.context or {}).get("folder"))
    except MapError as error:
        raise BrokenRules([("", line) for line in str(error).splitlines()]) from None


class Axis(Scale):
    """One joint and the drive that moves it."""

    name: Literal["pitch", "yaw", "roll"] = key("of the joint")
    rotates: Literal["X", "Y", "Z"] = key(
        "axis of the joint in the device's frame",
        "X, Z, Y of pitch, yaw, roll",
        by=lambda made: DEFAULT_ROTATES[made["name"]],
    )
    unit: int = key("Modbus unit id", ..., 1, 247)
    map: Annotated[
        RegisterMap, BeforeValidator(_map), WithJsonSchema({"type": "string"})
    ] = key("register map: a name, or a .toml file relative to this one")
    min_deg: float = key("soft limit", ..., -180, 180)
    max_deg: float = key("soft limit", ..., -180, 180)
    min_pulses: int = key(
        "soft limit", "of the limits", LOWEST, HIGHEST, by=_limit(min)
    )
    max_pulses: int = key(
        "soft limit", "of the limits", LOWEST, HIGHEST, by=_limit(max)
    )
    speed_deg_s: float = key("of every move", ..., 1e-3, 5000)
    accel_deg_s2: float = key("of every move, also to brake", ..., 1e-3, 1e5)
    comm_timeout_s: float | None = key(
        "the drive stops itself when the line is silent for so long", None, 0.01, 60
    )

    def pulses_within(self, angle_deg: float) -> int:
        """A tolerance in degrees as whole pulses, at least one."""
        return max(1, round(angle_deg * abs(self.pulses_per_deg)))

    def motion_counts(self) -> dict[str, int]:
        """Register values of speed and acceleration of a move.

        Raises:
            ValueError: one does not fit its register.
        """
        units, turns = self.map.units, self.reduction / 360.0
        speed, accel = self.speed_deg_s * turns, self.accel_deg_s2 * turns  # of motor
        if units.speed == "pulse_per_s":
            speed *= self.pulses_per_rev
        if units.accel == "pulse_per_s2":
            accel *= self.pulses_per_rev
        if units.accel == "s_per_rev_per_s":
            accel = 1.0 / accel
        counts = {"speed": max(1, round(speed * units.speed_per_unit))}
        counts["accel"] = counts["decel"] = max(1, round(accel * units.accel_per_unit))
        for name, count in counts.items():
            for frame in self.map.move.write:
                if found := frame.offset_of(name):
                    encode(count, found[1], self.map.word_order)
        return counts

    def broken_rules(self) -> Iterator[tuple[str, str]]:
        if self.min_deg >= self.max_deg:
            got = f"{self.min_deg} and {self.max_deg}"
            yield "min_deg", f"must be under max_deg, got {got}"
        elif self.min_pulses >= self.max_pulses:
            got = f"{self.min_pulses} and {self.max_pulses}"
            yield "min_pulses", f"must be under max_pulses, got {got}"
        else:
            for name in ("min_deg", "max_deg"):
                end = getattr(self, name)
                pulses = self.to_pulses(end)
                if not self.min_pulses <= pulses <= self.max_pulses:
                    yield (
                        name,
                        (
                            f"{end} deg is {pulses} pulses, outside min_pulses.."
                            f"max_pulses ({self.min_pulses}..{self.max_pulses})"
                        ),
                    )
        try:
            self.motion_counts()
        except ValueError as error:
            yield "speed_deg_s", f"or accel_deg_s2 is too large: {error}"
        if self.comm_timeout_s is not None and self.map.comm_timeout is None:
            yield (
                "comm_timeout_s",
                (
                    f"the map {self.map.name} has no register for it; set it with the "
                    "maker's tool and leave this key out"
                ),
            )


def _by_format(hyperimu: Any, other: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda made: hyperimu if made["format"] == "hyperimu" else other


def _phone_order(made: dict[str, Any]) -> str | None:
    angles = made["format"] == "lines" and not made["quaternion_columns"]
    return None if angles else "ZYX"


class ImuSettings(Section):
    """The phone's stream."""

    format: Literal["hyperimu", "lines", "sensorlogger"] = key("app of the phone")
    transport: Literal["listen", "connect"] = key(
        "listen: the phone connects to this computer", "listen"
    )
    host: str = key(
        "listen: this computer's address; connect: the phone's", "127.0.0.1"
    )
    port: int = key("TCP port; 0: any free one", ..., 0, 65535)
    # HyperIMU sends azimuth, pitch, roll, which turn about Z, X, Y; the order is ZYX.
    columns: tuple[Column, Column, Column] = key(
        "of the three angles, in the sequence of order",
        "[0, 1, 2]; hyperimu: [1, 3, 2]",
        by=_by_format((1, 3, 2), (0, 1, 2)),
    )
    quaternion_columns: tuple[Column, Column, Column, Column] | None = key(
        "of x, y, z, w, in place of angles", None
    )
    stamp_column: int = key(
        "of the phone's clock in ms; -1: none", "-1; hyperimu: 0", -1, 200,
        by=_by_format(0, -1),
    )  # fmt: skip
    column_count: int = key(
        "a line of another width is refused; 0: as the first line", 0, 0, 200
    )
    separator: str = key("between columns", ",")
    unit: Literal["deg", "rad"] = key("of the angles", "deg")
    order: Order | None = key(
        "sequence of the phone's Euler angles", "ZYX; lines of angles: required",
        by=_phone_order,
    )  # fmt: skip
    signs: tuple[Sign, Sign, Sign] = key(
        "of the angles, in the sequence of order",
        "[1, 1, 1]; hyperimu: [-1, -1, -1]",
        by=_by_format((-1, -1, -1), (1, 1, 1)),
    )
    mounting_deg: tuple[Angle, Angle, Angle] = key(
        "turn of the phone on the end-effector about Z, then Y, then X", (0.0, 0.0, 0.0)
    )
    stale_s: float = key("older than this while moving: stop", 0.4, 0.02, 10)
    max_jump_deg: float = key("between two readings", 20.0, 0.1, 180)

    @property
    def mounting(self) -> Array:
        """(3, 3) R_EP."""
        return euler_to_matrix(self.mounting_deg, "ZYX")

    def broken_rules(self) -> Iterator[tuple[str, str]]:
        if self.format == "sensorlogger" and self.transport != "listen":
            yield "transport", "must be listen: Sensor Logger pushes its messages"
        named = (*self.columns, *(self.quaternion_columns or ()), self.stamp_column)
        if self.column_count and max(named) >= self.column_count:
            yield (
                "column_count",
                f"{self.column_count} is too few for the columns named",
            )
        if self.order is None:
            yield "order", "missing; a line stream does not say the order of its angles"
        if len(self.separator) != 1 or self.separator in "0123456789+-.eE\r\n":
            yield (
                "separator",
                f"must be one character no number has: {self.separator!r}",
            )


class MechanismSettings(Section):
    """The chain of joints."""

    order: Order = key("axes of the joints from the base outwards", "ZXY")


class MotionSettings(Section):
    """How the device is moved."""

    max_step_deg: float = key("longer moves are split", 15.0, 0.1, 360)
    approach_overshoot_deg: float = key(
        "> 0: come to every posture from below; play becomes pure bias", 0.0, 0, 20
    )
    position_tolerance_deg: float = key(
        "a drive this close is on its target", 0.05, 1e-4, 5
    )
    poll_s: float = key("between two looks at drives and IMU", 0.05, 0.001, 0.1)
    deadline_factor: float = key("a move may take its computed time times", 2.0, 1, 20)
    deadline_slack_s: float = key("plus", 2.0, 0.05, 60)
    stall_s: float = key("standing so long off its target is a fault", 1.0, 0.05, 30)
    following_deg: float = key("a drive may leave its way by", 3.0, 0.01, 45)
    envelope_margin_deg: float = key("the IMU may read past limits by", 15.0, 0.1, 90)
    max_disagreement_deg: float = key(
        "between IMU and command at a posture", 45.0, 0.1, 180
    )
    heartbeat_s: float = key("a motion loop silent for so long: stop", 3.0, 0.2, 60)
    mirror_limits: bool = key("write the soft limits to the drives too", False)


class SettleSettings(Section):
    """When a posture counts as settled, and how long it is measured."""

    window_s: float = key("time over which the IMU must be quiet", 0.5, 0.01, 60)
    min_samples: int = key("readings in the window, at least", 10, 3, 10_000)
    std_deg: float = key("largest deviation over the window", 0.1, 1e-6, 10)
    slope_deg_s: float = key("largest slope over the window", 0.2, 1e-6, 100)
    timeout_s: float = key("to settle", 10.0, 0.05, 600)
    samples: int = key("readings averaged for one measurement", 25, 1, 10_000)

    def broken_rules(self) -> Iterator[tuple[str, str]]:
        if self.timeout_s <= self.window_s:
            yield "timeout_s", f"must be longer than window_s, got {self.timeout_s}"


class SessionSettings(Section):
    """What a calibration session does."""

    candidates: int = key("M, postures drawn", 50, 5, 100_000)
    k: int = key("K, postures chosen; 4 leave no residual", 4, 4, 10_000)
    method: Literal["policy", "auto", "exact", "exchange", "greedy", "random"] = key(
        "how they are chosen", "policy"
    )
    min_efficiency: float = key("under this D-efficiency exact is used", 0.9, 0, 1)
    seed: int = key("of the candidates drawn", 0, 0, HIGHEST)
    pitch_range_deg: Range | None = key("of the candidates; absent: the limits", None)
    yaw_range_deg: Range | None = key("likewise", None)
    roll_range_deg: Range | None = key("likewise", None)
    verify_postures: int = key("held out; each before and after", 4, 0, 1000)
    verify_limit_deg: float = key("largest good error once compensated", 0.5, 1e-3, 45)
    reference_tolerance_deg: float = key("zero posture on `resume`", 0.5, 1e-3, 45)
    max_unreachable: int = key("postures out of reach until a fault", 3, 0, 1000)
    zero: Literal["here", "drive"] = key(
        "here: the device stands in its zero posture; drive: go to pulse 0", "here"
    )


class RigConfig(Section):
    """A whole, valid configuration."""

    bus: BusSettings
    axes: tuple[Axis, Axis, Axis]
    imu: ImuSettings
    mechanism: MechanismSettings = MechanismSettings()
    settle: SettleSettings = SettleSettings()
    motion: MotionSettings = MotionSettings()
    session: SessionSettings = SessionSettings()
    output: str = key("every run makes its own folder in here", "runs")
    _text: str = PrivateAttr("")

    @property
    def text(self) -> str:
        """The TOML it came from."""
        return self._text

    @property
    def letters(self) -> tuple[str, str, str]:
        """Axis letters of pitch, yaw and roll."""
        a, b, c = (axis.rotates for axis in self.axes)
        return a, b, c

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """(3, 2) degrees in which candidates are drawn."""
        overshoot = self.motion.approach_overshoot_deg
        return tuple(
            getattr(self.session, f"{axis.name}_range_deg")
            or (axis.min_deg + overshoot, axis.max_deg)
            for axis in self.axes
        )

    @property
    def silence_s(self) -> float:
        """Silence between frames that the slowest of the drives wants."""
        return max(axis.map.inter_frame_s for axis in self.axes)

    def to_pulses(self, angles_deg: Any) -> Pulses:
        """Whole pulses of (3,) degrees."""
        a, b, c = (
            axis.to_pulses(float(angle))
            for axis, angle in zip(self.axes, angles_deg, strict=True)
        )
        return a, b, c

    def to_deg(self, pulses: Any) -> Array:
        """(..., 3) degrees of (..., 3) pulses."""
        scales = np.array([axis.pulses_per_deg for axis in self.axes])
        return np.asarray(pulses, dtype=np.float64) / scales

    def described(self) -> dict[str, Any]:
        """Everything as JSON values, in the layout of run folders of version 1."""
        axes = []
        moved = {*Scale.model_fields, "rotates", "map"}
        for axis in self.axes:
            plain = axis.model_dump(exclude=moved)
            plain["letter"] = axis.rotates
            plain["map"] = {"name": axis.map.name, "digest": axis.map.digest}
            plain["scale"] = axis.model_dump(include=set(Scale.model_fields))
            axes.append(plain)
        imu = self.imu.model_dump()
        imu["quaternion"], imu["angle_unit"] = (
            imu.pop("quaternion_columns"),
            imu.pop("unit"),
        )
        imu["stamp_column"] = None if imu["stamp_column"] < 0 else imu["stamp_column"]
        imu["column_count"] = imu["column_count"] or None
        session = self.session.model_dump()
        for name in AXIS_NAMES:
            del session[f"{name}_range_deg"]
        return {
            "bus": self.bus.model_dump(),
            "axes": axes,
            "imu": imu,
            "mechanism_order": self.mechanism.order,
            "settle": self.settle.model_dump(),
            "motion": self.motion.model_dump(),
            "session": session | {"ranges": self.ranges},
        }

    def fingerprint(self) -> str:
        """SHA-256 of what a measurement depends on.

        Where the bus and the phone are reached may change between a run and its
        resumption; how the device moves and is measured may not.
        """
        data = self.described()
        del data["bus"]
        for name in ("host", "port", "transport", "stale_s"):
            del data["imu"][name]
        text = json.dumps(data, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    def broken_rules(self) -> Iterator[tuple[str, str]]:
        motion, session = self.motion, self.session
        slowest = self.bus.timeout_s * (self.bus.read_retries + 1)
        overshoot = motion.approach_overshoot_deg
        if session.k >= session.candidates:
            yield "session.k", f"must be under candidates ({session.candidates})"
        for axis, (low, high) in zip(self.axes, self.ranges, strict=True):
            name = axis.name
            if abs(1.0 / axis.pulses_per_deg) > motion.position_tolerance_deg:
                yield (
                    f"axes.{name}.pulses_per_rev",
                    ("one pulse is coarser than motion.position_tolerance_deg"),
                )
            if axis.comm_timeout_s is not None and axis.comm_timeout_s <= slowest:
                yield (
                    f"axes.{name}.comm_timeout_s",
                    (
                        "must exceed bus.timeout_s x (read_retries + 1) = "
                        f"{slowest:g} s, got {axis.comm_timeout_s:g}"
                    ),
                )
            if motion.mirror_limits and axis.map.limits is None:
                yield (
                    "motion.mirror_limits",
                    (f"the map {axis.map.name} of {name} has no limit registers"),
                )
            if low >= high:
                yield (
                    f"session.{name}_range_deg",
                    (f"must be [low, high], got [{low}, {high}]"),
                )
            elif low - overshoot < axis.min_deg - 1e-9 or high > axis.max_deg + 1e-9:
                yield (
                    f"session.{name}_range_deg",
                    (
                        f"[{low}, {high}] with an overshoot of {overshoot} leaves the "
                        f"axis's limits [{axis.min_deg}, {axis.max_deg}]"
                    ),
                )
