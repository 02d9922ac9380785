"""What a robot recorded, in a bag or LeRobot dataset, and LeRobot's servo files."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.checks import Array, in_words, numbers
from jaxcal.extras import needs
from jaxcal.files import AnyPath, write_over
from jaxcal.models.model import Recording, as_parameters

if TYPE_CHECKING:
    from jaxcal.arms.chain import SerialChain as Chain

_WITHIN = 0.05  # degrees in which a resting joint stays
_JITTER = 8.0  # standard deviations: no reading of a joint at rest is farther apart
_STATES = "sensor_msgs/msg/JointState"


def at_rest(
    arm: Chain, path: AnyPath, *, seconds: float = 0.5, within: float | None = None
) -> Array:
    """Postures (N, J) at which a recorded arm stood still, in their order.

    Args:
        path, seconds, within: as of ``Recording``.

    Raises:
        ValueError: the arm never stood still; it says how the joints jitter.
    """
    return _rests_of(arm, Recording(path, seconds=seconds, within=within))[0]


def recorded(arm: Chain, recording: Recording) -> tuple[Array, Array | None]:
    """Commands (N, n) and readings (N, q) of a recording, the mean of each rest.

    Readings are zeros of contacts and of poses of a board, which stand in the commands,
    and None where no message holds them (corners' pixels) or of a LeRobot dataset.
    """
    sensor = arm.sensor
    views = sensor.views and sensor.zeros
    if not views and tuple(sensor.inputs) not in ((), (sensor.kind,)):
        raise ValueError(
            f"commands of a {sensor.kind} need {', '.join(sensor.inputs)}, which no "
            "recording has; pass the postures of at_rest"
        )
    pixels = sensor.views and not views
    commands, read = _rests_of(arm, recording, "" if pixels else sensor.kind)
    matrices = np.zeros((len(commands), 3, 3))
    if read is not None and (views or arm.fitting.relative):
        matrices = read[:, 3:].reshape(-1, 3, 3).swapaxes(1, 2)
    if views:
        if read is None:
            raise ValueError(f"{recording.path} has no board poses")
        turns = Rotation.from_matrix(matrices).as_rotvec(degrees=True)
        commands = np.column_stack([commands, read[:, :3], turns])
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
    if read is not None and arm.fitting.relative:
        read = np.hstack([read[:, :3], arm.rotation_vectors(commands, matrices)])
    return commands, read


def _rests_of(
    arm: Chain, recording: Recording, kind: str = ""
) -> tuple[Array, Array | None]:
    """Means of the joints (N, J) where the arm stood still, in degrees and lengths, and
    of the messages (N, r) for a ``kind`` of sensor, None for ""."""
    names, turning = arm.joint_names, np.array(arm.command_units) == "deg"
    columns = [recording.names.get(name, name) for name in names]
    path, messages = pathlib.Path(recording.path), None
    if (path / "meta" / "info.json").is_file():
        parts = _dataset(path, columns, recording.servos)
    else:
        if recording.servos is not None:
            raise ValueError(f"servos needs a LeRobot dataset: {path} is none")
        times, joints, messages = _bag(path, columns, kind, recording.topic)
        parts = [(times, np.where(turning, np.degrees(joints), joints))]
    both = [rests(*part, recording.seconds, recording.within) for part in parts]
    postures, spans = (np.concatenate(of_parts) for of_parts in zip(*both, strict=True))
    if not len(postures):
        raise ValueError(
            f"{path} has no {recording.seconds:g} s of rest: the joints jitter by "
            f"{in_words(jitter(parts[0][1]).round(4))}; change what counts as rest "
            "with seconds= and within="
        )
    if messages is None:
        return postures, None
    at, values = messages
    there = [(at >= first) & (at <= last) for first, last in spans]
    for number, rows in enumerate(there):
        if not rows.any():
            raise ValueError(f"{path}: rest {number} has no reading of the sensor")
    return postures, np.array([values[rows].mean(axis=0) for rows in there])


def _vector(part: Any) -> list[float]:
    return [part.x, part.y, part.z]


def _pose(message: Any) -> list[float]:
    """Position, then the columns of its rotation, whose mean is nearly one."""
    at, turn = message.pose.position, message.pose.orientation
    matrix = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    return [*_vector(at), *matrix.T.ravel().tolist()]


# Of a sensor's kind the messages that hold its readings, the first that a bag has.
_MESSAGES: dict[str, dict[str, Callable[[Any], list[float]]]] = {
    "position": {
        "geometry_msgs/msg/PointStamped": lambda each: _vector(each.point),
        "geometry_msgs/msg/PoseStamped": lambda each: _vector(each.pose.position),
    },
    "pose": {"geometry_msgs/msg/PoseStamped": _pose},
    "board": {"geometry_msgs/msg/PoseStamped": _pose},
    "distance": {
        "sensor_msgs/msg/Range": lambda each: [each.range],
        "std_msgs/msg/Float64": lambda each: [each.data],
    },
    "gravity": {"sensor_msgs/msg/Imu": lambda each: _vector(each.linear_acceleration)},
    "wrench": {
        "geometry_msgs/msg/WrenchStamped": lambda each: [
            *_vector(each.wrench.force),
            *_vector(each.wrench.torque),
        ]
    },
}


def _bag(
    path: pathlib.Path, names: Sequence[str], kind: str, topic: str
) -> tuple[Array, Array, tuple[Array, Array] | None]:
    """Times (T,) and joints (T, J) in radians, metres; times and values of messages."""
    times, rows, at, values = [], [], [], []
    joints_met: set[str] = set()
    with _opened(path) as bag:
        types = _MESSAGES.get(kind, {})
        connections = [c for c in bag.connections if topic in ("", c.topic)]
        there = [c for msgtype in types for c in connections if c.msgtype == msgtype]
        there = [c for c in there if c.msgtype == there[0].msgtype]
        topics = sorted({c.topic for c in there})
        if types and len(topics) != 1:
            listed = ", ".join(topics) or f"none with topic {topic or '(any)'}"
            raise ValueError(
                f"{path} must hold one topic of {' or '.join(types)}, got {listed}"
                + ("; topic= names one" if topics else "")
            )
        states = [c for c in bag.connections if c.msgtype == _STATES]
        for connection, time, raw in bag.messages(connections=[*states, *there]):
            message = bag.deserialize(raw, connection.msgtype)
            if connection.msgtype != _STATES:
                at.append(1e-9 * time)
                values.append(types[connection.msgtype](message))
                continue
            joints = dict(zip(message.name, message.position, strict=False))
            joints_met |= joints.keys()
            if joints.keys() >= set(names):
                times.append(1e-9 * time)
                rows.append([joints[name] for name in names])
    if not rows:
        raise ValueError(
            f"{path} must contain joint states of {', '.join(names)}, got "
            f"{', '.join(sorted(joints_met)) or 'none'}"
        )
    messages = (np.array(at), np.array(values)) if types else None
    return np.array(times), np.array(rows), messages


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[Any]:
    with needs("ros", "reading a rosbag"):
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    path.stat()  # raises where there is none
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise ValueError(
            f"{path} must be a ROS bag (a folder with metadata.yaml) or a LeRobot "
            "dataset (a folder with meta/info.json)"
        )
    try:
        with AnyReader([path], default_typestore=store) as bag:
            yield bag
    except AnyReaderError as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{path} cannot be read as a ROS bag: {reason}") from error


def _dataset(
    path: pathlib.Path, names: Sequence[str], servos: Any
) -> list[tuple[Array, Array]]:
    """Times (T,) and joints (T, J) in degrees of each episode of a LeRobot dataset.

    Of versions 2 and 3, its columns named by ``meta/info.json``.
    """
    with needs("lerobot", "reading a LeRobot dataset"):
        from pyarrow import parquet
    info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8-sig"))
    feature = info.get("features", {}).get("observation.state", {})
    columns = feature.get("names") or []
    if isinstance(columns, dict):
        columns = [name for part in columns.values() for name in part]
    columns = [name.removesuffix(".pos").removeprefix("main_") for name in columns]
    missing = [name for name in names if name not in columns]
    if missing:
        raise ValueError(
            f"{path} must hold observation.state of {', '.join(names)}, got "
            f"{', '.join(columns) or 'none'}"
        )
    files = sorted((path / "data").rglob("*.parquet"))
    wanted = ["episode_index", "timestamp", "observation.state"]
    read = [parquet.read_table(file, columns=wanted).to_pydict() for file in files]
    episodes, times, states = (
        [row for table in read for row in table[key]] for key in wanted
    )
    if not states:
        raise ValueError(f"{path} must hold data/**/*.parquet, got none")
    values = np.array(states, dtype=np.float64)[:, [columns.index(n) for n in names]]
    if servos is not None:
        values = Servos.load(servos).degrees(names, values)
    elif np.abs(values).max() > 360.0:
        raise ValueError(
            f"{path}: joints must be in degrees, got {np.abs(values).max():g}"
        )
    which, at = np.array(episodes), np.array(times, dtype=np.float64)
    return [(at[which == i], values[which == i]) for i in np.unique(which)]


def jitter(joints: Array) -> Array:
    """(J,) standard deviation of what a resting joint reads, of joints (T, J).

    The median of second differences: neither steady motion nor a few jerks count.
    """
    if len(joints) < 3:
        return np.zeros(joints.shape[1])
    second = joints[2:] - 2.0 * joints[1:-1] + joints[:-2]
    return np.asarray(np.median(np.abs(second), axis=0) / (0.6745 * np.sqrt(6.0)))


def rests(
    times: Array, joints: Array, seconds: float, within: float | None
) -> tuple[Array, Array]:
    """(N, J) means of the stretches of ``seconds`` or more that stay ``within``, and
    (N, 2) from when to when.

    By default within 0.05, or eight times what the joint jitters by; the first and the
    last third of a stretch then agree, so a slow motion is no rest. A stretch at the
    posture of the one before is the same rest.
    """
    noise = jitter(joints)
    most = np.full(joints.shape[1], _WITHIN if within is None else within)
    if within is None:
        most = np.maximum(most, _JITTER * noise)
    resting: list[Array] = []
    spans: list[tuple[float, float]] = []
    first, low, high = 0, joints[0], joints[0]
    for i in range(1, len(joints) + 1):
        if i < len(joints):
            wider = np.minimum(low, joints[i]), np.maximum(high, joints[i])
            if (wider[1] - wider[0] <= most).all():
                low, high = wider
                continue
        stretch = joints[first:i]
        if times[i - 1] - times[first] >= seconds:
            third = -(-len(stretch) // 3)
            drift = stretch[-third:].mean(axis=0) - stretch[:third].mean(axis=0)
            slack = _WITHIN + 4.0 * noise * np.sqrt(2.0 / third)
            still = within is not None or (np.abs(drift) <= slack).all()
            mean = stretch.mean(axis=0)
            again = resting and (np.abs(mean - resting[-1]) <= 2.0 * most).all()
            if still and not again:
                resting.append(mean)
                spans.append((times[first], times[i - 1]))
        if i < len(joints):
            first, low, high = i, joints[i], joints[i]
    means = np.array(resting).reshape(-1, joints.shape[1])
    return means, np.array(spans).reshape(-1, 2)


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
            given = motor if isinstance(motor, Mapping) else {}
            if not all(isinstance(given.get(key), int) for key in _KEYS):
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
    def load(cls, path: AnyPath, resolution: int = 4096) -> Self:
        """Read the file that ``lerobot-calibrate`` wrote."""
        try:
            content = json.loads(pathlib.Path(path).read_text(encoding="utf-8-sig"))
            if not isinstance(content, dict):
                raise ValueError("it must hold motors by name")
            return cls(content, resolution)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    def save(self, path: AnyPath, *, force: bool = False) -> None:
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
    path: AnyPath,
    parameters: ArrayLike,
    servos: AnyPath,
    names: Mapping[str, str],
    *,
    force: bool = False,
) -> dict[str, int]:
    """Write LeRobot's calibration file with the turning joints' zeros of ``parameters``
    (p,); arguments and what returns as of ``ArmCalibration.to_lerobot``."""
    theta = as_parameters(arm, parameters)
    zeros = (theta - arm.nominal)[: arm.table.size].reshape(arm.table.shape)[:, 3]
    ahead = {}
    for k, name in enumerate(arm.joint_names):
        moved = np.flatnonzero(arm.drive[:, k])
        if arm.command_units[k] == "deg" and len(moved) == 1:
            by_column = arm.drive[moved[0], k]
            ahead[names.get(name, name)] = zeros[moved[0]] / by_column
    old = Servos.load(servos)
    new = old.moved(ahead)
    new.save(path, force=force)
    return {name: round(new.middle(name) - old.middle(name)) for name in ahead}
