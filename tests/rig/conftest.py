"""Fixtures of commissioning."""

import pytest
from commission import device, quick_text
from harness import prove_stops

from rig.config import load_config
from rig.core import proof
from rig.journal.device import HOMED, IDENTIFIED, SIGN_CHECKED, DeviceRecord
from rig.prove import stops
from rig_workbench.commission import setup as wizard


@pytest.fixture
def at(tmp_path, monkeypatch):
    """An empty folder to work in, and axes that need not be watched by a person."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wizard, "WATCH_S", 0.3)
    monkeypatch.setattr(proof, "SLOW_DEG_S", 400.0)
    monkeypatch.setattr(proof, "LOOK_S", 0.01)
    monkeypatch.setattr(stops, "SPEED_DEG_S", 10.0)
    return tmp_path


@pytest.fixture
def commissioned(at):
    """A device of which all is known that a session needs."""
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        config = load_config("rig.toml")
        record = DeviceRecord.load(config.device_path)
        for state in (IDENTIFIED, HOMED, SIGN_CHECKED):
            record.reach(state, config)
        prove_stops(record, config)
        yield sim
