"""An arm from the command line: contacts in, a calibrated URDF file out."""

from __future__ import annotations

import numpy as np
import pytest

from jaxcal.commands.main import main
from jaxcal.models import Position, SerialChain, Socket

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
    assert "--force" in capsys.readouterr().err
    assert _run(files, "--radians", "--force", "--out", str(out)) in (0, None)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--out", "a.urdf"], "which look like radians"),
        (["--radians", "--tip", "thumb"], "tip must be a link of it"),
        (["--radians", "--distance", "0,1,0.05"], "distances must be rows"),
        (["--radians", "--sensor", "plane", "--distance", "0,1,2,3"], "is of --sensor"),
        (["--radians", "--base", "panda_rightfinger"], "there is no column"),
    ],
)
def test_what_does_not_fit_is_refused(files, capsys, flags, message):
    assert _run(files, *flags) == 2
    assert message in capsys.readouterr().err


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
