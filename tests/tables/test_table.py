"""Tables in and out of the console commands."""

from __future__ import annotations

import io

import numpy as np
import pytest

from jaxcal.tables import read_table


def written(tmp_path, text, name="table.csv"):
    path = tmp_path / name
    path.write_text(text)
    return str(path)


def test_csv_keeps_names_numbers_and_text(tmp_path):
    table = read_table(written(tmp_path, "pose,a,b\nleft,1,2.5\nright,3,-4e2\n"))
    assert table.names == ("a", "b")
    assert table.labels == {"pose": ["left", "right"]}
    np.testing.assert_array_equal(table.values, [[1, 2.5], [3, -400]])
    with pytest.warns(UserWarning, match="'pose' is read as label"):
        assert table.commands(None) == ("a", "b")
    np.testing.assert_array_equal(table.columns(["b", "a"]), [[2.5, 1], [-400, 3]])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_table_without_a_header_gets_names(tmp_path, delimiter):
    text = "\n".join(delimiter.join(row) for row in (["1", "2", "3"], ["4", "5", "6"]))
    table = read_table(written(tmp_path, "\ufeff" + text))
    assert table.names == ("u_x", "u_y", "u_z")
    np.testing.assert_array_equal(table.values, [[1, 2, 3], [4, 5, 6]])


def test_columns_by_their_prefix_and_availability(tmp_path):
    table = read_table(
        written(tmp_path, "u_1,y_1,available,u_2\n1,7,1,2\n3,8,0,\n"),
    )
    assert table.commands(None) == ("u_1", "u_2")
    assert table.outputs(None) == ("y_1",)
    np.testing.assert_array_equal(table.available(), [True, False])
    assert np.isnan(table.columns(["u_2"], table.available())[1, 0])
    with pytest.raises(ValueError, match="line 3, column 'u_2' must hold a number"):
        table.columns(["u_2"])


def test_standard_input(monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("a\n1\n2\n"))
    assert len(read_table("-")) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the table is empty"),
        ("a,b\n", "no rows below the header"),
        ("a,a\n1,2\n", "column 'a' comes twice"),
        ("a,b\n1,2\n3\n", "line 3 has 1 cells, the first has 2"),
    ],
)
def test_damaged_tables_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read_table(written(tmp_path, text))


def test_refusals_name_the_column(tmp_path):
    table = read_table(written(tmp_path, "a,b\n1,x\n2,3\n"))
    with pytest.raises(
        ValueError, match="line 2, column 'b' must hold a number, got 'x'"
    ):
        table.columns(["b"])
    with pytest.raises(ValueError, match="no column 'c'; columns: a"):
        table.columns(["c"])
    with pytest.raises(ValueError, match="no column begins with y_"):
        table.outputs(None)


def test_a_file_of_a_spreadsheet_is_refused(tmp_path):
    path = tmp_path / "t.xlsx"
    path.write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ValueError, match="a table must be CSV; save this one as CSV"):
        read_table(str(path))
