"""Joint states at rest from bags that rosbags itself writes."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.arms.files.recordings import rests
from jaxcal.models import (
    Board,
    Distance,
    Recording,
    SerialChain,
    Servos,
    Socket,
    Wrench,
)

from .arms import CONTACTS

PANDA = SerialChain.from_urdf(CONTACTS / "panda.urdf", tip="ball_link")
POSTURES = np.random.default_rng(0).uniform(-60.0, 60.0, (4, 7))


def _recorded():
    """Times and joints in degrees: a second at each posture, a second between two."""
    rng = np.random.default_rng(1)
    moves = [POSTURES[0]] * 50
    for one, two in itertools.pairwise(POSTURES):
        moves += [*np.linspace(one, two, 50), *[two] * 50]
    joints = np.array(moves)
    return 0.02 * np.arange(len(joints)), joints + 0.002 * rng.normal(size=joints.shape)


def test_postures_at_rest_are_found_and_moves_are_not():
    found = rests(*_recorded(), seconds=0.5, within=0.05)[0]
    np.testing.assert_allclose(found, POSTURES, atol=0.03)
    times, joints = _recorded()
    still = np.repeat(joints[:1], len(joints), axis=0)
    assert len(rests(times, still, 0.5, 0.05)[0]) == 1
    assert len(rests(times[:10], joints[:10], 0.5, 0.05)[0]) == 0


@pytest.mark.parametrize("rate", [50, 250, 1000])
@pytest.mark.parametrize("spread", [0.0, 0.002, 0.03, 0.1])
def test_encoders_that_jitter_still_rest(spread, rate):
    """Eight rests of a second; moves of .6 degrees a second are none, but of noise."""
    rng = np.random.default_rng(0)
    slow = 0.6 if spread < 0.1 else 6.0
    postures = np.cumsum(slow * rng.uniform(1.0, 1.7, (8, 7)), axis=0)
    moves = [postures[0]] * rate
    for one, two in itertools.pairwise(postures):
        moves += [*np.linspace(one, two, rate), *[two] * rate]
    joints = np.array(moves)
    joints = joints + spread * rng.normal(size=joints.shape)
    found, spans = rests(np.arange(len(joints)) / rate, joints, 0.5, None)
    assert len(found) == 8
    np.testing.assert_allclose(found, postures, atol=0.03 + 0.6 * spread)
    np.testing.assert_allclose(spans[:, 0], 2.0 * np.arange(8), atol=0.6)


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_bag_is_read_by_the_names_of_the_joints(plugin, tmp_path):
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state = store.types["sensor_msgs/msg/JointState"]
    header = store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    order = [3, 0, 6, 1, 5, 2, 4]
    names = [*(PANDA.joint_names[i] for i in order), "finger"]
    none = np.zeros(0)
    with Writer(
        tmp_path / "bag", version=9, storage_plugin=StoragePlugin[plugin]
    ) as bag:
        topic = bag.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for time, row in zip(*_recorded(), strict=True):
            position = np.append(np.radians(row[order]), 0.04)
            message = state(header(stamp(0, 0), ""), names, position, none, none)
            raw = store.serialize_cdr(message, state.__msgtype__)
            bag.write(topic, int(1e9 * time), raw)
    np.testing.assert_allclose(PANDA.at_rest(tmp_path / "bag"), POSTURES, atol=0.03)
    other = SerialChain.from_dh([(0, 0, 1, 0)], joint_names=["elbow"])
    with pytest.raises(
        ValueError, match=r"must contain joint states of elbow, got finger"
    ):
        other.at_rest(tmp_path / "bag")


def wrench(types, header, value):
    vector = types["geometry_msgs/msg/Vector3"]
    both = types["geometry_msgs/msg/Wrench"](vector(*value[:3]), vector(*value[3:]))
    return types["geometry_msgs/msg/WrenchStamped"](header, both)


def pose(types, header, value):
    turn = Rotation.from_rotvec(value[3:], degrees=True).as_quat()
    at = types["geometry_msgs/msg/Point"](*value[:3])
    whole = types["geometry_msgs/msg/Pose"](
        at, types["geometry_msgs/msg/Quaternion"](*turn)
    )
    return types["geometry_msgs/msg/PoseStamped"](header, whole)


def distance(types, header, value):
    return types["sensor_msgs/msg/Range"](header, 0, 0.0, 0.0, 9.0, float(value[0]))


def write_bag(folder, joints, forces, made=wrench):
    """A second at each posture with its reading, a second of motion between two."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    none, stamp = np.zeros(0), types["builtin_interfaces/msg/Time"](0, 0)
    header = types["std_msgs/msg/Header"](stamp, "")
    state = types["sensor_msgs/msg/JointState"]
    of_reading = made(types, header, np.zeros(6)).__msgtype__
    with Writer(folder, version=9) as bag:
        states, read = (
            bag.add_connection(topic, each, typestore=store)
            for topic, each in (
                ("/joint_states", state.__msgtype__),
                ("/read", of_reading),
            )
        )
        for i in range(20 * (2 * len(joints) - 1)):
            part, at = divmod(i, 20)
            one, two = joints[part // 2], joints[(part + 1) // 2]
            posture = np.radians(one + (two - one) * at / 20.0)
            force = forces[part // 2] + (100.0 if part % 2 else 0.01 * (-1) ** i)
            message = state(header, list(PANDA.joint_names), posture, none, none)
            raw = store.serialize_cdr(message, state.__msgtype__)
            bag.write(states, 50_000_000 * i, raw)
            raw = store.serialize_cdr(made(types, header, force), of_reading)
            bag.write(read, 50_000_000 * i + 1, raw)


def test_what_is_no_recording_is_refused_in_one_line(tmp_path):
    pytest.importorskip("rosbags")
    (folder := tmp_path / "folder").mkdir()
    (broken := tmp_path / "broken.mcap").write_text("no bag")
    for path, message in (
        (folder, r"folder must be a ROS bag.* or a LeRobot dataset"),
        (broken, r"broken\.mcap cannot be read as a ROS bag: [^\n]+$"),
    ):
        with pytest.raises(ValueError, match=message):
            PANDA.at_rest(path)


def test_a_recording_is_identified_and_checked_as_its_table_is(tmp_path):
    arm = PANDA.measured_with(Wrench())
    joints = np.random.default_rng(3).uniform(-60.0, 60.0, (8, 7))
    joints[:, [3, 5]] += [-65.0, 100.0]
    theta = arm.nominal.copy()
    own = arm.names.index("mass")
    theta[own : own + 10] = [1.4, 0.01, 0.02, 0.05, 3.0, -2.0, 1.0, 0.1, 0.2, -0.1]
    read = arm.predict(joints, theta)
    read += 0.02 * np.random.default_rng(0).normal(size=read.shape)
    write_bag(tmp_path / "bag", joints, read)
    found = jaxcal.identify(tmp_path / "bag", model=arm)
    table = jaxcal.identify(joints, read, model=arm)
    np.testing.assert_allclose(found.parameters, table.parameters, atol=2e-3)
    assert found.input_names == arm.joint_names
    assert found.check(tmp_path / "bag").says == table.check(joints, read).says
    recording = Recording(tmp_path / "bag", topic="/other")
    with pytest.raises(
        ValueError, match="one topic of geometry_msgs/msg/WrenchStamped"
    ):
        jaxcal.identify(recording, model=arm)
    touching = PANDA.measured_with(Socket(2))
    with pytest.raises(ValueError, match="socket of each of the 8 rests, got 2"):
        touching.recorded(Recording(tmp_path / "bag", which=[0, 1]))
    commands, zeros = touching.recorded(Recording(tmp_path / "bag", which=[0, 1] * 4))
    np.testing.assert_allclose(commands[:, :7], joints, atol=1e-9)
    np.testing.assert_array_equal(commands[:, 7], [0, 1] * 4)
    assert not zeros.any()
    with pytest.raises(ValueError, match="measured is missing"):
        jaxcal.identify(joints, model=arm)


def test_views_of_a_board_and_lengths_of_a_wire_are_recorded(tmp_path):
    joints = np.random.default_rng(5).uniform(-60.0, 60.0, (4, 7))
    joints[:, [3, 5]] += [-65.0, 100.0]
    seen = np.random.default_rng(6).uniform(-0.4, 0.4, (4, 6)) * [1, 1, 1, 99, 99, 99]
    seeing = PANDA.measured_with(Board("camera"))
    write_bag(tmp_path / "board", joints, seen, pose)
    commands, zeros = seeing.recorded(Recording(tmp_path / "board"))
    np.testing.assert_allclose(commands, np.hstack([joints, seen]), atol=1e-2)
    assert zeros.shape == (4, 6) and not zeros.any()
    write_bag(tmp_path / "wire", joints, np.arange(1.0, 5.0)[:, None], distance)
    drawn = PANDA.measured_with(Distance(2))
    commands, lengths = drawn.recorded(Recording(tmp_path / "wire", which=[0, 1, 0, 1]))
    np.testing.assert_array_equal(commands[:, 7], [0, 1, 0, 1])
    np.testing.assert_allclose(lengths[:, 0], np.arange(1.0, 5.0), atol=1e-3)


MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SO = SerialChain.from_dh(  # the size of an SO-101
    [(0.03, 90, 0.12, 0), (0.116, 0, 0, 0), (0.135, 0, 0, 0), (0, 90, 0, 90),
     (0, 0, 0.06, 0)],
    tool=(0.02, 0.0, 0.1),
    joint_names=MOTORS,
)  # fmt: skip


def _calibration(folder):
    """As lerobot-calibrate writes it; the middle motor of an odd range."""
    content = {
        name: {"id": i + 1, "drive_mode": i % 2, "homing_offset": 100 - 300 * i,
               "range_min": 700 + 11 * i, "range_max": 3400 - 7 * i}
        for i, name in enumerate((*MOTORS, "gripper"))
    }  # fmt: skip
    (folder / "so101.json").write_text(json.dumps(content, indent=4))
    return folder / "so101.json", content


@pytest.mark.slow
@pytest.mark.parametrize(("version", "degrees"), [("v2.1", True), ("v3.0", False)])
def test_a_lerobot_dataset_is_read_in_either_unit(version, degrees, tmp_path):
    """Oracle: the steps of each motor, by LeRobot's two formulas written out."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    path, content = _calibration(tmp_path)
    rng = np.random.default_rng(2)
    steps = rng.integers(1000, 3000, (6, 6)).astype(float)
    rows, truth = [], []
    for row in steps:
        normal, angles = [], []
        for step, motor in zip(row, content.values(), strict=True):
            low, high = motor["range_min"], motor["range_max"]
            value = (step - low) / (high - low) * 200.0 - 100.0
            normal.append(-value if motor["drive_mode"] else value)
            angles.append((step - (low + high) / 2.0) * 360.0 / 4095.0)
        rows.append(angles if degrees else normal)
        truth.append(angles)
    names = [f"{name}.pos" for name in content]
    info = {"codebase_version": version, "fps": 30, "features": {
        "observation.state": {"dtype": "float32", "shape": [6], "names":
            names if version == "v3.0" else {"motors": [f"main_{n}" for n in content]}},
    }}  # fmt: skip
    (tmp_path / "set" / "meta").mkdir(parents=True)
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps(info))
    folder = tmp_path / "set" / "data" / "chunk-000"
    folder.mkdir(parents=True)
    count = 30
    for episode in (0, 1):
        part = np.repeat(rows[3 * episode : 3 * episode + 3], count, axis=0)
        table = pyarrow.table({
            "observation.state": pyarrow.array(
                list(part.astype(np.float32)), pyarrow.list_(pyarrow.float32())),
            "timestamp": pyarrow.array(np.arange(3 * count) / 30.0, pyarrow.float32()),
            "episode_index": np.full(3 * count, episode),
        })  # fmt: skip
        parquet.write_table(table, folder / f"episode_{episode:06d}.parquet")
    recording = Recording(tmp_path / "set", servos=None if degrees else path)
    found, none = SO.recorded(recording)
    np.testing.assert_allclose(found, np.array(truth)[:, :5], atol=1e-4)
    assert none is None
    other = Recording(tmp_path / "set", names={"wrist_roll": "wrist"})
    with pytest.raises(ValueError, match=r"observation\.state of .*, wrist, got "):
        SO.recorded(other)


def test_zeros_of_joints_are_written_for_lerobot(tmp_path):
    """What its motors read then is where the joints are, by LeRobot's formula."""
    path, content = _calibration(tmp_path)
    rng = np.random.default_rng(4)
    off = dict(zip(MOTORS[1:4], [3.0, -2.0, 4.0], strict=True))
    theta = SO.nominal.copy()
    for name, degrees in off.items():
        theta[SO.names.index(f"theta{MOTORS.index(name) + 1}")] += degrees
    joints = rng.uniform(-60.0, 60.0, (25, 5))
    read = SO.predict(joints, theta) + 2e-4 * rng.normal(size=(25, 3))
    found = jaxcal.identify(joints, read, model=SO)
    with pytest.warns(
        UserWarning, match="zeros of the joints only: cross-validated error"
    ):
        moved = found.to_lerobot(tmp_path / "new.json", path)
    old, new = Servos.load(path), Servos.load(tmp_path / "new.json")
    for name, motor in new.motors.items():
        was = old.motors[name]
        assert was["range_min"] <= motor["range_min"] < motor["range_max"]
        assert motor["range_max"] <= was["range_max"]
        assert motor["homing_offset"] == was["homing_offset"]
        middles = [
            sum(m[k] for k in ("range_min", "range_max")) / 2 for m in (was, motor)
        ]
        ahead = (middles[0] - middles[1]) * 360.0 / 4095.0  # of any reading
        assert ahead == pytest.approx(off.get(name, 0.0), abs=0.25), name
    assert moved["elbow_flex"] == pytest.approx(2.0 * 4095 / 360, abs=3)
    assert new.motors["gripper"] == content["gripper"]
    with pytest.raises(FileExistsError):
        found.to_lerobot(tmp_path / "new.json", path)
    with pytest.raises(
        ValueError, match="zero of motor wrist_flex must be near the mid"
    ):
        old.moved({"wrist_flex": 80.0})
    path.write_text(json.dumps({"elbow_flex": {"id": 1}}))
    with pytest.raises(
        ValueError, match=r"so101.json: motor elbow_flex must have id, "
    ):
        Servos.load(path)
