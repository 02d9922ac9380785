"""One ``[[axes]]`` table: a joint, its drive, and pulses against degrees."""

from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ValidationInfo, WithJsonSchema

from rig.config.maps import RegisterMap, load_map
from rig.config.registers import encode
from rig.config.schema import Section, key

AXIS_NAMES = ("pitch", "yaw", "roll")  # the order of every (3,) in this package
DEFAULT_ROTATES = {"pitch": "X", "yaw": "Z", "roll": "Y"}
LOWEST, HIGHEST = -(2**31), 2**31 - 1

Pulses = tuple[int, int, int]  # of pitch, yaw and roll


class Scale(Section):
    """Pulses and degrees of one axis: ``theta = 360 p / (omega kappa)``."""

    pulses_per_rev: int = key(
        "omega: pulses for one motor turn, as set in the drive", ..., 1, 100_000_000
    )
    reduction: float = key("kappa: motor turns for one joint turn", 1.0, 1e-3, 1e5)
    direction: Literal[1, -1] = key(
        "-1: positive pulses turn the joint the negative way", 1
    )

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
    return load_map(name, (info.context or {}).get("folder"))


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
        """Speed and ramps as register values; ValueError where one does not fit."""
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
            if place := self.map.move.place_of(name):
                encode(count, place[1], self.map.word_order)
        return counts

    def broken_rules(self) -> Iterator[str]:
        for unit in ("deg", "pulses"):
            low, high = getattr(self, f"min_{unit}"), getattr(self, f"max_{unit}")
            if low >= high:
                yield f"min_{unit}: must be under max_{unit}, got {low} and {high}"
                return
        allowed = f"min_pulses..max_pulses ({self.min_pulses}..{self.max_pulses})"
        for name in ("min_deg", "max_deg"):
            pulses = self.to_pulses(getattr(self, name))
            if not self.min_pulses <= pulses <= self.max_pulses:
                yield f"{name}: {pulses} pulses are outside {allowed}"
        try:
            self.motion_counts()
        except ValueError as error:
            yield f"speed_deg_s: or accel_deg_s2 does not fit the drive: {error}"
        if self.comm_timeout_s is not None and self.map.comm_timeout is None:
            lack = f"the map {self.map.name} has no register for it"
            yield f"comm_timeout_s: {lack}; leave it out and use the maker's tool"
