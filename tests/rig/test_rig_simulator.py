"""The simulator: what real drives do, and what may be wired or set wrongly."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from harness import Simulator, fast_config, fast_text

from rig.commands import make_parser
from rig.config import parse_config
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig_workbench.simulator import Truth, truth_of
from rig_workbench.simulator.drive import COMM_ALARM, SimDrive

STILL = {"noise_deg": 0.0}


def joints_after(truth, degrees):
    """Joint angles once the drives have moved by (3,) degrees of the configuration."""
    config = fast_config()
    with Simulator(config, truth) as sim:
        before = sim.plant.joints()
        np.testing.assert_allclose(before, 0.0, atol=2e-3)  # it starts in its jig
        for axis, drive, angle in zip(config.axes, sim.drives, degrees, strict=True):
            drive.position += axis.to_pulses(angle)
        return sim.plant.joints()


def test_a_reversed_axis_turns_its_joint_the_other_way():
    matrix = np.array(Truth().matrix)
    right = joints_after(Truth(**STILL), [2, 3, 4])
    wrong = joints_after(Truth(reversed=(False, False, True), **STILL), [2, 3, 4])
    np.testing.assert_allclose(right, matrix @ [2, 3, 4], atol=2e-3)
    np.testing.assert_allclose(wrong, matrix @ [2, 3, -4], atol=2e-3)


def test_swapped_drives_turn_each_others_joints():
    matrix = np.array(Truth().matrix)
    found = joints_after(Truth(swapped=(0, 2, 1), **STILL), [1, 2, 5])
    np.testing.assert_allclose(found, matrix @ [1, 5, 2], atol=2e-3)
    # all three in a circle: joint i follows drive swapped[i]
    found = joints_after(Truth(swapped=(1, 2, 0), **STILL), [1, 2, 5])
    np.testing.assert_allclose(found, matrix @ [2, 5, 1], atol=2e-3)


def test_another_gearing_is_seen_in_the_joints_and_said_by_the_drive():
    truth = Truth(drive_pulses_per_rev=(4000, 10000, 10000), **STILL)
    found = joints_after(truth, [2, 0, 0])
    np.testing.assert_allclose(found, np.array(truth.matrix) @ [5, 0, 0], atol=2e-3)
    config = fast_config()
    with Simulator(config, truth) as sim, Bus(sim.start().bus) as bus:
        said = [ModbusDrive(bus, axis).ids()["pulses_per_rev"] for axis in config.axes]
    assert said == [4000, 10000, 10000]


def test_a_lost_origin_moves_the_counts_and_not_the_joints():
    config = fast_config()
    truth = Truth(lost_origin_deg=(1.4, 0.0, -1.4), **STILL)
    with Simulator(config, truth) as sim, Simulator(config, Truth(**STILL)) as sound:
        np.testing.assert_allclose(sim.plant.joints(), 0.0, atol=2e-3)
        off = [
            a.position - b.position
            for a, b in zip(sim.drives, sound.drives, strict=True)
        ]
        np.testing.assert_allclose(config.to_deg(off), [1.4, 0.0, -1.4], atol=2e-3)
        sound.power_cycle((1.4, 0.0, -1.4))
        assert [d.position for d in sound.drives] == [d.position for d in sim.drives]
        np.testing.assert_allclose(sound.plant.joints(), 0.0, atol=2e-3)


def test_homing_finds_the_origin_again_and_power_loss_forgets_it():
    config = fast_config()
    truth = Truth(lost_origin_deg=(1.4, 1.4, 1.4), **STILL)
    with Simulator(config, truth, speedup=20) as sim, Bus(sim.start().bus) as bus:
        drive, axis = ModbusDrive(bus, config.axes[0]), config.axes[0]
        sim.drives[0].position += axis.to_pulses(3.0)
        assert not axis.map.homed.holds(drive.status().word)
        drive.write(axis.map.home)
        end = time.monotonic() + 5
        while not drive.status().done:
            assert time.monotonic() < end
        assert axis.map.homed.holds(drive.status().word)
        assert drive.status().position == 0 and sim.drives[0].offset == 0
        sim.power_cycle()
        assert not axis.map.homed.holds(drive.status().word)


def drive_of(truth, register_map="generic"):
    text = fast_text({'map = "leadshine_pr"': f'map = "{register_map}"'})
    axis = parse_config(text).axes[0]
    return axis.map, SimDrive(axis, truth=truth)


def flags(register_map, drive):
    (word,) = drive.read(register_map.status.address, 1)
    return register_map.status.flags(word)


def test_enabling_and_resetting_take_their_time(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    register_map, drive = drive_of(Truth(enable_delay_s=0.5, reset_delay_s=0.3))
    (enable,), (reset,) = register_map.enable.write, register_map.alarm_reset.write
    assert not flags(register_map, drive)["enabled"]
    drive.write(enable.address, [1])
    now[0] += 0.4
    assert not flags(register_map, drive)["enabled"]
    now[0] += 0.2
    assert flags(register_map, drive)["enabled"]
    drive.raise_alarm(0x30)
    drive.write(reset.address, [1])
    assert flags(register_map, drive)["fault"]
    now[0] += 0.31
    assert not flags(register_map, drive)["fault"]


def test_the_position_of_a_standing_drive_flickers_by_a_count():
    register_map, drive = drive_of(Truth(jitter_counts=1))
    seen = {tuple(drive.read(register_map.position.address, 2)) for _ in range(200)}
    assert seen == {(0xFFFF, 0xFFFF), (0, 0), (0, 1)}
    assert drive.position == 0


@pytest.mark.parametrize("idle", [False, True])
def test_an_idle_watchdog_alarms_on_a_silent_line(idle, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    register_map, drive = drive_of(Truth(idle_watchdog=idle))
    drive.write(register_map.comm_timeout.write[0].address, [800])
    now[0] += 0.7
    assert not flags(register_map, drive)["fault"]
    now[0] += 0.9
    assert flags(register_map, drive)["fault"] == idle
    assert drive.alarm == (COMM_ALARM if idle else 0)


def test_replies_take_their_time():
    config = fast_config()
    with Simulator(config, Truth(latency_s=0.03)) as sim, Bus(sim.start().bus) as bus:
        begun = time.monotonic()
        ModbusDrive(bus, config.axes[0]).status()  # two replies
        assert time.monotonic() - begun >= 0.06


def test_options_of_the_command_line_describe_a_device():
    args = make_parser().parse_args(["simulate", "--noise", "0"])
    plain = vars(args)
    assert truth_of(plain, fast_config()) == Truth(noise_deg=0.0)
    odd = {
        "reversed": ["roll"], "swapped": ["pitch", "yaw"], "gearing": 4000,
        "lost_origin": 1.4, "realistic": True,
    }  # fmt: skip
    truth = truth_of(plain | odd, fast_config())
    assert truth.reversed == (False, False, True) and truth.swapped == (1, 0, 2)
    assert truth.drive_pulses_per_rev == (4000,) * 3
    assert truth.lost_origin_deg == (1.4,) * 3
    assert truth.jitter_counts == 1 and truth.idle_watchdog and truth.enable_delay_s
    with pytest.raises(ValueError, match="swapped must name two axes"):
        truth_of(plain | {"swapped": ["yaw"]}, fast_config())


def test_a_drive_ends_on_its_target_and_never_passes_it(monkeypatch):
    """However often it is looked at; play keeps what it once went too far."""
    now, rng = [0.0], np.random.default_rng(0)
    clock = SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr("rig_workbench.simulator.drive.time", clock)
    axis = fast_config().axes[0]
    for target in rng.integers(100, 8000, 60):
        drive = SimDrive(axis, speedup=3.0)
        drive._speed = axis.speed_deg_s * axis.pulses_per_deg
        drive._accel = axis.accel_deg_s2 * axis.pulses_per_deg
        drive.target, drive.moving, drive.done = int(target), True, False
        furthest = 0.0
        while not drive.done:
            now[0] += rng.choice([1e-5, 1e-4, 4e-4, 1e-3, 3e-3])
            drive.advance()
            furthest = max(furthest, drive.position)
        assert furthest == drive.position == target
