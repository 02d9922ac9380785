"""What a stop reads of a broken file or map: as much as there is, nothing invented."""

import re

import pytest

from rig import stop_config
from rig.config.maps import MAP_FOLDER

MAP_TEXT = (MAP_FOLDER / "leadshine_pr.toml").read_text()
STOP = "address = 0x6002, words = [0x0040]"


def map_of(old, new):
    """What is read of a map with a change, and its faults."""
    faults = []
    assert old in MAP_TEXT, old
    return stop_config.map_of(MAP_TEXT.replace(old, new), MAP_FOLDER, faults), faults


# Files

BUS = '[bus]\ntransport = "tcp"\nhost = "127.0.0.1"\nport = 5020\n'
IMU = 'format = "lines"\ntransport = "listen"\nhost = "0.0.0.0"\nport = 2055\n'
KEYS = 'map = "leadshine_pr"\npulses_per_rev = 10000\nmin_deg = -20\n'
AXES = [f'name = "{n}"\nunit = {u}\n{KEYS}' for u, n in enumerate(("p", "y", "r"), 1)]
TEXT = "".join((BUS, *(f"[[axes]]\n{axis}" for axis in AXES), f"[imu]\n{IMU}"))
BROKEN = TEXT + "[session]\nk = = 4\n"


@pytest.fixture
def read(tmp_path):
    def config(text):
        path = tmp_path / "rig.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return stop_config.read_file(path)

    return config


def header(number, new, text=TEXT):
    parts = text.split("[[axes]]\n")
    return (
        "[[axes]]\n".join(parts[: number + 1])
        + new
        + "[[axes]]\n".join(parts[number + 1 :])
    )


def is_whole(config):
    where = config.bus and config.bus.where
    units = sorted(axis.unit for axis in config.axes)
    return (units, config.lost, where) == ([1, 2, 3], [], "127.0.0.1:5020 (tcp)")


HEADERS = [
    "", "#[[axes]]\n", "[[axes]] the axis\n", "[[axis]]\n", "[axes]\n", "{{axes}}\n",
    "[[Axes]]\n", "[[axes2]]\n", "[axes.yaw]\n", "[[axes.]]\n", "axes]]\n", "[[axes\n",
    "[[\naxes]]\n", "[ [axes] ]\n", "[drive]\n", "[motion]\n",
]  # fmt: skip


@pytest.mark.parametrize("new", HEADERS)
@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("text", [TEXT, BROKEN], ids=["else valid", "broken"])
def test_an_axis_is_read_whatever_became_of_its_header(text, number, new, read):
    assert is_whole(read(header(number, new, text)))
    assert is_whole(read(text.replace("[[axes]]\n", new or "[[axes]]\n")))


@pytest.mark.parametrize(
    "table", ["[drive]\nmin_deg = -20\n", "[drive]\nmap = 3\n", "[axes.x]\na = 1\n"]
)
def test_what_looks_like_an_axis_and_is_none_is_lost(table, read):
    for text in (TEXT, BROKEN):
        config = read(text + table)
        assert len(config.axes) == 3 and len(config.lost) == 1


def test_what_is_no_axis_is_none(read):
    text = TEXT + '[readings]\nunit = "mm"\n[[readings.registers]]\nunit = 4\n'
    assert is_whole(read(text + '[imu2]\nunit = "deg"\n'))


@pytest.mark.parametrize(
    "value", ["9" * 5000, "[" * 3000 + "]" * 3000, "{a=" * 3000 + "1" + "}" * 3000]
)
def test_one_value_does_not_cost_the_file(value, read):
    assert is_whole(read(TEXT.replace("min_deg = -20", f"min_deg = {value}", 1)))
    assert stop_config.map_of(f"{MAP_TEXT}\n[x]\ny = {value}\n", MAP_FOLDER, [])


LINES = re.sub(r"^(\w+) =", r"bus.\1 =", BUS.removeprefix("[bus]\n"), flags=re.M)
BUSES = [
    BUS.replace("[bus]\n", new)
    for new in ("bus]\n", "(bus)\n", "[bus] the line\n", "[bus] ", "[modbus]\n",
                "[busses]\n", "", "#[bus]\n", "[[bus]]\n[[bus]]\n", "[line]\n")
] + [
    LINES,
    f"{BUS}{IMU}",
    f"{BUS}[imu] phone\n{IMU}",
    BUS + "port = 1\n",
    BUS.replace("port =", "port = 70000\nport ="),
    BUS.replace("port =", "port = x\nport ="),
    BUS.replace(" = ", " "),
    BUS + 'host = ""\n',
    BUS.replace("0.1", "0.1:502"),
    BUS.replace("127", "tcp://127"),
    BUS.replace("0.1", "0.1/"),
    BUS.replace("0.1", "0.1:5020").replace("port = 5020\n", ""),
]  # fmt: skip


@pytest.mark.parametrize("bus", BUSES)
@pytest.mark.parametrize("text", [TEXT, BROKEN], ids=["else valid", "broken"])
def test_the_bus_is_read(text, bus, read):
    assert is_whole(read(text.replace(BUS, bus)))


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32"])
def test_an_encoding_without_its_mark_is_read(encoding, read):
    assert is_whole(read(TEXT.encode(encoding)))


@pytest.mark.parametrize("quotes", ["\u201c\u201d", "\u201e\u201c", "\u00ab\u00bb"])
def test_typographic_quotes_are_quotes(quotes, read):
    text = re.sub('"([^"]*)"', rf"{quotes[0]}\1{quotes[1]}", TEXT)
    assert is_whole(read(text))


ROWS = [f'{{ name = "a{u}", unit = {u}, map = "leadshine_pr" }}' for u in (1, 2, 3)]


@pytest.mark.parametrize(
    "old, new", [(" }", ", }"), (" }", " speed = 3 }"), (", map", " map"), ("]", "")]
)
def test_axes_of_one_list_are_read(old, new, read):
    text = "axes = [\n " + ",\n ".join(ROWS) + "\n]\n"
    for count in (1, 3):
        assert is_whole(read(text.replace(old, new, count) + BUS))


UNITS = [
    "unit = 2,", "unit = 2;", "unit = 2 2", 'unit = "0x02"', "unit = [2]", "id = 2",
    "unit = 2\nunit = 0", 'unit = 2\nunit = "deg"', "unit := 2", "unit == 2",
    "unit 2", "unit 2  # of three", "unit 2,",
    'unit = 2, reduction = 5', 'unit = 2\nmap = "leadshine_pr"\nmap = ""',
]  # fmt: skip


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_is_read(unit, read):
    assert is_whole(read(TEXT.replace("unit = 2", unit)))


@pytest.mark.parametrize("unit", ["unit = 1 2", "unit = [2, 3]", "unit = two"])
def test_a_unit_is_not_guessed(unit, read):
    config = read(TEXT.replace("unit = 2", unit))
    assert [axis.unit for axis in config.axes] == [1, 3]
    assert config.lost == [("y", 0)]


def test_two_units_of_one_axis_are_both_stopped(read):
    config = read(TEXT.replace("unit = 2", "unit = 9\nunit = 2"))
    assert {axis.unit for axis in config.axes} == {1, 2, 3, 9}


@pytest.mark.parametrize("new", ["", 'map = ""\n', "map = 5\n"])
def test_an_axis_without_a_map_has_that_of_all_others(new, read):
    text = TEXT.replace('map = "leadshine_pr"\n', new, 1)
    config = read(text)
    assert is_whole(config) and "trying that of the others" in config.faults[0]
    config = read(text.replace("leadshine_pr", "oriental_az", 1))
    assert config.lost == [("p", 1)]


# Maps


def test_a_comma_too_many_in_a_stop_frame():
    drive_map, _ = map_of("[0x0040] }", "[0x0040], }")
    assert [frame.address for frame in drive_map.stop.write] == [0x6002]


@pytest.mark.parametrize(
    "stop",
    [
        'address = "0x6002", words = [0x0040]',
        'address = 0x6002, words = ["0x0040"]',
        "address = 0x6002, words = 0x0040",
        'address = [0x6002], words = "64"',
    ],
)
def test_a_stop_frame_is_read_or_refused(stop):
    drive_map, faults = map_of(STOP, stop)
    assert not faults
    frames = [(f.address, [w.value for w in f.words]) for f in drive_map.stop.write]
    assert frames == [(0x6002, [0x40])]


@pytest.mark.parametrize("address", ['"x6002"', '""', '"6 2"', "-1", "65536", "1.5"])
def test_no_other_register_is_written_for_an_address_that_is_none(address):
    drive_map, faults = map_of(STOP, f"address = {address}, words = [0x0040]")
    assert drive_map is None
    assert faults == ["the map leadshine_pr has no readable [stop]"]


@pytest.mark.parametrize("drive", ["Modbus", "modbuss", ""])
def test_a_kind_that_names_no_class_is_modbus(drive):
    drive_map, _ = map_of("schema = 1", f'drive = "{drive}"')
    assert drive_map.drive == "modbus"


@pytest.mark.parametrize("address", ["-1", "0x11003", '"x"'])
def test_a_status_that_cannot_be_read_is_told_in_words(address):
    drive_map, faults = map_of("address = 0x1003", f"address = {address}")
    assert drive_map.stop and drive_map.status is None
    text = "[status] or [position] of the map leadshine_pr cannot be read"
    assert faults == [text]
