"""No command loses or writes over what it reads; a flag without effect is refused."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import numpy as np
import pytest

import jaxcal
from jaxcal.commands import main
from jaxcal.models import SerialChain

from .test_beginners import URDF

U = np.random.default_rng(0).uniform(-20.0, 20.0, (12, 2)).round(3)
Y = U * [0.43, 0.71] + [3.1, -5.8]


def csv(header, values):
    return "\n".join([header, *(",".join(map(repr, row)) for row in values.tolist())])


@pytest.fixture
def ask(tmp_path, monkeypatch, capsys):
    """Runs a command in a folder with tables; its exit code, output and error."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text(csv("a,b", U))
    (tmp_path / "pairs.csv").write_text(csv("u_a,u_b,y_a,y_b", np.hstack([U, Y])))
    (tmp_path / "far.csv").write_text("y_a,y_b\n200,0\n5,-5\n")

    def run(typed):
        try:
            code = main(typed.split())
        except SystemExit as left:
            code = left.code
        return code, *capsys.readouterr()

    assert run("identify pairs.csv --out c.json")[0] == 0
    return run


@pytest.mark.parametrize("way", ["itself", "symbolic", "hard", "dotted"])
@pytest.mark.parametrize("typed", ["select t.csv -k 4", "select t.csv --score 0,1,2"])
def test_an_input_is_never_written_over(ask, tmp_path, way, typed):
    before, name = (tmp_path / "t.csv").read_bytes(), "other.csv"
    if way == "symbolic":
        os.symlink("t.csv", name)
    elif way == "hard":
        os.link("t.csv", name)
    else:
        name = "t.csv" if way == "itself" else "./../" + tmp_path.name + "/t.csv"
    code, out, said = ask(f"{typed} --out {name}")
    assert (code, out) == (2, "") and said.count("\n") == 1
    assert f"{name} is what is read" in said
    assert (tmp_path / "t.csv").read_bytes() == before
    assert ask(f"{typed} --out new.csv")[0] == 0


def test_nor_is_one_that_comes_over_standard_input(ask, monkeypatch, tmp_path):
    with open("t.csv") as file:
        monkeypatch.setattr("sys.stdin", file)
        code, _, said = ask("select - -k 4 --out t.csv")
    assert code == 2 and "t.csv is what is read" in said


@pytest.mark.skipif(sys.platform == "win32", reason="has no /dev/stdout")
def test_nor_is_one_that_the_shell_writes_to(ask, tmp_path):
    before = (tmp_path / "t.csv").read_bytes()
    command = [sys.executable, "-m", "jaxcal", "select", "t.csv", "-k", "4", "--csv"]
    with open("t.csv", "ab") as file:
        ended = subprocess.run(command, stdout=file, stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 2
    assert "standard output goes to t.csv, which is read" in ended.stderr
    assert (tmp_path / "t.csv").read_bytes() == before
    with open("plan.csv", "ab") as file:
        assert subprocess.run(command, stdout=file).returncode == 0


@pytest.mark.parametrize(
    "typed",
    [
        "identify pairs.csv --out pairs.csv",
        "identify pairs.csv --report . --against calibration.json",
        "predict c.json t.csv --out c.json",
        "command c.json far.csv --out far.csv",
    ],
)
def test_every_command_that_writes_keeps_what_it_reads(ask, tmp_path, typed):
    (tmp_path / "calibration.json").write_bytes((tmp_path / "c.json").read_bytes())
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    code, _, said = ask(typed)
    assert code == 2 and "is what is read" in said
    assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("identify pairs.csv --noise 1,5", "write 1.5, or 1.0,5.0"),
        ("select t.csv --noise 0,05", "write 0.05, or 0.0,05.0"),
        ("plan t.csv --noise 0.1 --accuracy 1,5", "write 1.5, or 1.0,5.0"),
        ("select t.csv --sensor position", "need --model FILE.urdf"),
        ("identify pairs.csv --sensor position", "need --model FILE.urdf"),
        ("identify pairs.csv --accuracy 1", "--accuracy needs an arm"),
        ("identify pairs.csv --unproven --out d.json", "--unproven needs --out FILE"),
        ("identify pairs.csv --overwrite --out d.json", "--overwrite needs --out FILE"),
        ("identify pairs.csv --servos s.json", "--servos needs a recording"),
        ("check c.json pairs.csv --servos s.json", "--servos goes with a recording"),
        ("check c.json pairs.csv --tolerance 0,5", "must be a number, got '0,5'"),
        ("check c.json pairs.csv --tolerance m=0,5", "must be UNIT=NUMBER,UNIT=NUM"),
        ("identify pairs.csv --which a", "--which: cannot read 'a'"),
        ("select t.csv --score 0,1,2 --time-limit 1", "Leave out with --score"),
        ("select t.csv --csv --out plan.json", "--csv and --out plan.json differ"),
        ("select t.csv --json --out plan.csv", "--json and --out plan.csv differ"),
    ],
)
def test_a_flag_without_effect_is_refused(ask, typed, message):
    code, out, said = ask(typed)
    assert (code, out) == (2, "") and message in said


@pytest.mark.parametrize("header", ["u_a,u_b,y_a,y_b", "a,b,y_a,y_b"])
@pytest.mark.parametrize("column", [0, 3])
def test_words_are_no_command_and_no_reading(ask, tmp_path, header, column):
    rows = np.hstack([U, Y]).astype(object)
    rows[:, column] = ["fast", "slow"] * 6
    text = "\n".join([header, *(",".join(map(str, row)) for row in rows)])
    (tmp_path / "pairs.csv").write_text(text)
    flags = "" if header.startswith("u") else " --inputs a,b"
    code, out, said = ask("identify pairs.csv" + flags)
    name = header.split(",")[column]
    assert (code, out) == (2, "")
    assert f"line 2, column '{name}' must hold a number, got 'fast'" in said


def test_two_noises_are_two(ask):
    assert ask("identify pairs.csv --noise 1.0,5.0")[0] == 0
    assert ask("identify pairs.csv --noise 0.1,0.2")[0] == 0


def test_a_target_far_from_the_readings_is_said(ask):
    code, out, said = ask("command c.json far.csv")
    assert code == 0
    wanted = (200.0 - 3.1) / 0.43
    assert np.isclose(float(out.splitlines()[1].split(",")[0]), wanted)
    assert "1 of 2 targets is far outside the measurements" in said
    low, high = Y[:, 0].min(), Y[:, 0].max()
    assert f"y_a = 200, measured range {low:.6g} to {high:.6g}" in said


def test_a_clipped_target_is_said(ask):
    code, _, said = ask("command c.json far.csv --clip --limits=-30,30")
    assert code == 0
    assert "1 of 2 targets are clipped: target 1, u_a = 457.907 to 30" in said


def test_targets_among_the_readings_are_not_said(ask, tmp_path):
    (tmp_path / "far.csv").write_text(csv("y_a,y_b", Y * 1.01))
    assert ask("command c.json far.csv")[2] == ""


def test_an_error_stands_alone(ask, tmp_path):
    (tmp_path / "t.csv").write_text(csv("time,a,b", np.c_[np.arange(12.0), U]))
    code, _, said = ask("select t.csv -k 99")
    assert code == 2 and said.count("\n") == 1
    code, _, said = ask("select t.csv -k 4")
    assert code == 0 and "column 'time' is not read" in said


def test_bytes_come_over_standard_input_too(ask, monkeypatch):
    text = csv("a,b", U).replace(",", ";").replace(".", ",")
    stream = io.TextIOWrapper(io.BytesIO(text.encode("utf-16")))
    monkeypatch.setattr("sys.stdin", stream)
    piped = ask("select - -k 4 --csv")
    plain = ask("select t.csv -k 4 --csv")
    assert piped[:2] == plain[:2]


def test_joints_beside_those_of_the_arm_are_said(ask, tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    arm = SerialChain.from_urdf(tmp_path / "arm.urdf")
    joints = np.c_[U, np.arange(12.0)] * 4.0
    (tmp_path / "t.csv").write_text(csv("turn,elbow,j5", joints))
    code, _, said = ask("select t.csv -k 4 --model arm.urdf")
    assert code == 0 and "column 'j5' is ignored" in said
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(joints, columns=["turn", "elbow", "j5"])
    with pytest.warns(UserWarning, match="column 'j5' is ignored"):
        jaxcal.select(frame, 4, "greedy", model=arm)
    read = pandas.DataFrame(arm.predict(joints[:, :2]), columns=["y_x", "y_y", "y_z"])
    with pytest.warns(jaxcal.CalibrationWarning):  # exact readings
        found = jaxcal.identify(frame[["elbow", "turn"]], read[["y_z", "y_x"]].join(
            read["y_y"]), model=arm)  # fmt: skip
    np.testing.assert_allclose(found.predict(joints[:, :2]), read, atol=1e-6)


ARM_UNITS = ["deg,deg,m,m,m", "\u00b0,degrees,[m],[m],[m]"]


def of_arm(tmp_path):
    """(20, 5) joints and positions of an arm whose file is written."""
    (tmp_path / "arm.urdf").write_text(URDF)
    arm, rng = SerialChain.from_urdf(tmp_path / "arm.urdf"), np.random.default_rng(1)
    joints = rng.uniform(-90.0, 90.0, (20, 2))
    return np.c_[joints, arm.predict(joints) + rng.normal(0.0, 1e-4, (20, 3))]


@pytest.mark.parametrize("units", [*ARM_UNITS, "rad,deg,m,m,m", "deg,deg,m,mm,m"])
def test_a_row_of_units_of_an_arm_is_compared(ask, tmp_path, units):
    lines = [",".join(map(repr, row)) for row in of_arm(tmp_path).tolist()]
    (tmp_path / "t.csv").write_text("\n".join(["turn,elbow,y_x,y_y,y_z", *lines]))
    assert ask("identify t.csv --model arm.urdf --out arm.json")[0] == 0
    text = "\n".join(["turn,elbow,y_x,y_y,y_z", units, *lines])
    (tmp_path / "t.csv").write_text(text)
    typed = "identify t.csv --model arm.urdf", "check arm.json t.csv"
    for code, _, said in map(ask, typed):
        if units in ARM_UNITS:
            assert code == 0 and "units are taken from line 2" in said
        else:
            fault = "'turn' is in rad" if "rad" in units else "'y_y' is in mm"
            assert code == 2 and f"column {fault}, by its row of units" in said
    (tmp_path / "t.csv").write_text(text.replace(units, "rad,rad,m,m,m"))
    assert ask("predict arm.json t.csv")[0] == 2
    assert ask("predict arm.json t.csv --radians")[0] == 0


@pytest.mark.parametrize(("unit", "code"), [("rad", 2), ("deg", 0), ("[\u00b0]", 0)])
def test_a_row_of_units_is_that_of_the_calibration(ask, tmp_path, unit, code):
    of_both = "--command-unit deg --measured-unit deg"
    assert ask(f"identify pairs.csv {of_both} --out d.json")[0] == 0
    rows = csv("", np.hstack([U, Y])).removeprefix("\n")
    text = f"u_a,u_b,y_a,y_b\n{unit},{unit},{unit},{unit}\n{rows}"
    (tmp_path / "far.csv").write_text(text)
    for typed in (
        "command d.json far.csv",
        "predict d.json far.csv",
        "check d.json far.csv",
        f"identify far.csv {of_both}",
    ):
        answer, _, said = ask(typed)
        assert answer == code
        assert ("and must be in deg" in said) == (code == 2)
    assert ask("predict c.json far.csv")[0] == 0  # of no unit


def test_what_an_arm_does_not_read_is_said(ask, tmp_path):
    values = np.c_[of_arm(tmp_path), np.ones(20)]
    (tmp_path / "t.csv").write_text(csv("turn,elbow,y_x,y_y,y_z", values[:, :5]))
    code, _, said = ask("identify t.csv --model arm.urdf --out arm.json")
    assert code == 0 and "column" not in said
    assert "column" not in ask("check arm.json t.csv")[2]
    header = "turn,elbow,y_x,y_y,y_z,y_roll,mode"
    more = (
        csv(header, values).replace("\n", ",fast\n").replace(f"{header},fast", header)
    )
    (tmp_path / "t.csv").write_text(f"{more},fast")
    for typed in ("identify t.csv --model arm.urdf", "check arm.json t.csv"):
        said = ask(typed)[2]
        assert said.count("column 'y_roll' is ignored (not needed)") == 1
        assert said.count("column 'mode' is read as label: words") == 1


@pytest.mark.parametrize("flags", [("0", "1"), ("FALSE", "TRUE"), ("no", "yes")])
def test_rows_that_are_not_available_are_used_and_said(ask, tmp_path, flags):
    rows = csv("u_a,u_b,y_a,y_b", np.hstack([U, Y])).splitlines()
    for zeros in (3, 0):
        cells = ["available", *(flags[i >= zeros] for i in range(len(U)))]
        text = "\n".join(f"{r},{c}" for r, c in zip(rows, cells, strict=True))
        (tmp_path / "far.csv").write_text(text)
        for typed in ("identify far.csv", "check c.json far.csv"):
            said = ask(typed)[2]
            assert ("all rows are used, 3 of them with 0" in said) == (zeros == 3)
        for typed in ("command c.json far.csv", "predict c.json far.csv"):
            code, out, said = ask(typed)
            assert code == 0 and len(out.splitlines()) == 1 + len(U)
            assert ("all rows are used, 3 of them with 0" in said) == (zeros == 3)


@pytest.mark.parametrize(
    "days", [("Mon", "Tue"), ("2026-05-01", "2026-05-02"), ("1", "2"), ("A", "")]
)
def test_sessions_have_any_labels(ask, tmp_path, days):
    rows = csv("u_a,u_b,y_a,y_b", np.hstack([U, Y])).splitlines()
    cells = ["day", *(days[i % 2] for i in range(len(U)))]
    text = "\n".join(f"{c},{r}" for r, c in zip(rows, cells, strict=True))
    (tmp_path / "far.csv").write_text(text)
    code, _, said = ask("identify far.csv --session day --out s.json")
    if "" in days:
        assert code == 2 and "line 3, column 'day' is empty" in said
        return
    assert code == 0
    assert jaxcal.Calibration.load("s.json").provenance["sessions"]["count"] == 2


def test_a_prediction_far_from_the_measurements_is_said(ask, tmp_path):
    (tmp_path / "far.csv").write_text("u_a,u_b\n900,0\n")
    code, _, said = ask("predict c.json far.csv")
    assert code == 0
    assert "1 of 1 commands is far outside the measurements" in said
    assert "u_a = 900" in said
