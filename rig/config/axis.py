"""One ``[[axes]]`` table: a joint, its drive, and pulses against degrees."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import pydantic
from pydantic import AfterValidator, BeforeValidator, ValidationInfo

from rig.config.maps import DriveMap, Units, load_map
from rig.config.schema import Section, advanced, key
from rig.registers import encode, motion_counts

AXIS_NAMES = ("pitch", "yaw", "roll")  # of the device that `setup` begins with
MOST_AXES = 6
DEFAULT_ROTATES = {"pitch": "X", "yaw": "Z", "roll": "Y"}

Pulses = tuple[int, ...]  # (n,) in the order of the axes
# Keys of a translation, and where their values are kept: in the unit of the axis.
IN_UNIT = ("min_deg", "max_deg", "speed_deg_s", "accel_deg_s2", "range_deg")
OF_TRANSLATION = {name.replace("_deg", "_mm"): name for name in IN_UNIT}


class Scale(Section):
    """Pulses and degrees of one axis: ``theta = 360 p / (omega kappa)``; degrees are
    millimetres of a translation: ``x = lead p / (omega kappa)``."""

    kind: Literal["rotation", "translation"] = key("what the axis does", "rotation")
    lead_mm: float | None = key("of a translation: travel per turn", None, 1e-3, 1e4)
    pulses_per_rev: int = key(
        "omega: pulses per turn of the motor", ..., 1, 100_000_000
    )
    reduction: float = key("kappa: motor turns per joint turn", 1.0, 1e-3, 1e5)
    direction: Literal[1, -1] = key("-1: positive pulses turn the joint negatively", 1)

    @classmethod
    def of(cls, described: dict[str, Any]) -> "Scale":
        """The scale of an axis as a journal describes it."""
        names = Scale.model_fields.keys() & described.keys()
        return cls(**{name: described[name] for name in names})

    @property
    def turns_per_deg(self) -> float:
        """Turns of the motor for one degree of the joint."""
        return self.reduction / (self.lead_mm or 360.0)

    @property
    def unit_name(self) -> str:
        """Unit in which its places are given."""
        return "mm" if self.kind == "translation" else "deg"

    @property
    def pulses_per_deg(self) -> float:
        """Signed pulses for one degree of the joint."""
        return self.direction * self.pulses_per_rev * self.turns_per_deg

    def motor_pulses(self, angle_deg: float) -> float:
        """Pulses of a turn of the motor itself."""
        return self.pulses_per_rev * angle_deg / 360.0

    def to_pulses(self, angle_deg: float) -> int:
        """Nearest whole pulse; the angle that counts is ``to_deg`` of it."""
        return round(angle_deg * self.pulses_per_deg)

    def to_deg(self, pulses: float) -> float:
        """Joint angle in degrees of a pulse count."""
        return pulses / self.pulses_per_deg


def _map(name: Any, info: ValidationInfo) -> DriveMap:
    if not isinstance(name, str) or not name:
        raise ValueError(f"must be the name of a map or of a file, got {name!r}")
    return load_map(name, (info.context or {}).get("folder"))


def _limit(value: float, info: ValidationInfo) -> float:
    if info.data.get("kind") == "rotation" and abs(value) > 180:
        raise ValueError(f"must be a number in [-180, 180], got {value!r}")
    return value


JointAngle = Annotated[float, AfterValidator(_limit)]
Range = tuple[JointAngle, JointAngle]


class Axis(Scale):
    """One joint and its drive; a translation has the keys of OF_TRANSLATION."""

    name: str = key("of the joint", pattern="^[a-z][a-z0-9_]{0,39}$")
    rotates: Literal["X", "Y", "Z"] | None = key(
        "of a rotation: axis of the joint in the device's frame, for a phone",
        "X, Z, Y of pitch, yaw, roll",
        by=lambda made: DEFAULT_ROTATES.get(made["name"]),
    )
    unit: int = key("Modbus unit id", ..., 1, 247)
    map: Annotated[
        DriveMap, BeforeValidator(_map), pydantic.WithJsonSchema({"type": "string"})
    ] = key("map of its drive: a name, or a .toml file relative to this one")
    min_deg: JointAngle = key("soft limit", ..., -10_000, 10_000)
    max_deg: JointAngle = key("soft limit", ..., -10_000, 10_000)
    speed_deg_s: float = key("of every move", ..., 1e-3, 5000)
    accel_deg_s2: float = key("of every move, start and stop", ..., 1e-3, 1e5)
    comm_timeout_s: float | None = advanced(
        "the drive stops itself when the line is silent for this time",
        "that of [bus], if the map has it", 0.01, 60, by=lambda made: None,
    )  # fmt: skip
    range_deg: Range | None = advanced("of the candidates; absent: the limits", None)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _in_millimetres(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("kind") != "translation":
            return data
        for new, name in OF_TRANSLATION.items():
            if name in data:
                raise ValueError(f"{name}: a translation has {new}")
        return {OF_TRANSLATION.get(name, name): data[name] for name in data}

    def key_of(self, name: str) -> str:
        """The key of rig.toml that holds a value, such as ``min_deg`` or ``min_mm``."""
        return name.replace("_deg", "_mm") if self.kind == "translation" else name

    @classmethod
    def unmoved(cls, name: str, unit: int, drive_map: DriveMap) -> "Axis":
        """A drive that is read or stopped and never moved: nothing else is known."""
        return cls.model_construct(name=name, rotates="X", unit=unit, map=drive_map)

    @property
    def min_pulses(self) -> int:
        return min(self.to_pulses(self.min_deg), self.to_pulses(self.max_deg))

    @property
    def max_pulses(self) -> int:
        return max(self.to_pulses(self.min_deg), self.to_pulses(self.max_deg))

    def pulses_within(self, angle_deg: float) -> int:
        """A tolerance in degrees as whole pulses, at least one."""
        return max(1, round(angle_deg * abs(self.pulses_per_deg)))

    def _counts_per_deg(self, units: Units) -> tuple[float, float]:
        """Register counts of 1 deg/s and of 1 deg/s^2 (of its inverse for a time)."""
        turns, pulses = self.turns_per_deg, abs(self.pulses_per_deg)
        per_deg = {"s_per_rev_per_s": 1.0 / turns}
        per_deg |= {"pulse_per_s": pulses, "pulse_per_s2": pulses}
        speed, accel = (per_deg.get(u, turns) for u in (units.speed, units.accel))
        return speed * units.speed_per_unit, accel * units.accel_per_unit

    def motion_counts(self) -> dict[str, int]:
        """Speed and ramps as register values, never faster than configured; none of a
        drive that takes them as they are. ValueError, ``key: rule, value``, where it
        cannot move so slowly, or the register cannot hold the value."""
        if (units := self.map.register_units) is None:
            return {}
        per_speed, per_accel = self._counts_per_deg(units)
        motion = self.speed_deg_s, self.accel_deg_s2
        in_pulses = (value * abs(self.pulses_per_deg) for value in motion)
        counts = motion_counts(units, self.pulses_per_rev, *in_pulses)
        for name, count in counts.items():
            if (place := self.map.place_of(name)) is None:
                continue
            key_name, unit, per, value = "accel_deg_s2", "/s^2", per_accel, motion[1]
            if name == "speed":
                key_name, unit, per, value = "speed_deg_s", "/s", per_speed, motion[0]
            key_name = self.key_of(key_name)
            if count < 1:
                raise ValueError(
                    f"{key_name}: must be at least {1.0 / per:.6g} {self.unit_name}"
                    f"{unit}, one count of the drive's register, got {value:g}"
                )
            try:
                encode(count, place[1], "big")
            except ValueError as error:
                text = f"{key_name}: the drive's register: {error}"
                raise ValueError(text) from None
        return counts

    @property
    def drive_motion(self) -> tuple[float, float]:
        """Speed in deg/s and acceleration in deg/s^2 that the drive is told."""
        if (units := self.map.register_units) is None:
            return self.speed_deg_s, self.accel_deg_s2
        per_speed, per_accel = self._counts_per_deg(units)
        counts = self.motion_counts()
        accel = counts["accel"] / per_accel
        if units.accel == "s_per_rev_per_s":
            accel = per_accel / counts["accel"]
        return counts["speed"] / per_speed, accel

    def broken_rules(self) -> Iterator[str]:
        if self.min_deg >= self.max_deg:
            low, high = self.key_of("min_deg"), self.key_of("max_deg")
            yield f"{low}: must be under {high}, got {self.min_deg} and {self.max_deg}"
            return
        if (self.kind == "translation") != (self.lead_mm is not None):
            yield f"lead_mm: a translation needs it, a rotation has none: {self.kind}"
            return
        try:
            self.motion_counts()
        except ValueError as error:
            yield str(error)
        if self.comm_timeout_s is not None and not self.map.has("comm_timeout"):
            lack = f"the map {self.map.name} has no register for it"
            yield f"comm_timeout_s: {lack}; leave it out and use the maker's tool"
