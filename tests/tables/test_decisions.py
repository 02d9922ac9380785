"""What each column is: by its name, its values and the company it keeps."""

from __future__ import annotations

import numpy as np
import pytest

from jaxcal.tables import parse

RNG = np.random.default_rng(0)
SORTED, SHUFFLED = np.sort(RNG.uniform(0.0, 9.0, 12)), RNG.permutation(12) + 1.0
RANDOM = RNG.uniform(-9.0, 9.0, (12, 9)).round(3)


def roles(header: str, columns: dict[str, np.ndarray] | None = None, **asked):
    """name: role, of a table of random numbers but for these columns."""
    names, values = header.split(","), RANDOM.copy()
    for name, column in (columns or {}).items():
        values[:, names.index(name)] = column
    rows = [",".join(map(repr, row[: len(names)])) for row in values.tolist()]
    table = parse("t.csv", "\n".join([header, *rows]).encode())
    return table, {name: decision.role for name, decision in table.decisions.items()}


@pytest.mark.parametrize(
    ("header", "inputs", "outputs"),
    [
        ("x_mm,y_mm,z_mm", "x_mm,y_mm,z_mm", ""),
        ("x_deg,y_deg,z_deg", "x_deg,y_deg,z_deg", ""),
        ("X_mm,y_mm", "X_mm,y_mm", ""),
        ("x_1,y_1,z_1,x_2,y_2,z_2", "x_1,y_1,z_1,x_2,y_2,z_2", ""),
        ("X,Y,Z", "X,Y,Z", ""),
        ("speed,y_axis", "speed,y_axis", ""),
        ("u_a,y_axis", "u_a", "y_axis"),
        ("u_a,u_b,y_a,y_b", "u_a,u_b", "y_a,y_b"),
        ("pitch,yaw,y_pitch,y_yaw", "pitch,yaw", "y_pitch,y_yaw"),
        ("x_1,x_2,y_1", "x_1,x_2", "y_1"),
        ("T,pH,available_rows", "T,pH", ""),
        ("u_x,u_y,u_z,y_x,y_y,y_z", "u_x,u_y,u_z", "y_x,y_y,y_z"),
    ],
)
def test_y_is_an_output_where_the_table_says_so(header, inputs, outputs):
    found = roles(header)[1]
    for role, names in (("input", inputs), ("output", outputs)):
        assert ",".join(name for name in found if found[name] == role) == names


def test_readings_are_named_where_y_is_an_axis():
    table = roles("x_mm,y_mm,z_mm,r")[0]
    with pytest.raises(ValueError, match=r"'y_mm' may be a coordinate.* --outputs"):
        table.outputs(None)
    with pytest.warns(UserWarning, match="'y_mm' is read as input: a coordinate"):
        assert table.commands(None, but=["r"]) == ("x_mm", "y_mm", "z_mm")
    beside = roles("u_a,u_b,x_mm,y_mm,z_mm")[0]
    with pytest.raises(ValueError, match="'y_mm' may be a coordinate"):
        beside.outputs(None)


@pytest.mark.parametrize(
    ("name", "column", "words"),
    [
        ("usable", np.tile([0.0, 1.0], 6), "name it available"),
        ("run", np.tile([1.0, 2.0], 6), "holds a number twice or more"),
    ],
)
def test_what_could_be_meant_otherwise_is_said(name, column, words):
    table = roles(f"{name},a,b", {name: column})[0]
    with pytest.warns(UserWarning, match=f"'{name}' is read as input: .*{words}"):
        assert table.commands(None) == (name, "a", "b")


GAPS = np.delete(np.arange(1.0, 14.0), 6)  # of a test that was left out


@pytest.mark.parametrize("name", ["Zeit [s]", "temps (s)", "X_Value", "Versuch Nr."])
@pytest.mark.parametrize(
    "column", [SORTED, GAPS, RNG.permutation(GAPS), SHUFFLED + 100.0]
)
def test_what_may_be_a_time_or_a_row_number_is_said(name, column):
    if name == "Versuch Nr." and column is SORTED:
        name = "ms"
    table = roles(f"{name},a,b", {name: column})[0]
    with pytest.warns(UserWarning) as said:
        assert table.commands(None) == (name, "a", "b")
    assert f"column '{name}' is read as input: may be a time" in str(said[0].message)
    assert "--inputs" in str(said[0].message)


LEVELS = np.array([(i, j) for i in range(4) for j in range(3)]) * 10.0


@pytest.mark.parametrize(
    "columns",
    [
        {"a": LEVELS[:, 0], "b": LEVELS[:, 1]},
        {"a": SORTED, "b": SORTED**2},  # swept together
        {"a": SORTED - 4.0},  # sorted commands of both signs
        {"a": RNG.permutation(12) * 15.0},
        {"a": RNG.integers(0, 181, 12)},
        {"a": np.arange(12) // 3},
        {},
    ],
)
@pytest.mark.filterwarnings("error")
def test_levels_and_sweeps_are_read_without_a_word(columns):
    assert roles("a,b", columns)[0].commands(None) == ("a", "b")


@pytest.mark.filterwarnings("error")
def test_a_sweep_beside_its_reading_is_read_without_a_word():
    table = roles("angle,y_1", {"angle": SORTED})[0]
    assert table.commands(None, but=["y_1"]) == ("angle",)


@pytest.mark.parametrize("form", ["u[{}] y[{}]", "u({}) y({})", "U_{} Y_{}"])
def test_readings_that_no_prefix_marks_are_said(form):
    u, y = form.split()
    names = [u.format(0), u.format(1), y.format(0)]
    with pytest.warns(UserWarning, match="is read as input: readings begin with y_"):
        assert roles(",".join(names))[0].commands(None) == (*names,)


def test_a_design_of_two_levels_is_read_without_a_word():
    levels = np.array([[i >> k & 1 for k in range(3)] for i in range(8)], float)
    names = parse(
        "t.csv",
        (
            "a,b,c\n" + "\n".join(",".join(map(str, row)) for row in levels.tolist())
        ).encode(),
    ).commands(None)
    assert names == ("a", "b", "c")


@pytest.mark.parametrize(
    ("header", "column", "role"),
    [
        ("time,a,b", SORTED, "time"),
        ("Time [s],a,b", SORTED, "time"),
        ("elapsedTime,a,b", SORTED, "time"),
        ("time,a,b", RANDOM[:, 0], "input"),
        ("cure_time,a,b", np.tile([10.0, 20.0, 30.0], 4), "input"),
        ("t,a,b", np.tile([1.0, 2.0], 6), "input"),
        ("timestamp,a,b", RANDOM[:, 0], "time"),
        ("time,a,b", 1.7e9 + RANDOM[:, 0], "time"),
        ("time,u_a,u_b", RANDOM[:, 0], "left out"),
        ("run,a,b", SHUFFLED, "left out"),
        ("RunOrder,a,b", SHUFFLED, "left out"),
        ("Std Order,a,b", SHUFFLED + 20.0, "left out"),
        ("run,a,b", np.tile([1.0, 2.0], 6), "input"),
        ("lot,a,b", SHUFFLED, "left out"),
        ("lot,a,b", SHUFFLED - 1.0, "left out"),
        ("lot,a,b", SHUFFLED + 5.0, "input"),
        ("pose_id,a,b", np.repeat([1.0, 2.0, 3.0], 4), "left out"),
        ("refractive_index,a,b", RANDOM[:, 0], "input"),
        ("note,a,b", np.full(12, np.nan), "left out"),
    ],
)
def test_what_counts_the_rows_is_no_command(header, column, role):
    name = header.split(",")[0]
    assert roles(header, {name: column})[1][name] == role


def test_an_unknown_running_number_is_asked_about():
    table = roles("lot,a,b", {"lot": SHUFFLED})[0]
    with pytest.raises(ValueError, match="'lot' holds each number from 1 to 12 once"):
        table.commands(None)
    assert table.commands("lot,a,b") == ("lot", "a", "b")


def test_levels_of_all_axes_are_axes():
    shuffled = {name: RNG.permutation(12) for name in "abc"}  # a Latin hypercube
    assert roles("a,b,c", shuffled)[0].commands(None) == ("a", "b", "c")


def test_time_alone_is_what_varies():
    table = roles("time,y_1", {"time": SORTED})[0]
    with pytest.warns(UserWarning, match="the only one"):
        assert table.commands(None, but=["y_1"]) == ("time",)


def test_what_is_not_read_is_said_with_its_reason():
    table = roles("time,a,b", {"time": SORTED})[0]
    with pytest.warns(UserWarning, match="b; column 'time' is not read: like"):
        table.commands(None)
    words = parse("t.csv", b"mode,a,b\nfast,1,2\nslow,2,5\n")
    with pytest.warns(UserWarning, match="'mode' is read as label: words"):
        words.commands(None)


def test_columns_that_nothing_asks_for_are_said():
    table = roles("j1,j2,j3,j4,x", {"j4": np.arange(12.0)})[0]
    with pytest.warns(UserWarning, match="columns 'j3', 'j4' are ignored"):
        table.named(["j1", "j2"], "u_", others=["x"])


def test_words_that_nothing_asks_for_are_said():
    table = parse("t.csv", b"j1,mode,note\n1,fast,a\n5,slow,b\n")
    with pytest.warns(UserWarning, match="'mode', 'note' are read as label: words"):
        table.named(["j1"], "u_", others=[])


def test_several_columns_are_told_in_the_plural():
    words = parse("t.csv", b"m,n,a,b\nfast,x,1,2\nslow,y,2,5\n")
    with pytest.warns(UserWarning, match="'n' are read as label: words"):
        words.commands(None)
