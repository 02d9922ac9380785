"""Postures offered: where the sensor reads, within the limits, and none invented."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxcal.models import Board, Gravity, Plane, Position, SerialChain, Socket

from .arms import contacts_of_a_panda, ur5
from .test_serial_chain import _matrix

PANDA, JOINTS, SOCKETS = contacts_of_a_panda("front")


def _panda(sensor):
    return SerialChain.from_urdf(PANDA, tip="ball_link", sensor=sensor)


def _within(arm, commands):
    low, high = arm.limits.T
    joints = commands[:, : arm.num_joints]
    return ((joints >= low - 1e-9) & (joints <= high + 1e-9)).all()


def _apart(joints):
    far = np.abs(joints[:, None] - joints).max(axis=-1)
    return far[np.triu_indices(len(joints), 1)].min()


def test_the_ball_is_in_its_socket_in_many_postures():
    contacts = np.column_stack([np.degrees(JOINTS), SOCKETS])
    arm = _panda(Socket(2)).located(contacts)
    found = arm.postures(60, seed=3)
    assert found.shape == (60, 8) and _within(arm, found)
    assert np.abs(arm.predict(found)).max() < 1e-6
    assert np.bincount(found[:, 7].astype(int)).min() > 15
    assert _apart(found[:, :7]) >= 2.0
    np.testing.assert_array_equal(found, arm.postures(60, seed=3))
    assert not np.array_equal(found, arm.postures(60, seed=4))
    # The sockets one after the other, and no leap that a better order would spare.
    assert (np.diff(found[:, 7]) != 0).sum() == 1
    travel = np.abs(np.diff(found[:, :7], axis=0)).max(axis=1).sum()
    mixed = found[np.random.default_rng(0).permutation(60), :7]
    assert travel < 0.7 * np.abs(np.diff(mixed, axis=0)).max(axis=1).sum()
    near = _panda(Socket()).postures(5, near=arm.sensor.places[:1])
    off = _panda(Position()).predict(near) - arm.sensor.places[0]
    assert near.shape == (5, 7) and np.abs(off).max() < 1e-6


def test_the_tip_is_on_the_plane_and_near_a_point():
    arm = _panda(Plane(1, [[0.0, 0.0, 2.0, 0.3]]))
    found = arm.postures(30)
    points = _panda(Position()).predict(found)
    np.testing.assert_allclose(points[:, 2], 0.3, atol=1e-6)
    assert _within(arm, found)
    around = _panda(Gravity()).postures(10, near=[[0.4, 0.0, 0.5, 0.3]])
    points = _panda(Position()).predict(around)
    assert np.linalg.norm(points - [0.4, 0.0, 0.5], axis=1).max() <= 0.3
    assert _panda(Position()).postures(7).shape == (7, 7)


def test_the_board_is_in_view():
    place = _matrix(Rotation.from_euler("x", 180.0, degrees=True), [0.5, 0.0, 0.0])
    arm = SerialChain.from_urdf(PANDA, tip="ball_link", sensor=Board("camera", place))
    found = arm.postures(100)  # of some 8,000 that are tried
    np.testing.assert_allclose(arm.predict(found), 0.0, atol=1e-9)
    where = found[:, 7:10]
    assert (where[:, 2] > 0.9 * np.linalg.norm(where, axis=1)).all()


def test_what_is_not_allowed_is_left_out():
    found = _panda(Position()).postures(20, allowed=lambda q: q[0] > 0.0)
    assert (found[:, 0] > 0.0).all()


@pytest.mark.parametrize(
    ("arm", "given", "message"),
    [
        (
            _panda(Socket()),
            {"near": [[3.0, 0, 0]]},
            "no posture reaches near = .* cannot reach it within .* unit of the arm's",
        ),
        (_panda(Position()), {"allowed": lambda q: False}, "are not allowed"),
        (_panda(Socket()), {}, "near is missing: the rough place of each socket"),
        (_panda(Board()), {}, r"place is missing, Board\(place=...\)"),
        (_panda(Board()), {"near": [[0.5, 0, 0, 1]]}, "unknown and near does not give"),
        (_panda(Position()), {"near": [[0, 0, 0]]}, r"rows \(x, y, z, radius\)"),
        (ur5(), {"count": 0}, "count must be at least 1"),
        (
            SerialChain.from_dh([(0, 0, 0, 0)], joints="P"),
            {},
            "the limits of sliding joints",
        ),
        (
            SerialChain.from_dh([(1.0, 0, 0, 0)], limits=[[0.0, 5.0]]),
            {"count": 9},
            "count must be at most 2 for this arm .* got 9: .* too close to another",
        ),
    ],
)
def test_a_count_that_cannot_be_reached_is_said_with_the_reason(arm, given, message):
    with pytest.raises(ValueError, match=message):
        arm.postures(given.pop("count", 4), **given)
