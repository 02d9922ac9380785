"""Commands and readings of another convention are named with the remedy."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.models import Pose, SerialChain
from tests.models.arms import CONTACTS

UR = [
    (0, 90, 0.1625, 0),
    (-0.425, 0, 0, 0),
    (-0.3922, 0, 0, 0),
    (0, 90, 0.1333, 0),
    (0, -90, 0.0997, 0),
    (0, 0, 0.0996, 0),
]
JOINTS = np.random.default_rng(0).uniform(-120.0, 120.0, (30, 6))


def test_a_tool_frame_that_is_turned_on_the_flange_is_named():
    arm, tool = SerialChain.from_dh(UR, sensor=Pose()), np.eye(4)
    tool[:3, :3] = Rotation.from_rotvec([0, 90, 0], degrees=True).as_matrix()
    turned = SerialChain.from_dh(UR, tool=tool, sensor=Pose())
    axes = turned.rotations(JOINTS, np.zeros((30, 3)))
    places = turned.predict(JOINTS)[:, :3]
    read = np.hstack([places, arm.rotation_vectors(JOINTS, axes)])
    with pytest.raises(ValueError, match=r"by 90 degrees on the flange.*\(0, 90, 0\)"):
        jaxcal.identify(JOINTS, read, model=arm)
    right = np.hstack([places, turned.rotation_vectors(JOINTS, axes)])
    right += np.random.default_rng(1).normal(0.0, 1e-4, right.shape)
    with warnings.catch_warnings(action="ignore"):
        assert jaxcal.identify(JOINTS, right, model=turned).verdict.explains


def test_joints_that_never_move_are_named():
    arm = SerialChain.from_dh(UR)
    with pytest.raises(ValueError, match="the same in all 10 rows"):
        jaxcal.identify(
            np.repeat(JOINTS[:1], 10, axis=0), arm.predict(JOINTS[:10]), model=arm
        )


def test_joints_in_0_to_360_are_named():
    arm = SerialChain.from_urdf(CONTACTS / "panda.urdf", tip="ball_link")
    joints = np.tile([0.0, 0, 0, -90, 0, 90, 0], (20, 1))
    joints += np.random.default_rng(0).uniform(-40, 40, (20, 7))
    read = arm.predict(joints)
    joints[:, 0] %= 360.0
    with pytest.raises(ValueError, match="in 0 to 360: subtract 360"):
        jaxcal.identify(joints, read, model=arm)


def test_lengths_that_cancel_are_no_length_of_the_arm():
    plain = SerialChain.from_dh(UR)
    table = np.array(UR, dtype=float)
    table[1, 2], table[2, 2] = 374.0, -374.0
    with pytest.warns(UserWarning, match="d2 = 374 cancels with another length"):
        factory = SerialChain.from_dh(table)
    assert factory.length == pytest.approx(plain.length)
    assert factory.default_prior().std[0] == pytest.approx(plain.default_prior().std[0])


def test_the_kinematics_file_of_universal_robots_is_read_as_it_is_written(tmp_path):
    rng, arm = np.random.default_rng(0), SerialChain.from_dh(UR)
    theta = arm.nominal.copy()
    theta[:30] += 1e-3 * rng.normal(size=30)
    arm.write("ur", tmp_path / "ur.yaml", theta)
    read = SerialChain.from_ur_kinematics(tmp_path / "ur.yaml")
    expected = arm.calibrated(theta)
    # The last row's lengths are a tool's, which the file does not hold.
    flange = SerialChain.from_dh(
        np.vstack([expected.table[:5], expected.table[5] * [0, 0, 1, 1, 0]])
    )
    assert np.abs(read.predict(JOINTS) - flange.predict(JOINTS)).max() < 1e-12
    (tmp_path / "other.yaml").write_text("kinematics:\n  shoulder:\n    x: 0\n")
    with pytest.raises(ValueError, match="shoulder needs x, y, z, roll"):
        SerialChain.from_ur_kinematics(tmp_path / "other.yaml")
