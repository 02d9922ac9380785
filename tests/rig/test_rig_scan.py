"""What reads only: scan, ports; and how rig.toml is edited."""

import shutil

import pytest
from commission import device
from harness import fast_config, fast_text, simulator
from pymodbus.framer import FramerSocket

from rig.__main__ import main
from rig.config import ConfigError, parse_config
from rig.config.config import EXAMPLES
from rig.prove.scan import parse_bus, scan
from rig.prove.steps import edit, set_values
from rig_workbench.simulator import parse_fault
from rig_workbench.simulator.drive import DriveException


@pytest.mark.slow
def test_scan_tells_families_apart_and_writes_nothing(at, capsys):
    for family in ("leadshine_pr", "applied_motion", "oriental_az", "generic"):
        text = fast_text().replace("leadshine_pr", family)
        config = parse_config(text)
        with device(config=config) as (sim, bus, _):
            registers = [dict(drive._registers) for drive in sim.drives]
            assert main(["scan", "--bus", bus, "--units", "5"]) == 0
            said = capsys.readouterr().out
            for unit in (1, 2, 3):
                assert f"unit {unit}: {family}" in said
            assert "unit 4" not in said and "5 of 5 units asked" in said
            assert [d.executions for d in sim.drives] == [[], [], []]
            for drive, before in zip(sim.drives, registers, strict=True):
                place = drive.map.position
                held = drive.map.move.write[0].address
                assert drive._registers[held] == before[held], place


class Registers:
    """A drive by its bare registers, served by our server in place of a SimDrive."""

    def __init__(self, values, others=None):
        self.values, self.others = values, others

    def read(self, address, count):
        found = [self.values.get(address + i, self.others) for i in range(count)]
        if None in found:
            raise DriveException(2)
        return found


@pytest.mark.parametrize(
    ("others", "lacking"),
    [(None, ()), (0, ()), (None, (0x0191, 0x01BF))],
    ids=["refuses what it has not", "reads 0 there", "a model without two of them"],
)
def test_scan_knows_a_drive_that_is_not_the_simulators(at, others, lacking, capsys):
    has = {0x1003: 0x32, 0x602C: 0, 0x602D: 0, 0x2203: 0, 0x0001: 4000}
    has |= {0x0191: 20, 0x01BF: 2}
    drive = Registers({k: v for k, v in has.items() if k not in lacking}, others)
    with device() as (sim, bus, _):
        sim.server.drives[2] = drive
        assert main(["scan", "--bus", bus, "--units", "2"]) == 0
    said = capsys.readouterr().out
    assert "unit 2: leadshine_pr" in said and "pulses_per_rev = 4000" in said


def test_a_gateway_that_answers_for_absent_units_is_no_drive(at, capsys):
    class Absent(Registers):
        def read(self, address, count):
            raise DriveException(11)

    with device() as (sim, bus, _):
        sim.server.drives[2] = Absent({})
        assert main(["scan", "--bus", bus, "--units", "3"]) == 0
    said = capsys.readouterr().out
    assert "unit 1: lead" in said and "unit 2" not in said and "unit 3: lead" in said


def test_an_empty_bus_is_said_with_what_to_check(at, capsys):
    with device() as (sim, bus, _):
        sim.server.drives.clear()
        sim.server._axis.clear()
        assert main(["scan", "--bus", bus, "--units", "2"]) == 3
    assert "baud rate" in capsys.readouterr().out


@pytest.mark.parametrize("transport", ["tcp", "rtu_tcp"])
def test_units_that_answer_late_are_told_as_such_alone(transport):
    """It used to add that no unit answers, and called their replies no replies."""
    config = fast_config()
    with simulator(config, transport=transport) as sim:
        for axis in config.axis_names:
            late = f"delayed_reply,axis={axis},seconds=0.3"
            sim.faults.add(parse_fault(late))
        said = []
        scan(sim.start().bus, 3, said.append)
    assert any(line.startswith("units 1") for line in said), said
    assert not any("no unit answers" in line or "units 4" in line for line in said), (
        said
    )


def test_a_reply_that_comes_twice_makes_no_unit_late(monkeypatch):
    with simulator(fast_config()) as sim:
        encode, said = FramerSocket.encode, []
        monkeypatch.setattr(FramerSocket, "encode", lambda *a: 2 * encode(*a))
        scan(sim.start().bus, 4, said.append)
    assert not any("late" in line for line in said), said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tcp:10.0.0.7:1502", {"host": "10.0.0.7", "port": 1502}),
        ("tcp:drives.local", {"host": "drives.local", "port": 502}),
        ("rtu_tcp:10.0.0.7:4001", {"transport": "rtu_tcp", "port": 4001}),
        ("rtu:/dev/ttyUSB0", {"device": "/dev/ttyUSB0", "baudrate": 115200}),
        (
            "rtu:/dev/ttyUSB0,9600,E,8,2",
            {"baudrate": 9600, "parity": "E", "bytesize": 8, "stopbits": 2},
        ),
    ],
)
def test_a_bus_is_named_in_one_word(text, expected):
    bus = parse_bus(text)
    assert {name: getattr(bus, name) for name in expected} == expected


@pytest.mark.parametrize(
    "text",
    ["", "tcp", "usb:1", "tcp:host:door", "rtu:/dev/x,fast", "rtu:/dev/x,9600,8,E,1"],
)
def test_a_bus_that_cannot_be_is_refused(text):
    with pytest.raises(ConfigError):
        parse_bus(text)


def test_an_edit_keeps_comments_layout_and_a_copy(tmp_path):
    path = tmp_path / "rig.toml"
    shutil.copy(EXAMPLES / "leadshine_pr.toml", path)
    before = path.read_text()
    edit(path, {"axes.roll.direction": 1, "axes.pitch.unit": 2, "axes.yaw.unit": 1})
    changed = [
        (old, new)
        for old, new in zip(
            before.splitlines(), path.read_text().splitlines(), strict=True
        )
        if old != new
    ]
    assert [new.split("#")[0].split() for _, new in changed] == [
        ["unit", "=", "2"],
        ["unit", "=", "1"],
        ["direction", "=", "1"],
    ]
    for old, new in changed:
        assert old.partition("#")[2] == new.partition("#")[2]
    (copy,) = tmp_path.glob("rig.toml.*.bak")
    assert copy.read_text() == before


def test_an_edit_that_would_not_be_valid_leaves_the_file(tmp_path):
    path = tmp_path / "rig.toml"
    shutil.copy(EXAMPLES / "leadshine_pr.toml", path)
    before = path.read_text()
    with pytest.raises(ConfigError, match="unit must differ"):
        edit(path, {"axes.pitch.unit": 2})
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_absent_table_is_made_and_a_key_taken_out():
    text = set_values(
        "[bus]\nport = 1 # here\nhost = 'x'\n", {"imu.port": 5, "bus.host": None}
    )
    assert text == "[bus]\nport = 1 # here\n\n[imu]\nport = 5\n"
