"""Where a camera is: files that robots read, and arms whose views show a part of it."""

from __future__ import annotations

import re
import warnings

import fr3
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.arms.files.urdf import joints_of
from jaxcal.commands import main
from jaxcal.models import Board, SerialChain
from tests.models.arms import CONTACTS

SCARA = {
    "table": [(0.3, 0, 0.2, 0), (0.25, 180, 0, 0), (0, 0, 0.1, 0), (0, 0, 0.05, 0)],
    "joints": "RRPR",
}
GANTRY = {"table": [(0, -90, 0, 0), (0, -90, 0, -90), (0, 0, 0, 0)], "joints": "PPP"}


def _pose(turn, shift):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), shift
    return matrix


# Of the camera in the tip's frame, and of the board in the base's.
MOUNT = _pose(Rotation.from_euler("zxy", [170, 8, -5], True), [0.02, -0.06, 0.045])
STAND = _pose(Rotation.from_euler("zx", [25, 180], True), [0.5, 0.1, 0.02])


def _seen(arm, joints, moves="camera"):
    """Commands of views by an exact arm, 1 mm and 0.1 degrees of noise."""
    rng, count = np.random.default_rng(3), len(joints)
    tips = np.tile(np.eye(4), (count, 1, 1))
    tips[:, :3, 3] = arm.predict(joints)
    tips[:, :3, :3] = arm.rotations(joints, np.zeros((count, 3)))
    inverse = np.linalg.inv
    board = inverse(tips @ MOUNT) @ STAND
    if moves == "board":
        board = inverse(STAND) @ tips @ MOUNT
    turns = Rotation.from_matrix(board[:, :3, :3]).as_rotvec(degrees=True)
    places = board[:, :3, 3] + rng.normal(0.0, 1e-3, (count, 3))
    return np.hstack([joints, places, turns + rng.normal(0.0, 0.1, (count, 3))])


def _of_a_panda(moves):
    path = CONTACTS / "panda.urdf"
    joints = np.array([0, -20, 0, -110, 0, 100, 45.0])
    joints = joints + np.random.default_rng(1).uniform(-35, 35, (20, 7))
    exact = SerialChain.from_urdf(path, tip="ball_link")
    joints = np.clip(joints, *(exact.limits.T * 0.99))
    return path, _seen(exact, joints, moves)


def test_a_view_that_the_sensor_may_have_read_is_named_and_the_others_used():
    """Real views; the one that is farthest off is so by four of the sensor's noises."""
    views = fr3.load()[[*range(19), 113]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        right = jaxcal.identify(views, np.zeros((20, 6)), model=fr3.arm())
        views[19, 9] += 0.02  # along the view
        wrong = jaxcal.identify(views, np.zeros((20, 6)), model=fr3.arm())
    assert list(right.outliers) == [19] and right.verdict.good
    assert any("19 is an outlier" in reason for reason in right.verdict.reasons)
    assert wrong.verdict.reasons[0] == "some readings contradict the others"
    assert not wrong.verdict.good and "row 19" in wrong.verdict.next_step


@pytest.mark.parametrize(("moves", "truth"), [("camera", MOUNT), ("board", STAND)])
def test_a_transform_is_where_the_camera_is_in_every_file(tmp_path, moves, truth):
    path, views = _of_a_panda(moves)
    arm = SerialChain.from_urdf(path, tip="ball_link", sensor=Board(moves))
    found = jaxcal.identify(views, model=arm)
    pose = found.static_transform(child="eye")
    assert found.verdict.good
    off = np.linalg.inv(truth) @ pose.matrix
    assert np.linalg.norm(off[:3, 3]) < 3.0 * pose.std[0] < 0.01
    turn = Rotation.from_matrix(off[:3, :3]).magnitude()
    assert np.degrees(turn) < 3.0 * pose.std[1] < 1.0
    parent = "ball_link" if moves == "camera" else "panda_link0"
    assert (pose.parent, pose.child) == (parent, "eye")
    for ending in ("yaml", "sh", "urdf"):
        file = tmp_path / f"eye.{ending}"
        found.to_transform(file, child="eye")
        with pytest.raises(FileExistsError):
            found.to_transform(file, child="eye")
    text = (tmp_path / "eye.yaml").read_text()
    said = [float(x) for x in re.findall(r"\b[xyzw]: (\S+?)[,}]", text)]
    assert np.allclose(said, [*pose.matrix[:3, 3], *pose.quaternion])
    words = (tmp_path / "eye.sh").read_text().split()
    assert float(words[words.index("--qw") + 1]) == said[-1]
    joint = joints_of((tmp_path / "eye.urdf").read_text())["eye_joint"]
    assert (joint.parent, joint.child) == (parent, "eye")
    assert np.allclose(joint.origin, pose.matrix)


def test_the_command_writes_a_transform(tmp_path, capsys):
    path, views = _of_a_panda("board")
    names = [f"panda_joint{i}" for i in range(1, 8)] + list(Board().inputs)
    table = tmp_path / "views.csv"
    np.savetxt(table, views, delimiter=",", header=",".join(names), comments="")
    out = tmp_path / "eye.yaml"
    typed = [
        *("identify", str(table), "--model", str(path), "--tip", "ball_link"),
        *("--sensor", "board", "--on-tip", "board", "--transform", str(out)),
        *("--frames", "world,eye", "--accuracy", "m=0.005,deg=0.5"),
    ]
    assert main(typed) == 0
    said = capsys.readouterr().out
    assert "eye in world: translation" in said and " deg (95 %" in said
    assert "child_frame_id: eye" in out.read_text()
    assert main(typed) == 2 and "exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arm", "middle", "wide", "hidden"),
    [
        (SCARA, [0, 60, 0.05, 0], [60, 50, 0.05, 90], ("tool z",)),
        (GANTRY, [0, 0, 0], [0.3, 0.3, 0.2], ("tool x", "tool y", "tool z")),
    ],
)
def test_of_an_arm_that_never_tilts_what_views_show_is_found(arm, middle, wide, hidden):
    rng = np.random.default_rng(0)
    joints = middle + rng.uniform(-1, 1, (20, len(middle))) * wide
    views = _seen(SerialChain.from_dh(**arm), joints)
    model = SerialChain.from_dh(**arm, sensor=Board("camera"))
    found = jaxcal.identify(views, model=model, measured_unit="m")
    verdict, pose = found.verdict, found.static_transform()
    assert verdict.good and verdict.place.hidden == pose.hidden == hidden
    assert any("not shown by these views" in why for why in verdict.reasons)
    off = np.linalg.inv(MOUNT) @ pose.matrix
    turn = Rotation.from_matrix(off[:3, :3]).magnitude()
    assert np.degrees(turn) < min(3.0 * pose.std[1], 0.3)
    if arm is SCARA:  # across its axes
        across = (pose.matrix - MOUNT)[:2, 3]
        assert np.linalg.norm(across) < 0.002


def test_a_tip_that_stands_still_shows_nothing():
    joints = np.repeat([[0.0, 60.0, 0.05, 0.0]], 5, axis=0)
    views = _seen(SerialChain.from_dh(**SCARA), joints)
    with pytest.raises(ValueError, match="the same in all 5 rows"):
        jaxcal.identify(views, model=SerialChain.from_dh(**SCARA, sensor=Board()))


def test_a_transform_needs_a_board_and_a_unit(tmp_path):
    rng = np.random.default_rng(0)
    joints = [0, 60, 0.05, 0] + rng.uniform(-1, 1, (20, 4)) * [60, 50, 0.05, 90]
    views = _seen(SerialChain.from_dh(**SCARA), joints)
    model = SerialChain.from_dh(**SCARA, sensor=Board("camera"))
    found = jaxcal.identify(views, model=model)
    with pytest.raises(ValueError, match="measured_unit"):
        found.static_transform()
    plain = SerialChain.from_dh(**SCARA)
    places = plain.predict(joints) + rng.normal(scale=1e-3, size=(20, 3))
    with pytest.raises(ValueError, match="Board"):
        jaxcal.identify(joints, places, model=plain).static_transform()
