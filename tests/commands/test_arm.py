"""An arm from the command line: contacts in, a calibrated URDF file out."""

from __future__ import annotations

import numpy as np
import pytest

from jaxcal.commands.main import main
from jaxcal.models import Position, SerialChain, Socket
from jaxcal.selection import select

from ..models.arms import contacts_of_a_panda


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
    given = ["--model", str(urdf), "--tip", "ball_link", "--sensor", "socket", *more]
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
        (["--out", "a.urdf"], "which look like radians"),
        (["--radians", "--tip", "thumb"], "tip link must be one of"),
        (["--radians", "--distance", "0,1,0.05"], "distances must be rows"),
        (["--radians", "--sensor", "plane", "--distance", "0,1,2,3"], "is of --sensor"),
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
        ValueError, match=r"panda_joint4 must be within its limits .*, to 2,"
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
    assert main([*given, *sensor[:-1]]) == 2
    assert "which look like radians" in capsys.readouterr().err
    assert main([*given, *sensor, "--lost", "3"]) == 2
    assert "lost must be at most 2" in capsys.readouterr().err
    assert main(["select", str(table), "-k", "4", "--radians"]) == 2
    assert "options of an arm need --model FILE.urdf" in capsys.readouterr().err


def test_predictions_take_the_columns_of_the_fit(files, capsys):
    saved = str(files[2] / "calibration.json")
    assert _run(files, "--radians", "--out", saved) == 0
    capsys.readouterr()
    assert main(["predict", saved, str(files[1]), "--radians"]) == 0
    off = np.loadtxt(capsys.readouterr().out.splitlines()[1:], delimiter=",")
    assert np.abs(off).max() < 0.002  # of contacts: zeros
    assert main(["predict", saved, str(files[1])]) == 2
    assert "which look like radians" in capsys.readouterr().err


def test_joints_are_locked_and_have_other_limits(files, capsys):
    given = ["postures", str(files[0]), "--tip", "ball_link", "-k", "4", "--csv",
             "--count", "12", "--limits", "panda_joint1=20,30"]  # fmt: skip
    assert main([*given, "--locked", "panda_joint7=45"]) == 0
    header, *rows = capsys.readouterr().out.splitlines()
    assert header == ",".join(f"panda_joint{i}" for i in range(1, 7))
    assert all(20.0 <= float(row.split(",")[0]) <= 30.0 for row in rows)
    assert main([*given, "--locked", "panda_joint7=1,2"]) == 2
    assert "--locked must be JOINT=VALUE" in capsys.readouterr().err


def test_postures_are_planned_and_the_rest_chosen_again(files, capsys):
    urdf, _, folder = files
    out, reached, picture = (folder / name for name in ("a.csv", "b.csv", "plan.png"))
    given = ["postures", str(urdf), "--tip", "ball_link", "--sensor", "socket",
             "--radians", "--count", "20"]  # fmt: skip
    near = ["--near=.4,.1,.3", "--near=.4,.15,.3"]
    assert main([*given, *near, "-k", "8", "--out", str(out)]) == 0
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
    assert "more than the 4 that were reached" in capsys.readouterr().err
    given.remove("--radians")
    assert main([*given, "-k", "7"]) == 2
    assert "which look like radians" in capsys.readouterr().err
    assert main([*given, *near, "--near=.4,.2", "-k", "7"]) == 2
    assert "--near must be 3 numbers for --sensor socket" in capsys.readouterr().err
