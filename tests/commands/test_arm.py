"""An arm from the command line: contacts in, a calibrated URDF file out."""

from __future__ import annotations

import dataclasses
import json
import re
from unittest import mock

import numpy as np
import pytest

from jaxcal.commands import main
from jaxcal.commands.arms import RecordingOptions
from jaxcal.models import Board, Position, SerialChain, Servos, Socket, Wrench
from jaxcal.selection import select

from ..models.arms import contacts_of_a_panda
from ..models.test_recordings import write_bag


@pytest.fixture
def files(tmp_path):
    """A URDF file, a table of contacts in radians, and the arm behind it."""
    urdf, q, socket = contacts_of_a_panda("front")
    arm = SerialChain.from_urdf(urdf, tip="ball_link")
    columns = [*arm.joint_names[::-1], "socket"]
    table = np.column_stack([q[:, ::-1], socket])
    path = tmp_path / "contacts.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="")
    return urdf, path, tmp_path


def _run(files, *more):
    urdf, table, _ = files
    given = ["--model", str(urdf), "--sensor", "socket", *more]
    given += [] if "--tip" in more else ["--tip", "ball_link"]
    return main(["identify", str(table), *given])


def test_contacts_become_a_calibrated_file(files, capsys):
    out = files[2] / "calibrated.urdf"
    assert _run(files, "--radians", "--out", str(out)) in (0, None)
    assert "tip link ball_link" in capsys.readouterr().out
    _, q, socket = contacts_of_a_panda("right")
    spread = {}
    for name, path in (("nominal", files[0]), ("calibrated", out)):
        arm = SerialChain.from_urdf(path, tip="ball_link", sensor=Position())
        points = arm.predict(np.degrees(q))
        off = [points[socket == k] - points[socket == k].mean(axis=0) for k in (0, 1)]
        spread[name] = np.linalg.norm(np.vstack(off), axis=1).mean()
    assert spread["calibrated"] < 0.001 < 0.005 < spread["nominal"]
    assert _run(files, "--radians", "--out", str(out)) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert _run(files, "--radians", "--overwrite", "--out", str(out)) in (0, None)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--out", "a.urdf"], "are they radians"),
        (["--radians", "--tip", "thumb"], "tip link must be one of"),
        (
            ["--tip", "left,right"],
            "--tip takes one link, got left,right. Several chains",
        ),
        (["--tip", "left", "--tip", "right"], "takes one link, got left,right"),
        (["--radians", "--play", "-1"], "play must not be negative"),
        (["--radians", "--distance", "0,1,0.05"], "distances must be rows"),
        (["--radians", "--sensor", "plane", "--distance", "0,1,2,3"], "needs --sensor"),
        (["--radians", "--base", "panda_rightfinger"], "there is no column"),
    ],
)
def test_what_does_not_fit_is_refused(files, capsys, flags, message):
    assert _run(files, *flags) == 2
    assert message in capsys.readouterr().err


def test_distances_between_sockets_need_to_know_which_is_which(files, capsys):
    table = files[1]
    table.write_text(table.read_text().replace("socket", "place"))
    assert _run(files, "--radians", "--distance", "0,1,0.05,0.0001") == 2
    assert "--distance needs a column 'socket'" in capsys.readouterr().err


def test_joints_far_beyond_their_limits_are_named(files):
    import jaxcal

    urdf, q, socket = contacts_of_a_panda("front")
    arm = SerialChain.from_urdf(urdf, tip="ball_link", sensor=Socket(2))
    commands = np.column_stack([np.degrees(q), socket])
    swapped = commands[:, [3, 1, 2, 0, 4, 5, 6, 7]]
    with pytest.raises(
        ValueError, match=r"row \d+: panda_joint4 = .* is outside its limits "
    ):
        jaxcal.identify(swapped, np.zeros((len(q), 3)), model=arm)


def test_contacts_are_chosen_from_a_table(files, capsys):
    urdf, table, _ = files
    given = ["select", str(table), "--model", str(urdf), "--tip", "ball_link",
             "-k", "12", "--method", "exchange", "--csv"]  # fmt: skip
    sensor = ["--sensor", "socket", "--distance", "0,1,0.05,0.0001", "--radians"]
    assert main([*given, *sensor]) == 0
    rows = np.loadtxt(capsys.readouterr().out.splitlines()[1:], delimiter=",")
    touching = Socket(2, distances=[(0, 1, 0.05, 1e-4)])
    arm = SerialChain.from_urdf(urdf, tip="ball_link", sensor=touching)
    _, q, socket = contacts_of_a_panda("front")
    contacts = np.column_stack([np.degrees(q), socket])
    assert set(rows[:, 0]) == set(select(contacts, 12, "exchange", model=arm).indices)
    several = ["--scenarios", "2", "--worst", "--criterion", "D"]
    assert main([*given[:-1], *sensor, *several]) == 0
    told = capsys.readouterr().out
    assert "log det S, worst" in told and "scenarios     2" in told
    assert main([*given, *sensor, "--worst"]) == 2
    assert "--worst needs --scenarios N" in capsys.readouterr().err
    assert main([*given, *sensor[:-1]]) == 2
    assert "are they radians" in capsys.readouterr().err
    assert main(["select", str(table), "-k", "4", "--radians"]) == 2
    assert "options of an arm need --model FILE.urdf" in capsys.readouterr().err


def test_predictions_take_the_columns_of_the_fit(files, capsys):
    saved = str(files[2] / "calibration.json")
    assert _run(files, "--radians", "--out", saved) == 0
    capsys.readouterr()
    assert main(["predict", saved, str(files[1]), "--radians"]) == 0
    off = np.loadtxt(capsys.readouterr().out.splitlines()[1:], delimiter=",")
    assert np.abs(off).max() < 0.002  # of contacts: zeros
    for command in ("predict", "check"):
        assert main([command, saved, str(files[1])]) == 2
        assert "are they radians" in capsys.readouterr().err
    # Contacts have no columns of readings.
    assert main(["check", saved, str(files[1]), "--radians"]) in (0, 1)
    assert "does not hold" not in capsys.readouterr().out


def test_joints_are_locked_and_have_other_limits(files, capsys):
    given = ["postures", str(files[0]), "--tip", "ball_link", "-k", "4", "--csv",
             "--count", "12", "--limits", "panda_joint1=20,30"]  # fmt: skip
    assert main([*given, "--locked", "panda_joint7=45"]) == 0
    header, *rows = capsys.readouterr().out.splitlines()
    assert header == ",".join(f"panda_joint{i}" for i in range(1, 7))
    assert all(20.0 <= float(row.split(",")[0]) <= 30.0 for row in rows)
    assert main([*given, "--locked", "panda_joint7=1,2"]) == 2
    assert "--locked must be JOINT=VALUE" in capsys.readouterr().err


@pytest.mark.slow
def test_postures_are_planned_and_the_rest_chosen_again(files, capsys):
    urdf, _, folder = files
    out, reached, picture = (folder / name for name in ("a.csv", "b.csv", "plan.png"))
    given = ["postures", str(urdf), "--tip", "ball_link", "--sensor", "socket",
             "--radians", "--count", "20"]  # fmt: skip
    near = ["--near=.4,.1,.3", "--near=.4,.15,.3"]
    assert main([*given, *near, "-k", "8", "--out", str(out)]) == 0
    told = r"Expected error: (\d+)% below 8 random postures, as good as about (\d+) "
    worth = re.search(told, capsys.readouterr().err)
    assert worth and 0 < int(worth[1]) < 100 and int(worth[2]) > 8
    lines = out.read_text().splitlines()
    arm = SerialChain.from_urdf(urdf, tip="ball_link")
    assert lines[0] == ",".join([*arm.joint_names, "socket"])
    rows = np.loadtxt(lines[1:], delimiter=",")
    points = arm.predict(np.degrees(rows[:, :7]))
    sockets = np.array([[0.4, 0.1, 0.3], [0.4, 0.15, 0.3]])
    np.testing.assert_allclose(points, sockets[rows[:, 7].astype(int)], atol=1e-6)
    # Columns of what was reached may come in any order; contacts show the sockets.
    both = [rows[rows[:, 7] == k][:2] for k in (0, 1)]
    columns = ",".join([*arm.joint_names[::-1], "socket"])
    table = np.vstack(both)[:, [*range(7)[::-1], 7]]
    np.savetxt(reached, table, delimiter=",", header=columns, comments="")
    given += ["--measured", str(reached)]
    capsys.readouterr()
    assert main([*given, "-k", "7", "--picture", str(picture)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + 7 - 4
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main([*given, "-k", "4"]) == 2
    assert "above 4, the number of postures" in capsys.readouterr().err
    given.remove("--radians")
    assert main([*given, "-k", "7"]) == 2
    assert "are they radians" in capsys.readouterr().err
    assert main([*given, *near, "--near=.4,.2", "-k", "7"]) == 2
    assert "--near takes 3 numbers for --sensor socket" in capsys.readouterr().err


def _planned(files, sensor, *flags):
    """Rows that the shell plans, and the arm of its file."""
    out = files[2] / "plan.csv"
    given = ["postures", str(files[0]), "--tip", "ball_link", "--sensor", sensor.kind,
             "--count", "12", "-k", "4", "--out", str(out)]  # fmt: skip
    assert main([*given, *flags]) == 0
    rows = np.loadtxt(out, delimiter=",", skiprows=1)
    return rows, SerialChain.from_urdf(files[0], tip="ball_link", sensor=sensor)


def _among(rows, offered):
    apart = np.abs(rows[:, None] - offered).max(axis=-1)
    return apart.min(axis=1).max() < 1e-9


def test_a_table_and_its_sockets_bound_what_is_planned(files, capsys):
    """On the tips and joints themselves: none below."""
    touching = Socket(1, [[0.45, 0.1, 0.2]])
    flags = ["--near=.45,.1,.2", "--floor", "0.18"]
    rows, arm = _planned(files, touching, *flags)
    points = arm.skeleton(rows)
    assert points[:, 2:, 2].min() >= 0.18 - 1e-9
    offered = arm.postures(12, floor=0.18)
    assert _among(rows, offered) and not _among(offered, arm.postures(12))


def test_a_camera_bounds_what_is_planned(files, capsys):
    place = np.array([[1, 0, 0, 0.4], [0, 1, 0, -0.1], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    board = Board("camera", place, extent=(0.2, 0.15))
    arm = SerialChain.from_urdf(files[0], tip="ball_link", sensor=board)
    views = arm.postures(3, seed=1)[:, :7]
    seen = arm.predict(np.hstack([views, np.zeros((3, 6))]))
    header = ",".join([*arm.joint_names, *arm.sensor.inputs])
    np.savetxt(files[2] / "views.csv", np.hstack([views, seen]), delimiter=",",
               header=header, comments="")  # fmt: skip
    flags = ["--board", "0.2,0.15", "--camera", "640,480,600,600,320,240", "--tilt"]
    flags += ["30", "--away", "0.35,0.7"]
    measured = ["--measured", str(files[2] / "views.csv"), "-k", "7"]
    rows, _ = _planned(files, board, *flags, *measured)
    options = {"camera": (640, 480, 600, 600, 320, 240), "distance": (0.35, 0.7)}
    found = arm.measured_with(Board("camera")).located(np.hstack([views, seen]))
    side = dataclasses.replace(board, side=found.sensor.side)
    offered = arm.measured_with(side).postures(12, tilt=30.0, **options)
    rows, offered = rows[:, :7], offered[:, :7]
    off = np.abs(rows[:, None] - offered).max(axis=-1).min(axis=1)
    assert off.max() < 0.1 < np.abs(rows[:, None] - arm.postures(12)[:, :7]).max()
    given = ["postures", str(files[0]), "--tip", "ball_link", "-k", "4"]
    assert main([*given, "--board", "0.2,0.15"]) == 2
    assert "--board WIDTH,HEIGHT needs --sensor board" in capsys.readouterr().err
    assert main([*given, "--away", "0.3,0.7"]) == 2
    assert "distance needs camera=" in capsys.readouterr().err


def test_a_recording_is_identified_and_checked_in_the_shell(files, capsys):
    urdf, _, folder = files
    arm = SerialChain.from_urdf(urdf, tip="ball_link", sensor=Wrench())
    own = arm.names.index("mass")
    theta = arm.nominal.copy()
    theta[own : own + 5] = [1.4, 0.01, 0.02, 0.05, 3.0]
    joints = np.random.default_rng(3).uniform(-60.0, 60.0, (8, 7))
    joints[:, [3, 5]] += [-65.0, 100.0]
    read = arm.predict(joints, theta)
    usual = np.asarray(arm.default_noise().std)
    read += usual * np.random.default_rng(0).normal(size=read.shape)
    write_bag(folder / "bag", joints, read)
    saved = str(folder / "tool.json")
    given = ["identify", str(folder / "bag"), "--model", str(urdf), "--tip",
             "ball_link", "--sensor", "wrench"]  # fmt: skip
    assert main([*given, "--out", saved]) == 0
    assert "mass" in capsys.readouterr().out
    assert main(["check", saved, str(folder / "bag")]) == 0
    assert "holds" in capsys.readouterr().out
    assert main(["check", saved, str(folder / "bag"), "--radians"]) == 2
    assert "recordings state their unit" in capsys.readouterr().err
    for more, message in (
        (["--radians"], "recordings state their unit"),
        (["--topic", "/none"], "got none with topic /none"),
        (["--sensor", "socket", "--which", "0x3,1"], "socket of each of the 8 rests"),
        (
            ["--sensor", "socket", "--which", "0x4,1x4", "--distance", "0,1,.05,.0001"],
            "contacts of socket",
        ),
        (["--servos", "so101.json"], "servos needs a LeRobot dataset"),
        (["--servos-out", "new.json"], "--servos-out needs --servos"),
    ):
        assert main([*given, *more]) == 2, more
        assert message in capsys.readouterr().err, more
    assert _run(files, "--which", "0,1") == 2
    assert "go with a recording, not a table" in capsys.readouterr().err


def test_zeros_are_written_for_lerobot_in_the_shell(files, capsys):
    """A Panda whose joints are motors; its file then has no other zero."""
    _, _, folder = files
    names = SerialChain.from_urdf(files[0], tip="ball_link").joint_names
    motors = {n: dict.fromkeys(("id", "drive_mode", "homing_offset"), 0) |
              {"range_min": 500, "range_max": 3600} for n in names}  # fmt: skip
    old, new = folder / "so.json", folder / "new.json"
    old.write_text(json.dumps(motors))
    flags = ["--radians", "--servos", str(old), "--servos-out", str(new)]
    assert _run(files, *flags) == 0
    assert f"saved {new}, steps: panda_joint1 +0" in capsys.readouterr().out
    assert Servos.load(new).motors["panda_joint1"] == motors["panda_joint1"]
    assert _run(files, *flags, "--out", str(folder / "a.urdf")) == 2
    assert "both would correct them twice" in capsys.readouterr().err


def test_a_dataset_in_degrees_keeps_its_servos_for_the_file_that_is_written(files):
    options = dict(which=[0, 0, 1], servos="so101.json")
    for in_degrees, read_by in ((False, "so101.json"), (True, None)):
        arm = mock.Mock(spec=SerialChain)
        arm.recorded.return_value = np.zeros((3, 8)), np.zeros((3, 3))
        arm.joint_names, arm.sensor = tuple("abcdefg"), Socket(2)
        given = RecordingOptions(**options, in_degrees=in_degrees)
        given.table(str(files[2]), mock.Mock(return_value=arm))
        assert arm.recorded.call_args.args[0].servos == read_by
