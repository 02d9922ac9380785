"""What real drives do: they take time to enable, flicker at rest, and have play."""

import json
import time

import numpy as np
import pytest
from harness import Simulator, changed, fast_text, session
from test_rig_motion import bench

from rig.config import parse_config
from rig.config.maps import MAP_FOLDER
from rig.core.stop import stop_all
from rig.drives.modbus import ModbusDrive
from rig.faults import MotionFault
from rig_workbench.simulator import Truth, parse_fault


def realistic(config=None, **truth):
    """A bench whose drives have these habits."""
    return bench(config, arm=False, truth=Truth(noise_deg=0.0, **truth))


def test_arming_waits_for_the_power_stage():
    with realistic(enable_delay_s=0.4) as motion:
        assert not any(drive.enabled for drive in motion.sim.drives)
        motion.device.arm()
        motion.move_to(motion.config.to_pulses([2, 2, 2]), "x")


def test_arming_waits_for_an_alarm_to_go():
    with realistic(reset_delay_s=0.4) as motion:
        motion.sim.drives[1].raise_alarm(0x40)
        motion.device.arm(reset_alarms=True)
        assert motion.device.armed


@pytest.mark.parametrize(
    ("delays", "says"),
    [
        ({"enable_delay_s": 9.0}, "pitch does not enable its power stage"),
        ({"reset_delay_s": 9.0}, "pitch is in alarm: alarm 0x40"),
    ],
)
def test_it_waits_as_long_as_the_map_says_and_no_longer(delays, says, tmp_path):
    text = (MAP_FOLDER / "leadshine_pr.toml").read_text()
    (tmp_path / "slow.toml").write_text(f"ready_s = 0.2\n{text}")
    changes = {'map = "leadshine_pr"': 'map = "slow.toml"'}
    config = parse_config(fast_text(changes), tmp_path)
    with realistic(config, **delays) as motion:
        motion.sim.drives[0].raise_alarm(0x40)
        if "enable_delay_s" in delays:
            motion.sim.drives[0].alarm = 0
        with pytest.raises(MotionFault, match=says):
            motion.device.arm(reset_alarms=True)


def test_a_look_that_took_longer_than_the_wait_is_not_the_last(monkeypatch):
    """A spoilt frame held it up: it tells of the time before the drive was ready."""
    with realistic(enable_delay_s=0.1) as motion:
        drive, real = motion.device.drives[0], ModbusDrive.status
        drive.axis = changed(drive.axis, map=changed(drive.axis.map, ready_s=0.05))

        def held_up(drive, retries=None):
            status = real(drive, retries)
            if not status.enabled:
                time.sleep(0.2)
            return status

        monkeypatch.setattr(ModbusDrive, "status", held_up)
        found = drive.bring(drive.arm, lambda status: status.enabled)
        assert found.enabled


def test_one_count_of_jitter_is_not_motion():
    with realistic(jitter_counts=1) as motion:
        motion.device.arm()
        motion.move_to(motion.config.to_pulses([2, 2, 2]), "x")
        for _ in range(5):
            results = stop_all(motion.device.drives)
            assert all(result.standing for result in results), results


def test_a_stuck_axis_is_noticed_although_its_position_flickers():
    with realistic(jitter_counts=1) as motion:
        motion.device.arm()
        motion.sim.faults.add(parse_fault("stuck_axis,axis=yaw"))
        with pytest.raises(MotionFault, match="yaw does not follow"):
            motion.move_to(motion.config.to_pulses([2, 9, 2]), "x")


OVERSHOOT = {"[motion]": "[motion]\napproach_overshoot_deg = 2"}


@pytest.mark.slow
def test_the_zero_taken_here_is_approached_from_the_side_of_the_references(tmp_path):
    """With play, a zero taken as the device was put there is off by half of it."""
    config = parse_config(fast_text(OVERSHOOT))
    said = []
    with Simulator(
        config, Truth(noise_deg=0.0, backlash_deg=1.0), rate_hz=250.0
    ) as sim:
        start = [round(drive.position) for drive in sim.drives]
        assert session(sim.start(), tmp_path / "run", sim, said) == 0, said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    last = summary["drift"]["angles_deg"][-1]  # of the zero posture
    assert np.abs(last).max() < 0.01
    assert summary["after"]["max"] < 0.01
    records = [json.loads(line) for line in (tmp_path / "run" / "journal.jsonl").open()]
    (zero,) = (r for r in records if r["event"] == "zero")
    assert zero["pulses"] == start
    below = config.to_pulses(config.to_deg(start) - 2.0)
    for axis, here, low in zip(config.axes, start, below, strict=True):
        moves = [
            r["pulses"]
            for r in records
            if r.get("label") == "zero" and r.get("axis") == axis.name
        ]
        turned = moves.index(low)  # in pieces there, and in pieces back
        away = abs(np.array([here, *moves]) - low)
        assert (np.diff(away[: turned + 2]) < 0).all()
        assert (np.diff(away[turned + 1 :]) > 0).all()
        assert moves[-1] == here


def test_a_zero_that_cannot_be_approached_moves_nothing(tmp_path):
    config = parse_config(fast_text({**OVERSHOOT, "min_deg = -20": "min_deg = -8"}))
    said = []
    with Simulator(config, Truth(noise_deg=0.0), rate_hz=250.0) as sim:
        assert session(sim.start(), tmp_path / "run", sim, said) == 2, said
        assert sim.executions() == [[], [], []]
    assert any("outside the limits, nothing was sent: pitch" in line for line in said)


@pytest.mark.slow
@pytest.mark.parametrize("register_map", ["leadshine_pr", "generic"])
def test_a_whole_session_with_everything_real_drives_do(register_map, tmp_path):
    changes = {'map = "leadshine_pr"': f'map = "{register_map}"'}
    if register_map == "generic":
        changes |= {
            'map = "leadshine_pr"': 'map = "generic"\ncomm_timeout_s = 0.8',
            "timeout_s = 0.5": "timeout_s = 0.25",
        }
    config = parse_config(fast_text(changes))
    truth = Truth(
        noise_deg=0.0, latency_s=0.004, enable_delay_s=0.3, jitter_counts=1,
        idle_watchdog=True,
    )  # fmt: skip
    said = []
    with Simulator(config, truth, rate_hz=250.0) as sim:
        assert session(sim.start(), tmp_path / "run", sim, said) == 0, said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert np.abs(np.array(summary["A"]) - truth.matrix).max() < 1e-3
