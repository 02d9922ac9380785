"""Sensors against what they mean, written out a posture at a time, and differences."""

from __future__ import annotations

import dataclasses
import json
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.arms.sensors import SENSORS, Flush, Reading
from jaxcal.models import (
    Board,
    Distance,
    Gravity,
    Plane,
    Pose,
    Position,
    Sensor,
    SerialChain,
    Several,
    Socket,
    Wrench,
    from_dict,
    identifiability,
)

from .arms import CONTACTS, UR5_TABLE, differences, ur5
from .test_serial_chain import _matrix, tool_frame

RNG = np.random.default_rng(0)
PANDA = CONTACTS / "panda.urdf"
JOINTS = RNG.uniform(-120.0, 120.0, (6, 6))
WHICH = np.array([0.0, 1.0, 0.0, 1.0, 1.0, 0.0])[:, None]
SEEN = np.hstack([RNG.normal(size=(6, 3)) * 300.0, RNG.normal(size=(6, 3)) * 60.0])
PLACE = _matrix(Rotation.random(rng=RNG), RNG.normal(size=3) * 500.0)
SOCKETS = np.array([[400.0, 100.0, 0.0], [400.0, 150.0, 0.0]])
PLANES = np.array([[0.0, 0.0, 1.0, 20.0], [1.0, 2.0, 2.0, 300.0]])
ANCHORS = np.array([[900.0, 0.0, 0.0, 5.0], [0.0, 900.0, 100.0, 0.0]])
MOUNT = _matrix(Rotation.random(rng=RNG), [30.0, -20.0, 50.0])


def _board(moves, tip, row, own):
    stand = _matrix(None, own[:3])
    for axis, angle in zip("xyz", own[3:6], strict=True):
        stand = stand @ _matrix(Rotation.from_euler(axis, angle, degrees=True))
    stand = stand @ _matrix(Rotation.from_matrix(PLACE[:3, :3]))
    first, second = (tip, stand) if moves == "camera" else (stand, tip)
    board = np.linalg.inv(first) @ second
    seen = Rotation.from_rotvec(row[3:], degrees=True).as_matrix()
    turn = Rotation.from_matrix(board[:3, :3] @ seen.T).as_rotvec(degrees=True)
    return [*(board[:3, 3] - row[:3]), *turn]


def _plane(tip, row, own):
    normal = PLANES[int(row[0]), :3] / np.linalg.norm(PLANES[int(row[0]), :3])
    tilt1, tilt2, offset = own.reshape(2, 3)[int(row[0])]
    least = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, least) / np.linalg.norm(np.cross(normal, least))
    second = np.cross(normal, first)
    leaning = normal + np.radians(tilt1) * first + np.radians(tilt2) * second
    return [leaning / np.linalg.norm(leaning) @ tip[:3, 3] - offset]


def _flush(tip, row, own):
    """The height, and the x and y of the normal in the tip's frame, as degrees."""
    lifted = tip.copy()
    step = 1.0  # the height is linear
    heights = [_plane(tip, row, own)[0]]
    for axis in tip[:3, :2].T:  # how the height changes along the face
        lifted[:3, 3] = tip[:3, 3] + step * axis
        rise = (_plane(lifted, row, own)[0] - heights[0]) / step
        heights.append(np.degrees(rise))
    return heights


def _distance(tip, row, own):
    x, y, z, zero = own.reshape(2, 4)[int(row[0])]
    return [np.linalg.norm(tip[:3, 3] - [x, y, z]) - zero]


def _weight(tip, row, own):
    down = -own[0] * 9.81 * np.array([0.1, 0.0, 1.0]) / np.sqrt(1.01)
    force = tip[:3, :3].T @ down
    return [*(force + own[4:7]), *(np.cross(own[1:4], force) + own[7:])]


CORNERS = np.array([[x, y, 0.0] for x in (0.0, 30.0, 60.0) for y in (0.0, 40.0)])
CAMERA = (800.0, 820.0, 320.0, 240.0)


def _pixels(moves, tip, own):
    """Corner by corner, by matrices of OpenCV's pinhole."""
    nowhere = np.zeros(6)
    x, y, z, *turn = _board(moves, tip, nowhere, own)
    turn = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    fx, fy, cx, cy = own[6:] if len(own) > 6 else CAMERA
    inside = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0, 0, 1]])
    found = []
    for corner in CORNERS:
        u, v, w = inside @ (turn @ corner + [x, y, z])
        found += [u / w, v / w]
    return found


# Sensor, columns of the commands after the joints, readings (tip, columns, own).
CASES = {
    "position": (Position(), np.zeros((6, 0)), lambda tip, row, own: tip[:3, 3]),
    "socket": (
        Socket(2, SOCKETS),
        WHICH,
        lambda tip, row, own: tip[:3, 3] - own.reshape(2, 3)[int(row[0])],
    ),
    "plane": (Plane(2, PLANES), WHICH, _plane),
    "flush": (Flush(2, PLANES), WHICH, _flush),
    "distance": (Distance(2, ANCHORS), WHICH, _distance),
    "gravity": (
        Gravity(up=(0.1, 0.0, 1.0)),
        np.zeros((6, 0)),
        lambda tip, row, own: (
            own[0] * 9.81 * tip[:3, :3].T @ [0.1, 0.0, 1.0] / np.sqrt(1.01) + own[1:]
        ),
    ),
    "wrench": (Wrench(up=(0.1, 0.0, 1.0)), np.zeros((6, 0)), _weight),
    "camera on the tip": (
        Board("camera", PLACE),
        SEEN,
        lambda tip, row, own: _board("camera", tip, row, own),
    ),
    "board on the tip": (
        Board("board", PLACE),
        SEEN,
        lambda tip, row, own: _board("board", tip, row, own),
    ),
    "pixels on the tip": (
        Board("camera", PLACE, CORNERS, CAMERA),
        np.zeros((6, 0)),
        lambda tip, row, own: _pixels("camera", tip, own),
    ),
    "pixels of a lens that is not known": (
        Board("board", PLACE, CORNERS, CAMERA, intrinsics=True),
        np.zeros((6, 0)),
        lambda tip, row, own: _pixels("board", tip, own),
    ),
    "pixels from afar": (
        Board("board", PLACE, CORNERS, CAMERA),
        np.zeros((6, 0)),
        lambda tip, row, own: _pixels("board", tip, own),
    ),
}


def _case(name):
    sensor, columns, readings = CASES[name]
    model = ur5(sensor=sensor, compliance=())
    parameters = model.nominal + np.random.default_rng(1).normal(size=len(model.names))
    return model, np.hstack([JOINTS, columns]), parameters, readings


@pytest.mark.parametrize("name", CASES)
def test_readings_are_what_the_sensor_means(name):
    model, commands, parameters, readings = _case(name)
    values = dict.fromkeys(
        [f"tool {a}" for a in ("x", "y", "z", "rx", "ry", "rz")], 0.0
    )
    values["tool z"] = 31.0
    values |= dict(zip(model.names, parameters, strict=True))
    posed = ur5(sensor=Pose())  # so that all turns of the tool are there
    own = parameters[len(parameters) - len(model.sensor.names) :]
    expected = [
        readings(tool_frame(posed, command, values), command[6:], own)
        for command in commands
    ]
    np.testing.assert_allclose(
        model.predict(commands, parameters), expected, atol=1e-9, rtol=1e-12
    )


@pytest.mark.parametrize("name", [*CASES, "several"])
def test_derivatives_are_those_of_central_differences(name):
    if name == "several":
        model, commands, parameters = _several()
    else:
        model, commands, parameters, _ = _case(name)
    numeric = differences(lambda at: model.predict(commands, at), parameters)
    size = np.abs(numeric).max(axis=(0, 1)) + 1e-9
    slopes = model.jacobian(commands, parameters)
    np.testing.assert_allclose(slopes / size, numeric / size, atol=1e-6)
    assert model.jacobian(commands).shape == (*numeric.shape[:2], len(model.names))
    by_command = np.stack(
        [
            (
                model.predict(commands + step, parameters)
                - model.predict(commands - step, parameters)
            )
            / 2e-4
            for step in np.eye(model.num_inputs)[:6] * 1e-4
        ],
        axis=-1,
    )
    found = model.command_jacobian(commands, parameters)[..., :6]
    np.testing.assert_allclose(found, by_command, atol=1e-5 * np.abs(by_command).max())


def _several():
    sensors = (Position(), Socket(2, SOCKETS), Gravity(), Board("camera", PLACE))
    mounts = [MOUNT, np.linalg.inv(MOUNT), MOUNT @ MOUNT]
    model = ur5(sensor=Several(sensors, mounts))
    tables = [(JOINTS, JOINTS[:, :3]), (np.hstack([JOINTS, WHICH]), None)]
    tables += [(JOINTS, JOINTS[:, :3]), (np.hstack([JOINTS, SEEN]), None)]
    commands, _ = model.together(*tables)
    parameters = model.nominal + np.random.default_rng(1).normal(size=len(model.names))
    return model, commands, parameters


def test_several_sensors_read_what_each_reads_where_it_is_mounted():
    model, commands, parameters = _several()
    values = dict(zip(model.names, parameters, strict=True))
    length, inputs = model.length, (*model.joint_names, *model.sensor.inputs)
    found = model.predict(commands, parameters)
    for i, one in enumerate(model.sensor.sensors):
        rows = commands[:, 6] == i
        tool = _matrix(None, [values[f"tool {axis}"] for axis in "xyz"])
        if i:
            shift = np.array(model.sensor.mounts)[i - 1][:3, 3]
            given = dict(zip(["x", "y", "z"], shift, strict=True))
            title = f"{one.kind} tool "
            given |= {n[len(title) :]: values[n] for n in values if n.startswith(title)}
            tool = tool @ _matrix(None, [given[axis] for axis in "xyz"])
            for axis in "xyz":
                turn = Rotation.from_euler(
                    axis, given.get(f"r{axis}", 0.0), degrees=True
                )
                tool = tool @ _matrix(turn)
            turn = Rotation.from_matrix(np.array(model.sensor.mounts)[i - 1][:3, :3])
            tool = tool @ _matrix(turn)
        alone = SerialChain.from_dh(
            model.table[:, :4], tool=tool, sensor=one, compliance=()
        )
        theta = alone.nominal.copy()
        for k, name in enumerate(alone.names):
            if not name.startswith("tool"):
                theta[k] = values[name]
        columns = [inputs.index(name) for name in (*alone.joint_names, *one.inputs)]
        expected = alone.predict(commands[np.ix_(rows, columns)], theta)
        width = len(one.outputs)
        np.testing.assert_allclose(
            found[rows, :width], expected / one.stds(length), atol=1e-7, rtol=1e-9
        )
        assert (found[rows, width:] == 0.0).all()


@pytest.mark.parametrize("name", [*CASES, "several"])
def test_a_sensor_comes_back_from_json(name):
    model, commands, parameters = (_several() if name == "several" else _case(name))[:3]
    again = from_dict(model.to_dict())
    assert again.to_dict() == model.to_dict() and again.units == model.units
    np.testing.assert_array_equal(
        again.predict(commands, parameters), model.predict(commands, parameters)
    )
    assert set(SENSORS) >= {"position", "pose", "socket", "plane", "distance"}


@pytest.mark.parametrize("moves", ["camera", "board"])
def test_hand_and_eye_are_found_without_a_guess(moves):
    """A tool turned by 180 degrees and a place anywhere, from poses without noise."""
    turned = _matrix(Rotation.from_euler("x", 180.0, degrees=True), [20.0, -30.0, 40.0])
    tool = _matrix(Rotation.from_euler("z", 100.0, degrees=True)) @ turned
    true = SerialChain.from_dh(ur5().table[:, :4], tool=tool, sensor=Pose())
    frames = [
        tool_frame(true, q, dict(zip(true.names, true.nominal, strict=True)))
        for q in JOINTS
    ]
    seen = []
    for tip in frames:
        first, second = (tip, PLACE) if moves == "camera" else (PLACE, tip)
        board = np.linalg.inv(first) @ second
        turn = Rotation.from_matrix(board[:3, :3]).as_rotvec(degrees=True)
        seen.append([*board[:3, 3], *turn])
    model = ur5(sensor=Board(moves))
    commands = np.hstack([JOINTS, seen])
    found = model.located(commands)
    np.testing.assert_allclose(found.tool, tool, atol=1e-8)
    np.testing.assert_allclose(found.sensor.place, PLACE, atol=1e-8)
    np.testing.assert_allclose(found.predict(commands), 0.0, atol=1e-8)
    ahead = np.array(seen)[:, 2] > 0.0  # of the camera: the others' pixels do not exist
    wide = ur5(sensor=Board(moves, None, CORNERS, CAMERA))
    pixels = found.measured_with(
        Board(moves, found.sensor.place, CORNERS, CAMERA)
    ).predict(JOINTS[ahead])
    if ahead.sum() > 2:
        again = wide.located(JOINTS[ahead], pixels)
        np.testing.assert_allclose(again.tool, tool, atol=1e-5)
        np.testing.assert_allclose(again.sensor.place, PLACE, atol=1e-5)
    with pytest.raises(ValueError, match="about two axes in these views"):
        still = np.repeat(commands[:1], 5, axis=0)
        model.located(still)


def _views(moves, count=20, joints=None):
    """Postures and poses of a board seen in them, by frames alone; mm and degrees."""
    if joints is None:
        joints = np.random.default_rng(5).uniform(-100.0, 100.0, (count, 6))
    stand = _matrix(Rotation.from_euler("xyz", [3.0, 0.1, 2.0]), (600.0, 100.0, 0.0))
    arm = SerialChain.from_dh(UR5_TABLE)
    values = dict(zip(arm.names, arm.nominal, strict=True))
    tips = [tool_frame(arm, row, values) @ MOUNT for row in joints]
    ends = [(tip, stand) if moves == "camera" else (stand, tip) for tip in tips]
    seen = np.array([np.linalg.inv(camera) @ board for camera, board in ends])
    return joints, seen


def _as_columns(poses):
    vectors = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec(degrees=True)
    return np.hstack([poses[:, :3, 3], vectors])


def test_a_board_of_another_size_is_named():
    """Its squares 8 % too large: the arm is stretched, and every pixel is met."""
    first, seen = _views("camera", 200)
    aside = np.abs(seen[:, :2, 3] / seen[:, 2:3, 3]).max(axis=1)
    first = first[np.where(seen[:, 2, 3] > 0.0, aside, np.inf).argmin()]
    drawn = first + np.random.default_rng(1).uniform(-40.0, 40.0, (60, 6))
    joints, seen = _views("camera", joints=drawn)
    aside = np.abs(seen[:, :2, 3] / seen[:, 2:3, 3]).max(axis=1)
    ahead = (seen[:, 2, 3] > 0.0) & (aside < 0.5)
    joints, seen = joints[ahead], _as_columns(seen[ahead])
    arm = SerialChain.from_dh(UR5_TABLE, sensor=Board("camera"))
    true = arm.located(np.hstack([joints, seen]))
    stand = true.sensor.place
    pixels = true.measured_with(Board("camera", stand, CORNERS, CAMERA)).predict(joints)
    pixels = pixels + np.random.default_rng(0).normal(0.0, 0.2, pixels.shape)
    for by, good in ((1.0, True), (1.08, False)):
        model = SerialChain.from_dh(
            UR5_TABLE, sensor=Board("camera", None, by * CORNERS, CAMERA)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            found = jaxcal.identify(joints, pixels, model=model)
        told = "a board of another size" in str(found.verdict)
        assert (found.verdict.good, told) == (good, not good)


@pytest.mark.parametrize("moves", ["camera", "board"])
def test_views_in_another_convention_are_told_by_name(moves):
    joints, seen = _views(moves)
    model = SerialChain.from_dh(UR5_TABLE, sensor=Board(moves))
    right = _as_columns(seen)
    metres, radians, euler = right.copy(), right.copy(), right.copy()
    metres[:, :3] /= 1000.0
    radians[:, 3:] = np.radians(right[:, 3:])
    turns = Rotation.from_matrix(seen[:, :3, :3])
    euler[:, 3:] = turns.as_euler("xyz", degrees=True)
    for columns, how in (
        (_as_columns(np.linalg.inv(seen)), "inverted, or with camera and board"),
        (metres, "multiplied by 1000"),
        (radians, "turns in degrees"),
        (euler, "Euler angles as rotation vectors"),
    ):
        with pytest.raises(ValueError, match=f"fit the arm only .*{how}"):
            model.located(np.hstack([joints, columns]))
    right[:4, :3] += [[90.0], [-50.0], [70.0], [40.0]]  # and bad views do no harm
    found = model.located(np.hstack([joints, right]))
    np.testing.assert_allclose(found.tool, MOUNT, atol=1e-5)
    right += np.random.default_rng(1).normal(size=right.shape) * [
        1,
        1,
        1,
        0.1,
        0.1,
        0.1,
    ]
    fit = jaxcal.identify(np.hstack([joints, right]), np.zeros((20, 6)), model=model)
    np.testing.assert_allclose(fit.arm.tool[:3, 3], MOUNT[:3, 3], atol=4.0)
    assert "Rows 0, 1, 2, 3 are outliers" in str(fit.verdict)


@pytest.mark.parametrize("moves", ["camera", "board"])
def test_a_camera_that_is_found_is_good_however_accurate_the_arm(moves):
    noise = [1.0] * 3 + [0.1] * 3
    model = SerialChain.from_dh(UR5_TABLE, sensor=Board(moves))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        joints, seen = _views(moves)  # of an arm without errors
        read = _as_columns(seen) + noise * rng.normal(size=(len(seen), 6))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
            found, wrong = (
                jaxcal.identify(np.hstack([joints, views]), 0.0 * read, model=model)
                for views in (read, np.roll(read, 1, axis=0))
            )
        off = np.linalg.norm(found.arm.tool[:3, 3] - MOUNT[:3, 3])
        assert found.verdict.good and off < 3.0 * found.verdict.place.std[0] < 36.0
        assert "Position of the camera or board" in str(found.verdict)
        assert not wrong.verdict.good


def test_sockets_planes_and_anchors_are_found_from_nominal_postures():
    commands = np.hstack([JOINTS, WHICH])
    points = ur5().predict(JOINTS)
    model = ur5(sensor=Socket(2)).located(commands)
    middle = [points[WHICH[:, 0] == i].mean(axis=0) for i in range(2)]
    np.testing.assert_allclose(model.sensor.places, middle)
    assert model.located(commands[:1]).sensor.places is model.sensor.places
    many = np.random.default_rng(2).uniform(-120.0, 120.0, (20, 6))
    wire = ur5(sensor=Distance(1))
    far = np.linalg.norm(ur5().predict(many) - ANCHORS[0, :3], axis=1, keepdims=True)
    found = wire.located(many, far).sensor.places
    np.testing.assert_allclose(found, [[*ANCHORS[0, :3], 0.0]], atol=1e-8)
    found = wire.located(many, far + 300.0).sensor.places  # and its zero
    np.testing.assert_allclose(found, [[*ANCHORS[0, :3], -300.0]], atol=1e-8)
    with pytest.raises(ValueError, match="anchor 0 has 3 lengths, four are needed"):
        wire.located(many[:3], far[:3])
    with pytest.raises(ValueError, match=r"anchor 0 do not fit .* unit of the arm"):
        wire.located(many, far / 1000.0)
    plane = ur5(sensor=Plane()).located(many)
    offs = plane.predict(many)
    rng = np.random.default_rng(3)
    for _ in range(50):  # no other plane is nearer
        normal = rng.normal(size=3)
        heights = ur5().predict(many) @ normal / np.linalg.norm(normal)
        assert offs.std() <= heights.std() and abs(offs.mean()) < 1e-9


def test_distances_between_sockets_are_facts():
    model = ur5(sensor=Socket(2, SOCKETS, distances=[(0, 1, 49.0, 0.1)]))
    off, rows = model.fitting.facts()
    np.testing.assert_allclose(off, [-10.0])
    numeric = differences(lambda at: -model.fitting.facts(at)[0], model.nominal)
    np.testing.assert_allclose(rows, numeric, atol=1e-6)
    both = ur5(sensor=Several((Position(), model.sensor)))
    off, rows = both.fitting.facts()
    assert off[0] == pytest.approx(-10.0)
    assert [n for n, r in zip(both.names, rows[0], strict=True) if r] == [
        "socket0 y",
        "socket1 y",
    ]
    assert ur5().fitting.facts()[1].shape == (0, 39)


def test_wrong_readings_of_one_of_several_sensors_are_refused():
    arm = ur5(sensor=Several((Position(), Socket(2, distances=[(0, 1, 50.0, 0.1)]))))
    joints = np.random.default_rng(4).uniform(-120.0, 120.0, (12, 6))
    seen = ur5().predict(joints)
    contacts = np.column_stack([joints, np.arange(12) % 2])
    for at, message in (
        (0.001, "measured must be in the model's unit"),
        (1.0, "at one point"),
    ):
        together = arm.together((joints, at * seen), (contacts, None))
        with pytest.raises(ValueError, match=message):
            jaxcal.identify(*together, model=arm)


def _elsewhere(sensor):
    """The arm in a frame that is turned by 100 degrees and 3 m away."""
    far = _matrix(Rotation.from_euler("z", 100.0, degrees=True), [3000.0, -2000.0, 0.0])
    return far, SerialChain.from_dh(UR5_TABLE, tool=MOUNT, base=far, sensor=sensor)


def test_a_trackers_frame_is_found_where_it_is_not_the_first_sensor():
    shift = _matrix(None, [400.0, 0.0, 0.0])  # of the reflector on the tool
    sensors = Several((Gravity(), Position()), [shift])
    far, true = _elsewhere(sensors)
    together = true.together((JOINTS, None), (JOINTS, None))[0]
    found = SerialChain.from_dh(UR5_TABLE, tool=MOUNT, sensor=sensors)
    found = found.located(together, true.predict(together))
    np.testing.assert_allclose(found.base, far, atol=1e-8)


def test_poses_in_a_frame_far_from_the_arms_are_told_the_base():
    far, true = _elsewhere(Pose())
    arm = SerialChain.from_dh(UR5_TABLE, tool=MOUNT, sensor=Pose())
    with pytest.raises(ValueError, match="base is missing: with Pose") as told:
        arm.located(JOINTS, true.predict(JOINTS))
    given = json.loads(str(told.value).split("base=")[1].split(";")[0])
    np.testing.assert_allclose(given, far, atol=1e-6)
    SerialChain.from_dh(UR5_TABLE, base=given)  # as it stands
    near = true.predict(JOINTS)
    near[:, 0] += 1000.0  # which the fit finds
    assert true.located(JOINTS, near) is true


def test_what_a_sensor_cannot_see_is_held_and_named():
    base = [f"base {axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")]
    for sensor in (Socket(), Plane(), Distance(), Board()):
        assert list(ur5(sensor=sensor).default_prior().fixed) == base
    held = ur5(sensor=Gravity()).default_prior().fixed
    assert {"a2", "d1", "base x", "base rz"} <= set(held) and "theta2" not in held
    both = ur5(sensor=Several((Socket(), Gravity())))
    assert both.default_prior().fixed == ("base x", "base y", "base z", "base rz")
    assert not ur5(sensor=Several((Position(), Socket()))).default_prior().fixed
    many = np.random.default_rng(2).uniform(-120.0, 120.0, (60, 6))
    report = identifiability(ur5(sensor=Socket()), many)
    assert report.held == tuple(base)
    assert (
        str(report).splitlines()[-1] == f"Held at the nominal value: {', '.join(base)}"
    )


def test_gravity_finds_the_zeros_of_joints_from_twelve_postures():
    """Of an arm whose axes are where its table has them; 3 simulated arms."""
    arm = SerialChain.from_urdf(PANDA, tip="ball_link", sensor=Gravity())
    prior = arm.default_prior()
    exact = np.isin(arm.names, prior.fixed)
    exact |= [name.startswith(("alpha", "beta")) for name in arm.names]
    std = np.where(exact, 0.0, np.asarray(prior.std))
    low, high = np.clip(arm.limits, -150.0, 150.0).T
    offered = np.random.default_rng(0).uniform(low, high, (100, 7))
    names = [f"theta{i}" for i in range(2, 7)]  # not about the vertical, the tool's
    chosen = jaxcal.select(
        offered, 12, "exchange", model=arm, criterion=jaxcal.As(names)
    ).indices
    at = [arm.names.index(name) for name in names]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = arm.nominal + std * rng.normal(size=len(std))
        felt = arm.predict(offered[chosen], truth) + 0.00981 * rng.normal(size=(12, 3))
        found = jaxcal.identify(offered[chosen], felt, model=arm)
        assert np.sqrt(np.mean((found.parameters - truth)[at] ** 2)) < 0.05


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda felt: felt / 9.81,
            r"have magnitude 9.81 within 20 %, got 1 .*magnitude=",
        ),
        (lambda felt: 1000.0 * felt, "within 20 %, got 9810"),
        (
            lambda felt: -felt,
            r"along up, \(0, 0, 1\), got \(0, 0, -1\) .*negate",
        ),
        (
            lambda felt: Rotation.from_euler("z", -90.0, degrees=True).apply(felt),
            r"turned by 90 degrees .* vector \(0, 0, 90\) in degrees",
        ),
    ],
)
def test_gravity_in_another_unit_or_frame_is_told_by_name(change, told):
    arm = ur5(sensor=Gravity())
    felt = arm.predict(JOINTS)
    assert arm.located(JOINTS, felt + 0.4) is arm  # a bias
    with pytest.raises(ValueError, match=told):
        arm.located(JOINTS, change(felt))
    little = Rotation.from_euler("xy", [10.0, 7.0], degrees=True).apply(felt)
    for row in range(6):  # one direction of up shows no turn about itself
        assert arm.located(JOINTS[[row]], little[[row]]) is arm
    turned = _matrix(Rotation.from_euler("z", 90.0, degrees=True), [0.0, 0.0, 31.0])
    given = SerialChain.from_dh(UR5_TABLE, tool=turned, sensor=Gravity())
    same = Rotation.from_euler("z", -90.0, degrees=True).apply(felt)
    np.testing.assert_allclose(given.predict(JOINTS), same, atol=1e-9)


def _weighed(seed=7, count=8):
    """Postures, readings of 1.6 kg on a sensor turned by MOUNT, by frames alone."""
    rng = np.random.default_rng(seed)
    joints, own = rng.uniform(-150.0, 150.0, (count, 6)), rng.normal(size=6)
    arm = SerialChain.from_dh(UR5_TABLE)
    values = dict(zip(arm.names, arm.nominal, strict=True))
    tips = [tool_frame(arm, row, values) @ MOUNT for row in joints]
    forces = np.array([tip[:3, :3].T @ [0.0, 0.0, -9.81] for tip in tips])
    read = np.hstack([1.6 * forces, 1.6 * np.cross([10.0, -5.0, 80.0], forces)]) + own
    noise = np.array([0.1] * 3 + [5.0] * 3)
    return joints, read + noise * rng.normal(size=read.shape), forces, noise


def test_a_load_is_weighed_as_by_linear_least_squares():
    """Where mounting and gravity are known it is linear in m, m c and six zeros."""
    joints, read, forces, noise = _weighed()
    rows = []
    for force in forces:
        lever = -np.cross(np.eye(3), force).T  # of torque = (m c) x force
        rows.append(np.hstack([force, np.zeros(3)])[:, None])
        rows[-1] = np.hstack([rows[-1], np.vstack([np.zeros((3, 3)), -lever])])
        rows[-1] = np.hstack([rows[-1], np.eye(6)])
    white = np.tile(noise, len(joints))
    matrix = np.concatenate(rows) / white[:, None]
    x = np.linalg.lstsq(matrix, read.ravel() / white)[0]
    model = SerialChain.from_dh(UR5_TABLE, tool=MOUNT, sensor=Wrench())
    arm = [name for name in model.names if name not in model.sensor.names]
    prior = jaxcal.Prior(np.inf, fixed=arm)
    options = {"noise": jaxcal.Noise(std=noise), "loss": "gaussian", "prior": prior}
    found = jaxcal.identify(joints, read, model=model, **options)
    own = dict(zip(found.names, found.parameters, strict=True))
    own = np.array([own[name] for name in model.sensor.names])
    np.testing.assert_allclose(own, [x[0], *x[1:4] / x[0], *x[4:]], rtol=1e-6)


def test_how_a_wrench_is_mounted_is_found_and_its_mistakes_are_named():
    joints, read, forces, _ = _weighed()
    arm = SerialChain.from_dh(UR5_TABLE, sensor=Wrench())
    found = jaxcal.identify(joints, read, model=arm)
    own = dict(zip(found.names, found.parameters, strict=True))
    assert own["mass"] == pytest.approx(1.6, abs=0.05) and found.verdict.good
    # A controller that subtracts an old payload leaves readings of what is left of it.
    assert "show a mass of" in str(found.verdict)
    said = found.check(joints, read)
    assert [*said.tolerances] == ["N", "N length"]
    assert f"a change of {said.tolerance:.3g} N or " in str(said)
    turn = found.arm.tool[:3, :3].T @ MOUNT[:3, :3]
    assert np.degrees(Rotation.from_matrix(turn).magnitude()) < 2.0
    with pytest.raises(ValueError, match="negate forces and torques") as told:
        arm.located(joints, -read)
    for cause in (
        "hangs from the ceiling",
        "Wrench(up=(0, 0, -1))",
        "a payload heavier",
    ):
        assert cause in str(told.value)
    hanging = SerialChain.from_dh(UR5_TABLE, sensor=Wrench(up=(0.0, 0.0, -1.0)))
    assert hanging.located(joints, -read) is not hanging  # as it was said to be
    with pytest.raises(
        ValueError, match=r"up = \(0, 0, 1\), or with up = \(0, 0, -1\)"
    ):
        SerialChain.from_dh(UR5_TABLE, sensor=Wrench(up=(1.0, 0.0, 0.0))).located(
            joints, 1.6 * np.hstack([forces, forces]) * [1, 1, 1, 10, 10, 10]
        )
    with pytest.raises(ValueError, match="arm's unit of length"):
        arm.located(joints, read * [1, 1, 1, 1e3, 1e3, 1e3])
    assert arm.located(joints[:3], read[:3]) is arm  # too few to tell
    scara = [(325, 0, 300, 0), (225, 180, 0, 0), (0, 0, 100, 0), (0, 0, 50, 0)]
    upright = SerialChain.from_dh(scara, joints="RRPR", sensor=Wrench())
    for seed in range(9):  # nothing is tilted, so noise alone differs
        read = np.random.default_rng(seed).normal(size=(8, 6))
        assert upright.located(joints[:, :4], read) is upright


@dataclasses.dataclass(frozen=True, eq=False)
class Height(Sensor):
    """A stranger's: the height of the tip above the measuring frame."""

    kind = "height"

    @property
    def outputs(self):
        return ("height",)

    def usual_noise(self, length):
        return 1e-4 * length

    def read(self, tip, inputs, own):
        by_tip = np.zeros((len(tip.position), 1, 6))
        by_tip[:, 0, 2] = 1.0
        return Reading(tip.position[:, 2:], by_tip, np.zeros((len(by_tip), 1, 0)))


def test_a_sensor_of_ones_own_needs_no_more_than_a_class():
    model = ur5(sensor=Height())
    np.testing.assert_array_equal(model.predict(JOINTS), ur5().predict(JOINTS)[:, 2:])
    np.testing.assert_array_equal(model.jacobian(JOINTS), ur5().jacobian(JOINTS)[:, 2:])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Socket(0), "count must be at least 1"),
        (lambda: Socket(2, np.zeros((3, 3))), r"places must have shape \(2, 3\)"),
        (lambda: Socket(2, distances=[(0, 1, 50.0)]), "distances must be rows"),
        (
            lambda: Socket(2, distances=[(0, 2, 50.0, 0.1)]),
            "two of 2 sockets, counted from 0",
        ),
        (
            lambda: Socket(2, distances=[(1, 1, 50.0, 0.1)]),
            "two of 2 sockets, counted from 0",
        ),
        (lambda: Plane(1, [[0, 0, 0, 1]]), "must have normals other than zero"),
        (lambda: Gravity(up=(0, 0, 0)), "up must be a direction"),
        (lambda: Gravity(0.0), "magnitude must be positive"),
        (lambda: Wrench(mass=0.0), "mass must be positive, got 0.0"),
        (lambda: Board(corners=np.eye(3)), "corners must be four or more rows"),
        (lambda: Board(corners=CORNERS), "camera must be .fx, fy, cx, cy. in pixels"),
        (lambda: Board("hand"), "moves must be one of camera, board"),
        (lambda: Several((Position(),)), "sensors must hold at least two sensors"),
        (lambda: ur5(sensor=Socket(noise=-1.0)).default_noise(), "noise of the sensor"),
        (
            lambda: ur5(sensor=Socket(2)).predict(np.full((1, 7), 2.0)),
            r"column socket of commands must be a whole number in \[0, 2\), got 2 in",
        ),
        (lambda: ur5().together((JOINTS, None)), "needs an arm with sensor=Several"),
    ],
)
def test_what_cannot_be_a_sensor_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_views_of_a_board_weigh_by_their_covariance():
    """A spoilt view of enormous covariance is as good as none."""
    model = ur5(sensor=Board("camera", PLACE))
    seen = model.predict(np.hstack([JOINTS, np.zeros((len(JOINTS), 6))]))
    commands = np.hstack([JOINTS, seen + 0.01 * np.sin(np.arange(6.0) + JOINTS)])
    spread = np.diag([1.0, 1.0, 4.0, 0.1, 0.1, 0.02]) ** 2
    covariance = np.array([spread * (1.0 + i) for i in range(len(JOINTS))])
    zeros = np.zeros((len(JOINTS), 6))
    stated = dataclasses.replace(model.default_prior(), by_data=False)
    options = {"model": model, "loss": "gaussian", "prior": stated}
    without = jaxcal.identify(
        commands[1:],
        zeros[1:],
        noise=jaxcal.Noise(covariance=covariance[1:]),
        **options,
    )
    commands[0, 6:] += 5.0
    covariance[0] *= 1e12
    found = jaxcal.identify(
        commands, zeros, noise=jaxcal.Noise(covariance=covariance), **options
    )
    np.testing.assert_allclose(found.parameters, without.parameters, atol=1e-6)
    errors = found.standard_errors, without.standard_errors
    np.testing.assert_allclose(*errors, rtol=1e-5)
    plain = jaxcal.identify(
        commands[1:], zeros[1:], noise=jaxcal.Noise(covariance=spread), **options
    )
    assert np.abs(plain.parameters - without.parameters).max() > 1e-4


@pytest.mark.parametrize("ahead", [1.0, 5.0, 20.0])
@pytest.mark.parametrize("way", [3.0, 60.0])
def test_far_anchors_are_found_by_an_arm_that_is_off(ahead, way):
    """In units of the arm's length; what the lengths leave open does no harm."""
    rng = np.random.default_rng(5)
    joints = rng.uniform(-90.0, 90.0, 6) + way * rng.uniform(-1.0, 1.0, (8, 6))
    wire = ur5(sensor=Distance(1))
    true = ur5().predict(joints) + 0.003 * wire.length * rng.normal(size=(8, 3))
    anchor = ahead * wire.length * np.array([0.6, -0.48, 0.64])
    far = np.linalg.norm(true - anchor, axis=1, keepdims=True)
    off = wire.located(joints, far).predict(joints) - far
    assert np.abs(off).max() < 0.02 * wire.length


@pytest.mark.parametrize("zero", [0.0, 0.25, -0.25])
def test_the_zero_of_a_wire_is_found_by_an_arm_that_is_off(zero):
    """In units of the arm's length; twelve anchors, all around."""
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        joints = rng.uniform(-110.0, 110.0, (60, 6))
        wire = ur5(sensor=Distance(1))
        true = ur5().predict(joints) + 0.004 * wire.length * rng.normal(size=(60, 3))
        anchor = rng.normal(size=3)
        anchor *= wire.length / np.linalg.norm(anchor)
        far = np.linalg.norm(true - anchor, axis=1) - zero * wire.length
        found.append(wire.located(joints, far[:, None]).sensor.places[0, 3])
    off = np.array(found) / wire.length - zero
    assert np.abs(off).max() < (0.05 if zero else 1e-12)


def test_views_that_hardly_turn_are_of_no_other_convention():
    model = SerialChain.from_dh(UR5_TABLE, sensor=Board("camera"))
    rng, told = np.random.default_rng(8), []
    for _ in range(60):
        about = np.eye(6)[rng.integers(6)] + 0.1
        joints = rng.uniform(-100.0, 100.0, 6) + about * rng.uniform(-5.0, 5.0, (5, 6))
        right = _as_columns(_views("camera", joints=joints)[1])
        right[:, 3:] += rng.normal(0.0, 0.3, (5, 3))
        try:
            model.located(np.hstack([joints, right]))
        except ValueError as error:
            told.append(str(error))
    assert not [each for each in told if "the inverse" in each]


def test_cameras_that_see_one_board_share_where_it_is():
    """Two cameras stand; the board is on the tip once, and their lenses are found."""
    lens = (800.0, 820.0, 320.0, 240.0)
    boards = [
        Board("board", None, CORNERS, lens, intrinsics=True, same_board=i > 0)
        for i in range(2)
    ]
    arm = ur5(sensor=Several(tuple(boards)))
    apart = ur5(
        sensor=Several((boards[0], dataclasses.replace(boards[1], same_board=False)))
    )
    assert len(apart.names) - len(arm.names) == 6
    with pytest.raises(ValueError, match="same_board"):
        Several((Board("camera"), boards[1]))
    rng = np.random.default_rng(0)
    tip = ur5()
    home = np.array([10, -75, 95, -110, -90, 20])
    joints = home + rng.uniform(-25, 25, (24, 6))
    middle = tip.predict(joints).mean(axis=0)
    seen, places = [], []
    for side in (-1.0, 1.0):  # at 700 mm, looking at the tip
        ahead = np.array([0.3 * side, 0.4, -1.0])
        ahead /= np.linalg.norm(ahead)
        across = np.cross(ahead, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        place = np.eye(4)
        place[:3, :3] = np.column_stack([across, np.cross(ahead, across), ahead])
        place[:3, 3] = middle - 700.0 * ahead
        places.append(place)
        true = (830.0, 790.0, 330.0, 235.0)
        exact = ur5(sensor=Board("board", place, CORNERS, true))
        seen.append(exact.predict(joints) + rng.normal(0.0, 0.3, (24, 12)))
    commands, measured = arm.together((joints, seen[0]), (joints, seen[1]))
    found = jaxcal.identify(commands, measured, model=arm, measured_unit="mm")
    values = dict(zip(found.names, found.parameters, strict=True))
    errors = dict(zip(found.names, found.standard_errors, strict=True))
    for name, value in zip(("fx", "fy", "cx", "cy"), true, strict=True):
        for i in range(2):
            key = f"board {i}: {name}"
            assert abs(values[key] - value) < 4.0 * errors[key] < 40.0
    for camera, place in enumerate(places):
        pose = found.static_transform(camera=camera)
        off = 1e3 * pose.matrix[:3, 3] - place[:3, 3]
        assert np.linalg.norm(off) < 4e3 * pose.std[0] < 100.0
    assert [one.unit for one in found.verdict.errors] == ["pixels a corner"] * 2


def test_a_flush_face_shows_more_than_a_probe():
    """Of an arm with errors, twenty flush contacts against twenty touches."""
    rng = np.random.default_rng(0)
    theta = ur5().nominal.copy()
    theta[:30] += 0.3 * rng.normal(size=30)
    table = [[0.0, 0.0, 1.0, -100.0]]
    true = ur5().calibrated(theta).measured_with(Flush(1, table))
    points = true.measured_with(Position()).skeleton

    def from_above(joints):
        way = np.diff(points(joints[None])[0, -2:], axis=0)[0]
        return way[2] < np.cos(np.radians(150.0)) * np.linalg.norm(way)

    joints = true.postures(30, near=table, seed=1, allowed=from_above)
    assert np.abs(true.predict(joints)).max() < 1e-3
    errors = {}
    for sensor in (Plane(1, table), Flush(1, table)):
        model = ur5(sensor=sensor)
        noise = np.asarray(model.default_noise().std) * np.ones(len(sensor.outputs))
        prior = dataclasses.replace(model.default_prior(), by_data=False)
        read = rng.normal(size=(30, len(noise))) * noise
        found = jaxcal.identify(
            joints, read, model=model, prior=prior, noise_std=noise, loss="gaussian"
        )
        assert found.verdict.explains
        errors[sensor.kind] = found.standard_errors[:30]
        # Farther out along the normal and a plane that is farther away are the same.
        why = next(
            line
            for line in found.verdict.reasons
            if "kept at the nominal value" in line
        )
        at = found.names.index("tool z")
        assert "tool z" in why and found.parameters[at] == pytest.approx(31.0, abs=1.0)
    # The same heights and more readings; the leans show alpha and beta.
    assert (errors["flush"] < 1.1 * errors["plane"]).all()
    assert errors["flush"][1] < 0.3 * errors["plane"][1]
    again = SENSORS["flush"].from_dict(Flush(1, table).to_dict())
    assert again.count == 1 and again.kind == "flush"
