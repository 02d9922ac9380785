"""Tables as people export them; the oracle is the array that each was written from."""

from __future__ import annotations

import csv
import gzip
import io

import numpy as np
import pytest

import jaxcal
from jaxcal.tables import parse

NAMES = ("u_a", "u_b", "y_c")
VALUES = np.random.default_rng(0).uniform(-20.0, 20.0, (9, 3)).round(4)


def text_of(
    delimiter: str = ",",
    decimal: str = ".",
    head: str | None = None,
    end: str = "\n",
    form: str = ".4f",
) -> str:
    rows = [[f"{x:{form}}".replace(".", decimal) for x in row] for row in VALUES]
    lines = [delimiter.join(row) for row in rows]
    return end.join([delimiter.join(NAMES) if head is None else head, *lines, ""])


def savetxt(**options: str) -> str:
    file = io.StringIO()
    np.savetxt(file, VALUES, fmt="%.18e", **options)
    return file.getvalue()


def of_excel(*, sep: bool = False) -> str:
    return ("sep=;\r\n" if sep else "") + text_of(";", ",", end="\r\n")


def with_sep(delimiter: str, line: str) -> str:
    return f"{line}\n" + text_of(delimiter)


PLAIN = text_of()
LINES = PLAIN.splitlines()
DIALECTS = {
    "commas": PLAIN,
    "quoted": "\n".join('"' + '","'.join(line.split(",")) + '"' for line in LINES),
    "Excel in German": of_excel(),
    "Excel with sep=": of_excel(sep=True),
    "sep= of tabs": with_sep("\t", "sep=\t"),
    "SEP= in quotes": with_sep("|", '"SEP=|"'),
    "tabs and decimal commas": text_of("\t", ","),
    "blanks": text_of(" "),
    "aligned": text_of("    ", form="12.4f"),
    "blanks and decimal commas": text_of(" ", ","),
    "decimal commas in quotes": "\n".join(
        [LINES[0]]
        + [
            ",".join(f'"{cell.replace(".", ",")}"' for cell in line.split(","))
            for line in LINES[1:]
        ]
    ),
    "carriage returns": text_of(end="\r"),
    "numpy": savetxt(header=" ".join(NAMES)),
    "numpy with commas": savetxt(header=",".join(NAMES), delimiter=","),
    "comments": f"# rig 3, morning\n# a b\n{PLAIN}# end\n",
    "a comment between": "\n".join([*LINES[:4], "# a pause", *LINES[4:]]),
    "units": "\n".join([LINES[0], "deg,[mm],1/min", *LINES[1:]]),
    "empty columns": "\n".join(f"{line},," for line in LINES),
    "a delimiter at the end": "\n".join([LINES[0], *(f"{x}," for x in LINES[1:])]),
    "empty rows": f"{PLAIN},,\n\n,,\n",
    "R write.csv": "\n".join(
        ['"",' + LINES[0], *(f'"{i}",{line}' for i, line in enumerate(LINES[1:], 1))]
    ),
    "R write.table": "\n".join(
        [LINES[0]] + [f'"{i}",{line}' for i, line in enumerate(LINES[1:], 1)]
    ).replace(",", " "),
    "an index of pandas, shuffled": "\n".join(
        ["," + LINES[0], *(f"{7 * i % 23},{line}" for i, line in enumerate(LINES[1:]))]
    ),
    "minus signs of typography": PLAIN.replace("-", "\u2212"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dialect", DIALECTS)
def test_what_is_exported_is_read(dialect):
    table = parse("t.csv", DIALECTS[dialect].encode())
    assert table.names == NAMES and not table.labels
    np.testing.assert_allclose(table.values, VALUES, atol=1e-12)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
def test_encodings(encoding):
    table = parse("t.csv", PLAIN.replace("u_b", "u_b [°]").encode(encoding))
    assert table.names == ("u_a", "u_b [°]", "y_c")
    np.testing.assert_array_equal(table.values, VALUES)


def test_a_compressed_file(tmp_path):
    path = tmp_path / "t.csv.gz"
    path.write_bytes(gzip.compress(PLAIN.encode()))
    np.testing.assert_array_equal(jaxcal.read_table(path).values, VALUES)


@pytest.mark.parametrize("blank", ["'", "\u2019", "\u00a0", "\u202f", "\u2009", " "])
def test_thousands_between_blanks(blank):
    numbers = [-838.0, 16295.1, 1234567.25, 0.5]
    cells = [f"{x:,}".replace(",", blank) for x in numbers]
    table = parse("t.csv", "\n".join(["u_p", *cells]).encode())
    np.testing.assert_array_equal(table.values[:, 0], numbers)


@pytest.mark.parametrize(
    ("cells", "numbers"),
    [
        (["1,234.5", "2,000", "-3,000.25"], [1234.5, 2000.0, -3000.25]),
        (["1.234,5", "2.000", "-3.000,25"], [1234.5, 2000.0, -3000.25]),
        (["1.234.567", "14.036"], [1234567.0, 14036.0]),
        (["1,5", "2,125"], [1.5, 2.125]),
        (["14.036", "22.125", "-7.250"], [14.036, 22.125, -7.25]),
        (["14.036", "-838.5", "512"], [14.036, -838.5, 512.0]),
        (["14.036", "90", "0"], [14.036, 90.0, 0.0]),
        (["1e3", "2.5E-1", "+.5"], [1000.0, 0.25, 0.5]),
    ],
)
def test_one_decimal_mark_for_all_cells(cells, numbers):
    table = parse("t.csv", "\n".join(["a;b", *(f"{x};1" for x in cells)]).encode())
    np.testing.assert_array_equal(table.values[:, 0], numbers)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "u_a,u_b\n-838,1\n14.036,2\n",
            "line 3, column 'u_a': '14.036' may mean 14036",
        ),
        (
            "a,b\n12.500,4\n-83,1\n40.000,2\n",
            "line 2, column 'a': '12.500' may mean 12500",
        ),
        (
            "a;b\n8,200;4\n-38;1\n14,036;2\n",
            "line 2, column 'a': '8,200' may mean 8200",
        ),
        ('a,b\n"1,234",1\n"2,345",2\n', "line 2, column 'a': '1,234' may mean 1234"),
        ("a;b\n1,5;2\n3.5;1\n2,5;4\n", "line 3, column 'a' must hold a number, got"),
        ("u_a,u_on\n1,fast\n2,slow\n", "line 2, column 'u_on' must .* got 'fast'"),
        ("u_a,y_b\n1,ok\n2,bad\n", "line 2, column 'y_b' must hold a number, got 'ok'"),
        ("a,b\nfoo,bar\n1,2\n3,4\n5,6\n", "line 2, column 'a' must .* got 'foo'"),
        ("a,b\n1,5%\n3,4\n5,6\n", "line 2, column 'b' must hold a number, got '5%'"),
        ("a\n1_000\n2\n3\n", "line 2, column 'a' must hold a number, got '1_000'"),
        ("u_a,u_b\n1,2\n3,4,5\n", "line 3 has 3 cells, the first has 2"),
        ("a,b\n1,2\n\x00,4\n", "line 3 is not UTF-8 text"),
        ("words,more\na,b\n", "no column contains numbers: words, more"),
    ],
)
def test_what_could_be_two_things_is_refused_with_the_cell(text, message):
    with pytest.raises(ValueError, match=message):
        parse("t.csv", text.encode())


def test_true_and_false_are_numbers_where_a_command_is_asked_for():
    table = parse("t.csv", b"u_a,u_on,done\n1,TRUE,false\n2,False,TRUE\n")
    np.testing.assert_array_equal(table.columns(["u_on"])[:, 0], [1.0, 0.0])
    np.testing.assert_array_equal(table.columns(["done"])[:, 0], [0.0, 1.0])
    assert table.decisions["done"].role == "label" and table.row_names is None


@pytest.mark.parametrize(
    "name",
    [
        "available",
        "Available",
        "AVAILABLE",
        " available ",
        "available?",
        "available_",
        "Available (0/1)",
    ],
)
@pytest.mark.parametrize("words", [("0", "1"), ("FALSE", "TRUE"), ("No", "yes")])
def test_available_in_any_spelling(name, words):
    rows = [f"{i},{words[i % 2]}" for i in range(4)]
    table = parse("t.csv", "\n".join([f"a,{name}", *rows]).encode())
    np.testing.assert_array_equal(table.available(), [False, True, False, True])


@pytest.mark.parametrize("cell", ["maybe", "2", ""])
def test_available_is_yes_or_no(cell):
    table = parse("t.csv", f"a,available\n1,1\n2,{cell}\n".encode())
    with pytest.raises(ValueError, match="line 3"):
        table.available()
    twice = parse("t.csv", b"a,available,Available\n1,1,1\n")
    with pytest.raises(ValueError, match="could both be available"):
        twice.available()


def test_rows_whose_names_begin_with_a_hash_stay():
    rows = [f"#{i},{i * i}" for i in range(5)]
    table = parse("t.csv", "\n".join(["pose,a", *rows]).encode())
    assert len(table) == 5 and table.row_names == [f"#{i}" for i in range(5)]
    numbered = parse("t.csv", "\n".join(["#,a", *(x[1:] for x in rows)]).encode())
    assert numbered.decisions["#"].role == "left out"


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize(
    "cell",
    [
        *("#VALUE!", "#N/A", "#DIV/0!", "#NUM!", "#NAME?", "#REF!", "#NULL!"),
        *("#WERT!", "#BEZUG!", "#ZAHL!", "#NV", "#ÜBERLAUF!", "#VALEUR!", "#NOMBRE!"),
        *("#N/D", "#¡VALOR!", "#¿NOMBRE?"),
    ],
)
def test_an_error_of_a_spreadsheet_is_no_comment(cell, mark):
    rows = [["u_a", "u_b"], ["1", "2"], [cell, "3"], ["4", "5"], ["7", "1"]]
    for places in [0, 1], [1, 0], [0]:
        text = "\n".join(mark.join(row[i] for i in places) for row in rows)
        with pytest.raises(ValueError, match="line 3, column 'u_a' must hold a number"):
            parse("t.csv", text.encode()).columns(["u_a"])


@pytest.mark.parametrize(
    "comment", ["# VALUE!", "#note", "#NOTE! see below", "#N/A is a gap", "#a,b", "#NB"]
)
def test_comments_stay_comments(comment):
    with pytest.warns(UserWarning, match="ignored comment .*: line 3"):
        table = parse("t.csv", f"a,b\n1,2\n{comment}\n4,5\n".encode())
    assert table.lines == (2, 4)


def test_lines_are_those_of_the_file():
    with pytest.warns(UserWarning, match="units are taken from line 3"):
        table = parse("t.csv", b"# a\na,b\nmm,mm\n# c\n1,2\n\n3,nan\n")
    assert table.lines == (5, 7)
    with pytest.raises(ValueError, match="line 7, column 'b'"):
        table.columns(["b"])


def test_read_table_takes_what_csv_writes(tmp_path):
    path = tmp_path / "t.csv"
    with open(path, "w", newline="") as file:
        csv.writer(file, dialect="excel-tab").writerows([NAMES, *VALUES.tolist()])
    np.testing.assert_array_equal(jaxcal.read_table(str(path)).values, VALUES)


def test_a_quote_that_is_never_closed_is_named_with_its_line():
    with pytest.raises(ValueError, match=r"line 3: a quote .* is never closed"):
        parse("t.csv", b'a,b\n1,2\n3,"4\n5,6\n7,8\n')


def test_a_name_of_two_lines_is_one_name():
    table = parse("t.csv", b'"T\n(C)","p\nH"\n1,2\n5,3\n2,9\n')
    assert table.names == ("T (C)", "p H")


@pytest.mark.parametrize(
    "units", ["kN,mbar,\u00b5\u03b5", "deg,mmHg,LSB", "px,ppm,widgets"]
)
def test_units_need_not_all_be_known(units):
    text = "\n".join(["u_a,u_b,y_c", units, "1,2,3", "3,4,5", "5,9,1"])
    with pytest.warns(UserWarning, match="units are taken from line 2"):
        assert len(parse("t.csv", text.encode())) == 3


@pytest.mark.parametrize(
    ("stated", "wanted", "same"),
    [
        ("rad", "deg", False),
        ("mm", "m", False),
        ("ms", "s", False),
        ("mV", "MV", False),
        ("V", "", True),
        ("", "deg", True),
        ("-", "deg", True),
        ("[\u00b0]", "deg", True),
        ("degrees", "deg", True),
        ("rad", "radians", True),
        ("\u00b5m", "um", True),
        ("m/s\u00b2", "m/s^2", True),
    ],
)
def test_a_row_of_units_is_compared(stated, wanted, same):
    text = f"u_a,y_c\nmm,{stated}\n1,2\n3,4\n5,9\n"
    with pytest.warns(UserWarning, match="units are taken"):
        table = parse("t.csv", text.encode())
    table.require_units(["u_a"], ["mm"])
    if same:
        return table.require_units(["y_c", "u_a"], [wanted, ""])
    fault = f"column 'y_c' is in {stated}, by its row of units, and must be in {wanted}"
    with pytest.raises(ValueError, match=fault):
        table.require_units(["u_a", "y_c"], ["mm", wanted])


def test_words_below_the_header_are_no_units():
    with pytest.raises(ValueError, match="line 2, column 'u_a' must hold a number"):
        parse("t.csv", b"u_a,u_b\nfast,slow\n1,2\n3,4\n5,9\n").columns(["u_a"])


@pytest.mark.parametrize(
    "cells",
    ["12.5 mm|7.25 mm|3.0 mm", "7%|9%|12%", "1/8|3/8|1/2", "90\u00b0|45\u00b0|0\u00b0"],
)
def test_numbers_with_their_unit_are_no_labels(cells):
    rows = [f"{cell},{i}.5" for i, cell in enumerate(cells.split("|"))]
    table = parse("t.csv", "\n".join(["a,b", *rows]).encode())
    with pytest.raises(ValueError, match="column 'a' holds numbers and units"):
        table.commands(None)
    assert table.commands("b") == ("b",)


def test_names_of_a_number_and_a_letter_are_labels():
    table = parse("t.csv", b"plate,a\n1A,3\n2A,4\n3A,9\n")
    with pytest.warns(UserWarning, match="'plate' is read as label"):
        assert table.commands(None) == ("a",)


def test_exponents_of_fortran_are_read():
    table = parse("t.csv", b"a,b\n1.1D+01,1\n-2.5d-1,4\n")
    np.testing.assert_array_equal(table.values, [[11.0, 1.0], [-0.25, 4.0]])


def test_decimal_commas_between_commas_are_refused_without_a_header():
    cells = [f"{x:.2f}".replace(".", ",") for x in (0.04, -0.79, 12.5, 3.25)]
    with pytest.raises(ValueError, match="line 1 may hold 2 numbers with decimal comm"):
        parse("t.csv", f"{cells[0]},{cells[1]}\n{cells[2]},{cells[3]}\n".encode())


def test_rows_that_r_numbers_between_commas_are_read():
    """write.table(frame, sep = ",") gives the column of row names no name."""
    rows = [f'"{i + 1}",{text}' for i, text in enumerate(text_of().split("\n")[1:-1])]
    text = "\n".join(['"u_a","u_b","y_c"', *rows])
    with pytest.warns(UserWarning, match="ignored column 1"):
        table = parse("t.csv", text.encode())
    np.testing.assert_array_equal(table.values, VALUES)


def test_words_of_available_are_refused_with_what_is_read():
    table = parse("t.csv", b"a,available\n1,yes\n2,x\n")
    with pytest.raises(ValueError, match="line 3, available must be 1 or 0, TRUE or"):
        table.available()


def test_columns_without_a_header_are_said():
    table = parse("t.csv", b"1,2\n3,5\n8,1\n")
    with pytest.warns(UserWarning, match="no header: its columns are u_1, u_2"):
        table.commands(None)


def test_a_quote_within_a_cell_is_none():
    table = parse("t.csv", b'name,u_a,y\n5" pipe,1,2\n"multi\nline",2,3\n')
    np.testing.assert_array_equal(table.columns(["u_a"])[:, 0], [1.0, 2.0])
    with pytest.raises(ValueError, match=r"line 3: a quote .* is never closed"):
        parse("t.csv", b'u_a,y,note\n1,2,5" pipe\n3,4,"abc\n5,6,d\n7,8,e\n')
