"""The tables of rig.toml but for its axes: one class a table, one field a key."""

import re
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from rig.config.axis import Range
from rig.config.maps import Read
from rig.config.schema import Section, advanced, key
from rig.registers import Kind
from rig.stop_config import NETWORK, where_of

Order = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
Sign = Literal[1, -1]
Column = Annotated[int, Field(ge=0, le=200)]
Angle = Annotated[float, Field(ge=-360, le=360)]
Method = Literal["policy", "auto", "exact", "exchange", "greedy", "random"]

# key(what it means, default (... where required), lowest, highest)


class BusSettings(Section):
    """One line for all drives."""

    transport: Literal["tcp", "rtu_tcp", "rtu", "serial", "can"] = key(
        "rtu: a serial port; rtu_tcp: RTU over TCP; serial, can: of your own drives"
    )
    host: str = key("address of a tcp or rtu_tcp bus", "")
    port: int = key("TCP port of a tcp or rtu_tcp bus", 502, 1, 65535)
    device: str = key("serial port; channel of a CAN bus, such as can0", "")
    baudrate: int = key("for a serial port or a CAN bus", 115200, 1200, 3_000_000)
    parity: Literal["N", "E", "O"] = key("of an rtu bus", "N")
    stopbits: int = key("of an rtu bus", 1, 1, 2)
    bytesize: int = key("of an rtu bus", 8, 7, 8)
    echo: bool = key("RTU: the adapter echoes what it is sent", False)
    timeout_s: float = key("for one reply", 0.3, 0.01, 5)
    read_retries: int = advanced("of a move not taken; twice for a read", 2, 0, 10)

    where = property(where_of)

    def broken_rules(self) -> Iterator[str]:
        required = "host" if self.transport in NETWORK else "device"
        if not getattr(self, required):
            yield f"{required}: missing; transport {self.transport!r} needs one"


def _separator_rule(text: str) -> Iterator[str]:
    if len(text) != 1 or text in "0123456789+-.eE\r\n":
        yield f"separator: must be one character that is in no number, got {text!r}"


def _by_format(hyperimu: Any, other: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda made: hyperimu if made["format"] == "hyperimu" else other


class ImuSettings(Section):
    """The phone's stream."""

    format: Literal["hyperimu", "lines", "sensorlog", "json", "sensorlogger"] = key(
        "app of the phone; sensorlog: lines below a header; json: one object per line"
    )
    transport: Literal["listen", "connect", "udp"] = key(
        "listen: the phone connects here; udp: it sends datagrams here", "listen"
    )
    host: str = key("of this computer; connect: of the phone", "127.0.0.1")
    port: int = key("TCP port; 0: any free one", ..., 0, 65535)
    # HyperIMU sends azimuth, pitch, roll, which turn about Z, X, Y; the order is ZYX.
    columns: tuple[Column, Column, Column] = key(
        "columns of the three angles, in the sequence of order",
        "[0, 1, 2]; hyperimu: [1, 3, 2]",
        by=_by_format((1, 3, 2), (0, 1, 2)),
    )
    quaternion_columns: tuple[Column, Column, Column, Column] | None = key(
        "columns of x, y, z, w, instead of angles", None
    )
    stamp_column: int = advanced(
        "column of the phone's clock; -1: none", "-1; hyperimu: 0", -1, 200,
        by=_by_format(0, -1),
    )  # fmt: skip
    stamp_unit: Literal["s", "ms", "us", "ns"] | None = advanced(
        "of the phone's clock; absent: from the first stamp, else ms (json: ns)", None
    )
    column_count: int = advanced("of a line; 0: as the first line", 0, 0, 200)
    separator: str = advanced("between columns", ",")
    unit: Literal["deg", "rad"] = key("of the angles", "deg")
    order: Order | None = key(
        "sequence of the phone's Euler angles", "ZYX; lines of angles: required",
        by=lambda made: (
            "ZYX" if made["format"] != "lines" or made["quaternion_columns"] else None
        ),
    )  # fmt: skip
    signs: tuple[Sign, Sign, Sign] = key(
        "signs of the angles, in the sequence of order",
        "[1, 1, 1]; hyperimu: [-1, -1, -1]",
        by=_by_format((-1, -1, -1), (1, 1, 1)),
    )
    mounting_deg: tuple[Angle, Angle, Angle] = key(
        "turn of the phone on the end-effector about Z, then Y, then X", (0.0, 0.0, 0.0)
    )
    allow: tuple[str, ...] = key("addresses that may send; none: the first", ())
    heading: Literal["relative", "absolute"] = advanced(
        "absolute: the phone has the same heading after every start", "relative"
    )
    stale_s: float = key("oldest reading allowed while moving", 0.4, 0.02, 10)
    max_jump_deg: float = advanced("largest change between readings", 20.0, 0.1, 180)

    @property
    def by_quaternion(self) -> bool:
        """Whether it sends quaternions, which have no unit, order or signs."""
        of_format = self.format in ("sensorlogger", "sensorlog", "json")
        return of_format or self.quaternion_columns is not None

    def fields(self, stamp_unit: str = "") -> str:
        """What the fields of a record are taken for, in words; ``stamp_unit`` of its
        time, where that is known."""
        unit = stamp_unit or self.stamp_unit or "the unit of the first stamp"
        if self.format in ("json", "sensorlogger"):
            return f"the quaternion x, y, z, w of an orientation; the time in {unit}"
        if self.format == "sensorlog":
            return "a quaternion and its time, by the names in the app's header"
        stamp = f"column {self.stamp_column} the time in {unit}"
        stamp = stamp if self.stamp_column >= 0 else "no time"
        if columns := self.quaternion_columns:
            return f"columns {[*columns]} a quaternion x, y, z, w; {stamp}"
        turns = zip(self.columns, str(self.order), self.signs, strict=True)
        angles = ", ".join(f"{c} about {'-' * (g < 0)}{axis}" for c, axis, g in turns)
        return f"columns {angles} (in this order), in {self.unit}; {stamp}"

    def broken_rules(self) -> Iterator[str]:
        if self.format == "sensorlogger" and self.transport != "listen":
            yield "transport: must be listen: Sensor Logger pushes its messages"
        angles = self.quaternion_columns or self.columns
        if len(set(angles)) < len(angles):
            which = "quaternion_columns" if self.quaternion_columns else "columns"
            yield f"{which}: must differ, got {list(angles)}"
        if self.format != "sensorlogger" and self.stamp_column in angles:
            yield f"stamp_column: {self.stamp_column} is also one of the angles"
        named = (*self.columns, *(self.quaternion_columns or ()), self.stamp_column)
        if self.column_count and max(named) >= self.column_count:
            yield f"column_count: {self.column_count} is too few for the columns named"
        if self.order is None:
            yield "order: missing; a line stream does not state the order of its angles"
        yield from _separator_rule(self.separator)


class ReadingRegister(Read):
    """A value of a Modbus device that measures."""

    unit: int = key("Modbus unit id", 1, 0, 255)
    type: Kind = key("of its value", "i32")
    word_order: Literal["big", "little"] = key("big: high word first", "big")


class ReadingsSettings(Section):
    """Numbers that a sensor sends, in place of a phone."""

    names: tuple[str, ...] = key(
        "1 to 12; a reading named like an axis rises with it",
        min_length=1,
        max_length=12,
    )
    unit: str = key("of all of them", "mm", min_length=1)
    transport: Literal["tcp", "listen", "udp", "serial", "modbus"] = key(
        "tcp: lines of a sensor at host and port; listen: the sensor connects here; "
        "udp: it sends datagrams; serial: lines on a serial port; modbus: registers"
    )
    host: str = key("tcp, modbus: of the sensor; else of this computer", "127.0.0.1")
    port: int = key("TCP or UDP port at host", 502, 0, 65535)
    device: str = key("serial port, for serial or Modbus RTU", "")
    baudrate: int = key("of a serial port", 115200, 1200, 3_000_000)
    parity: Literal["N", "E", "O"] = key("of a serial port", "N")
    stopbits: int = key("of a serial port", 1, 1, 2)
    bytesize: int = key("of a serial port", 8, 7, 8)
    registers: tuple[ReadingRegister, ...] = key("modbus: one per name", ())
    columns: tuple[Column, ...] = key("of the numbers in a line", (), max_length=12)
    separator: str = key("between columns", ",")
    factors: tuple[float, ...] = key("units per count that is sent", ())
    request: str = advanced("sent before each line, if the sensor needs it", "")
    period_s: float = advanced("time between two polls of registers", 0.02, 0.001, 1)
    scale: float = key(
        "change that is certainly visible and harmless. Until everything is proved, "
        "readings may change by at most nine times this", ..., 1e-9, 1e9,
    )  # fmt: skip
    most_jump: float = advanced("largest change between two readings", 1e9, 1e-9, 1e12)
    stale_s: float = key("oldest reading allowed while moving", 0.4, 0.02, 10)

    def broken_rules(self) -> Iterator[str]:
        if len(set(self.names)) < len(self.names):
            yield f"names: must differ, got {', '.join(self.names)}"
        for name in self.names:
            if not re.fullmatch("[a-z][a-z0-9_]{0,23}", name):
                yield f"names: must be small letters, digits and _, got {name!r}"
        modbus = self.transport == "modbus"
        for key_name, required in (
            ("registers", modbus), ("columns", False), ("factors", False)
        ):  # fmt: skip
            count = len(getattr(self, key_name))
            if count != len(self.names) and (count or required):
                yield f"{key_name}: must be {len(self.names)}, as names, got {count}"
        if self.transport == "serial" and not self.device:
            yield "device: missing; transport 'serial' needs one"
        yield from _separator_rule(self.separator)


class ModelSettings(Section):
    """What the device does with a command, where that is not ``y = A u + b``."""

    urdf: str = key("for an arm: its URDF file, whose joints are the axes", "")
    base: str = advanced("of urdf: the fixed link; absent: the root", "")
    tip: str = key("of urdf: link that carries phone or sensor; absent: the last", "")
    sensor: Literal["gravity", "position"] = key(
        "of urdf, at its tip: the direction of up, or metres of the file", "gravity"
    )
    magnitude: float = advanced("gravity in the readings' unit", 9.81, 1e-6, 1e6)
    factory: str = key("FILE.py:NAME or MODULE:NAME of a model, or what makes one", "")

    @property
    def file(self) -> str:
        """The file that says it, where there is one."""
        path = self.factory.rpartition(":")[0]
        return self.urdf or (path if path.endswith(".py") else "")

    def broken_rules(self) -> Iterator[str]:
        if bool(self.urdf) == bool(self.factory):
            yield "urdf: give either urdf or factory, not both"
        elif self.factory and not all(self.factory.rpartition(":")[::2]):
            yield f"factory: must be FILE.py:NAME or MODULE:NAME, got {self.factory!r}"


class MechanismSettings(Section):
    """The chain of joints."""

    order: Order = key("axes of the joints from the base outwards", "ZXY")


class MotionSettings(Section):
    """How the device is moved."""

    max_speed_deg_s: float = key(
        "limit of all speed_deg_s; raise it only with a reason", 120.0, 1e-3, 5000
    )
    max_step_deg: float = key("longer moves are split", 15.0, 0.1, 360)
    approach_overshoot_deg: float = key("> 0: reach postures from below", 0.0, 0, 20)
    position_tolerance_deg: float = advanced(
        "of a drive from its target", 0.05, 1e-4, 5
    )
    poll_s: float = advanced("between two polls of drives and IMU", 0.05, 0.001, 0.1)
    stall_s: float = advanced("at rest off its target until a fault", 1.0, 0.05, 30)
    envelope_margin_deg: float = advanced("of the IMU past the limits", 15.0, 0.1, 90)
    mirror_limits: bool = advanced("also write the soft limits to the drives", False)


class SettleSettings(Section):
    """When a posture counts as settled, and how long it is measured."""

    window_s: float = key("time for which the IMU must be quiet", 0.5, 0.01, 60)
    min_samples: int = advanced("least number of readings in the window", 10, 3, 10_000)
    std_deg: float = key("largest standard deviation over the window", 0.1, 1e-6, 10)
    slope_deg_s: float = key("largest slope over the window", 0.2, 1e-6, 100)
    timeout_s: float = advanced("to settle", 10.0, 0.05, 600)
    samples: int = key("readings averaged per measurement", 25, 1, 10_000)

    def broken_rules(self) -> Iterator[str]:
        if self.timeout_s <= self.window_s:
            yield f"timeout_s: must be longer than window_s, got {self.timeout_s}"


class SessionSettings(Section):
    """What a calibration session does."""

    candidates: int = key("M, postures drawn", 50, 5, 100_000)
    k: int | None = key("K, to choose; absent: axes plus one", None, 2, 10_000)
    method: Method | None = key("absent: policy for three axes, else auto", None)
    min_efficiency: float = advanced("below this D-efficiency exact is used", 0.9, 0, 1)
    seed: int = advanced("seed of the candidates", 0, 0, 2**31 - 1)
    pitch_range_deg: Range | None = key("range_deg of the axis pitch", None)
    yaw_range_deg: Range | None = key("range_deg of the axis yaw", None)
    roll_range_deg: Range | None = key("range_deg of the axis roll", None)
    verify_postures: int = key("held out, measured before and after", 4, 0, 1000)
    verify_limit_deg: float = key("largest good error, compensated", 0.5, 1e-3, 45)
    drift_limit_deg: float = key("largest nonlinear drift of zero", 0.2, 1e-3, 45)
    reference_tolerance_deg: float = advanced("of the zero posture", 0.5, 1e-3, 45)
    max_unreachable: int = advanced("unreachable postures until a fault", 3, 0, 1000)
    zero: Literal["here", "drive"] = key(
        "drive: pulse 0; here: where it stands", "here"
    )
