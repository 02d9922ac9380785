"""Arms read from URDF files, against the transforms that the file writes down."""

from __future__ import annotations

import json

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxcal.models import Pose, SerialChain, from_dict
from jaxcal.models.model import by_name

from .test_serial_chain import _matrix, _slide


def _urdf(joints, extra=""):
    """A file of joints (type, xyz, rpy, axis) in a row, links link0, link1, ..."""
    links = "".join(f'<link name="link{i}"/>' for i in range(len(joints) + 1))
    text = "".join(
        f'<joint name="j{i + 1}" type="{kind}">'
        f'<parent link="link{i}"/><child link="link{i + 1}"/>'
        f'<origin xyz="{_words(xyz)}" rpy="{_words(rpy)}"/>'
        f'<axis xyz="{_words(axis)}"/></joint>'
        for i, (kind, xyz, rpy, axis) in enumerate(joints)
    )
    return f'<robot name="arm">{links}{text}{extra}</robot>'


def _words(values):
    return " ".join(repr(float(value)) for value in values)


def _tip(joints, command):
    """Position of the last link by the transforms of the file; degrees, metres."""
    frame = np.eye(4)
    moves = iter(command)
    for kind, xyz, rpy, axis in joints:
        frame = frame @ _matrix(Rotation.from_euler("xyz", rpy), xyz)
        unit = np.array(axis) / np.linalg.norm(axis)
        if kind in ("revolute", "continuous"):
            turn = Rotation.from_rotvec(np.radians(next(moves)) * unit)
            frame = frame @ _matrix(turn)
        elif kind == "prismatic":
            frame = frame @ _matrix(None, next(moves) * unit)
    return frame


def _read(tmp_path, text, **options):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    return SerialChain.from_urdf(path, **options)


right = st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, 1.5708, 0.3, -2.0])
axes = st.sampled_from([(0, 0, 1), (0, 0, -1), (0, 1, 0), (1, 0, 0), (1, 2, -2)])
kinds = st.sampled_from(["revolute", "revolute", "continuous", "prismatic", "fixed"])
lengths = st.sampled_from([0.0, 0.1, -0.4, 0.75])


@hypothesis.given(
    st.lists(
        st.tuples(kinds, st.tuples(*[lengths] * 3), st.tuples(*[right] * 3), axes),
        min_size=1,
        max_size=6,
    ),
    axes,
    st.integers(0, 1000),
)
def test_a_file_and_the_model_agree_at_every_posture(
    tmp_path_factory, joints, first, seed
):
    joints = [("revolute", (0, 0, 0.2), (0, 0, 0), first), *joints]
    model = _read(tmp_path_factory.mktemp("urdf"), _urdf(joints), sensor=Pose())
    command = np.random.default_rng(seed).uniform(-180.0, 180.0, model.num_inputs)
    frame = _tip(joints, command)
    outputs = model.predict(command[None])
    np.testing.assert_allclose(outputs[0, :3], frame[:3, 3], atol=1e-9)
    vectors = model.rotation_vectors(command[None], frame[None, :3, :3])
    np.testing.assert_allclose(vectors, 0.0, atol=1e-9)
    assert np.abs(model.table[:, [0, 2]]).max() < 1e4  # no feet of near-parallel axes


def test_a_file_gives_the_table_of_the_same_arm(tmp_path):
    """Two parallel axes, a crossing one and a flange: a SCARA's first three joints."""
    joints = [
        ("revolute", (0, 0, 0.3), (0, 0, 0), (0, 0, 1)),
        ("revolute", (0.25, 0, 0.1), (0, 0, 0), (0, 0, 1)),
        ("revolute", (0.2, 0, 0), (-np.pi / 2, 0, 0), (0, 0, 1)),
        ("fixed", (0, 0.05, 0.12), (0, 0, 0), (0, 0, 1)),
    ]
    model = _read(tmp_path, _urdf(joints))
    expected = [(0.25, 0, 0.1, 0, 0), (0.2, -90, 0, 0, 0), (0, 0, 0, 0, 0)]
    np.testing.assert_allclose(model.table, expected, atol=1e-12)
    np.testing.assert_allclose(model.tool, _slide("y", 0.05) @ _slide("z", 0.12))
    table = SerialChain.from_dh(
        [row[:4] for row in expected], base=(0, 0, 0.3), tool=(0, 0.05, 0.12)
    )
    commands = np.random.default_rng(0).uniform(-180.0, 180.0, (9, 3))
    np.testing.assert_allclose(
        model.jacobian(commands), table.jacobian(commands), atol=1e-12
    )
    assert model.joint_names == ("j1", "j2", "j3")


def test_a_chain_between_two_links_of_a_tree(tmp_path):
    joints = [
        ("fixed", (1.0, 0, 0), (0, 0, 0), (0, 0, 1)),
        ("revolute", (0, 0, 0.3), (0, 0, 0), (0, 0, 1)),
        ("prismatic", (0.25, 0, 0.1), (0, 1.0, 0), (0, 0, 1)),
    ]
    finger = (
        '<link name="camera"/><joint name="mount" type="fixed">'
        '<parent link="link2"/><child link="camera"/></joint>'
    )
    with pytest.raises(
        ValueError, match=r"--tip \(tip=\) is missing: .* \(link3, camera"
    ):
        _read(tmp_path, _urdf(joints, finger))
    model = _read(tmp_path, _urdf(joints, finger), tip="link3", base="link1")
    assert model.joints == "RP"
    expected = (np.linalg.inv(_slide("x", 1.0)) @ _tip(joints, (30.0, 0.2)))[:3, 3]
    np.testing.assert_allclose(model.predict([[30.0, 0.2]])[0], expected, atol=1e-12)


ONE = [("revolute", (0, 0, 1), (0, 0, 0), (0, 0, 1))]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot>", "is not a URDF file"),
        ("<sdf/>", r"must be <robot>, got <sdf>"),
        (_urdf(ONE).replace("revolute", "floating"), "type of joint j1 .* 'floating'"),
        (_urdf(ONE).replace('"0.0 0.0 1.0"', '"0 a 1"'), "of joint j1 must be three"),
        (
            _urdf(ONE).replace("rpy=", 'quat_xyzw="0 0 0.6 0.8" other='),
            "<origin> of joint j1 must give its rotation.*got quat_xyzw='0 0 0.6",
        ),
        (
            _urdf(ONE).replace('axis xyz="0.0 0.0 1.0"', 'axis xyz="0 0 0"'),
            "the axis of joint j1 must not be zero",
        ),
        (_urdf(ONE).replace('<child link="link1"/>', ""), "joint j1 has no <child"),
        (_urdf(ONE).replace('child link="link1"', 'child link="x"'), "the link 'x'"),
        (
            _urdf(ONE).replace("</joint>", '<mimic joint="j0"/></joint>'),
            "joint j1 must mimic another joint of the file, got 'j0'",
        ),
        (
            _urdf(ONE).replace("</joint>", '<limit lower="a"/></joint>'),
            "lower of <limit> of joint j1 must be a number, got 'a'",
        ),
        (_urdf(ONE, "<xacro:arm/>"), "xacro file: expand it first, xacro arm.xacro"),
        (
            _urdf(ONE, '<xacro:arm xmlns:xacro="http://ros.org/wiki/xacro"/>'),
            "it is a xacro file",
        ),
        (_urdf(ONE).replace('"0.0 0.0 1.0"', '"0 0 ${h}"'), "a xacro file: expand it"),
        (
            _urdf(
                ONE,
                '<joint name="j2" type="fixed"><parent link="link0"/>'
                '<child link="link1"/></joint>',
            ),
            "link link1 is the child of two joints, j1 and j2",
        ),
        (_urdf([("fixed", *ONE[0][1:])]), "no movable joint between"),
    ],
)
def test_a_file_that_is_no_chain_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        _read(tmp_path, text)


TREE = """
<robot name="tree">
  <link name="body"/><link name="left"/><link name="palm"/><link name="finger"/>
  <link name="right"/><link name="camera"/>
  <joint name="shoulder" type="revolute">
    <parent link="body"/><child link="left"/><axis xyz="0 1 0"/>
    <origin xyz="0 0.2 0.5" rpy="0.1 0 0"/>
    <limit lower="-1.5707963267948966" upper="1"/>
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="left"/><child link="palm"/><axis xyz="0 0 1"/>
    <origin xyz="0.3 0 0" rpy="0 1 0"/><limit lower="0" upper="0.1"/>
  </joint>
  <joint name="curl" type="revolute">
    <parent link="palm"/><child link="finger"/><axis xyz="1 0 0"/>
    <origin xyz="0 0 0.1"/><mimic joint="slide" multiplier="5" offset="0.2"/>
  </joint>
  <joint name="neck" type="continuous">
    <parent link="body"/><child link="right"/><axis xyz="0 0 1"/>
    <origin xyz="0 -0.2 0.5"/>
  </joint>
  <joint name="eye" type="fixed">
    <parent link="right"/><child link="camera"/><origin xyz="0.1 0 0.1" rpy="0 0 2"/>
  </joint>
</robot>
"""


def _transform(xyz, rpy=(0, 0, 0)):
    return _matrix(Rotation.from_euler("xyz", rpy), xyz)


def _finger(shoulder, slide):
    """The finger in the body's frame, radians and metres."""
    return (
        _transform((0, 0.2, 0.5), (0.1, 0, 0))
        @ _transform((0, 0, 0), (0, shoulder, 0))
        @ _transform((0.3, 0, 0), (0, 1, 0))
        @ _transform((0, 0, slide))
        @ _transform((0, 0, 0.1))
        @ _transform((0, 0, 0), (0.2 + 5 * slide, 0, 0))
    )


def _camera(neck):
    turned = _transform((0, -0.2, 0.5)) @ _transform((0, 0, 0), (0, 0, neck))
    return turned @ _transform((0.1, 0, 0.1), (0, 0, 2))


def test_any_two_links_of_a_tree_with_a_joint_that_mimics(tmp_path):
    model = _read(tmp_path, TREE, base="camera", tip="finger", sensor=Pose())
    assert model.joint_names == model.inputs == ("neck", "shoulder", "slide")
    for neck, shoulder, slide in ((0.0, 0.0, 0.0), (1.0, -0.7, 0.05)):
        frame = np.linalg.inv(_camera(neck)) @ _finger(shoulder, slide)
        command = [[np.degrees(neck), np.degrees(shoulder), slide]]
        found = model.predict(command)
        np.testing.assert_allclose(found[0, :3], frame[:3, 3], atol=1e-12)
        turn = model.rotation_vectors(command, frame[None, :3, :3])
        np.testing.assert_allclose(turn, 0.0, atol=1e-9)
    back = _read(tmp_path, TREE, base="finger", tip="camera")
    frame = np.linalg.inv(_finger(-0.7, 0.05)) @ _camera(1.0)
    at = dict(zip(model.joint_names, command[0], strict=True))
    found = back.predict([[at[name] for name in back.joint_names]])
    np.testing.assert_allclose(found[0], frame[:3, 3], atol=1e-12)
    slope = model.predict(np.add(command, [0, 0, 1e-6])) - model.predict(command)
    np.testing.assert_allclose(
        model.command_jacobian(command)[0, :3, 2], slope[0, :3] / 1e-6, atol=1e-5
    )


def test_limits_are_read_and_joints_are_locked(tmp_path):
    model = _read(tmp_path, TREE, tip="finger")
    np.testing.assert_allclose(model.limits, [[-90.0, np.degrees(1.0)], [0.0, 0.1]])
    neck = _read(tmp_path, TREE, tip="camera")
    assert np.isinf(neck.limits).all()
    locked = _read(tmp_path, TREE, tip="finger", locked={"slide": 0.05})
    assert locked.joint_names == ("shoulder",)
    np.testing.assert_allclose(
        locked.predict([[20.0]])[0], _finger(np.radians(20.0), 0.05)[:3, 3], atol=1e-12
    )
    again = from_dict(json.loads(json.dumps(locked.to_dict())))
    np.testing.assert_array_equal(again.predict([[20.0]]), locked.predict([[20.0]]))
    np.testing.assert_array_equal(again.limits, locked.limits)


def test_columns_of_a_table_are_taken_by_the_names_of_the_joints(tmp_path):
    pandas = pytest.importorskip("pandas")
    model = _read(tmp_path, TREE, base="camera", tip="finger")
    frame = pandas.DataFrame({"slide": [0.01], "neck": [10.0], "shoulder": [5.0]})
    picked = np.asarray(by_name(model, frame))
    np.testing.assert_array_equal(picked, [[10.0, 5.0, 0.01]])
    with pytest.raises(ValueError, match="'neck' is missing"):
        by_name(model, frame.drop(columns="neck"))


def test_links_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"tip link must be one of .* got 'flange'"):
        _read(tmp_path, _urdf(ONE), tip="flange")
    with pytest.raises(ValueError, match="no movable joint between base 'link0' and"):
        _read(tmp_path, _urdf(ONE), tip="link0", base="link0")
    with pytest.raises(ValueError, match="base 'b' and tip 'link1' are not connected"):
        _read(tmp_path, _urdf(ONE, '<link name="b"/>'), tip="link1", base="b")
    with pytest.raises(ValueError, match=r"locked joint must be one of j1, got 'j9'"):
        _read(tmp_path, _urdf(ONE), locked={"j9": 0.0})
    ring = _urdf(
        ONE,
        '<joint name="back" type="fixed"><parent link="link1"/>'
        '<child link="link0"/></joint>',
    )
    with pytest.raises(ValueError, match="the joints back, j1 form a loop"):
        _read(tmp_path, ring, tip="link1")


def test_axes_that_are_almost_parallel_keep_lengths_short_and_exact(tmp_path):
    """A file that was calibrated: axes off by tenths of degrees, and one near -z."""
    joints = [
        ("revolute", (0, 0, 0.1), (np.pi - 1e-6, 0, 0), (0, 0, 1)),
        ("revolute", (0, 0, 0.1), (np.pi / 2, 0, 0), (0, 0, 1)),
        ("revolute", (0.4, 0, 0), (0.005, 0, 0), (0, 0, 1)),
        ("revolute", (0.3, 0, 0), (np.pi + 0.05, 0.02, 0), (0, 0, 1)),
        ("fixed", (0, 0.1, 0), (0, 0, 0), (0, 0, 1)),
    ]
    model = _read(tmp_path, _urdf(joints))
    assert model.length < 1.5  # the common normal of such axes is 80 m away
    for command in np.random.default_rng(0).uniform(-180.0, 180.0, (9, 4)):
        found = model.predict(command[None])[0]
        np.testing.assert_allclose(found, _tip(joints, command)[:3, 3], atol=1e-13)


def test_what_xacro_left_behind_and_the_shape_of_links_do_not_matter(tmp_path):
    left = '<!-- <xacro:include filename="$(find x)"/> --><material name="${colour}"/>'
    assert _read(tmp_path, _urdf(ONE, left)).joint_names == ("j1",)
    gazebo = '<controller:gazebo_manager name="of no declared name space"/>'
    assert _read(tmp_path, _urdf(ONE, gazebo)).joint_names == ("j1",)


def test_a_finger_that_mimics_a_slide_elsewhere_is_told_in_lengths(tmp_path):
    finger = """
      <link name="thumb"/><joint name="pinch" type="prismatic">
      <parent link="right"/><child link="thumb"/><axis xyz="0 1 0"/>
      <mimic joint="slide" multiplier="-1"/></joint></robot>"""
    model = _read(tmp_path, TREE.replace("</robot>", finger), tip="thumb")
    assert model.joint_names == ("neck", "slide")
    assert model.command_units == ("deg", "length")
    expected = (_transform((0, -0.2, 0.5)) @ _transform((0, -0.03, 0)))[:3, 3]
    np.testing.assert_allclose(model.predict([[0.0, 0.03]])[0], expected, atol=1e-12)
    np.testing.assert_array_equal(model.limits[1], [0.0, 0.1])
    curled = _read(tmp_path, TREE, base="palm", tip="finger")  # by a slide outside
    assert curled.command_units == ("length",)
