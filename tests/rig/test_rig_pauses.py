"""What a session does when the stream pauses, the computer sleeps, a drive crawls."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from harness import HASTY, changed, fast_config
from test_rig_motion import bench, other_controller

from rig.core import device as devices
from rig.core import heartbeat
from rig.core import motion as moving
from rig.drives.drive import Status
from rig.faults import MotionFault, PauseRequested
from rig.readings.source import ReadingError
from rig_workbench.simulator import parse_fault


def test_a_stream_that_pauses_while_nothing_moves_is_waited_for():
    """Wi-Fi's power saving holds it for half a second."""
    with bench(fast_config(HASTY)) as motion:
        target = motion.config.to_pulses([5, 5, 5])
        motion.sim.faults.add(parse_fault("imu_gap,seconds=0.8"))
        time.sleep(motion.config.imu.stale_s + 0.1)
        with pytest.raises(ReadingError):
            motion.device.imu.latest()
        assert not motion.device.moves
        motion.move_to(target, "x")
        assert motion.device.positions() == target and motion.device.paused_s > 0.1
        motion.sim.faults.add(parse_fault("imu_gap,seconds=0.8"))
        time.sleep(motion.config.imu.stale_s + 0.1)
        assert motion.measure(target)["samples"] >= 5


def test_a_stream_that_stays_away_pauses_a_session(monkeypatch):
    monkeypatch.setattr(devices, "PATIENCE_S", 0.3)
    with bench(fast_config(HASTY)) as motion:
        motion.sim.faults.add(parse_fault("imu_gap,seconds=30"))
        time.sleep(motion.config.imu.stale_s + 0.1)
        with pytest.raises(PauseRequested, match=r"s old.*did not move meanwhile"):
            motion.move_to(motion.config.to_pulses([5, 5, 5]), "x")
        assert motion.sim.executions() == [[], [], []]


def test_a_drive_that_moves_while_the_stream_pauses_is_a_fault():
    with bench(fast_config(HASTY)) as motion:
        motion.sim.faults.add(parse_fault("imu_gap,seconds=3"))
        time.sleep(motion.config.imu.stale_s + 0.1)
        other_controller(motion)
        with pytest.raises(MotionFault, match="moves while the readings pause"):
            motion.device.attitude()


@pytest.mark.parametrize("moves", [True, False])
def test_a_computer_that_slept_is_named(monkeypatch, moves):
    ahead = [3.0]
    monkeypatch.setattr(heartbeat, "clock_ahead_s", lambda: ahead[0])
    told_events = []
    with bench(arm=False) as motion:
        motion.device.stopper.emit = lambda event, **f: told_events.append(f)
        motion.device.arm()
        time.sleep(0.2)
        motion.device.heartbeat.feed(moving=moves)
        ahead[0] += 600.0
        end = time.monotonic() + 3.0
        told = "this computer slept for 600 s"
        if moves:
            while not motion.device.stopper.reason and time.monotonic() < end:
                time.sleep(0.01)
            assert told in motion.device.stopper.reason
        else:
            notes = []
            while not notes and time.monotonic() < end:
                time.sleep(0.01)
                notes = [fields for fields in told_events if "text" in fields]
            assert told in notes[0]["text"] and not motion.device.stopper.reason


@pytest.mark.parametrize(
    ("reduction", "asked", "seen", "fault"),
    [
        (50.0, 0.05, 0.24, False),  # it begins at 2 rpm: 12 degrees of the motor
        (50.0, 0.05, 0.5, True),
        (1.0, 0.7, 4.9, False),  # of a direct drive no faster than our own slow
        (1.0, 0.7, 12.0, True),
        (50.0, 10.0, 15.0, False),
        (50.0, 10.0, 60.0, True),
    ],
)
def test_crawls_are_no_slower_than_a_drive_can_begin(reduction, asked, seen, fault):
    scale = changed(fast_config().axes[0], reduction=reduction)
    axis = SimpleNamespace(
        name="pitch", unit_name="deg", turns_per_deg=scale.turns_per_deg,
        to_deg=scale.to_deg, drive_motion=(asked, 1.0), map=scale.map,
    )  # fmt: skip
    at = [
        Status(
            round(seen * t * scale.pulses_per_deg), True, False, True, False, 0, t, t
        )
        for t in np.arange(0.0, 2.0, 0.05)
    ]
    fake = SimpleNamespace(simulated=False)
    check = moving._check_speed
    if fault:
        with pytest.raises(MotionFault, match="instead of the commanded"):
            check(fake, axis, at)
    else:
        check(fake, axis, at)
