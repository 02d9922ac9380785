"""Commissioning over the real protocol, against a simulated device that is miswired."""

import contextlib
import json
import os
import pathlib
import pty
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from harness import SPEEDUP, fast_config, fast_text, no_figures

from rig import commissioning
from rig.__main__ import main
from rig.commission import bench, home, setup, steps
from rig.commission.jog import FIRST_S, REPEAT_S, Held, Released
from rig.commission.operator import Operator
from rig.commission.scan import parse_bus
from rig.commission.toml import edit, set_values
from rig.config import AXIS_NAMES, ConfigError, load_config, parse_config
from rig.config.files import EXAMPLES
from rig.device.record import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    ZEROED,
    DeviceRecord,
)
from rig.faults import Refused
from rig.simulator import Simulator, Truth
from rig.simulator.drive import DriveException

RIG = pathlib.Path(__file__).parents[2]
QUICK = (  # of the new rig.toml: short windows, quick axes
    "settle.window_s=0.04", "settle.min_samples=5", "settle.samples=5",
    "settle.slope_deg_s=0.5", "motion.poll_s=0.005", "imu.stale_s=1.0",
    "session.method=exact", "session.verify_postures=1",
    *(f"axes.{name}.{key}" for name in AXIS_NAMES
      for key in ("speed_deg_s=400", "accel_deg_s2=8000", "reduction=10")),
)  # fmt: skip


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def at(tmp_path, monkeypatch):
    """An empty folder to work in, and axes that need not be watched by a person."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(steps, "WATCH_S", 0.3)
    monkeypatch.setattr(bench, "SLOW_DEG_S", 400.0)
    return tmp_path


@contextlib.contextmanager
def device(truth=None, transport="tcp", config=None, **options):
    """A simulated device, the bus as the command line names it, and a phone's port."""
    config = config or fast_config()
    options.setdefault("speedup", SPEEDUP)
    with Simulator(
        config, truth or Truth(noise_deg=0.005), transport=transport, rate_hz=250.0,
        **options,
    ) as sim:  # fmt: skip
        bus = sim.start().bus
        port = free_port()
        sim.start_phone(port)
        where = f"{transport}:{bus.host}:{bus.port}"
        if transport == "rtu":
            where = f"rtu:{bus.device},115200,N,8,1"
        yield sim, where, port


def set_up(bus: str, port: int, *more: str, values=QUICK) -> int:
    given = [word for value in values for word in ("--set", value)]
    common = ["--yes", "--bus", bus, "--imu", f"hyperimu:{port}", "--units", "4"]
    return main(["setup", *common, *given, *more])


# From cables to a calibration


@pytest.mark.parametrize(
    "transport", ["tcp", pytest.param("rtu", marks=pytest.mark.slow)]
)
def test_setup_finds_exchanged_reversed_and_wrongly_geared_axes(at, transport, capsys):
    truth = Truth(
        noise_deg=0.005, swapped=(1, 0, 2), reversed=(True, False, True),
        drive_pulses_per_rev=(4000, 10000, 20000),
    )  # fmt: skip
    with device(truth, transport) as (_, bus, port):
        assert set_up(bus, port) == 0
        config = load_config("rig.toml")
        # Joint i is turned by drive swapped[i], whose unit is that index plus one.
        assert [axis.unit for axis in config.axes] == [2, 1, 3]
        assert [axis.pulses_per_rev for axis in config.axes] == [10000, 4000, 20000]
        assert [axis.reduction for axis in config.axes] == [10, 10, 10]
        # Yaw's drive has direction -1 in the simulator; those of 1 and 3 are reversed.
        assert [axis.direction for axis in config.axes] == [-1, -1, -1]
        record = DeviceRecord.load(config.device_path)
        for state in (IDENTIFIED, HOMED, SIGN_CHECKED, ZEROED):
            assert record.state(state) is not None, state
        assert config.imu.allow == ("127.0.0.1",)
        assert record.missing(config) is None
        if transport == "rtu":  # the slow one goes on to the calibration
            with no_figures():
                go_on = ["calibrate", "--config", "rig.toml", "--arm", "--zero"]
                assert main(go_on) == 0
            (path,) = at.glob("runs/calibrate-*/summary.json")
            found = json.loads(path.read_text())["A"]
            np.testing.assert_allclose(found, truth.matrix, atol=0.005)
    said = capsys.readouterr().out
    assert "next: jaxcal-rig calibrate --config rig.toml" in said
    # the corrected file is the written one with other values: comments stay
    text = pathlib.Path("rig.toml").read_text()
    assert "# omega: pulses for one motor turn, as set in the drive" in text
    assert len(list(at.glob("rig.toml.*.bak"))) == 2  # the phone's address, the axes


@pytest.mark.slow
def test_gearing_that_no_register_tells_is_taken_from_the_phone(at):
    text = (EXAMPLES / "generic.toml").read_text()
    config = load_config_text(text)
    truth = Truth(noise_deg=0.005, drive_pulses_per_rev=(1000,) * 3)
    turned = []
    with device(truth, config=config, speedup=20.0) as (sim, bus, port):
        start = sim.plant.attitude()
        measure = sim.plant.attitude

        def watched():
            matrix = measure()
            angle = np.arccos(np.clip((np.trace(start.T @ matrix) - 1) / 2, -1, 1))
            turned.append(np.degrees(angle))
            return matrix

        sim.plant.attitude = watched
        values = [value for value in QUICK if "reduction" not in value]
        values += [f"axes.{a.name}.reduction={a.reduction}" for a in config.axes]
        assert set_up(bus, port, values=values) == 0
    written = load_config("rig.toml")
    for axis, was, gain in zip(
        written.axes, config.axes, (0.43, 0.71, 0.87), strict=True
    ):
        # ten times as far as commanded: now about as commanded
        factor = was.pulses_per_rev / 1000 * gain
        assert axis.reduction == pytest.approx(was.reduction / factor, rel=0.03)
    assert max(turned) < 9.0  # and on the way to it nothing went far


def load_config_text(text):
    return parse_config(re.sub(r"(?m)^(speed_deg_s =) .*", r"\1 100", text))


@pytest.mark.slow
def test_setup_goes_on_where_it_was_left(at, capsys):
    with device() as (sim, bus, port):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                steps, "take_zero", lambda place: (_ for _ in ()).throw(OSError("gone"))
            )
            assert set_up(bus, port) == 2
        capsys.readouterr()
        moved = len(sim.executions()[0])
        assert main(["setup", "--yes"]) == 0
        said = capsys.readouterr().out
        assert "9 zero" in said and "8 axes" not in said and "6 jog" not in said
        assert len(sim.executions()[0]) == moved


def test_setup_asks_with_defaults_and_moves_nothing_without_a_yes(at):
    asked: list[str] = []
    told: list[str] = []

    def read(question):
        asked.append(question)
        return "no" if told[-1].startswith("axes: ") else ""

    with device() as (sim, bus, port):
        operator = Operator(say=told.append, read=read)
        values = dict(commissioning.setting(value) for value in QUICK)
        given = setup.Given(bus=bus, imu=f"hyperimu:{port}", units=4, values=values)
        config = setup.write_config(at / "rig.toml", given, operator)
        record = DeviceRecord.load(config.device_path)
        place = steps.Place(config, record, operator, at / "rig.toml")
        with pytest.raises(Refused, match="not confirmed"):
            setup.go(place, given)
        assert sim.executions() == [[], [], []]
    assert record.state(HOMED) and not record.state(SIGN_CHECKED)
    assert all(re.search(r"\[.+\]: $", question) for question in asked)


@pytest.mark.parametrize("simulated", [False, True])
def test_the_next_command_of_a_simulated_device_simulates_it(
    commissioned, at, simulated
):
    """The device that `setup --simulate` served is gone when it ends."""
    told: list[str] = []
    config = load_config("rig.toml")
    record = DeviceRecord.load(config.device_path)
    record.reach(ZEROED, config)
    operator = Operator(yes=True, say=told.append)
    place = steps.Place(config, record, operator, at / "rig.toml", full_speed=simulated)
    assert setup.go(place, setup.Given()) == 0
    again = " --simulate" if simulated else ""
    assert told[-1] == f"next: jaxcal-rig calibrate{again} --config rig.toml"


@pytest.mark.slow
def test_setup_of_a_simulated_device_in_one_command(at):
    wrong = ["--reversed", "yaw", "--noise", "0.005"]
    quick = [word for value in QUICK for word in ("--set", value)]
    common = ["--simulate", "--yes", "--units", "3"]
    assert main(["setup", *common, *wrong, *quick]) == 0
    (path,) = at.glob("runs/simulated-*/rig.toml")
    yaw = load_config(path).axes[1]
    with no_figures():
        assert main(["calibrate", "--simulate", "--config", str(path)]) == 0
    assert yaw.direction == 1  # the simulator's own has -1
    assert DeviceRecord.load(path.with_name("device.json")).state(ZEROED)


def test_without_a_terminal_nothing_is_confirmed(at, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", open(os.devnull))
    with device() as (_, bus, port):
        assert main(["setup", "--bus", bus, "--imu", f"hyperimu:{port}"]) == 2
    assert "--yes" in capsys.readouterr().err
    assert not pathlib.Path("rig.toml").exists()


# Each step


@pytest.fixture
def commissioned(at):
    """A device of which all is known that a session needs."""
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        config = load_config("rig.toml")
        record = DeviceRecord.load(config.device_path)
        for state in (IDENTIFIED, HOMED, SIGN_CHECKED):
            record.reach(state, config)
        yield sim


@pytest.mark.slow
def test_steps_want_the_states_before_them(at, capsys):
    with device() as (_, bus, port):
        place = ["--config", "rig.toml", "--yes"]
        (at / "rig.toml").write_text(quick_text(bus, port))
        for command in (["home", "--here"], ["axes"], ["zero"], ["jog", "pitch", "1"]):
            assert main([*command, *place]) == 2
            assert "not IDENTIFIED" in capsys.readouterr().err
        assert main(["scan", "--config", "rig.toml", "--units", "3"]) == 0
        assert main(["axes", *place]) == 2
        assert main(["home", "--here", *place]) == 0
        assert main(["zero", *place]) == 2
        assert main(["axes", *place]) == 0
        assert main(["zero", *place]) == 0
    record = DeviceRecord.load(at / "device.json")
    assert record.state(ZEROED)["pulses"] == [0, 0, 0]


def quick_text(bus, port):
    from rig.commission.toml import new_text

    axes = [
        {"name": name, "letter": letter, "unit": unit, "family": "leadshine_pr",
         "pulses": 10000}
        for unit, (name, letter) in enumerate(zip(AXIS_NAMES, "XZY", strict=True), 1)
    ]  # fmt: skip
    text = new_text(parse_bus(bus), axes, "hyperimu", port)
    values = dict(commissioning.setting(value) for value in QUICK)
    return set_values(text, values | {"axes.yaw.direction": -1})


def test_home_by_the_drives_ends_a_lost_origin(at):
    truth = Truth(noise_deg=0.005, lost_origin_deg=(1.4, 1.4, 1.4))
    with device(truth) as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--yes"]) == 0
        assert [drive.offset for drive in sim.drives] == [0, 0, 0]
        assert [drive.homed for drive in sim.drives] == [True] * 3


def test_a_drive_that_never_gets_home_is_stopped_and_said(at, monkeypatch, capsys):
    monkeypatch.setattr(home, "HOME_S", 1.0)
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        for drive in sim.drives:
            drive._home = lambda: None  # its switch is not wired
        assert main(["home", "--yes"]) == 3
        assert all(drive.stops for drive in sim.drives)
    assert "pitch is not home" in capsys.readouterr().out
    assert DeviceRecord.load(at / "device.json").state(HOMED) is None


def test_jog_moves_one_axis_by_a_step_and_no_more_than_three_degrees(commissioned):
    before = [drive.position for drive in commissioned.drives]
    assert main(["jog", "yaw", "-2", "--yes"]) == 0
    way = [d.position - b for d, b in zip(commissioned.drives, before, strict=True)]
    config = load_config("rig.toml")
    assert way == [0, config.axes[1].to_pulses(-2.0), 0]
    with pytest.raises(SystemExit) as refused:
        main(["jog", "yaw", "3.5", "--yes"])
    assert refused.value.code == 2
    assert main(["jog", "yaw", "--yes"]) == 2  # holding a key needs a terminal


def test_a_step_is_cut_at_the_limit(commissioned):
    pitch = commissioned.drives[0]
    limit = round(load_config("rig.toml").axes[0].to_deg(pitch.position)) + 1.0
    config = edit(pathlib.Path("rig.toml"), {"axes.pitch.max_deg": limit})
    assert main(["jog", "pitch", "3", "--yes"]) == 0
    assert pitch.position == config.axes[0].to_pulses(limit)


class Keys:
    def __init__(self):
        self.pressed: list[str] = []

    def keys(self, wait_s=0.0):
        found, self.pressed = self.pressed, []
        return found


def test_a_key_is_held_until_it_stops_repeating():
    now, keys = [0.0], Keys()
    held = Held(keys, "+", lambda: now[0])  # type: ignore[arg-type]
    now[0] = FIRST_S - 0.01  # a keyboard takes its time before it repeats
    held.check()
    for _ in range(5):
        now[0] += 0.9 * REPEAT_S
        keys.pressed = ["+"]
        held.check()
    now[0] += REPEAT_S + 0.01
    with pytest.raises(Released):
        held.check()


def test_any_other_key_stops_at_once():
    keys = Keys()
    held = Held(keys, "+")  # type: ignore[arg-type]
    keys.pressed = ["+", " "]
    with pytest.raises(Released):
        held.check()


def test_a_held_key_moves_and_letting_go_stops(at):
    """Through a terminal, as a person does it."""
    terminal, inside = pty.openpty()
    slow = ["--simulate", "--speedup", "0.02"]
    with open(at / "said", "wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "rig", "jog", "pitch", *slow],
            stdin=inside, stdout=said, stderr=said,
            env={**os.environ, "PYTHONPATH": str(RIG)},
        )  # fmt: skip
    os.close(inside)

    def wait_for(text):
        end = time.monotonic() + 60.0
        while text not in (at / "said").read_text():
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.02)

    try:
        os.write(terminal, b"yes\n")
        wait_for("hold + or an arrow")
        for _ in range(10):
            os.write(terminal, b"+")
            time.sleep(0.1)
        wait_for("stands at")
        os.write(terminal, b"q")
        assert process.wait(20) == 0
    finally:
        process.kill()
        os.close(terminal)
    text = (at / "said").read_text()
    assert "stop: key released" in text
    angle = float(re.search(r"pitch stands at (-?[0-9.]+) deg", text)[1])
    # It moved, and it did not go on to the end of what a held key may do.
    assert 0.1 < angle - Truth().jig_deg[0] < 15.0


def test_sigterm_in_the_axis_check_stops_the_drives(commissioned, at, monkeypatch):
    emit = bench.Bench.emit

    def struck(run, event, **fields):
        if event == "stand" and fields["name"] == "pitch:plus":
            os.kill(os.getpid(), signal.SIGTERM)
        return emit(run, event, **fields)

    monkeypatch.setattr(bench.Bench, "emit", struck)
    stops = [len(drive.stops) for drive in commissioned.drives]
    assert main(["axes", "--yes"]) == 128 + signal.SIGTERM
    after = [len(drive.stops) for drive in commissioned.drives]
    assert all(now > then for now, then in zip(after, stops, strict=True))
    assert not any(drive.moving for drive in commissioned.drives)
    journal = next(iter(sorted(at.glob("runs/axes-*"))[-1:])) / "journal.jsonl"
    assert '"event":"stopped"' in journal.read_text()


def test_a_step_is_not_resumed(commissioned, at, capsys):
    assert main(["zero", "--yes"]) == 0
    folder = next(iter(at.glob("runs/zero-*")))
    assert main(["resume", str(folder), "--arm"]) == 2
    assert "run it again" in capsys.readouterr().err


@pytest.mark.slow
def test_a_declined_correction_leaves_the_file_and_the_state(at):
    with device(Truth(noise_deg=0.005, reversed=(False, False, True))) as d:
        _, bus, port = d
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        before = (at / "rig.toml").read_text()
        told: list[str] = []
        answer = {"axes: write": "no"}

        def read(question):
            return answer.get(told[-1][:11], "yes")

        config = load_config("rig.toml")
        record = DeviceRecord.load(config.device_path)
        operator = Operator(say=told.append, read=read)
        with pytest.raises(Refused):
            steps.axes(steps.Place(config, record, operator, at / "rig.toml"))
    assert (at / "rig.toml").read_text() == before
    assert record.state(SIGN_CHECKED) is None
    assert any("axes.roll.direction = -1" in line for line in told)


def test_imu_pins_the_sender_and_tells_what_to_type(commissioned, capsys):
    config = edit(pathlib.Path("rig.toml"), {"imu.allow": None})
    assert main(["imu", "--seconds", "1", "--yes"]) == 0
    said = capsys.readouterr().out
    assert f"port {config.imu.port}" in said and "readings per s" in said
    assert load_config("rig.toml").imu.allow == ("127.0.0.1",)


# Reads only


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


def test_ports_tells_what_answers(capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert main(["ports", "--tcp", f"127.0.0.1:{port}"]) == 0
    assert f"127.0.0.1:{port}: accepts connections" in capsys.readouterr().out
    assert main(["ports", "--tcp", f"127.0.0.1:{free_port()}"]) == 3
    assert main(["ports", "--tcp", "127.0.0.1:door"]) == 2


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
        ("rtu:/dev/ttyUSB0,9600,8,E,1", {"parity": "E", "bytesize": 8, "stopbits": 1}),
    ],
)
def test_a_bus_is_named_in_one_word(text, expected):
    bus = parse_bus(text)
    assert {name: getattr(bus, name) for name in expected} == expected


@pytest.mark.parametrize(
    "text",
    ["", "tcp", "usb:1", "tcp:host:door", "rtu:/dev/x,fast", "rtu:/dev/x,9600,N,E"],
)
def test_a_bus_that_cannot_be_is_refused(text):
    with pytest.raises(ConfigError):
        parse_bus(text)


# rig.toml


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
