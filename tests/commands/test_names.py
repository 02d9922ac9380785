"""Columns are read by name in every command; the oracle is a map by name in numpy."""

from __future__ import annotations

import csv
import io
import itertools
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxcal.commands import main
from jaxcal.models import Linear, Polynomial

from .test_beginners import URDF

AXES = ("pitch", "yaw", "roll")
MATRIX = {  # output: input: slope
    "pitch": {"pitch": 0.43, "yaw": 0.02, "roll": 0.0},
    "yaw": {"pitch": 0.0, "yaw": 0.71, "roll": 0.01},
    "roll": {"pitch": 0.03, "yaw": 0.0, "roll": 0.87},
}
BIAS = {"pitch": 3.1, "yaw": -5.8, "roll": 2.41}
COMMANDED = {
    axis: column
    for axis, column in zip(
        AXES, np.random.default_rng(3).uniform(-20.0, 20.0, (3, 12)), strict=True
    )
}
REACHED = {
    y: sum(slope * COMMANDED[u] for u, slope in row.items()) + BIAS[y]
    for y, row in MATRIX.items()
}
every_order = st.permutations(range(6))
FEW = settings(
    max_examples=15,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def text_of(columns: dict[str, np.ndarray], header: bool = True) -> str:
    rows = zip(
        *([repr(float(x)) for x in column] for column in columns.values()), strict=True
    )
    lines = [",".join(columns)] if header else []
    return "\n".join([*lines, *(",".join(row) for row in rows)])


def parsed(text: str) -> dict[str, np.ndarray]:
    rows = list(csv.DictReader(io.StringIO(text)))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


@pytest.fixture
def ask(tmp_path, monkeypatch, capsys):
    """Runs a command on a table; its exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def run(typed: str, columns: dict[str, np.ndarray] | str) -> tuple[int, str, str]:
        text = columns if isinstance(columns, str) else text_of(columns)
        (tmp_path / "t.csv").write_text(text)
        code = main(typed.split())
        return code, *capsys.readouterr()

    measured = {f"u_{axis}": COMMANDED[axis] for axis in AXES}
    measured |= {f"y_{axis}": REACHED[axis] for axis in AXES}
    assert run("identify t.csv --out c.json --command-unit deg", measured)[0] == 0
    return run


SPELT = st.tuples(*(st.sampled_from(["{}", "PREFIX{}"]) for _ in AXES))


@FEW
@given(order=every_order, spelt=SPELT)
def test_predict_takes_commands_by_name(ask, order, spelt):
    columns = {
        form.replace("PREFIX", "u_").format(axis): COMMANDED[axis]
        for form, axis in zip(spelt, AXES, strict=True)
    }
    columns |= {f"y_{axis}": REACHED[axis] + 1.0 for axis in AXES}
    shuffled = dict([*columns.items()][i] for i in order)
    code, out, _ = ask("predict c.json t.csv", shuffled)
    assert code == 0
    for axis in AXES:
        np.testing.assert_allclose(parsed(out)[f"y_{axis}"], REACHED[axis], atol=1e-9)


@FEW
@given(order=every_order, spelt=SPELT)
def test_command_takes_outputs_by_name(ask, order, spelt):
    columns = {
        form.replace("PREFIX", "y_").format(axis): REACHED[axis]
        for form, axis in zip(spelt, AXES, strict=True)
    }
    columns |= {f"u_{axis}": COMMANDED[axis] + 1.0 for axis in AXES}
    shuffled = dict([*columns.items()][i] for i in order)
    code, out, _ = ask("command c.json t.csv", shuffled)
    assert code == 0
    for axis in AXES:
        np.testing.assert_allclose(parsed(out)[f"u_{axis}"], COMMANDED[axis], atol=1e-8)


@FEW
@given(order=every_order)
def test_identify_names_what_it_finds(ask, order):
    columns = {f"u_{axis}": COMMANDED[axis] for axis in AXES}
    columns |= {f"y_{axis}": REACHED[axis] for axis in AXES}
    shuffled = dict([*columns.items()][i] for i in order)
    code, out, _ = ask("identify t.csv --json", shuffled)
    assert code == 0
    found = json.loads(out)
    for y, row in zip(found["output_names"], found["derived"]["matrix"], strict=True):
        for u, slope in zip(found["input_names"], row, strict=True):
            assert slope == pytest.approx(MATRIX[y[2:]][u[2:]], abs=1e-12)


def test_a_line_says_how_columns_were_read(ask):
    by_name = {axis: REACHED[axis] for axis in ("yaw", "pitch", "roll")}
    said = ask("command c.json t.csv", by_name)[2]
    assert said == "t.csv: columns reordered by name\n"
    bare = {axis: REACHED[axis] for axis in AXES}
    assert ask("command c.json t.csv", bare)[2] == ""
    exact = {f"y_{axis}": REACHED[axis] for axis in AXES}
    assert ask("command c.json t.csv", exact)[2] == ""
    code, out, said = ask("command c.json t.csv", text_of(exact, header=False))
    assert code == 0
    np.testing.assert_allclose(parsed(out)["u_yaw"], COMMANDED["yaw"], atol=1e-8)
    assert said.startswith("t.csv has no header: columns are read by position")


@pytest.mark.parametrize("command", ["predict", "command"])
@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("pitch,yaw", "there is no column 'PREFIXroll'"),
        ("pitch,yaw,sway", "there is no column 'PREFIXroll'"),
        ("a,b,c", "there is no column 'PREFIXpitch', 'PREFIXyaw', 'PREFIXroll'"),
        ("OTHERpitch,OTHERyaw,OTHERroll", "there is no column 'PREFIXpitch'"),
        ("pitch,yaw,roll,pitch", "column 'pitch' comes twice"),
        ("Pitch,yaw,roll", "there is no column 'PREFIXpitch'"),
        ("1,2", "3 columns are needed (PREFIXpitch, PREFIXyaw, PREFIXroll), got 2"),
        ("pitch,2,roll", "mixes names and numbers, 'pitch' and '2'"),
    ],
)
def test_what_half_matches_is_refused(ask, command, header, message):
    own, other = ("u_", "y_") if command == "predict" else ("y_", "u_")
    header = header.replace("OTHER", other)
    width = header.count(",") + 1
    text = header + "\n" + ",".join("1" * width)
    code, out, said = ask(f"{command} c.json t.csv", text)
    assert (code, out) == (2, "")
    assert message.replace("PREFIX", own) in said


def test_check_and_report_take_both_by_name(ask, tmp_path):
    rng = np.random.default_rng(5)
    columns = {f"u_{axis}": COMMANDED[axis] for axis in AXES}
    columns |= {axis: REACHED[axis] + rng.normal(0.0, 0.01, 12) for axis in AXES}
    asked = "identify t.csv --outputs roll,pitch,yaw --out noisy.json --report r"
    pytest.importorskip("jinja2")
    assert ask(asked, columns)[0] == 0
    off = np.stack([columns[axis] - COMMANDED[axis] for axis in AXES])
    numbers = json.loads((tmp_path / "r" / "verdict.json").read_text())["numbers"]
    before = np.linalg.norm(off, axis=0).mean()
    assert numbers["nominal_mean"] == pytest.approx(before)
    shuffled = dict([*columns.items()][i] for i in (5, 1, 4, 0, 3, 2))
    code, out, _ = ask("check noisy.json t.csv --json", shuffled)
    assert code == 0 and json.loads(out)["good"]
    alone = {axis: COMMANDED[axis] for axis in AXES}
    code, _, said = ask("check noisy.json t.csv", alone)
    assert code == 2 and "pitch, roll, yaw would be both commands and readings" in said
    code, _, said = ask("check noisy.json t.csv", alone | {"u_roll": COMMANDED["yaw"]})
    assert code == 2 and "--inputs" not in said


def test_columns_that_are_named_are_in_the_order_named(ask):
    table = {"a": REACHED["pitch"], "b": REACHED["roll"], "c": REACHED["yaw"]}
    code, out, _ = ask("command c.json t.csv --outputs a,c,b", table)
    assert code == 0
    np.testing.assert_allclose(parsed(out)["u_roll"], COMMANDED["roll"], atol=1e-8)
    by_name = {axis: REACHED[axis] for axis in AXES}  # names count here too
    code, out, _ = ask("command c.json t.csv --outputs roll,pitch,yaw", by_name)
    np.testing.assert_allclose(parsed(out)["u_roll"], COMMANDED["roll"], atol=1e-8)
    half = {"a": REACHED["pitch"], "roll": REACHED["yaw"], "b": REACHED["roll"]}
    code, _, said = ask("command c.json t.csv --outputs a,roll,b", half)
    assert code == 2
    assert "has 'b' at the position of 'y_roll', and 'roll' elsewhere" in said
    assert ask("command c.json t.csv --outputs a,a,b", half)[0] == 2


def test_a_unit_in_the_name_must_be_the_calibrations(ask):
    rig = {"pulses_pitch": 9e9 * COMMANDED["yaw"]}  # as jaxcal-rig writes pairs.csv
    rig |= {f"u_deg_{axis}": COMMANDED[axis] for axis in AXES[::-1]}
    code, out, _ = ask("predict c.json t.csv", rig)
    assert code == 0
    np.testing.assert_allclose(parsed(out)["y_roll"], REACHED["roll"], atol=1e-9)
    radians = {f"{axis}_rad": np.radians(COMMANDED[axis]) for axis in AXES}
    assert ask("predict c.json t.csv", radians)[0] == 2
    both = {f"u_deg_{axis}": COMMANDED[axis] for axis in AXES}
    both |= {"pitch": COMMANDED["pitch"]}
    code, _, said = ask("predict c.json t.csv", both)
    assert code == 2
    assert "columns 'u_deg_pitch' and 'pitch' could both be 'u_pitch'" in said


def test_a_model_takes_its_inputs_by_name(ask, tmp_path):
    model = Linear("1 + pitch + yaw + I(yaw**2)", inputs=["pitch", "yaw"])
    (tmp_path / "m.json").write_text(json.dumps(model.to_dict()))
    y = 1.0 + 2.0 * COMMANDED["pitch"] + 3.0 * COMMANDED["yaw"] ** 2
    table = {"u_yaw": COMMANDED["yaw"], "u_pitch": COMMANDED["pitch"], "y_out": y}
    for columns in (table, dict([*table.items()][::-1])):
        code, out, _ = ask("identify t.csv --model m.json --json", columns)
        assert code == 0
        found = json.loads(out)["derived"]["parameters"]
        np.testing.assert_allclose(found, [1.0, 2.0, 0.0, 3.0], atol=1e-9)
    half = {"u_yaw": COMMANDED["yaw"], "u_roll": COMMANDED["roll"], "y_out": y}
    code, _, said = ask("identify t.csv --model m.json", half)
    assert code == 2
    assert "there is no column 'pitch'" in said
    assert ask("select t.csv -k 5 --model m.json", half)[0] == 2


def test_letters_of_a_polynomial_are_places(ask, tmp_path):
    (tmp_path / "m.json").write_text(json.dumps(Polynomial(2, 2).to_dict()))
    y = 1.0 + COMMANDED["pitch"] ** 2 - 3.0 * COMMANDED["yaw"]
    table = {"yaw": COMMANDED["yaw"], "pitch": COMMANDED["pitch"], "y_out": y}
    code, _, said = ask("identify t.csv --model m.json --out p.json", table)
    assert code == 0
    assert "columns yaw, pitch are used as x, y, in their order" in said
    shuffled = {"pitch": COMMANDED["pitch"], "yaw": COMMANDED["yaw"]}
    code, out, _ = ask("predict p.json t.csv", shuffled)
    np.testing.assert_allclose(parsed(out)["y_out"], y, atol=1e-6)


def test_an_arm_takes_joints_and_readings_by_name(ask, tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    from jaxcal.models import SerialChain

    arm = SerialChain.from_urdf(tmp_path / "arm.urdf")
    joints = np.random.default_rng(1).uniform(-90.0, 90.0, (20, 2))
    truth = arm.nominal + 0.001
    read = arm.predict(joints, truth)
    columns = {f"y_{axis}": read[:, i] for i, axis in enumerate("xyz")}
    columns |= {"elbow": joints[:, 1], "u_turn": joints[:, 0]}
    found = []
    for order in itertools.islice(itertools.permutations(columns), 0, None, 29):
        shuffled = {name: columns[name] for name in order}
        code, out, _ = ask("identify t.csv --model arm.urdf --json", shuffled)
        assert code == 0
        found.append(json.loads(out)["derived"]["parameters"])
    by_array = arm.predict(joints, found[0])
    np.testing.assert_allclose(by_array, read, atol=1e-4)
    np.testing.assert_allclose(found, [found[0]] * len(found), atol=1e-9)
    code, _, said = ask(
        "identify t.csv --model arm.urdf",
        {("y_1" if name == "y_x" else name): x for name, x in columns.items()},
    )
    assert code == 2
    assert "there is no column 'x', with or without y_" in said


def test_a_subset_of_another_table_is_refused(ask, tmp_path):
    table = {axis: COMMANDED[axis] for axis in AXES}
    assert ask("select t.csv -k 5 --out plan.csv", table)[0] == 0
    turned = {axis: table[axis] for axis in AXES[::-1]}
    assert ask("score t.csv --subset plan.csv", turned)[0] == 0
    other = {axis: table[axis][::-1] for axis in AXES}
    code, _, said = ask("score t.csv --subset plan.csv", other)
    assert code == 2
    assert "This selection is from another table" in said


# -- columns that number the rows or tell their time -----------------------------------

NUMBERS = {
    "id": np.arange(1.0, 13.0)[np.random.default_rng(0).permutation(12)],
    "index": np.arange(12.0),
    "time_s": np.sort(np.random.default_rng(0).uniform(0.0, 9.0, 12)),
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize(
    "typed",
    ["select t.csv -k 5 --csv", "score t.csv --indices 0,1,2,3,4 --csv", "identify"],
)
def test_a_number_of_the_row_is_no_command(ask, name, typed):
    table = {name: NUMBERS[name]} | {axis: COMMANDED[axis] for axis in AXES}
    if typed == "identify":
        table |= {f"y_{axis}": REACHED[axis] for axis in AXES}
        code, out, said = ask("identify t.csv --json", table)
        assert json.loads(out)["input_names"] == [*AXES]
    else:
        code, out, said = ask(typed, table)
        plain = {axis: COMMANDED[axis] for axis in AXES}
        with_it, without = parsed(out), parsed(ask(typed, plain)[1])
        np.testing.assert_array_equal(with_it["index"], without["index"])
    assert code == 0
    assert f"column {name!r} is not read" in said


@pytest.mark.parametrize("step", [1.0, -1.0, 0.1])
@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize("typed", ["select t.csv -k 5", "plan t.csv --accuracy 9"])
def test_a_constant_step_under_another_name_is_refused(ask, step, header, typed):
    table = {"zeit": step * np.arange(12.0)} | {axis: COMMANDED[axis] for axis in AXES}
    noise = " --noise 1" if typed.startswith("plan") else ""
    code, _, said = ask(typed + noise, text_of(table, header))
    assert code == 2
    what = "column 'zeit'" if header else "column 1"
    assert f"{what} rises by {step:.4g} per row" in said
    chosen = "zeit,pitch,yaw" if header else "u_1,u_2,u_3"
    assert ask(f"{typed}{noise} --inputs {chosen}", text_of(table, header))[0] == 0


def test_a_sweep_of_one_axis_is_one(ask):
    assert ask("select t.csv -k 2", {"angle": np.arange(0.0, 60.0, 5.0)})[0] == 0
    marked = {"u_time": np.arange(12.0), "u_yaw": COMMANDED["yaw"]}
    assert ask("select t.csv -k 3", marked)[2] == ""


def test_train_reads_the_same_columns(tmp_path, caplog):
    from jaxcal.commands.train_configuration import candidates_of

    table = {"id": np.arange(12.0)} | {axis: COMMANDED[axis] for axis in AXES}
    (tmp_path / "t.csv").write_text(text_of(table))
    with pytest.warns(UserWarning, match="column 'id' is not read"):
        values = candidates_of(str(tmp_path / "t.csv")).values
    want = np.stack([COMMANDED[axis] for axis in AXES], axis=1)
    want = (want - want.min(0)) / np.ptp(want, axis=0)
    np.testing.assert_allclose(values[0], want, atol=1e-6)
    (tmp_path / "t.csv").write_text(text_of(table).replace("id", "zaehler"))
    with pytest.raises(ValueError, match="column 'zaehler' rises by 1"):
        candidates_of(str(tmp_path / "t.csv"))


def test_an_unnamed_column_is_a_data_frames_index_or_refused(ask):
    table = {"": np.arange(12)} | {axis: COMMANDED[axis] for axis in AXES}
    rows = text_of(table).splitlines()
    text = "\n".join([rows[0], *(row.replace(".0", "", 1) for row in rows[1:])])
    code, _, said = ask("select t.csv -k 5", text)
    assert code == 0
    assert "ignored column 1 (looks like a row number)" in said
    code, _, said = ask("select t.csv -k 5", text.replace("\n3,", "\n7,"))
    assert code == 2
    assert "column 1 has no name" in said
