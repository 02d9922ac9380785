"""Arms read from URDF files, against the transforms that the file writes down."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxcal.models import Pose, SerialChain

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
    st.integers(0, 1000),
)
def test_a_file_and_the_model_agree_at_every_posture(tmp_path_factory, joints, seed):
    joints = [("revolute", (0, 0, 0.2), (0, 0, 0), (0, 0, 1)), *joints]
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
    with pytest.raises(ValueError, match=r"tip must be given: .* \(link3, camera"):
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
        ("<sdf/>", r"must hold a <robot>, got <sdf>"),
        (_urdf(ONE).replace("revolute", "floating"), "type of joint j1 .* 'floating'"),
        (_urdf(ONE).replace('"0.0 0.0 1.0"', '"0 a 1"'), "of joint j1 must be three"),
        (
            _urdf(ONE).replace('axis xyz="0.0 0.0 1.0"', 'axis xyz="0 0 0"'),
            "the axis of joint j1 must not be zero",
        ),
        (_urdf(ONE).replace('<child link="link1"/>', ""), "joint j1 has no <child"),
        (_urdf(ONE).replace('child link="link1"', 'child link="x"'), "the link 'x'"),
        (
            _urdf(ONE).replace("</joint>", '<mimic joint="j0"/></joint>'),
            "joint j1 mimics another one",
        ),
        (
            _urdf(
                ONE,
                '<joint name="j2" type="fixed"><parent link="link0"/>'
                '<child link="link1"/></joint>',
            ),
            "link link1 is the child of the joints j1 and j2",
        ),
        (_urdf([("fixed", *ONE[0][1:])]), "no joint moves between"),
    ],
)
def test_a_file_that_is_no_chain_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        _read(tmp_path, text)


def test_links_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"tip must be a link of .* got 'flange'"):
        _read(tmp_path, _urdf(ONE), tip="flange")
    with pytest.raises(ValueError, match="base 'link1' is not above tip 'link0'"):
        _read(tmp_path, _urdf(ONE), "link0", "link1")
    ring = _urdf(
        ONE,
        '<joint name="back" type="fixed"><parent link="link1"/>'
        '<child link="link0"/></joint>',
    )
    with pytest.raises(ValueError, match="the joints back, j1 form a loop"):
        _read(tmp_path, ring, tip="link1")
