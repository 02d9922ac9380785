"""Serial arms against 4 x 4 matrices, finite differences and a measured UR5."""

from __future__ import annotations

import functools

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxcal.arms.files.write import standing_as
from jaxcal.models import Pose, Position, SerialChain, Socket, from_dict

from .arms import UR5_TABLE, differences, ur5, ur5_data


def _matrix(rotation=None, translation=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    if rotation is not None:
        matrix[:3, :3] = rotation.as_matrix()
    matrix[:3, 3] = translation
    return matrix


def _turn(axis, degrees):
    return _matrix(Rotation.from_euler(axis, degrees, degrees=True))


def _slide(axis, length):
    return _matrix(None, np.eye(3)["xyz".index(axis)] * length)


def tool_frame(model, command, values):
    """The tool in the measuring frame by products of matrices, from named values."""
    product = [
        _matrix(None, [values[f"base {axis}"] for axis in "xyz"]),
        *(_turn(axis, values[f"base r{axis}"]) for axis in "xyz"),
        _matrix(Rotation.from_matrix(model.base[:3, :3])),
    ]
    for i, kind in enumerate(model.joints, start=1):
        move = values.get(f"gear{i}", 1.0) * command[i - 1]
        for wave, times in (("sin", 1), ("cos", 1), ("sin2", 2), ("cos2", 2)):
            shape = np.sin if wave.startswith("sin") else np.cos
            amplitude = values.get(f"theta{i} {wave}", 0.0)
            angle = values.get(f"gear{i}", 1.0) * np.radians(command[i - 1])
            move += amplitude * shape(times * angle)
        theta, d = values[f"theta{i}"], values[f"d{i}"]
        joint = [
            _turn("z", theta + (move if kind == "R" else 0.0)),
            _slide("z", d + (move if kind == "P" else 0.0)),
        ]
        link = [
            _slide("x", values[f"a{i}"]),
            _turn("x", values[f"alpha{i}"]),
            _turn("y", values[f"beta{i}"]),
        ]
        product += joint + link if model.convention == "standard" else link + joint
    product.append(_matrix(None, [values[f"tool {axis}"] for axis in "xyz"]))
    product.append(_matrix(Rotation.from_matrix(model.tool[:3, :3])))
    if isinstance(model.sensor, Pose):
        product += [_turn(axis, values[f"tool r{axis}"]) for axis in "xyz"]
    return functools.reduce(np.matmul, product)


@st.composite
def arms(draw, compliance=False):
    """Any small arm, commands for it and parameters near its nominal ones."""
    n = draw(st.integers(1, 5))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    joints = "".join(draw(st.sampled_from("RRP")) for _ in range(n))
    table = rng.uniform(-1.0, 1.0, (n, 4)) * [2.0, 180.0, 2.0, 180.0]
    for column, values in ((0, [0.0]), (1, [0.0, 90.0, -90.0]), (2, [0.0])):
        special = rng.random(n) < 0.4
        table[special, column] = rng.choice(values, special.sum())
    mountings = [
        _matrix(Rotation.random(rng=rng), rng.normal(size=3)) for _ in range(2)
    ]
    revolute = [i + 1 for i in range(n) if joints[i] == "R"]
    loads = [(int(rng.integers(1, n + 1)), 0.3, rng.normal(size=3)) for _ in range(2)]
    model = SerialChain.from_dh(
        table,
        draw(st.sampled_from(["standard", "modified"])),
        joints=joints,
        base=mountings[0],
        tool=mountings[1],
        sensor=draw(st.sampled_from([Position(), Pose()])),
        gears=[i + 1 for i in range(n) if rng.random() < 0.5],
        compliance=revolute[:2] if compliance else (),
        loads=loads if compliance else (),
        gravity=rng.normal(size=3),
    )
    commands = rng.uniform(-180.0, 180.0, (4, n))
    commands[:, [kind == "P" for kind in joints]] /= 100.0
    parameters = model.nominal + rng.normal(size=model.num_parameters) * 0.2
    return model, commands, parameters


def _outputs(model, command, parameters):
    values = dict(zip(model.names, parameters, strict=True))
    frame = tool_frame(model, command, values)
    if isinstance(model.sensor, Position):
        return frame[:3, 3]
    nominal = tool_frame(
        model, command, dict(zip(model.names, model.nominal, strict=True))
    )
    turn = Rotation.from_matrix(frame[:3, :3] @ nominal[:3, :3].T)
    return np.concatenate([frame[:3, 3], turn.as_rotvec(degrees=True)])


@hypothesis.given(arms())
def test_outputs_are_those_of_products_of_matrices(arm):
    model, commands, parameters = arm
    expected = [_outputs(model, command, parameters) for command in commands]
    for _ in range(2):
        outputs = model.predict(commands, parameters)
        np.testing.assert_allclose(outputs, expected, atol=1e-11)
        outputs[:] = np.nan  # they are the caller's


@hypothesis.settings(max_examples=25)
@hypothesis.given(arms(compliance=True))
def test_derivatives_are_those_of_central_differences(arm):
    model, commands, parameters = arm
    numeric = differences(lambda at: model.predict(commands, at), parameters)
    np.testing.assert_allclose(
        model.jacobian(commands, parameters), numeric, atol=2e-6, rtol=1e-6
    )
    by_command = np.stack(
        [
            (
                model.predict(commands + step, parameters)
                - model.predict(commands - step, parameters)
            )[:, :3]
            / 2e-4
            for step in np.eye(model.num_inputs) * 1e-4
        ],
        axis=-1,
    )
    np.testing.assert_allclose(
        model.command_jacobian(commands, parameters)[:, :3],
        by_command,
        atol=2e-6,
        rtol=1e-6,
    )


@hypothesis.given(arms())
def test_a_model_comes_back_from_json(arm):
    model, commands, parameters = arm
    again = from_dict(model.to_dict())
    assert again.to_dict() == model.to_dict()
    assert again.names == model.names and again.units == model.units
    np.testing.assert_array_equal(
        again.predict(commands, parameters), model.predict(commands, parameters)
    )


def test_a_command_turns_a_pose_against_the_orientation_it_is_compared_with():
    model = ur5(sensor=Pose())
    commands = ur5_data("ur5_random_20.csv")[0][:3]
    values = dict(zip(model.names, model.nominal, strict=True))
    frames = []
    for step in (1e-4, -1e-4):
        moved = commands + np.array([0, 0, 0, step, 0, 0])
        frames.append([tool_frame(model, each, values)[:3, :3] for each in moved])
    first, second = (model.rotation_vectors(commands, each) for each in frames)
    slope = model.command_jacobian(commands)[:, 3:, 3]
    np.testing.assert_allclose(slope, (first - second) / 2e-4, atol=1e-7)


def test_both_conventions_describe_the_same_arm():
    standard = SerialChain.from_dh(UR5_TABLE)
    rows = np.array(UR5_TABLE, dtype=float)
    modified = rows.copy()
    modified[0, :2] = 0.0
    modified[1:, :2] = rows[:-1, :2]  # a and alpha of the link before the joint
    craig = SerialChain.from_dh(modified, "modified")
    commands = np.random.default_rng(0).uniform(-180.0, 180.0, (20, 6))
    np.testing.assert_allclose(
        craig.predict(commands), standard.predict(commands), atol=1e-10
    )


@pytest.mark.parametrize("name", ["ur5_grid_1000.csv", "ur5_random_20.csv"])
def test_the_nominal_ur5_goes_to_its_targets(name):
    commands, targets, _ = ur5_data(name)
    assert np.abs(ur5().predict(commands) - targets).max() < 0.003


def test_the_names_of_a_six_axis_arm():
    names = ur5(gears=[1], compliance=[2]).names
    assert names[:5] == ("a1", "alpha1", "d1", "theta1", "beta1")
    assert names[30:32] == ("gear1", "compliance2")
    assert names[32:] == (
        *("base x", "base y", "base z", "base rx", "base ry", "base rz"),
        *("tool x", "tool y", "tool z"),
    )
    assert len(ur5().names) == 39 == ur5().num_parameters
    assert len(ur5(sensor=Pose()).names) == 42


def test_the_default_prior_follows_the_size_of_the_arm():
    millimetres = ur5(compliance=[2]).default_prior()
    metres = SerialChain.from_dh(
        np.array(UR5_TABLE) / [1000.0, 1.0, 1000.0, 1.0],
        tool=(0.0, 0.0, 0.031),
        compliance=[2],
    )
    ratio = np.array(millimetres.std) / np.array(metres.default_prior().std)
    by_unit = {"length": 1000.0, "deg": 1.0, "deg per torque": 0.001}
    np.testing.assert_allclose(ratio, [by_unit[unit] for unit in metres.units])
    std = dict(zip(ur5().names, ur5().default_prior().std, strict=True))
    assert 1.5 < std["a2"] < 2.1 and std["alpha3"] == 0.3 and std["theta3"] == 0.5
    assert 90.0 < std["base x"] < 130.0 and std["tool z"] == std["base x"]


def test_a_weight_bends_a_compliant_joint_by_its_torque():
    """A bar of 2 m with a weight of 3 at its end: torque 6 cos(u) about y."""
    bar = SerialChain.from_dh(
        [(2.0, 0.0, 0.0, 0.0)],
        base=_turn("x", 90.0),  # the axis is -y: up is positive
        compliance=[1],
        loads=[(1, 3.0, (0.0, 0.0, 0.0))],
    )
    parameters = bar.nominal
    parameters[bar.names.index("compliance1")] = 0.01
    for angle in (0.0, 60.0, 90.0):
        at = np.radians(angle - 0.01 * 6.0 * np.cos(np.radians(angle)))
        expected = [[2.0 * np.cos(at), 0.0, 2.0 * np.sin(at)]]
        np.testing.assert_allclose(
            bar.predict([[angle]], parameters), expected, atol=1e-12
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"table": [(0, 1.5708, 1, 0)]}, "look like right angles in radians"),
        ({"table": [(0, 90, 1)]}, r"table must have shape \(n, 4\)"),
        ({"joints": "RX"}, "joints must be 6 letters R"),
        ({"convention": "craig"}, "convention must be one of standard, modified"),
        ({"sensor": "angle"}, r"sensor must be of jaxcal.models, .* got 'angle'"),
        ({"gears": [7]}, "gears must be joints of 1 to 6, each once"),
        ({"compliance": [0]}, "compliance must be at least 1"),
        ({"joints": "PRRRRR", "compliance": [1]}, "joint 1 is prismatic"),
        ({"tool": (1, 2)}, r"tool must be a translation \(3,\) or a transform"),
        ({"base": 2 * np.eye(4)}, "the rotation of base must be a rotation"),
        ({"loads": [(9, 1.0, (0, 0, 0))]}, "link of a load must be at most 6"),
    ],
)
def test_what_cannot_be_an_arm_is_refused(options, message):
    given = {"table": UR5_TABLE, **options}
    with pytest.raises(ValueError, match=message):
        SerialChain.from_dh(**given)


def test_commands_and_parameters_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"commands must have shape \(N, 6\)"):
        ur5().predict(np.zeros((3, 5)))
    with pytest.raises(ValueError, match=r"parameters must have shape \(39,\)"):
        ur5().jacobian(np.zeros((3, 6)), np.zeros(38))


def test_harmonics_move_the_joints_and_have_derivatives():
    model = ur5(harmonics=(2, 3, 5), gears=(3,))
    rng = np.random.default_rng(0)
    joints = rng.uniform(-120.0, 120.0, (5, 6))
    theta = model.nominal + rng.normal(size=len(model.names))
    theta[model.names.index("gear3")] = 1.01
    values = dict(zip(model.names, theta, strict=True))
    expected = [tool_frame(model, row, values)[:3, 3] for row in joints]
    np.testing.assert_allclose(model.predict(joints, theta), expected, atol=1e-9)
    numeric = differences(lambda at: model.predict(joints, at), theta)
    np.testing.assert_allclose(model.jacobian(joints, theta), numeric, atol=1e-5)
    rate = np.stack(
        [
            (model.predict(joints + by, theta) - model.predict(joints - by, theta))
            / 2e-4
            for by in 1e-4 * np.eye(6)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(model.command_jacobian(joints, theta), rate, atol=1e-5)
    again = model.calibrated(theta)
    np.testing.assert_allclose(again.predict(joints), expected, atol=1e-9)
    assert from_dict(model.to_dict()).to_dict() == model.to_dict()


def test_harmonics_are_of_revolute_joints():
    with pytest.raises(ValueError, match="harmonics must name revolute joints, joint"):
        SerialChain.from_dh([(0, 0, 0, 0)], joints="P", harmonics=[1])
    with pytest.raises(ValueError, match=r"waves must have shape \(1, 4\)"):
        ur5(harmonics=[1], waves=[0.1])


def test_contacts_are_missed_by_more_by_a_larger_arm_wherever_it_stands():
    arm = ur5(sensor=Socket(2))
    commands = np.random.default_rng(0).uniform(-150.0, 150.0, (9, 7))
    names, length = np.array(arm.names), np.array(arm.units) == "length"
    theta = arm.nominal + np.where(length, 1.0, 0.3)
    slopes = arm.fitting.log_size_jacobian(commands, theta)
    larger = arm.fitting.log_size(commands, np.where(length, 1.3, 1.0) * theta)
    np.testing.assert_allclose(
        larger - arm.fitting.log_size(commands, theta), np.log(1.3)
    )
    by_lengths = differences(lambda t: arm.fitting.log_size(commands, t), theta)
    np.testing.assert_allclose(slopes[:, length], by_lengths[:, length], atol=1e-9)
    stands = slopes[:, np.isin(names, ["d1", "base x"])]
    np.testing.assert_allclose(stands, 0.0, atol=1e-15)
    assert arm.measured_with(Position()).fitting.log_size(commands, theta) is None
    # On a rail that stands still it is the same arm; the rail's way shows the size.
    rows = [(0, -90, 0, 0), *np.array(UR5_TABLE)[:, :4].tolist()]
    rail = SerialChain.from_dh(
        rows, joints="PRRRRRR", tool=(0, 0, 31), sensor=Socket(2)
    )
    along = np.column_stack([np.full(9, 700.0), commands])
    np.testing.assert_allclose(
        rail.fitting.log_size(along, rail.nominal),
        arm.fitting.log_size(commands, arm.nominal),
    )
    slopes = rail.fitting.log_size_jacobian(along, rail.nominal)
    by_all = differences(lambda t: rail.fitting.log_size(along, t), rail.nominal)
    length = np.array(rail.units) == "length"
    np.testing.assert_allclose(slopes[:, length], by_all[:, length], atol=1e-9)
    along[0, 0] = 701.0  # jitter
    assert rail.fitting.log_size(along, rail.nominal) is not None
    along[0, 0] = 800.0
    assert rail.fitting.log_size(along, rail.nominal) is None


def test_an_arm_whose_joint_follows_another_stands_as_one_elsewhere():
    """The limits are of the two columns, not of the three joints."""
    table = [(300.0, 0, 100, 0), (250, 90, 0, 0), (100, 0, 50, 0)]
    arm = SerialChain.from_dh(table, drive=[[1, 0], [0.5, 0], [0, 1]])
    base = np.eye(4)
    base[:3, 3] = 10.0, -20.0, 5.0
    there = SerialChain.from_dh(table, drive=arm.drive, base=base)
    moved = standing_as(arm, there, arm.nominal, np.zeros((1, 2)))
    at = arm.names.index("base x")
    np.testing.assert_allclose(moved[at : at + 3], base[:3, 3], atol=1e-9)
