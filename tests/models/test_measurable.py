"""Postures that can be measured: looked at by projections and lines of this file."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxcal.models import Board, SerialChain, Socket

from .arms import CONTACTS, ur5

NEAR = [[-400.0, 200.0, 50.0], [-400.0, 250.0, 50.0]]
CORNERS = np.array([[30.0 * x, 30.0 * y, 0.0] for x in range(6) for y in range(5)])
CAMERA = (1280.0, 960.0, 900.0, 900.0, 640.0, 480.0)
PLACE = np.eye(4)
PLACE[:3, 3] = [-550.0, 100.0, 0.0]
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("zx", [180.0, 8.0], degrees=True).as_matrix()
MOUNT[:3, 3] = [20.0, -60.0, 45.0]


def _frames(arm, joints, parameters):
    """(N, 4, 4) of the tip, by the table's matrices written out."""
    rows = parameters[: arm.table.size].reshape(-1, 5)
    frames = np.repeat(np.eye(4)[None], len(joints), axis=0)
    for (a, alpha, d, theta, beta), angle in zip(rows, joints.T, strict=True):
        link = np.repeat(np.eye(4)[None], len(joints), axis=0)
        turn = Rotation.from_euler("z", angle[:, None] + theta, degrees=True)
        bend = Rotation.from_euler("XY", [alpha, beta], degrees=True).as_matrix()
        link[:, :3, :3] = turn.as_matrix() @ bend
        link[:, :3, 3] = turn.apply([a, 0.0, d])
        frames = frames @ link
    return frames @ arm.tool


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_views_hold_the_whole_board_from_its_printed_side(side, seed):
    """By a camera whose focal length is off by a tenth, on an arm that is off."""
    sensor = Board("camera", PLACE, CORNERS, CAMERA[2:], side)
    arm = ur5(sensor=sensor)
    arm = SerialChain.from_dh(arm.table, tool=MOUNT, sensor=sensor)
    joints = arm.postures(40, seed=seed, camera=CAMERA, tilt=40.0)
    rng, truth = np.random.default_rng(seed), arm.nominal.copy()
    std = np.asarray(arm.default_prior().std)[: arm.table.size]
    truth[: arm.table.size] += std * rng.normal(size=len(std))
    seen = np.linalg.inv(_frames(arm, joints, truth)) @ PLACE
    spots = CORNERS @ np.matrix_transpose(seen[:, :3, :3]) + seen[:, None, :3, 3]
    for times in (0.9, 1.1):
        pixels = times * 900.0 * spots[..., :2] / spots[..., 2:] + [640.0, 480.0]
        inside = (spots[..., 2] > 0.0) & (pixels > 0.0).all(axis=-1)
        inside &= (pixels < [1280.0, 960.0]).all(axis=-1)
        assert inside.all(axis=1).mean() >= 0.95
    towards = -(seen[:, :3, 2] * seen[:, :3, 3]).sum(axis=1)
    assert (side * towards > 0.0).all()


def test_the_printed_side_is_known_from_views():
    exact = SerialChain.from_dh(
        ur5().table,
        tool=MOUNT,
        sensor=Board("camera", PLACE, CORNERS, CAMERA[2:], -1.0),
    )
    joints = exact.postures(5, camera=CAMERA, seed=1)
    unknown = exact.measured_with(Board("camera", None, CORNERS, CAMERA[2:]))
    found = unknown.located(joints, exact.predict(joints))
    assert found.sensor.side == -1.0
    more = found.postures(10, camera=(70.0, 55.0), distance=(200.0, 700.0))
    seen = np.linalg.inv(_frames(exact, more, exact.nominal)) @ PLACE
    assert ((seen[:, :3, 2] * seen[:, :3, 3]).sum(axis=1) > 0.0).all()


def test_corners_outside_the_picture_are_named():
    wide = Board("camera", PLACE, CORNERS, CAMERA)
    arm = SerialChain.from_dh(ur5().table, tool=MOUNT, sensor=wide)
    joints = arm.postures(8, seed=2)  # by the sensor's own camera
    pixels = arm.predict(joints).reshape(8, -1, 2)
    assert ((pixels > 0.0) & (pixels < CAMERA[:2])).all()
    narrow = arm.measured_with(Board("camera", PLACE, CORNERS, CAMERA[2:]))
    np.testing.assert_array_equal(narrow.predict(joints), arm.predict(joints))
    arm.fitting.prepared(joints, arm.predict(joints))
    arm.fitting.prepared(joints, _at_left(pixels, 3, -0.0005).reshape(8, -1))  # noise
    with pytest.raises(ValueError, match=r"1 of 8 board rows .* of row 3 is at"):
        arm.fitting.prepared(joints, _at_left(pixels, 3, -0.01).reshape(8, -1))
    aside = joints.copy()
    aside[5, 4] += 180.0  # the camera looks away
    with pytest.warns(UserWarning, match="1 of 8 candidates .* row 5 of the available"):
        arm.fitting.prepared(aside)


def _at_left(pixels, row, share):
    """Pixels (N, C, 2) of a row moved until its leftmost is at a share of the width."""
    moved = pixels.copy()
    moved[row, :, 0] += share * CAMERA[0] - pixels[row, :, 0].min()
    return moved


def test_a_board_without_corners_takes_a_camera_for_its_postures():
    posed = Board("camera", PLACE, extent=(200.0, 150.0), camera=CAMERA)
    arm = SerialChain.from_dh(ur5().table, tool=MOUNT, sensor=posed)
    candidates = arm.postures(12, seed=2)
    arm.fitting.prepared(candidates)
    arm.fitting.prepared(candidates, arm.predict(candidates) - 80.0)  # poses, no pixels
    with pytest.raises(ValueError, match=r"camera must be .*, got \(640.0, 480.0\)"):
        Board("camera", PLACE, camera=(640.0, 480.0))


def test_contacts_on_a_table_keep_the_arm_above_it():
    arm = ur5(sensor=Socket(2))
    plain = arm.postures(60, near=NEAR)
    safe = arm.postures(60, near=NEAR, floor=0.0)

    def heights(commands):
        """(N,) of the lowest of the ends of links 2 to 5."""
        tips = [
            _frames(_cut(arm, n), commands[:, :n], _cut(arm, n).nominal)
            for n in (2, 3, 4, 5)
        ]
        return np.min([frame[:, 2, 3] for frame in tips], axis=0)

    assert (heights(plain) < 0.0).mean() > 0.3
    assert (heights(safe) > -1e-6).all()


def _cut(arm, links):
    """The first links alone."""
    return SerialChain.from_dh(arm.table[:links])


@pytest.mark.slow
def test_a_socket_that_no_posture_reaches_is_named():
    arm = ur5(sensor=Socket(2))
    with pytest.raises(
        ValueError, match=r"no posture reaches socket 1 at \(3000, 0, 0\)"
    ):
        arm.postures(20, near=[NEAR[0], [3000.0, 0.0, 0.0]])


def test_wrong_rooms_and_views_are_named():
    arm = SerialChain.from_urdf(CONTACTS / "panda.urdf", tip="ball_link")
    touching, looking = (arm.measured_with(one) for one in (Socket(1), Board()))
    near = [[0.4, 0.1, 0.3]]
    for options, why in (
        ({"camera": CAMERA}, "camera needs an arm with sensor=Board"),
        ({"tilt": 100.0}, "tilt needs camera=.*got 100"),
        ({"distance": (0.2, 0.5)}, "distance needs camera="),
        ({"floor": 0.45}, r"no posture reaches near = .* are below the floor"),
    ):
        with pytest.raises(ValueError, match=why):
            touching.postures(5, near=near, **options)
    for options, why in (
        ({"camera": (1, 2, 3)}, "camera must be"),
        ({"camera": CAMERA, "tilt": 95.0}, "tilt must be in"),
        ({"camera": CAMERA, "distance": (0.5, 0.2)}, "distance must be"),
    ):
        with pytest.raises(ValueError, match=why):
            looking.postures(5, **options)
