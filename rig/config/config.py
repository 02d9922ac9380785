"""The whole of rig.toml, what follows from several of its tables, and its reading."""

import functools
import hashlib
import json
import pathlib
import tomllib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rig.config import settings
from rig.config.axis import AXIS_NAMES, MOST_AXES, Axis, Pulses, Scale
from rig.config.schema import ConfigError, Section, key, parse, read_text
from rig.stop_config import rows_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Of an axis, for whoever moves its drive.
SCALE = ("min_pulses", "max_pulses", "pulses_per_rev", "pulses_per_deg")
EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"
POLLS, HICCUP_S = 4, 0.5  # of the motion loop's heartbeat
PHONE = (
    "format", "columns", "quaternion_columns", "unit", "order", "signs", "mounting_deg"
)  # fmt: skip
SENSOR = ("names", "unit", "registers", "columns", "factors")
UP = ("up_x", "up_y", "up_z")  # what a phone on an arm measures
# What of these tables may not change between a run and its resumption.
MEASURED = {
    "settle": ("window_s", "min_samples", "std_deg", "slope_deg_s", "samples"),
    "motion": ("approach_overshoot_deg",),
    "session": ("k", "candidates", "method", "seed", "verify_postures"),
}


def names_of(described: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Names of the axes, and of what is measured, of a journal's configuration."""
    axes = [str(axis["name"]) for axis in described.get("axes", ())]
    by_phone = UP if (described.get("model") or {}).get("urdf") else axes
    readings = described.get("readings") or {"names": by_phone}
    return axes, [str(name) for name in readings["names"]]


def units_of(described: dict[str, Any]) -> tuple[str, str]:
    """Units of the commands, and of what is measured, of a journal's configuration."""
    kinds = [axis.get("kind", "rotation") for axis in described.get("axes", ())]
    units = dict.fromkeys("mm" if kind == "translation" else "deg" for kind in kinds)
    readings = described.get("readings") or {"unit": "deg"}
    return ", ".join(units), str(readings["unit"])


def differences(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """``key: was VALUE, is VALUE`` of two flat tables, where they differ."""
    return [
        f"{key}: was {then.get(key, 'not known')}, is {now.get(key, 'not known')}"
        for key in dict.fromkeys([*then, *now])
        if then.get(key) != now.get(key)
    ]


# Parts of a map that turn counts into places, and that say how a drive is stopped.
PLACES = ("word_order", "units", "position", "move")
STOPS = ("status", "stop", "broadcast_stop", "hold", "restart_s", "comm_timeout")


@functools.cache
def _digest(register_map: str, names: tuple[str, ...]) -> str:
    """Digest of parts of a map's text."""
    data = tomllib.loads(register_map)
    # What other kinds of drives have was added to the digest later.
    more = ("drive", "settings")
    parts = [data.get(name) for name in names]
    parts += [data[name] for name in more if name in data]
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


class RigConfig(Section):
    """A whole, valid configuration."""

    bus: settings.BusSettings
    axes: tuple[Axis, ...]
    imu: settings.ImuSettings | None = None  # the phone, or
    readings: settings.ReadingsSettings | None = None  # numbers
    model: settings.ModelSettings | None = None  # else it is affine
    mechanism: settings.MechanismSettings = settings.MechanismSettings()
    settle: settings.SettleSettings = settings.SettleSettings()
    motion: settings.MotionSettings = settings.MotionSettings()
    session: settings.SessionSettings = settings.SessionSettings()
    output: str = key("every run makes a folder in this folder", "runs")
    device: str = key("how it was commissioned, relative to this file", "device.json")

    @property
    def device_path(self) -> pathlib.Path:
        """The device's record; ``device`` is relative to the configuration's folder."""
        return self.folder / self.device

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes, in the order of every command."""
        return tuple(axis.name for axis in self.axes)

    @property
    def axis_unit(self) -> str:
        """Unit of the commands: deg or mm, or both."""
        return ", ".join(dict.fromkeys(axis.unit_name for axis in self.axes))

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of what is measured, in the order of every measurement."""
        if self.readings:
            return self.readings.names
        return UP if self.is_arm else self.axis_names

    @property
    def is_arm(self) -> bool:
        """Whether the axes are the joints of a URDF."""
        return self.model is not None and bool(self.model.urdf)

    @property
    def model_path(self) -> pathlib.Path | None:
        """The file of its model, where it has one."""
        return self.folder / self.model.file if self.model and self.model.file else None

    @property
    def output_unit(self) -> str:
        """Unit of what is measured."""
        return self.readings.unit if self.readings else "deg"

    @property
    def source(self) -> settings.ImuSettings | settings.ReadingsSettings:
        """The phone, or the sensor."""
        return self.readings or self.phone

    @property
    def phone(self) -> settings.ImuSettings:
        """The phone, of what is asked only where there is one."""
        assert self.imu is not None
        return self.imu

    @property
    def k(self) -> int:
        """Postures that are chosen."""
        return self.session.k or len(self.axes) + 1

    @property
    def method(self) -> str:
        """How they are chosen."""
        return self.session.method or ("policy" if len(self.axes) == 3 else "auto")

    @property
    def letters(self) -> tuple[str, ...]:
        """Axis letter of each joint."""
        return tuple(str(axis.rotates) for axis in self.axes)

    @property
    def joint_order(self) -> str:
        """Axis letters of the joints that there are, from the base outwards."""
        return "".join(at for at in self.mechanism.order if at in self.letters)

    @property
    def chain(self) -> list[int]:
        """The axes that turn a phone, from the base outwards; none of numbers."""
        if self.imu is None:
            return []
        if self.is_arm:
            return list(range(len(self.axes)))
        return [self.letters.index(letter) for letter in self.joint_order]

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """(n, 2) degrees in which candidates are drawn."""
        overshoot = self.motion.approach_overshoot_deg
        return tuple(
            axis.range_deg
            or getattr(self.session, f"{axis.name}_range_deg", None)
            or (axis.min_deg + overshoot, axis.max_deg)
            for axis in self.axes
        )

    @property
    def silence_s(self) -> float:
        """Silence between frames that the slowest of the drives wants."""
        return max(axis.map.inter_frame_s for axis in self.axes)

    @property
    def told(self) -> dict[str, Any]:
        """What a stop of its drives needs, and what whoever moves them keeps to."""
        return {
            "bus": self.bus.model_dump(),
            "silence_s": self.silence_s,
            "standing": False,
            "device": str(self.device_path.resolve()),
            "stand_s": max(axis.map.restart_s for axis in self.axes),
            "drives": [
                {
                    "name": axis.name,
                    "unit": axis.unit,
                    "map": axis.map.text,
                    "folder": str(axis.map.folder),
                    "scale": {name: getattr(axis, name) for name in SCALE},
                    # Counts a second, and a second squared, of its fastest move.
                    "pace": [n * abs(axis.pulses_per_deg) for n in axis.drive_motion],
                }
                for axis in self.axes
            ],
        }

    @property
    def heartbeat_s(self) -> float:
        """How long the motion loop may be silent while something moves: POLLS pauses
        between polls, or a computer's of HICCUP_S, and an exchange that may have to
        connect first."""
        return max(POLLS * self.motion.poll_s, HICCUP_S) + 2.0 * self.bus.timeout_s

    @property
    def comm_timeouts_s(self) -> dict[str, float]:
        """Axis to seconds, of the drives that watch their line: unless configured, the
        heartbeat and one read with all its tries."""
        default = self.heartbeat_s + self._slowest_read_s
        return {
            axis.name: axis.comm_timeout_s or default
            for axis in self.axes
            if axis.map.has("comm_timeout")
        }

    @property
    def _slowest_read_s(self) -> float:
        return self.bus.timeout_s * (self.bus.read_retries + 1)

    def to_pulses(self, angles_deg: Any) -> Pulses:
        """Whole pulses of (n,) degrees."""
        each = zip(self.axes, angles_deg, strict=True)
        return tuple(axis.to_pulses(float(angle)) for axis, angle in each)

    def to_deg(self, pulses: Any) -> "NDArray[np.float64]":
        """(..., n) degrees of (..., n) pulses."""
        import numpy as np  # a third of what `stop` would wait for at its start

        scales = np.array([axis.pulses_per_deg for axis in self.axes])
        return np.asarray(pulses, dtype=np.float64) / scales

    def described(self) -> dict[str, Any]:
        """Every key as JSON, as the journal keeps it; maps are in the fingerprint."""
        no_maps = {"__all__": {"map"}}
        data = self.model_dump(
            exclude={"output": True, "device": True, "axes": no_maps}
        )
        # Those left out too.
        data["session"] |= {"ranges": self.ranges, "k": self.k, "method": self.method}
        return data

    def changed_since(self, start: dict[str, Any]) -> list[str]:
        """Keys that would make a resumed run measure otherwise, in words; ``start`` is
        the first record of its journal."""
        then, now = dict(start["device"]), self.device_fingerprint()
        described = self.described()
        for table, names in MEASURED.items():
            for name in names:
                now[f"{table}.{name}"] = described[table][name]
                then[f"{table}.{name}"] = start["config"][table][name]
        return differences(then, now)

    def device_fingerprint(self) -> dict[str, Any]:
        """Key of rig.toml to value, of all that says which place a pulse count means;
        of a map only what turns counts into places."""
        fingerprint: dict[str, Any] = {}
        for axis in self.axes:
            scale = axis.model_dump(include={*Scale.model_fields, "unit", "rotates"})
            if axis.kind == "rotation":  # as records of before say nothing of it
                del scale["kind"], scale["lead_mm"]
            family = f"{axis.map.name} ({_digest(axis.map.text, PLACES)})"
            values = {"map": family, **scale}
            fingerprint |= {f"axes.{axis.name}.{name}": values[name] for name in values}
        if self.model is not None:
            text = self.model_path.read_bytes() if self.model_path else b""
            digest = hashlib.sha256(text).hexdigest()[:8] if self.model_path else ""
            data = self.model.model_dump() | {"digest": digest}
            fingerprint |= {f"model.{name}": data[name] for name in data}
        if self.imu is None:
            assert self.readings is not None
            data = self.readings.model_dump(mode="json", include=set(SENSOR))
            return fingerprint | {f"readings.{name}": data[name] for name in SENSOR}
        fingerprint["mechanism.order"] = self.mechanism.order
        imu = self.imu.model_dump(mode="json", include=set(PHONE))
        return fingerprint | {f"imu.{name}": imu[name] for name in PHONE}

    def stop_fingerprint(self) -> dict[str, str]:
        """Key to digest of what says how each drive is stopped, and stands."""
        return {
            f"axes.{axis.name}.map, how it is stopped": _digest(axis.map.text, STOPS)
            for axis in self.axes
        }

    def broken_rules(self) -> Iterator[str]:
        session = self.session
        if self.k >= session.candidates:
            yield f"session.k: must be under candidates ({session.candidates})"
        if self.k <= len(self.axes):
            fewest = len(self.axes) + 1
            yield f"session.k: must be at least {fewest} (axes plus one), got {self.k}"
        if (self.imu is None) == (self.readings is None):
            yield "imu: give either [imu] or [readings], not both"
            return
        if self.model is not None:
            yield from self._rules_of_model(self.model)
        by_letters = self.axes if self.imu and not self.is_arm else ()
        for axis in by_letters:
            if axis.kind != "rotation" or axis.rotates is None:
                why = "missing; a phone measures rotations about X, Y, Z"
                yield f"axes.{axis.name}.rotates: {why}"
                return
        letters = [str(axis.rotates) for axis in by_letters]
        if len(set(letters)) < len(letters):
            yield f"axes: rotates must differ between them, got {', '.join(letters)}"
        for middle in by_letters:
            within = -90.0 < middle.min_deg and middle.max_deg < 90.0
            if within or middle.rotates != self.mechanism.order[1]:
                continue
            yield (
                f"axes.{middle.name}: min_deg and max_deg must be between -90 and 90, "
                "the range in which a phone can read the middle axis of "
                f"mechanism.order; got {middle.min_deg:g} and {middle.max_deg:g}"
            )
        for axis, ends in zip(self.axes, self.ranges, strict=True):
            yield from self._rules_of_axis(axis, *ends)

    def _rules_of_axis(self, axis: Axis, low: float, high: float) -> Iterator[str]:
        """Rules of an axis: its speed, pulses, map and the range of its session."""
        motion, overshoot = self.motion, self.motion.approach_overshoot_deg
        slowest = self._slowest_read_s
        at, span = f"axes.{axis.name}", f"session.{axis.name}_range_deg"
        if axis.range_deg or axis.name not in AXIS_NAMES:
            span = f"{at}.{axis.key_of('range_deg')}"
        if axis.speed_deg_s > motion.max_speed_deg_s:
            most = f"at most motion.max_speed_deg_s = {motion.max_speed_deg_s:g}"
            name = axis.key_of("speed_deg_s")
            yield f"{at}.{name}: must be {most}, got {axis.speed_deg_s:g}"
        if abs(1.0 / axis.pulses_per_deg) > motion.position_tolerance_deg:
            yield f"{at}: one pulse is coarser than motion.position_tolerance_deg"
        if axis.comm_timeout_s is not None and axis.comm_timeout_s <= slowest:
            least = f"bus.timeout_s x (read_retries + 1) = {slowest:g} s"
            yield f"{at}.comm_timeout_s: must exceed {least}"
        if motion.mirror_limits and not axis.map.has("limits"):
            lack = f"the map {axis.map.name} of {axis.name} has no limit registers"
            yield f"motion.mirror_limits: {lack}"
        if low >= high:
            yield f"{span}: must be [low, high], got [{low}, {high}]"
        elif low - overshoot < axis.min_deg - 1e-9 or high > axis.max_deg + 1e-9:
            ends = f"[{low}, {high}] with an overshoot of {overshoot}"
            limits = f"[{axis.min_deg}, {axis.max_deg}]"
            yield f"{span}: {ends} exceeds the axis's limits {limits}"

    def _rules_of_model(self, model: settings.ModelSettings) -> Iterator[str]:
        if self.session.k is None:
            yield "session.k: missing; with a [model] give how many postures to measure"
        if not model.urdf:
            return
        for axis in self.axes:
            if axis.kind != "rotation":
                yield f"axes.{axis.name}.kind: must be rotation, of a [model] by urdf"
        if self.imu and model.sensor != "gravity":
            yield "model.sensor: must be gravity: a phone at rest measures gravity"
        if self.readings and len(self.readings.names) != 3:
            count = len(self.readings.names)
            yield f"readings.names: must be 3 for model.sensor, got {count}"


# Files


def load_config(path: str | pathlib.Path) -> RigConfig:
    """Read and check a configuration file; ConfigError lists every fault."""
    return parse_config(read_text(path), pathlib.Path(path).parent, str(path))


def parse_config(
    text: str, folder: pathlib.Path | None = None, source: str = "configuration"
) -> RigConfig:
    """Check the text of a configuration; maps by path are relative to ``folder``."""
    config = parse(RigConfig, text, source, {"folder": folder}, _repeated)
    if set(config.axis_names) == set(AXIS_NAMES):  # written in any order
        axes = sorted(config.axes, key=lambda axis: AXIS_NAMES.index(axis.name))
        config = config.model_copy(update={"axes": tuple(axes)})
    config._folder = folder or pathlib.Path()
    if (path := config.model_path) and not path.is_file():
        assert config.model is not None
        name = "urdf" if config.model.urdf else "factory"
        raise ConfigError(source, [f"model.{name}: there is no file {path}"])
    return config


def _repeated(data: dict[str, Any]) -> Iterator[str]:
    """Names and units that axes share; told even beside other faults."""
    tables = data.get("axes")
    if isinstance(tables, list) and not 1 <= len(tables) <= MOST_AXES:
        yield f"axes: must be 1 to {MOST_AXES} tables, got {len(tables)}"
    for name in ("name", "unit"):
        values = [str(axis[name]) for axis in rows_of(tables) if name in axis]
        if len(set(values)) < len(values):
            yield f"axes: {name} must differ between them, got {', '.join(values)}"


def example_names() -> list[str]:
    """Names of the configurations that ship."""
    return sorted(path.stem for path in EXAMPLES.glob("*.toml"))


def example_text(name: str) -> str:
    """Text of a configuration that ships; ConfigError where none has the name."""
    if name not in example_names():
        raise ConfigError(name, [f"examples are {', '.join(example_names())}"])
    return (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
