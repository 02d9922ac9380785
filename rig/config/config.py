"""The whole of rig.toml, and what follows from several of its tables."""

import hashlib
import json
import pathlib
import tomllib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr

from rig.config.axis import AXIS_NAMES, Axis, Pulses, Scale
from rig.config.maps import RegisterMap
from rig.config.schema import Section, key
from rig.config.settings import (
    BusSettings,
    ImuSettings,
    MechanismSettings,
    MotionSettings,
    SessionSettings,
    SettleSettings,
)

PHONE = (
    "format", "columns", "quaternion_columns", "unit", "order", "signs", "mounting_deg"
)  # fmt: skip
# Left out of ``fingerprint``: addresses, and what version 1 did not know. A key added
# here leaves the fingerprints of older files as they are.
UNCOUNTED = {"imu": ("host", "port", "transport", "stale_s", "heading")}
# May also change before a run is resumed: they judge what was measured, or stop it.
LIMITS = {
    "motion": (
        "deadline_factor", "deadline_slack_s", "stall_s", "following_deg",
        "envelope_margin_deg", "max_disagreement_deg", "heartbeat_s",
    ),
    "session": ("verify_limit_deg", "reference_tolerance_deg", "max_unreachable"),
}  # fmt: skip


def differences(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """``key: VALUE then, VALUE now`` of two flat tables, where they differ."""
    return [
        f"{key}: {then.get(key, 'not known')} then, {now.get(key, 'not known')} now"
        for key in dict.fromkeys([*then, *now])
        if then.get(key) != now.get(key)
    ]


def _without(data: dict[str, Any], left_out: dict[str, Any]) -> dict[str, Any]:
    """A described configuration without its bus and some keys of its tables."""
    return {
        table: {k: v for k, v in keys.items() if k not in left_out.get(table, ())}
        if isinstance(keys, dict)
        else keys
        for table, keys in data.items()
        if table != "bus"
    }


def _flat(data: Any, at: str = "") -> dict[str, Any]:
    """Dotted key to value; axes are called by their names."""
    if isinstance(data, dict):
        pairs = [(str(name), value) for name, value in data.items()]
    elif data and isinstance(data, list) and isinstance(data[0], dict):
        pairs = [(value["name"], value) for value in data]
    else:
        return {at: data}
    flat: dict[str, Any] = {}
    for name, value in pairs:
        flat |= _flat(value, f"{at}.{name}" if at else name)
    return flat


def _family(register_map: RegisterMap) -> str:
    data = tomllib.loads(register_map.text)
    parts = [data.get(name) for name in ("word_order", "units", "position", "move")]
    text = json.dumps(parts, sort_keys=True)
    return f"{register_map.name} ({hashlib.sha256(text.encode()).hexdigest()[:8]})"


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
    device: str = key(
        "record of how the device was commissioned, relative to this file",
        "device.json",
    )
    _folder: pathlib.Path = PrivateAttr(pathlib.Path())

    @property
    def device_path(self) -> pathlib.Path:
        """The device's record; ``device`` is relative to the configuration's folder."""
        return self._folder / self.device

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

    def to_deg(self, pulses: Any) -> NDArray[np.float64]:
        """(..., 3) degrees of (..., 3) pulses."""
        scales = np.array([axis.pulses_per_deg for axis in self.axes])
        return np.asarray(pulses, dtype=np.float64) / scales

    def described(self) -> dict[str, Any]:
        """Everything as JSON values, in the layout of run folders of version 1."""
        data = self.model_dump(exclude={"mechanism", "output", "axes", "device"})
        imu, session = data["imu"], data["session"]
        imu["quaternion"] = imu.pop("quaternion_columns")
        imu["angle_unit"] = imu.pop("unit")
        imu["stamp_column"] = None if imu["stamp_column"] < 0 else imu["stamp_column"]
        imu["column_count"] = imu["column_count"] or None
        for name in AXIS_NAMES:
            del session[f"{name}_range_deg"]
        session["ranges"] = self.ranges
        scale = set(Scale.model_fields)
        axes = [
            axis.model_dump(exclude={*scale, "rotates", "map"})
            | {"letter": axis.rotates, "scale": axis.model_dump(include=scale)}
            | {"map": {"name": axis.map.name, "digest": axis.map.digest}}
            for axis in self.axes
        ]
        return {**data, "axes": axes, "mechanism_order": self.mechanism.order}

    def fingerprint(self) -> str:
        """SHA-256 of what a measurement depends on, as version 1 took it."""
        data = _without(self.described(), UNCOUNTED)
        text = json.dumps(data, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    def changed_since(self, described: dict[str, Any]) -> list[str]:
        """Keys that would make a resumed run move or measure differently, in words.

        Args:
            described: ``described()`` when the run began, from its journal.
        """
        now = json.loads(json.dumps(self.described(), default=str))
        left_out = {
            table: (*UNCOUNTED.get(table, ()), *LIMITS.get(table, ()))
            for table in UNCOUNTED | LIMITS
        }
        then, now = (_flat(_without(each, left_out)) for each in (described, now))
        return differences(then, now)

    def device_fingerprint(self) -> dict[str, Any]:
        """Key of rig.toml to value, of all that says which place a pulse count means.

        Of a map it is the part that turns counts into places: one that learns another
        register by an update is the same family.
        """
        found: dict[str, Any] = {}
        for axis in self.axes:
            scale = axis.model_dump(include={*Scale.model_fields, "unit", "rotates"})
            values = {"map": _family(axis.map), **scale}
            found |= {f"axes.{axis.name}.{name}": values[name] for name in values}
        found["mechanism.order"] = self.mechanism.order
        imu = self.imu.model_dump(mode="json", include=set(PHONE))
        return found | {f"imu.{name}": imu[name] for name in PHONE}

    def broken_rules(self) -> Iterator[str]:
        motion, session = self.motion, self.session
        slowest = self.bus.timeout_s * (self.bus.read_retries + 1)
        overshoot = motion.approach_overshoot_deg
        if session.k >= session.candidates:
            yield f"session.k: must be under candidates ({session.candidates})"
        for axis, (low, high) in zip(self.axes, self.ranges, strict=True):
            at, span = f"axes.{axis.name}", f"session.{axis.name}_range_deg"
            if abs(1.0 / axis.pulses_per_deg) > motion.position_tolerance_deg:
                yield f"{at}: one pulse is coarser than motion.position_tolerance_deg"
            if axis.comm_timeout_s is not None and axis.comm_timeout_s <= slowest:
                least = f"bus.timeout_s x (read_retries + 1) = {slowest:g} s"
                yield f"{at}.comm_timeout_s: must exceed {least}"
            if motion.mirror_limits and axis.map.limits is None:
                lack = f"the map {axis.map.name} of {axis.name} has no limit registers"
                yield f"motion.mirror_limits: {lack}"
            if low >= high:
                yield f"{span}: must be [low, high], got [{low}, {high}]"
            elif low - overshoot < axis.min_deg - 1e-9 or high > axis.max_deg + 1e-9:
                limits = f"[{axis.min_deg}, {axis.max_deg}]"
                yield (
                    f"{span}: [{low}, {high}] with an overshoot of {overshoot} leaves "
                    f"the axis's limits {limits}"
                )
