"""A stop over a gateway of one connection whose replies come late, or not at all."""

import time

import pytest
from harness import changed
from test_rig_wire import behind_a_gateway, folder  # noqa: F401  # its locks

from rig.core.stop import stop_all
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig_workbench.simulator import parse_fault


def set_moving(sim, config):
    with sim.server.lock:
        for drive, axis in zip(sim.drives, config.axes, strict=True):
            drive._move(axis.to_pulses(18.0), 2000.0, 20000.0)


@pytest.mark.parametrize("refuses", ["accepts and closes", "is closed"])
@pytest.mark.parametrize("fault", ["delayed_reply,seconds=0.1", "dead_drive"])
def test_every_unit_gets_its_stop_over_the_only_connection(refuses, fault):
    """The second was refused, and the good first lay unused from then on."""
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
