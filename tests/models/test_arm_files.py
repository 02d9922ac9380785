"""Calibrated arms written back: read again they go where the calibration says."""

from __future__ import annotations

import json
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.models import Pose, Position, SerialChain, Socket, from_dict

from .arms import UR5_TABLE, ur5
from .test_serial_chain import _matrix
from .test_urdf import TREE, _tip, _transform, _urdf

ARM = """<?xml version="1.0" encoding="utf-8"?>
<!-- a comment before: µ -->
<robot name="arm">
  <link name="base">
    <visual><geometry><mesh filename="a.stl"/></geometry></visual>
  </link>
  <link name="upper"/> <link name="fore"/> <link name="hand"/> <link name="ball"/>
  <joint name="shoulder" type="revolute">
    <!-- <origin xyz="9 9 9"/> is a comment -->
    <origin  rpy='1.5707963267948966 0 0'   xyz="0 0 0.3" other="kept"/>
    <parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><axis xyz="0 1 0"/>
    <origin xyz="0.4 0 0" rpy="0 1.5707963267948966 0"></origin>
  </joint>
  <joint name="wrist" type="continuous">
    <parent link="fore"/><child link="hand"/><axis xyz="1 1 0"/>
  </joint>
  <joint name="ball_joint" type="fixed">
    <parent link="hand"/><child link="ball"/><origin xyz="0 0 0.1"/>
  </joint>
</robot>
"""


def _round_trip(tmp_path, text, size=1.0, **ends):
    """The model, parameters that are off, the text written, and the model of that."""
    path, out = tmp_path / "arm.urdf", tmp_path / "calibrated.urdf"
    path.write_text(text, encoding="utf-8")
    model = SerialChain.from_urdf(path, sensor=Pose(), **ends)
    rng = np.random.default_rng(0)
    off = np.where(np.array(model.units) == "length", 0.01, 1.0) * size
    parameters = model.nominal + off * rng.normal(size=model.num_parameters)
    tip = model.write("urdf", out, parameters)
    again = SerialChain.from_urdf(out, sensor=Pose(), **{**ends, "tip": tip})
    return model, parameters, out.read_text(encoding="utf-8"), again


@pytest.mark.parametrize(
    ("text", "ends"),
    [
        (ARM, {}),
        (ARM, {"tip": "hand"}),
        (ARM, {"base": "ball", "tip": "base"}),
        (ARM, {"base": "ball", "tip": "upper"}),
        (ARM, {"locked": {"elbow": 30.0}}),
        (TREE, {"base": "camera", "tip": "finger"}),
        (TREE, {"base": "camera", "tip": "palm"}),
        (TREE, {"tip": "finger", "locked": {"slide": 0.03}}),
    ],
)
def test_the_file_written_goes_where_the_prediction_is(tmp_path, text, ends):
    model, parameters, _, again = _round_trip(tmp_path, text, **ends)
    commands = np.random.default_rng(1).uniform(-90.0, 90.0, (20, model.num_inputs))
    commands[:, [name == "slide" for name in model.joint_names]] /= 1000.0
    turns = model.predict(commands, parameters)
    found = again.predict(commands)
    np.testing.assert_allclose(found[:, :3], turns[:, :3], atol=1e-9)
    frames = model.rotations(commands, turns[:, 3:])
    vectors = again.rotation_vectors(commands, frames)
    np.testing.assert_allclose(vectors, 0.0, atol=1e-7)
    assert again.joint_names == model.joint_names


def test_all_but_the_origins_is_kept(tmp_path):
    model, _parameters, text, _ = _round_trip(tmp_path, ARM)
    before, after = ARM.splitlines(), text.splitlines()
    changed = [line for line in before if line not in after]
    assert len(changed) == 3 and all("<origin" in line for line in changed)
    assert "<!-- a comment before: µ -->" in text and 'other="kept"' in text
    assert '<mesh filename="a.stl"/>' in text
    assert text.count("<origin") == ARM.count("<origin") + 1  # the wrist had none
    unchanged = tmp_path / "same.urdf"
    model.write("urdf", unchanged, model.nominal)
    assert unchanged.read_text(encoding="utf-8") == ARM


@pytest.mark.parametrize("encoding", ["utf-8-sig", "iso-8859-1"])
def test_every_other_byte_is_kept(tmp_path, encoding):
    """Ends of lines, byte order mark, declared encoding, and what follows the robot."""
    text = ARM.replace("utf-8", encoding.removesuffix("-sig")).replace("\n", "\r\n")
    data = (text + "<!-- </robot> -->\r\n").encode(encoding)
    path, out = tmp_path / "arm.urdf", tmp_path / "out.urdf"
    path.write_bytes(data)
    model = SerialChain.from_urdf(path, tip="hand")
    model = from_dict(json.loads(json.dumps(model.to_dict())))
    model.write("urdf", out, model.nominal)
    assert out.read_bytes() == data
    off = model.nominal + 0.01
    for tip in ("hand_calibrated", "hand_calibrated_again"):
        assert model.write("urdf", out, off, force=True) == tip
        before, after = data.splitlines(), out.read_bytes().splitlines()
        lost = [line for line in before if line not in after]
        assert all(b"<origin" in each or b"wrist" in each for each in lost)
        again = SerialChain.from_urdf(out, tip=tip)
        commands = np.array([[10.0, 20.0, 30.0]])
        found = again.predict(commands)
        np.testing.assert_allclose(found, model.predict(commands, off), atol=1e-12)
        model = SerialChain.from_urdf(out, tip="hand")  # and calibrated once more
        off, data = model.nominal + 0.01, out.read_bytes()


@pytest.mark.parametrize(
    ("encoding", "tip", "more", "name"),
    [
        ("utf-8", "l&amp;6 'a'", "", "l&6 'a'_calibrated"),
        ("iso-8859-1", "gerät", "", "gerät_calibrated"),
        ("utf-8", "l6", "<link name='l6_calibrated'/>", "l6_calibrated_again"),
        (
            "utf-8",
            "l6",
            '<link name="side"/><joint name="l6_calibrated_joint" type="fixed">'
            '<parent link="base"/><child link="side"/></joint>',
            "l6_calibrated_again",
        ),
    ],
)
def test_a_new_link_is_the_only_one_of_its_name(tmp_path, encoding, tip, more, name):
    text = ARM.replace("utf-8", encoding).replace('"hand"', f'"{tip}"')
    text = text.replace("</robot>", f"{more}</robot>").replace("\n", "\r\n")
    path, out = tmp_path / "arm.urdf", tmp_path / "out.urdf"
    path.write_bytes(text.encode(encoding))
    model = SerialChain.from_urdf(path, tip=name.partition("_")[0])
    off, commands = model.nominal + 0.01, [[10.0, 20.0, 30.0]]
    assert model.write("urdf", out, off) == name
    links = [link.get("name") for link in ElementTree.parse(out).iter("link")]
    assert links.count(name) == 1
    again = SerialChain.from_urdf(out, tip=name)
    found = again.predict(commands)
    np.testing.assert_allclose(found, model.predict(commands, off), atol=1e-12)
    data = out.read_bytes()
    assert data.count(b"\n") == data.count(b"\r\n") > text.count("\n")


@pytest.mark.parametrize(
    ("encoding", "origin", "message"),
    [
        ("utf-16", '<origin xyz="0 0 0.1"/>', "is in UTF-16, .* save it as UTF-8"),
        ("utf-8", "&place;", "<origin> of joint ball_joint cannot be written"),
    ],
)
def test_what_cannot_be_written_is_never_told_as_written(
    tmp_path, encoding, origin, message
):
    entity = """<!DOCTYPE robot [<!ENTITY place "<origin xyz='0 0 0.1'/>">]><robot"""
    text = ARM.replace("utf-8", encoding).replace("<robot", entity)
    path, out = tmp_path / "arm.urdf", tmp_path / "out.urdf"
    path.write_text(text.replace('<origin xyz="0 0 0.1"/>', origin), encoding=encoding)
    model = SerialChain.from_urdf(path)
    with pytest.raises(ValueError, match=message):
        model.write("urdf", out, model.nominal + 0.01)
    assert not out.exists()


def test_nothing_is_written_over_a_file_without_force(tmp_path):
    model, _parameters, text, _ = _round_trip(tmp_path, ARM)
    out = tmp_path / "calibrated.urdf"
    with pytest.raises(FileExistsError, match="exists; pass force=True"):
        model.write("urdf", out, model.nominal)
    assert out.read_text(encoding="utf-8") == text
    model.write("urdf", out, model.nominal, force=True)
    assert out.read_text(encoding="utf-8") == ARM


def test_what_no_file_can_hold_is_refused(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM, encoding="utf-8")
    model = SerialChain.from_urdf(path, gears=[2])
    parameters = model.nominal.copy()
    parameters[model.names.index("gear2")] = 1.01
    with pytest.raises(
        ValueError, match=r"gear2 is 1\.01, which this file format cannot"
    ):
        model.write("urdf", tmp_path / "out.urdf", parameters)
    model = SerialChain.from_urdf(path, compliance=[2])
    parameters = model.nominal.copy()
    parameters[model.names.index("compliance2")] = 0.1
    with pytest.raises(ValueError, match="compliance2, which this file format cannot"):
        model.write("urdf", tmp_path / "out.urdf", parameters)
    with pytest.raises(ValueError, match="must come from a URDF file"):
        ur5().write("urdf", tmp_path / "out.urdf", ur5().nominal)
    model = SerialChain.from_urdf(path, base="hand", tip="upper")
    with pytest.raises(ValueError, match=r"its joint .* a link fixed to it"):
        model.write("urdf", tmp_path / "out.urdf", model.nominal + 0.01)
    assert not (tmp_path / "out.urdf").exists()


def test_a_calibrated_arm_is_nominal_where_it_was_found(tmp_path):
    model = ur5(sensor=Socket(), gears=[2], compliance=())
    parameters = model.nominal + 0.1 * np.random.default_rng(0).normal(size=43)
    commands = np.random.default_rng(1).uniform(-90.0, 90.0, (20, 6))
    points = model.measured_with(Position()).predict(commands, parameters[:-3])
    found = model.calibrated(parameters)
    np.testing.assert_allclose(found.predict(commands), points, atol=1e-9)


def test_a_calibrated_arm_yields_as_it_was_found_to():
    model = ur5(sensor=Socket())
    by = np.array([name.startswith("compliance") for name in model.names])
    rng = np.random.default_rng(0)
    noise = 0.1 * rng.normal(size=len(by))
    parameters = model.nominal + np.where(by, 1e-4 * np.abs(noise), noise)
    commands = rng.uniform(-90.0, 90.0, (20, 6))
    tip = model.measured_with(Position())
    points = tip.predict(commands, parameters[:-3])
    sag = points - tip.predict(commands, np.where(by, 0.0, parameters)[:-3])
    found = model.calibrated(parameters)
    again = from_dict(found.to_dict())
    off = again.predict(commands) - points
    # Its torques are those of the arm as calibrated, not as designed.
    assert np.abs(sag).max() > 0.1 and np.abs(off).max() < 0.01 * np.abs(sag).max()


def _ur_frames(text):
    """Transforms of the six joints in UR's file, by their names."""
    frames, name = {}, ""
    for line in text.splitlines()[1:-1]:
        key, value = line.strip().split(":")
        if value:
            frames[name][key] = float(value)
        else:
            name = key
            frames[name] = {}
    assert list(frames) == "shoulder upper_arm forearm wrist_1 wrist_2 wrist_3".split()
    return [
        _transform([f["x"], f["y"], f["z"]], [f["roll"], f["pitch"], f["yaw"]])
        for f in frames.values()
    ]


def _along(frames, command):
    frame = np.eye(4)
    for step, angle in zip(frames, command, strict=True):
        turn = Rotation.from_euler("z", angle, degrees=True)
        frame = frame @ step @ _matrix(turn)
    return frame


def test_the_kinematics_file_of_universal_robots(tmp_path):
    metres = np.array(UR5_TABLE) / [1000.0, 1.0, 1000.0, 1.0]
    arm = SerialChain.from_dh(metres, sensor=Pose())
    rng = np.random.default_rng(0)
    off = np.where(np.array(arm.units) == "length", 0.001, 0.3)
    parameters = arm.nominal + off * rng.normal(size=arm.num_parameters)
    parameters[30:] = 0.0  # base and tool are not in the file
    path = tmp_path / "kinematics.yaml"
    arm.write("ur", path, parameters)
    last = parameters[25:30].copy()
    wrist = _matrix(Rotation.from_euler("x", last[1], degrees=True), [last[0], 0, 0])
    wrist = wrist @ _matrix(Rotation.from_euler("y", last[4], degrees=True))
    for command in rng.uniform(-180.0, 180.0, (5, 6)):
        frame = _along(_ur_frames(path.read_text()), command) @ wrist
        expected = arm.predict(command[None], parameters)[0]
        np.testing.assert_allclose(frame[:3, 3], expected[:3], atol=1e-9)
    # The nominal file is that of the ROS description.
    arm.write("ur", path, arm.nominal, force=True)
    frames = _ur_frames(path.read_text())
    np.testing.assert_allclose(frames[2][:3, 3], [-0.425, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(frames[4][:3, 3], [0.0, -0.09456, 0.0], atol=2e-4)
    with pytest.raises(ValueError, match="must be in metres"):
        ur5().write("ur", path, ur5().nominal)


def test_the_kinematics_file_of_any_six_joints(tmp_path):
    """Fixed joints between them, axes that are not z."""
    joints = [
        ("revolute", (0, 0, 0.3), (0, 0, 0.2), (0, 1, 0)),
        ("revolute", (0.1, 0, 0.1), (-1.57, 0, 0.1), (0, 0, -2)),
        ("continuous", (0, -0.4, 0.02), (0, 0.1, 0), (1, 0, 0)),
        ("fixed", (0.05, 0, 0.03), (0.3, -0.2, 0.7), (0, 0, 1)),
        ("revolute", (0.02, 0, 0.35), (1.57, 0, 0), (1, 1, 0)),
        ("revolute", (0, 0.05, 0), (0, 1.57, 0), (0, -1, 0)),
        ("revolute", (0, 0, 0.08), (0, 0, 0), (0, 0, 1)),
    ]
    source, path = tmp_path / "arm.urdf", tmp_path / "kinematics.yaml"
    source.write_text(_urdf(joints))
    arm = SerialChain.from_urdf(source)
    arm.write("ur", path, arm.nominal)
    rng = np.random.default_rng(0)
    parameters, commands = arm.nominal, rng.uniform(-180.0, 180.0, (5, 6))
    for command in commands:
        frame = _along(_ur_frames(path.read_text()), command)
        np.testing.assert_allclose(frame, _tip(joints, command), atol=1e-9)
    parameters[:25] += 0.01 * rng.normal(size=25)  # the last row moves the tool only
    arm.write("ur", path, parameters, force=True)
    found = [_along(_ur_frames(path.read_text()), each)[:3, 3] for each in commands]
    np.testing.assert_allclose(found, arm.predict(commands, parameters), atol=1e-9)


MIMIC = _urdf(
    [
        ("revolute", (0, 0, 0.3), (0, 0, 0), (0, 0, 1)),
        ("prismatic", (0.1, 0, 0.1), (-1.57, 0, 0.1), (0, 0, 1)),
        ("revolute", (0, -0.4, 0.02), (0, 0.1, 0), (1, 0, 0)),
        ("revolute", (0.2, 0, 0), (1.0, 0, 0), (0, 1, 0)),
        ("prismatic", (0.1, 0, 0.1), (0.5, 0, 0.1), (0, 0, 1)),
    ]
)


@pytest.mark.parametrize(
    ("times", "joint", "follows"),
    [(-1.5, "j1", "joint 3 moves by -1.5 j1"), (1.0, "side", None)],
)
def test_a_table_on_file_has_the_offsets_of_joints_that_follow(
    tmp_path, times, joint, follows
):
    parts = MIMIC.split("</joint>")
    parts[2] += f'<mimic joint="{joint}" multiplier="{times}" offset="0.2"/>'
    parts[4] += '<mimic joint="j2" offset="0.03"/>'
    side = (
        '<link name="side"/><joint name="side" type="revolute">'
        '<parent link="link0"/><child link="side"/></joint></robot>'
    )
    source, path = tmp_path / "arm.urdf", tmp_path / "dh.csv"
    source.write_text("</joint>".join(parts).replace("</robot>", side))
    arm = SerialChain.from_urdf(source, tip="link5")
    with pytest.warns(UserWarning, match="joint 5 moves by 1 j2") as told:
        arm.write("dh", path, arm.nominal)
    assert follows is None or follows in str(told[0].message)
    lines = [line.split(",") for line in path.read_text().splitlines()[1:]]
    third = "joint 3" if follows else "side"
    assert [line[0] for line in lines] == ["j1", "j2", third, "j4", "joint 5"]
    rows = [[float(word) for word in line[1:]] for line in lines]
    plain = SerialChain.from_dh(rows, joints=arm.joints, base=arm.base, tool=arm.tool)
    command = np.array([[20.0, 0.1, 30.0, 40.0]])[:, : arm.num_joints]
    moves = command @ arm.drive.T
    np.testing.assert_allclose(plain.predict(moves), arm.predict(command), atol=1e-12)


def test_joints_that_follow_are_not_in_the_file_of_universal_robots(tmp_path):
    drive = np.eye(6)[:, :5]
    drive[5, 1] = -1.5
    metres = np.array(UR5_TABLE) / [1000.0, 1.0, 1000.0, 1.0]
    arm = SerialChain.from_dh(metres, drive=drive)
    with pytest.raises(ValueError, match=r"joint 6 moves by -1\.5 joint 2, which"):
        arm.write("ur", tmp_path / "kinematics.yaml", arm.nominal)


def test_where_a_tracker_stands_is_found_and_is_in_the_file(tmp_path):
    """Its frame is 5 m away and turned by 130 degrees."""
    path, out = tmp_path / "arm.urdf", tmp_path / "calibrated.urdf"
    path.write_text(ARM, encoding="utf-8")
    arm, rng = SerialChain.from_urdf(path), np.random.default_rng(0)
    off = np.where(np.array(arm.units) == "length", 0.001, 0.1)
    truth = arm.nominal + off * rng.normal(size=arm.num_parameters)
    joints = rng.uniform(-120.0, 120.0, (40, 3))
    turn = Rotation.from_rotvec([80.0, -60.0, 80.0], degrees=True)
    seen = turn.apply(arm.predict(joints, truth)) + np.array([3.0, -4.0, 1.0])
    found = jaxcal.identify(joints[:30], seen[:30], model=arm, noise_std=1e-5)
    np.testing.assert_allclose(found.predict(joints), seen, atol=1e-5)
    assert found.verdict.good and found.verdict.nominal < 0.02
    with pytest.warns(UserWarning, match="fitted without harmonics"):
        tip = found.to_urdf(out)
    again = SerialChain.from_urdf(out, tip=tip)
    np.testing.assert_allclose(again.predict(joints), seen, rtol=0, atol=1e-4)


def test_the_table_as_csv(tmp_path):
    path = tmp_path / "dh.csv"
    parameters = ur5().nominal + 0.1
    ur5().write("dh", path, parameters)
    rows = np.genfromtxt(path, delimiter=",", names=True)
    np.testing.assert_array_equal(rows["theta"], parameters[3:30:5])
    np.testing.assert_array_equal(rows["beta"], 0.1)
    assert path.read_text().splitlines()[1].startswith("joint 1,")


def test_a_file_of_one_joint(tmp_path):
    text = _urdf([("revolute", (0, 0, 1), (0, 0, 0), (0, 0, 1))])
    model, parameters, written, again = _round_trip(tmp_path, text)
    assert '<link name="link1_calibrated"/>' in written
    commands = [[10.0], [50.0]]
    np.testing.assert_allclose(
        again.predict(commands)[:, :3], model.predict(commands, parameters)[:, :3]
    )
