"""The likeliest errors of a first hour: each is one line that says what to do."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from jaxcal.commands import main

URDF = """\
<robot name="lift">
<link name="base"/><link name="column"/><link name="arm"/><link name="tip"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="column"/>
<origin xyz="0 0 0.4"/><axis xyz="0 0 1"/></joint>
<joint name="elbow" type="revolute"><parent link="column"/><child link="arm"/>
<origin xyz="0.3 0 0" rpy="1.5708 0 0"/><axis xyz="0 0 1"/></joint>
<joint name="flange" type="fixed"><parent link="arm"/><child link="tip"/>
<origin xyz="0.2 0 0"/></joint></robot>
"""
HEAD = "pitch,yaw,roll"
POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (12, 3)).round(2)
ROWS = [",".join(map(str, row)) for row in POINTS.tolist()]
TABLE = "\n".join([HEAD, *ROWS])
REACHED = POINTS * [0.43, 0.71, 0.87] + [3.1, -5.8, 2.41]
JOINTS = np.random.default_rng(1).uniform(-90.0, 90.0, (12, 2))


def csv(header: str, values: np.ndarray) -> str:
    rows = [",".join(map(str, row)) for row in values.tolist()]
    return "\n".join([header, *rows])


FILES = {
    "table.csv": TABLE,
    "decimal_comma.csv": TABLE.replace(",", ";").replace(".", ","),
    "word.csv": TABLE.replace(ROWS[4], "1,abc,2"),
    "unit.csv": TABLE.replace(ROWS[4], "1.5°,2,3"),
    "nan.csv": TABLE.replace(ROWS[4], "1,nan,2"),
    "gap.csv": TABLE.replace(ROWS[4], "1,,2"),
    "short.csv": TABLE.replace(ROWS[4], "1,2"),
    "repeated.csv": "\n".join([HEAD, *ROWS[:3] * 4]),
    "flat.csv": "\n".join([HEAD, *(f"{i % 4},{i * i},0" for i in range(9))]),
    "header.csv": HEAD,
    "empty.csv": "",
    "twice.csv": TABLE.replace("yaw", "pitch"),
    "book.xlsx": "PK\x03\x04",
    "masked.csv": "\n".join([f"{HEAD},available", *(f"{row},0" for row in ROWS)]),
    "pairs.csv": csv(
        "u_pitch,u_yaw,u_roll,y_pitch,y_yaw,y_roll", np.hstack([POINTS, REACHED])
    ),
    "unread.csv": csv("u_a,y_a", np.array([[1, 1], [2, np.nan], [3, 3]])),
    "three.csv": csv("u_a,u_b,u_c,y_a,y_b,y_c", np.hstack([POINTS, REACHED])[:3]),
    "target.csv": "y_pitch,y_yaw,y_roll\n2,-4,3",
    "far.csv": "y_pitch,y_yaw,y_roll\n200,-4,3",
    "two.csv": "2,-4",
    "arm.urdf": URDF,
    "radians.csv": csv("turn,elbow", np.radians(JOINTS)),
    "joints.csv": csv("turn,elbow,spare", np.hstack([JOINTS, JOINTS[:, :1]])),
}
CASES = [  # what was typed, what the line must hold
    ("select missing.csv", "missing.csv: No such file"),
    ("select word.csv", "line 6, column 'yaw' must hold a number, got 'abc'"),
    ("select unit.csv", "line 6, column 'pitch' must hold a number, got '1.5°'"),
    ("select nan.csv", "line 6, column 'yaw'", "leave the row out"),
    ("select gap.csv", "line 6, column 'yaw'", "empty cell"),
    ("select short.csv", "line 6 has 2 cells, the first has 3"),
    ("select repeated.csv", "12 rows (3 of them distinct)", "pitch"),
    ("select flat.csv", "the same in every row: roll"),
    ("select header.csv", "no rows below the header"),
    ("select empty.csv", "the table is empty"),
    ("select twice.csv", "column 'pitch' comes twice"),
    ("select book.xlsx", "save this one as CSV"),
    ("select table.csv --out plan.xlsx", "must end in .csv or .json, got plan.xlsx"),
    ("select table.csv -k 3", "k must be at least 4"),
    ("select table.csv -k 13", "12 available candidates, got 13"),
    ("select table.csv --inputs pitch,jaw", "no column 'jaw'; columns: pitch, yaw"),
    ("select table.csv --method best", "method must be one of", "got 'best'"),
    ("select table.csv --model arm.urdf", "there is no column 'turn'"),
    ("select table.csv --model calibration.json", "this is a calibration, and a model"),
    ("select table.csv --model table.csv", "--model takes an arm (.urdf), a saved"),
    ("identify pairs.csv --transform x.yaml", "--transform needs --model FILE.urdf"),
    ("select table.csv --model a.xacro -k 5", "expand it first: xacro a.xacro >"),
    ("select table.csv --score no.csv", "'no.csv' is neither: no such file"),
    ("select table.csv --score 1,2,x", "'1,2,x' is neither: no such file"),
    ("select masked.csv", "rows whose 'available' is 1,", "got 0"),
    ("select calibration.json", "save this one as CSV"),
    ("select arm.urdf", "save this one as CSV"),
    ("select table.csv --noise 0", "must be positive, got 0.0"),
    ("identify pairs.csv --report table.csv", "table.csv is not a folder"),
    ("example table --folder table.csv", "table.csv is not a folder"),
    ("postures arm.urdf -k 6 --sensor sockt", "--sensor must be one of", "'sockt'"),
    ("postures arm.urdf -k 6 --picture .", "ending of --picture must be one of"),
    (
        "plan table.csv --accuracy 0.001 --noise 0.1",
        "0.001 cannot be reached: all",
    ),
    ("identify table.csv", "no column begins with y_", "--outputs"),
    (
        "identify pairs.csv --inputs u_yaw,y_yaw",
        "--inputs and --outputs both hold y_yaw",
    ),
    ("identify unread.csv", "unread.csv: line 3, column 'y_a' must hold a number"),
    ("identify three.csv", "4 or more rows", "got 3"),
    (
        "command calibration.json far.csv --limits=-20,20",
        "target 1 (200, -4, 3) cannot be reached: u_pitch would have to be 457.9",
        "(limits -20 to 20",
    ),
    ("command calibration.json two.csv", "3 columns are needed", "got 2 without a"),
    ("command table.csv target.csv", "`jaxcal identify ... --out FILE` writes"),
    ("command calibration.json target.csv --limits=20,-20", "must be LOW, HIGH"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("beginners")
    for name, text in FILES.items():
        (path / name).write_text(text, encoding="utf-8")
    out = str(path / "calibration.json")
    assert main(["identify", str(path / "pairs.csv"), "--out", out]) == 0
    return path


@pytest.mark.parametrize(("typed", "wanted"), [(c[0], c[1:]) for c in CASES])
def test_an_error_is_one_line_that_says_what_to_do(
    folder, monkeypatch, capsys, typed, wanted
):
    monkeypatch.chdir(folder)
    assert main(typed.split()) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    for part in wanted:
        assert part in said.err


def test_a_calibration_that_an_editor_saved_with_a_byte_order_mark(
    folder, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    plain = "command calibration.json target.csv".split()
    assert main(plain) == 0
    wanted = capsys.readouterr().out
    marked = (folder / "calibration.json").read_text(encoding="utf-8")
    (folder / "marked.json").write_text(marked, encoding="utf-8-sig")
    assert main(["command", "marked.json", "target.csv"]) == 0
    assert capsys.readouterr().out == wanted


def test_a_negative_value_after_a_blank(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit):
        main("command calibration.json target.csv --limits -20,20".split())
    assert "write --limits=VALUE" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("imported", "missing", "extra"),
    [
        ("jaxcal.reports.plots", "matplotlib", "plots"),
        ("jaxcal.adaptive", "jax", "policy"),
    ],
)
def test_an_import_names_its_extra(imported, missing, extra):
    code = f"import sys; sys.modules[{missing!r}] = None; from {imported} import *"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    wanted = f"{imported} needs {missing}, which is not installed: "
    (line,) = [x for x in done.stderr.splitlines() if wanted in x]
    assert line.endswith(f"[{extra}]'")


def test_radians_are_named(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main("select radians.csv -k 4 --model arm.urdf".split()) == 0
    assert "if these are radians" in capsys.readouterr().err


def test_ctrl_c_is_told_in_one_line(monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxcal.commands.questions.read_table", interrupt)
    assert main(["select", "table.csv"]) == 130
    assert capsys.readouterr().err == "jaxcal select: interrupted\n"


def test_the_columns_of_an_arm_in_any_company(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main("select joints.csv -k 4 --model arm.urdf".split()) == 0
    said = capsys.readouterr().err
    assert said.startswith("joints.csv: column 'spare' is ignored")


@pytest.mark.parametrize("separator", [";", "\t"])
def test_what_is_read_as_it_comes(tmp_path, capsys, separator):
    path = tmp_path / "table.csv"
    path.write_text(TABLE.replace(",", separator), encoding="utf-8-sig")  # with a BOM
    assert main(["select", str(path), "-k", "4"]) == 0
    assert "pitch" in capsys.readouterr().out
