"""From cables to a calibration, against a simulated device that is miswired."""

import dataclasses
import json
import os
import pathlib
import re
import types

import numpy as np
import pytest
from commission import QUICK, device, quick_text, set_up
from harness import ARM, fast_text, no_figures
from other_drives import stage_text

from rig.__main__ import main
from rig.config import load_config, parse_config
from rig.config.config import EXAMPLES
from rig.faults import Refused
from rig.journal.device import HOMED, IDENTIFIED, SIGN_CHECKED, ZEROED, DeviceRecord
from rig.prove import steps
from rig.prove.scan import Answer
from rig.prove.steps import Operator
from rig_workbench.commission import setup
from rig_workbench.simulator import Truth


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["tcp", "rtu"])
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
    assert "# omega: pulses per motor turn, as set in the drive" in text
    assert len(list(at.glob("rig.toml.*.bak"))) == 2  # the phone's address, the axes


@pytest.mark.slow
def test_a_gearing_that_is_off_on_all_axes_and_that_no_register_tells_is_refused(
    at, capsys
):
    text = (EXAMPLES / "generic.toml").read_text()
    config = load_config_text(text)
    truth = Truth(noise_deg=0.005, drive_pulses_per_rev=(1000,) * 3)
    turned = []
    with device(truth, config=config, speedup=4.0) as (sim, bus, port):
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
        assert set_up(bus, port, values=values) == 3
    assert "has no register for its pulses" in capsys.readouterr().out
    for axis, was in zip(load_config("rig.toml").axes, config.axes, strict=True):
        assert axis.reduction == was.reduction
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
        # A session begins with small moves that show what each axis turns.
        before, shown = np.split(np.abs(sim.executions()[0]), [moved])
        assert len(shown) <= 6 and shown.max() < before.max()


def test_setup_asks_with_defaults_and_moves_nothing_without_a_yes(at):
    asked: list[str] = []
    told: list[str] = []

    def read(question):
        asked.append(question)
        word = re.search(r"Type (\w+) to continue", question)
        return word[1] if word and word[1] != "axes" else ""

    with device() as (sim, bus, port):
        operator = Operator(say=told.append, read=read)
        values = dict(setup.setting(value) for value in QUICK)
        given = setup.SetupOptions(
            bus=bus, imu=f"hyperimu:{port}", units=4, values=values
        )
        config = setup.write_config(at / "rig.toml", given, operator)
        record = DeviceRecord.load(config.device_path)
        place = steps.Site(config, record, operator, at / "rig.toml")
        with pytest.raises(Refused, match="not confirmed"):
            setup.go(place, given)
        assert sim.executions() == [[], [], []]
    assert record.state(HOMED) and not record.state(SIGN_CHECKED)
    assert all(re.search(r"(\[.+\]|to continue): $", question) for question in asked)


OPTIONS = {"bus": "", "imu": "", "axes": "", "readings": ""}


@pytest.mark.parametrize(
    "options, kinds, told",
    [
        ({"axes": "table:Z"}, ["rotation"], "hyperimu"),
        ({"axes": "pan:Z,tilt:X", "imu": "lines:2055"}, ["rotation"] * 2, "lines"),
        (
            {"axes": "x:mm,y:mm,z:mm", "readings": "serial:/dev/ttyUSB1,9600"},
            ["translation"] * 3, "serial",
        ),
        (
            {"axes": "x:mm,turn:deg", "readings": "modbus:10.0.0.9"},
            ["translation", "rotation"], "modbus",
        ),
        ({"model": str(ARM)}, ["rotation"] * 5, "hyperimu"),
    ],
)  # fmt: skip
def test_setup_writes_files_of_other_devices(
    tmp_path, monkeypatch, options, kinds, told
):
    """Each passes its own check, and the drives' line is that of their map."""
    units = [Answer(unit, ("leadshine_pr",), {}, 10000) for unit in range(1, 7)]
    monkeypatch.setattr(setup, "scan", lambda *_: units)
    given = setup.asked(**OPTIONS | options)
    if not given.bus:
        given = dataclasses.replace(given, bus="tcp:10.0.0.7")
    operator = Operator(yes=True, say=lambda text: None)
    config = setup.write_config(tmp_path / "rig.toml", given, operator)
    assert [axis.kind for axis in config.axes] == kinds
    source = config.imu.format if config.imu else config.readings.transport
    assert source == told
    assert main(["check", str(tmp_path / "rig.toml")]) == 0


@pytest.mark.parametrize(
    "options, told",
    [
        ({"axes": "x"}, "--axes must be NAME:KIND"),
        ({"axes": "x:mm"}, "--axes x:mm: a phone measures rotations"),
        ({"axes": "x:mm,x:mm"}, "the axis x is named twice"),
        ({"readings": "pipe:1"}, "--readings must be tcp:HOST:PORT"),
        ({"readings": "udp:1", "imu": "lines"}, "a phone or a sensor"),
    ],
)
def test_wrong_options_of_setup_are_refused(options, told):
    with pytest.raises(Refused, match=told):
        setup.sensor_of(setup.asked(**OPTIONS | options).readings)


@pytest.mark.parametrize(
    "simulated", [pytest.param(False, marks=pytest.mark.slow), True]
)
def test_the_next_command_of_a_simulated_device_simulates_it(
    commissioned, at, simulated
):
    """The device that `setup --simulate` served is gone when it ends."""
    told: list[str] = []
    config = load_config("rig.toml")
    record = DeviceRecord.load(config.device_path)
    record.reach(ZEROED, config)
    operator = Operator(yes=True, say=told.append)
    place = steps.Site(config, record, operator, at / "rig.toml", full_speed=simulated)
    assert setup.go(place, setup.SetupOptions()) == 0
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


def test_a_simulated_setup_leaves_the_device_of_an_existing_file_alone(at, capsys):
    """It used the file: the real device moved, at the speed of a simulated one."""
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        given = ["setup", "--simulate", "--yes", "--config", "rig.toml"]
        assert main(given) == 2
        assert "--simulate writes a new file" in capsys.readouterr().err
        assert sim.server.requests == 0


@pytest.mark.slow
def test_a_simulated_check_of_the_axes_corrects_no_file(at, capsys):
    """It wrote what a reversed simulated axis is into the file of a real device."""
    (at / "rig.toml").write_text(fast_text())
    given = ["--simulate", "--yes", "--config", "rig.toml", "--reversed", "roll"]
    assert main(["axes", *given]) == 1
    assert "axes.roll.direction = -1 (now 1)" in capsys.readouterr().out
    assert (at / "rig.toml").read_text() == fast_text()


def test_limits_of_a_translation_are_asked_for_in_its_unit_and_written(tmp_path):
    path, said = tmp_path / "rig.toml", []
    path.write_text(stage_text('transport = "rtu"\ndevice = "x"', "leadshine_pr", 1))
    answers = iter(["-15", "", "", "20"])
    ask = Operator(read=lambda prompt: said.append(prompt) or next(answers))
    site = types.SimpleNamespace(
        path=path, config=load_config(path), operator=ask, take=lambda config: None
    )
    setup._ask_limits(site)
    x, y = load_config(path).axes
    assert (x.min_deg, y.max_deg) == (-15.0, 20.0)
    assert "lowest safe place, mm from home" in said[0]
