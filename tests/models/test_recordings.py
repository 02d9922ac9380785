"""Joint states at rest from bags that rosbags itself writes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from jaxcal.models import SerialChain
from jaxcal.models.serial.recordings import at_rest

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
    found = at_rest(*_recorded(), seconds=0.5, within=0.05)
    np.testing.assert_allclose(found, POSTURES, atol=0.03)
    times, joints = _recorded()
    still = np.repeat(joints[:1], len(joints), axis=0)
    assert len(at_rest(times, still, 0.5, 0.05)) == 1
    assert len(at_rest(times[:10], joints[:10], 0.5, 0.05)) == 0


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
    found = at_rest(np.arange(len(joints)) / rate, joints, 0.5, None)
    assert len(found) == 8
    np.testing.assert_allclose(found, postures, atol=0.03 + 0.6 * spread)


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
        ValueError, match=r"must hold joint states of elbow, got finger"
    ):
        other.at_rest(tmp_path / "bag")
