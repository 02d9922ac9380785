"""A stop over a gateway of one connection whose replies come late, or not at all."""

import time

import pytest
from harness import changed, fast_config, fast_text, simulator
from test_rig_wire import behind_a_gateway, folder  # noqa: F401  # its locks

from rig import stopping
from rig.__main__ import main
from rig.config import load_config
from rig.core import stop as core_stop
from rig.core.stop import stop_all
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig.journal.lock import BusLock
from rig_workbench.simulator import parse_fault


def set_moving(sim, config):
    with sim.server.lock:
        for drive, axis in zip(sim.drives, config.axes, strict=True):
            drive._move(axis.to_pulses(18.0), 2000.0, 20000.0)


@pytest.mark.parametrize("refuses", ["accepts and closes", "is closed"])
@pytest.mark.parametrize("fault", ["delayed_reply,seconds=0.1", "dead_drive"])
def test_every_unit_gets_its_stop_over_the_only_connection(refuses, fault):
    """The second was refused, and the first, which works, was no longer used."""
    with behind_a_gateway() as (sim, gateway, settings, config):
        set_moving(sim, config)
        axes = ["pitch"] if fault == "dead_drive" else ["pitch", "yaw", "roll"]
        for axis in axes:
            sim.faults.add(parse_fault(f"{fault},axis={axis}"))
        with Bus(changed(settings, timeout_s=0.3)) as bus:
            drives = [ModbusDrive(bus, axis) for axis in config.axes]
            while not gateway.given:
                time.sleep(0.001)
            if refuses == "is closed":
                gateway.close()
            first, *others = stop_all(drives)
        assert all(unit.acknowledged for unit in others), others
        assert all(unit.standing for unit in others) or fault != "dead_drive", others
        assert first.acknowledged == (fault != "dead_drive"), first
        assert gateway.given == 1 and all(drive.stops for drive in sim.drives[1:])
        assert gateway.refused <= 2


def test_stop_waits_for_a_gateway_though_nothing_was_armed(
    tmp_path, monkeypatch, capsys
):
    """It gave up after 5 s, and did not say that nothing was stopped."""
    monkeypatch.setattr(stopping, "REOPEN_S", 1.5)
    with behind_a_gateway() as (sim, gateway, _, config):
        path = tmp_path / "rig.toml"
        path.write_text(fast_text({"port = 5020": f"port = {gateway.port}"}))
        set_moving(sim, config)
        gateway._free = time.monotonic() + 60.0
        assert main(["stop", "--config", str(path)]) == 3
        shown = capsys.readouterr()
        assert "NOTHING WAS STOPPED BY THIS COMMAND: unit 1: no valid" in shown.err
        gateway._free = time.monotonic() + 1.0
        assert main(["stop", "--config", str(path)]) == 0
        assert all(drive.stops for drive in sim.drives)


def test_a_unit_that_no_frame_was_sent_to_is_named():
    with behind_a_gateway() as (_, gateway, settings, config):
        gateway._free = time.monotonic() + 60.0
        with Bus(settings) as bus:
            results = stop_all([ModbusDrive(bus, axis) for axis in config.axes])
    assert all("NO STOP COULD BE SENT, NOT seen standing" in str(r) for r in results)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_was_armed_from_its_folder_is_stopped_though_the_file_names_another_bus(
    elsewhere, tmp_path, monkeypatch, capsys
):
    """Its session was reported as another device, and was not stopped."""
    monkeypatch.setattr(stopping, "REOPEN_S", 0.2)
    with simulator(fast_config(), speedup=0.02) as sim:
        text = fast_text({"port = 5020": f"port = {sim.start().bus.port}"})
        path = tmp_path / "rig.toml"
        path.write_text(text)
        config = load_config(path)
        BusLock(config.bus).leave(config)
        set_moving(sim, config)
        (tmp_path / "elsewhere").mkdir()
        path = tmp_path / "elsewhere" / "rig.toml" if elsewhere else path
        path.write_text(text.replace(f"port = {config.bus.port}", "port = 9"))
        assert main(["stop", "--config", str(path)]) == 3
        assert [bool(drive.stops) for drive in sim.drives] == [not elsewhere] * 3
    said = capsys.readouterr().out
    assert ("NOT stopped, another device" in said) == elsewhere
    assert ("armed from this folder: stopping it as well" in said) != elsewhere


def test_drives_behind_a_slow_gateway_are_seen_standing(monkeypatch):
    """Three units at .2 s a reply had no time to be looked at twice."""
    monkeypatch.setattr(core_stop, "VERIFY_S", 1.5)
    with behind_a_gateway() as (sim, _, settings, config):
        set_moving(sim, config)
        for axis in config.axes:
            slow = f"delayed_reply,seconds=0.2,axis={axis.name}"
            sim.faults.add(parse_fault(slow))
        with Bus(changed(settings, timeout_s=1.0)) as bus:
            results = stop_all([ModbusDrive(bus, axis) for axis in config.axes])
        assert all(unit.acknowledged and unit.standing for unit in results), results
        assert not any(unit.detail for unit in results)  # not "it moved on for 3 s"
