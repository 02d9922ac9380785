"""``jaxcal COMMAND`` as a user types it; oracles by brute force in float64."""

from __future__ import annotations

import csv
import io
import itertools
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import jaxcal
from jaxcal.commands import main
from jaxcal.commands.arms import ArmOptions
from jaxcal.models import SerialChain

MATRIX = np.array([[0.43, 0.02, 0.0], [0.0, 0.71, 0.01], [0.03, 0.0, 0.87]])
BIAS = np.array([3.1, -5.8, 2.41])
NAMES = ("pitch", "yaw", "roll")


@pytest.fixture
def commands():
    return np.random.default_rng(3).uniform(-20.0, 20.0, (10, 3))


@pytest.fixture
def candidates(tmp_path, commands):
    path = tmp_path / "candidates.csv"
    rows = [
        f"p{i},{','.join(map(repr, row))}" for i, row in enumerate(commands.tolist())
    ]
    path.write_text("label,pitch,yaw,roll\n" + "\n".join(rows) + "\n")
    return str(path)


@pytest.fixture
def calibration(tmp_path, commands, capsys):
    """A calibration made by the command itself from exact measurements."""
    path, out = tmp_path / "measured.csv", tmp_path / "calibration.json"
    measured = commands @ MATRIX.T + BIAS
    rows = np.concatenate([commands, measured], axis=1).tolist()
    header = ",".join((*NAMES, "y_1", "y_2", "y_3"))
    path.write_text("\n".join([header, *(",".join(map(repr, r)) for r in rows)]))
    assert main(["identify", str(path), "--out", str(out)]) == 0
    assert "pitch" in capsys.readouterr().out
    return str(out)


def parsed(text):
    return list(csv.DictReader(io.StringIO(text)))


def best_subset(commands, k):
    z = np.concatenate([commands, np.ones((len(commands), 1))], axis=1)
    return max(
        itertools.combinations(range(len(z)), k),
        key=lambda s: np.linalg.slogdet(z[list(s)].T @ z[list(s)])[1],
    )


@pytest.mark.parametrize("k", [None, 5])
def test_select_finds_the_brute_force_optimum(candidates, commands, capsys, k):
    flags = [] if k is None else ["-k", str(k)]
    assert main(["select", candidates, *flags, "--csv"]) == 0
    rows = parsed(capsys.readouterr().out)
    chosen = tuple(sorted(int(row["index"]) for row in rows))
    assert chosen == best_subset(commands, k or 4)
    for row in rows:
        assert row["label"] == f"p{row['index']}"
        given = commands[int(row["index"])]
        assert [float(row[name]) for name in NAMES] == given.tolist()


def test_select_for_people_and_machines(candidates, commands, capsys):
    assert main(["select", candidates]) == 0
    shown = capsys.readouterr().out
    assert "pitch" in shown
    assert "proven" in shown
    assert main(["select", candidates, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert tuple(sorted(document["indices"])) == best_subset(commands, 4)
    assert document["proven"] is True
    assert {row["label"] for row in document["rows"]} == {
        f"p{i}" for i in document["indices"]
    }


def test_score_judges_what_select_wrote(tmp_path, candidates, capsys):
    out = str(tmp_path / "plan.csv")
    assert main(["select", candidates, "--method", "greedy", "--out", out]) == 0
    asked = ["select", candidates, "--json", "--score"]
    assert main([*asked, out]) == 0
    judged = json.loads(capsys.readouterr().out)
    chosen = ",".join(str(i) for i in judged["indices"])
    assert main([*asked, chosen]) == 0
    again = json.loads(capsys.readouterr().out)
    assert judged["log_det"] == again["log_det"]
    assert 0.0 < judged["efficiency"] <= 1.0
    assert main([*asked, chosen, "-k4"]) == 2
    assert main([*asked, chosen, "--best=2"]) == 2


def test_names_of_0_2_work_and_warn(candidates, capsys):
    new = ["select", candidates, "--inputs", "pitch,yaw,roll", "--score", "0,5,9,3"]
    assert main([*new, "--json"]) == 0
    judged = json.loads(capsys.readouterr().out)
    old = ["score", candidates, "--columns=pitch,yaw,roll", "--indices", "0,5,9,3"]
    assert main([*old, "--json"]) == 0
    out, warned = capsys.readouterr()
    assert json.loads(out)["value"] == judged["value"]
    assert [line.split(": ")[1].split(" since")[0] for line in warned.splitlines()] == [
        "score is select --score",
        "--columns is --inputs",
        "--indices is --score",
    ]


@pytest.mark.parametrize(
    ("words", "nearest"),
    [
        ("slect t.csv", "there is no command 'slect'; did you mean select?"),
        ("select t.csv --metod exact", "no option --metod; did you mean --method?"),
        ("select t.csv 4", "there is no option 4; did you mean -k 4?"),
        ("select t.csv -k 2 -o c.csv", "there is no option -o; did you mean --out?"),
        ("select t.csv --criterion=As1", "did you mean As?"),
        ("select t.csv --zzz", "jaxcal select: unrecognized arguments: --zzz"),
        ("plan t.csv --acuracy 1", "no option --acuracy; did you mean --accuracy?"),
        ("select t.csv --noise nan", "--noise: must be a number, got 'nan'"),
        ("select t.csv --replicates 0", "--replicates: must be a whole number of at"),
    ],
)
def test_what_is_mistyped_is_answered_with_the_nearest(words, nearest, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    said = capsys.readouterr().err
    assert ended.value.code == 2 and nearest in said and said.count("\n") == 1


@pytest.mark.parametrize("words", ["help", "help select", "select --help"])
def test_help_is_asked_for_as_it_is_elsewhere(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    usage = capsys.readouterr().out.splitlines()[0]
    assert ended.value.code == 0 and ("select" in words) == ("jaxcal select" in usage)


@pytest.mark.parametrize("words", ["--version", "plan --version"])
def test_every_command_has_a_version(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"jaxcal {jaxcal.__version__}\n"


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("select t.csv >&-", "jaxcal: standard output is closed\n"),
        ("select - <&-", "jaxcal select: standard input is closed\n"),
    ],
)
def test_a_closed_stream_is_one_line(typed, said):
    typed = f"{sys.executable} -m jaxcal {typed}"
    done = subprocess.run(typed, shell=True, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr == said


def test_a_device_is_not_replaced_by_a_file(candidates, tmp_path, capsys):
    os.mkfifo(tmp_path / "device")
    assert main(["select", candidates, "--out", str(tmp_path / "device")]) == 2
    assert "is a device, not a file" in capsys.readouterr().err


def test_standard_error_may_be_closed(candidates):
    typed = f"{sys.executable} -m jaxcal select {candidates} 2>&-"
    done = subprocess.run(typed, shell=True, capture_output=True, text=True)
    assert done.returncode == 0 and "candidates" in done.stdout


def test_plan_prints_a_table_and_the_rows(candidates, capsys):
    flags = ["--accuracy", "0.2", "--noise", "0.1", "--replicates", "3"]
    assert main(["plan", candidates, *flags]) == 0
    assert "measure rows" in capsys.readouterr().out
    assert main(["plan", candidates, *flags, "--csv"]) == 0
    rows = parsed(capsys.readouterr().out)
    assert float(rows[-1]["standard_error"]) <= 0.2


def test_predict_and_command_are_inverse(calibration, tmp_path, commands, capsys):
    table = tmp_path / "u.csv"
    table.write_text(
        "pitch,yaw,roll\n"
        + "\n".join(",".join(map(repr, r)) for r in commands.tolist())
    )
    assert main(["predict", calibration, str(table)]) == 0
    text = capsys.readouterr().out
    there = np.array([[float(v) for v in row.values()] for row in parsed(text)])
    np.testing.assert_allclose(there, commands @ MATRIX.T + BIAS, atol=1e-9)
    reached = tmp_path / "y.csv"
    reached.write_text(text)
    assert main(["command", calibration, str(reached), "--limits=-20,20"]) == 0
    back = np.array(
        [[float(v) for v in row.values()] for row in parsed(capsys.readouterr().out)]
    )
    np.testing.assert_allclose(back, commands, atol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["select", "missing.csv"], "missing.csv"),
        (["select", "CANDIDATES", "-k", "3"], "k must be at least 4"),
        (
            ["select", "CANDIDATES", "--method", "greedy", "--time-limit", "3"],
            "time_limit",
        ),
        (["select", "CANDIDATES", "--inputs", "pitch,sway"], "no column 'sway'"),
        (["select", "CANDIDATES", "--score", "0,1,2,99"], "99"),
        (["command", "CALIBRATION", "CANDIDATES", "--clip"], "--clip needs --limits"),
        (
            ["command", "CALIBRATION", "CANDIDATES", "--limits", "1"],
            "--limits takes LOW,HIGH, once for all axes",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    candidates, calibration, capsys, arguments, message
):
    names = {"CANDIDATES": candidates, "CALIBRATION": calibration}
    arguments = [names.get(argument, argument) for argument in arguments]
    if arguments[0] == "command":
        arguments += ["--outputs", "pitch,yaw,roll"]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"jaxcal {arguments[0]}: ")
    assert message in said
    assert said.count("\n") == 1


def test_select_in_a_pipe_loads_no_jax(commands):
    text = "\n".join(",".join(map(repr, row)) for row in commands.tolist())
    code = (
        "import sys; from jaxcal.commands import main; code = main(sys.argv[1:]);"
        "print(sorted({'jax', 'flax', 'matplotlib', 'pandas'} & set(sys.modules)),"
        "file=sys.stderr); sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "select", "-", "-k", "4", "--csv"],
        input=text,
        capture_output=True,
        text=True,
        env=os.environ,
        check=True,
    )
    assert len(parsed(done.stdout)) == 4
    said = "standard input has no header: its columns are u_x, u_y, u_z"
    assert done.stderr.splitlines() == [said, "[]"]


@pytest.fixture
def arm(tmp_path):
    model = SerialChain.from_dh([(0, 90, 150, 0), (300, 0, 0, 0), (250, 0, 0, 0)])
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(model.to_dict()))
    return model, str(path)


def test_a_model_goes_through_every_command(tmp_path, arm, capsys):
    model, path = arm
    rng = np.random.default_rng(0)
    commands = rng.uniform(20.0, 80.0, (12, 3))
    truth = model.nominal + 0.1 * rng.normal(size=model.num_parameters)
    rows = np.concatenate([commands, model.predict(commands, truth)], axis=1)
    table, out = tmp_path / "measured.csv", str(tmp_path / "calibration.json")
    header = "u_1,u_2,u_3,y_x,y_y,y_z"
    table.write_text(
        "\n".join([header, *(",".join(map(repr, r)) for r in rows.tolist())])
    )
    flags = [str(table), "--model", path, "--noise", "0.01"]

    assert main(["select", *flags, "-k", "4", "--criterion", "D", "--json"]) == 0
    chosen = json.loads(capsys.readouterr().out)
    wanted = jaxcal.select(
        commands, 4, model=model, criterion="D", noise=jaxcal.Noise(0.01)
    )
    assert sorted(chosen["indices"]) == sorted(wanted.indices.tolist())

    rows_chosen = ",".join(str(i) for i in chosen["indices"])
    judge = ["select", *flags, "--score", rows_chosen, "--json"]
    assert main([*judge, "--criterion", "D"]) == 0
    assert json.loads(capsys.readouterr().out)["value"] == wanted.value
    assert main(judge) == 0  # by the variance of predictions, as select would
    design = jaxcal.Design(commands, model, noise=jaxcal.Noise(0.01))
    judged = design.score(chosen["indices"])
    found = json.loads(capsys.readouterr().out)
    assert (found["criterion"], found["value"]) == ("I", judged.value)

    assert main(["plan", *flags, "--accuracy", "0.02", "--csv"]) == 0
    assert float(parsed(capsys.readouterr().out)[-1]["standard_error"]) <= 0.02

    assert main(["identify", *flags, "--out", out]) == 0
    assert "tool x" in capsys.readouterr().out
    assert main(["predict", out, str(table), "--std"]) == 0
    text = capsys.readouterr().out
    there = np.array([[float(v) for v in row.values()] for row in parsed(text)])
    np.testing.assert_allclose(there[:, :3], rows[:, 3:], atol=0.05)
    assert (there[:, 3:] > 0.0).all()
    reached = tmp_path / "y.csv"
    reached.write_text(text)
    inverse = ["command", out, str(reached), "--limits=0,100"]
    assert main([*inverse, "--outputs", "y_x,y_y,y_z"]) == 0
    back = parsed(capsys.readouterr().out)
    again = np.array([[float(v) for v in row.values()] for row in back])
    np.testing.assert_allclose(model.predict(again, truth), rows[:, 3:], atol=0.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [("[]", "JSON object"), ('{"kind": "jax"}', "model=..."), ("{", "arm.json: ")],
)
def test_a_bad_model_is_one_line(arm, candidates, capsys, text, message):
    with open(arm[1], "w") as file:
        file.write(text)
    assert main(["select", candidates, "--model", arm[1]]) == 2
    assert message in capsys.readouterr().err


def test_an_arm_is_read_from_urdf(tmp_path):
    path = tmp_path / "arm.URDF"
    path.write_text(
        '<robot name="arm"><link name="a"/><link name="b"/><joint name="turn" '
        'type="revolute"><parent link="a"/><child link="b"/>'
        '<origin xyz="0.3 0 0.1" rpy="0 0 0"/><axis xyz="0 0 1"/></joint></robot>'
    )
    read = ArmOptions().machine(str(path), None)
    assert read.to_dict() == SerialChain.from_urdf(path).to_dict()


def test_rare_options_are_in_the_help_that_asks_for_all(capsys):
    words = ("--seed", "--best", "--between", "--required", "--checkpoint", "--tip")
    for asked, shown in ((["--help"], False), (["--help", "all"], True)):
        with pytest.raises(SystemExit) as ended:
            main(["select", *asked])
        text = capsys.readouterr().out
        assert ended.value.code == 0 and ("more options: --help all" in text) != shown
        assert all((f"  {word} " in text) == shown for word in words)
