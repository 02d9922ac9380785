"""The steps of commissioning, over the real protocol."""

import os
import pathlib
import re
import signal

import numpy as np
import pytest
from commission import device, quick_text
from harness import changed, fast_config, simulator

from rig.__main__ import main
from rig.config import load_config
from rig.core.record_check import check_drives
from rig.faults import Refused
from rig.journal.device import HOMED, SIGN_CHECKED, ZEROED, DeviceRecord
from rig.prove import home, steps
from rig.prove.steps import Operator, edit
from rig_workbench.simulator import Truth
from rig_workbench.simulator.drive import SimDrive


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


def test_jog_moves_one_axis_by_a_step_and_no_more_than_ten_degrees(commissioned):
    before = [drive.position for drive in commissioned.drives]
    assert main(["jog", "yaw", "-2", "--yes"]) == 0
    way = [d.position - b for d, b in zip(commissioned.drives, before, strict=True)]
    config = load_config("rig.toml")
    assert way == [0, config.axes[1].to_pulses(-2.0), 0]
    for refused in (["10.5"], []):
        with pytest.raises(SystemExit) as ended:
            main(["jog", "yaw", *refused, "--yes"])
        assert ended.value.code == 2


def test_a_step_is_cut_at_the_limit(commissioned):
    pitch = commissioned.drives[0]
    limit = round(load_config("rig.toml").axes[0].to_deg(pitch.position)) + 1.0
    config = edit(pathlib.Path("rig.toml"), {"axes.pitch.max_deg": limit})
    assert main(["jog", "pitch", "3", "--yes"]) == 0
    assert pitch.position == config.axes[0].to_pulses(limit)


def test_a_step_before_homing_goes_from_where_the_drive_counts(at):
    """A count beyond a limit means no place yet: the step went back to the limit."""
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        roll = sim.drives[2]
        roll.power_cycle(90.0)
        before = roll.position
        assert main(["jog", "roll", "1", "--yes"]) == 0
        way = load_config("rig.toml").axes[2].to_pulses(1.0)
        assert before < roll.position <= before + abs(way)


def test_sigterm_in_the_axis_check_stops_the_drives(commissioned, at, monkeypatch):
    emit = steps.Run.emit

    def struck(run, event, **fields):
        if event == "stand" and fields["name"] == "pitch:plus":
            os.kill(os.getpid(), signal.SIGTERM)
        return emit(run, event, **fields)

    monkeypatch.setattr(steps.Run, "emit", struck)
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

        def read(question):
            word = re.search(r"Type (\w+) to continue", question)[1]
            return "no" if word == "correct" else word

        config = load_config("rig.toml")
        record = DeviceRecord.load(config.device_path)
        operator = Operator(say=told.append, read=read)
        with pytest.raises(Refused):
            steps.axes(steps.Site(config, record, operator, at / "rig.toml"))
    assert (at / "rig.toml").read_text() == before
    assert record.state(SIGN_CHECKED) is None
    assert any("axes.roll.direction = -1" in line for line in told)


def test_imu_pins_the_sender_and_tells_what_to_type(commissioned, capsys):
    config = edit(pathlib.Path("rig.toml"), {"imu.allow": None})
    assert main(["imu", "--seconds", "1", "--yes"]) == 0
    said = capsys.readouterr().out
    assert f"port {config.imu.port}" in said and "readings per s" in said
    assert load_config("rig.toml").imu.allow == ("127.0.0.1",)


@pytest.mark.parametrize(
    ("name", "obeys"),
    [
        ("generic", True),
        ("applied_motion", True),
        pytest.param("generic", False, marks=pytest.mark.slow),
        pytest.param("applied_motion", False, marks=pytest.mark.slow),
    ],
)
def test_a_count_of_0_after_a_power_cycle_is_not_home(at, name, obeys, monkeypatch):
    """D: homed at 0, switched off and pushed, such a drive said that it is at home."""
    if not obeys:  # a drive that can be set to 0 only
        value = SimDrive._value
        monkeypatch.setattr(
            SimDrive,
            "_value",
            lambda self, table, key: 0 if key == "home" else value(self, table, key),
        )
    told: list[str] = []
    served = fast_config({'map = "leadshine_pr"': f'map = "{name}"'})
    with simulator(served) as sim:
        served = changed(sim.start(), output=str(at))
        record = DeviceRecord(at / "device.json")
        operator = Operator(yes=True, say=told.append)
        place = steps.Site(served, record, operator, full_speed=True,
                            listeners=(sim.hear,))  # fmt: skip
        steps.show_identity(place)
        assert steps.go_home(place, here=True) == 0
        counts = [round(drive.position) for drive in sim.drives]
        assert counts == ([2**30] * 3 if obeys else [0] * 3)
        assert record.state(HOMED)["pulses"] == [0, 0, 0]
        assert steps.jog(place, "pitch", 1.0) == 0
        assert steps.jog(place, "pitch", -1.0) == 0
        np.testing.assert_allclose(sim.plant.joints(), 0.0, atol=0.1)
        assert [round(drive.position) for drive in sim.drives] == counts
        for drive in sim.drives:
            drive.power_cycle(-drive.position / drive.pulses_per_deg)
            assert drive.position == 0.0
        with place.bus("look") as drives:
            if obeys:
                with pytest.raises(Refused, match="was without power"):
                    check_drives(served, drives, record)
            else:
                check_drives(served, drives, record)
    assert (record.state(HOMED) is None) is obeys
    assert any("is not detected" in line for line in told) is not obeys
