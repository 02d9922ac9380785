"""How far a joint goes on after its stop bounds its speed near a limit."""

import math
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from commission import device, quick_text
from harness import fast_config
from recorder import axis_with
from test_rig_motion import bench

from rig.__main__ import main
from rig.core.proof import StopDistance, stop_distances
from rig.journal.device import STOP_PROVED, DeviceRecord
from rig_workbench.simulator import Truth
from rig_workbench.simulator import drive as sim_drive

RAMP = 149.0  # deg/s^2: it stops within .08 deg at 5 deg/s, and within 27 at 90


def furthest_beyond(speed, accel, way, delay, ramp):
    """Beyond its target, of a move that is stopped at any time; stepped, by hand."""
    dt, worst = 1e-4, -way
    peak = min(speed, math.sqrt(accel * way))
    places, speeds, x, v = [], [], 0.0, 0.0
    while x < way - 1e-9 and (v > 0 or x == 0.0):
        left = way - x
        v = min(v + accel * dt, peak, math.sqrt(2 * accel * max(0.0, left)))
        x += v * dt
        places.append(x)
        speeds.append(v)
        if v < 1e-3:
            break
    for place, v in zip(places[::20], speeds[::20], strict=True):
        worst = max(worst, place + v * delay + v * v / (2 * ramp) - way)
    return worst


@pytest.mark.parametrize("delay, ramp", [(0.0, 149.0), (0.02, 300.0), (0.3, 1e4)])
@pytest.mark.parametrize("room", [0.5, 5.0])
def test_the_fastest_move_stays_inside_whenever_it_is_stopped(delay, ramp, room):
    axis = axis_with("leadshine_pr", speed_deg_s=90.0, accel_deg_s2=400.0)
    _, accel = axis.drive_motion
    speeds = [5.0, 15.0]
    distances = [v * delay + v * v / (2 * ramp) for v in speeds]
    known = StopDistance.of(speeds, distances, accel)
    assert known.delay_s == pytest.approx(delay, abs=1e-9)
    assert known.per_square == pytest.approx(0.5 / ramp)
    assert known.at(90.0) == pytest.approx(90 * delay + 8100 / (2 * ramp))
    fastest = known.fastest(axis, room)
    assert furthest_beyond(fastest, accel, 40.0, delay, ramp) <= room
    if fastest < 90.0:  # and it is no slower than it need be
        assert furthest_beyond(1.5 * fastest, accel, 40.0, delay, ramp) > room


def test_a_drive_that_brakes_harder_than_its_move_is_never_slowed():
    axis = axis_with("leadshine_pr", speed_deg_s=90.0, accel_deg_s2=400.0)
    known = StopDistance.of([5, 15], [25 / 4000, 225 / 4000], axis.drive_motion[1])
    assert known.fastest(axis, 0.0) == axis.drive_motion[0]


def test_distances_that_no_ramp_explains_are_taken_for_the_worse():
    for distances in ([0.3, 0.3], [0.0, 0.9], [0.1, 0.1]):
        known = StopDistance.of([5.0, 15.0], distances, 100.0)
        assert known.at(5.0) >= distances[0] - 1e-12
        assert known.at(15.0) >= distances[1] - 1e-12
    alone = StopDistance.of([5.0], [0.1], 100.0)
    assert alone.at(90.0) == pytest.approx(0.1 * 18**2)


def test_a_gentler_ramp_of_the_moves_makes_a_stop_gentler_too():
    known = StopDistance.of([5, 15], [0.05, 0.45], 400.0)
    hard, soft = (axis_with("leadshine_pr", speed_deg_s=90.0, accel_deg_s2=a)
                  for a in (400.0, 100.0))  # fmt: skip
    assert known.fastest(hard, 2.0) >= known.fastest(soft, 2.0)


def test_a_stop_that_was_proved_without_a_distance_is_taken_for_slow():
    config = fast_config(SLOWER)
    unproved = SimpleNamespace(state=lambda name: None)
    assert stop_distances(unproved, config.axes) == {}
    proved = SimpleNamespace(state=lambda name: {})
    for axis in config.axes:
        known = stop_distances(proved, config.axes)[axis.name]
        fastest = known.fastest(axis, 2.0)
        assert fastest + fastest**2 / (2 * known.accel) < 4.0  # a second, and its ramp
        assert fastest < 3.0


SLOWER = {"speed_deg_s = 400": "speed_deg_s = 90", "accel_deg_s2 = 8000":
          "accel_deg_s2 = 400"}  # fmt: skip


@pytest.mark.parametrize("known", [False, True])
def test_a_stop_near_a_limit_ends_inside_it(known, monkeypatch):
    """H: at 90 degrees a second a joint ended at 47.1 of 20."""
    config = fast_config(SLOWER)
    accel = config.axes[0].drive_motion[1]
    monkeypatch.setattr(sim_drive, "QUICK_STOP_FACTOR", RAMP / accel)
    with bench(config, speedup=1.0) as motion:
        proof, sim, axis = motion.device.proof, motion.sim, motion.config.axes[0]
        for reach in proof.reaches:
            reach.checked = True
            reach.longest = 1e9  # this is about the speed alone
        if known:
            distances = [v * v / (2 * RAMP) for v in (5.0, 15.0)]
            proof.stops = {
                a.name: StopDistance.of([5.0, 15.0], distances, accel)
                for a in motion.config.axes
            }
        motion.device.config = motion.device.config.model_copy(
            update={"motion": motion.config.motion.model_copy(
                update={"max_step_deg": 360.0})}
        )  # fmt: skip
        thread = threading.Thread(target=lambda: _moved(motion, axis), daemon=True)
        thread.start()
        drive, fastest = sim.drives[0], 0.0
        end = time.monotonic() + 30
        while time.monotonic() < end:
            with sim.server.lock:
                drive.advance()
                place, speed = (x / drive.pulses_per_deg for x in
                                (drive.position, drive.velocity))  # fmt: skip
            fastest = max(fastest, abs(speed))
            if place > 10.0 or (known and place > 5.0 and abs(speed) > 0.9 * fastest
                                and place + speed**2 / (2 * accel) > 17.5):  # fmt: skip
                break
            time.sleep(0.001)
        motion.device.stopper.stop("as it is fastest")
        thread.join(10)
        with sim.server.lock:
            drive.advance()
        stands = drive.position / drive.pulses_per_deg
        assert fastest > (10.0 if known else 80.0)
        assert (stands <= axis.max_deg) == known, stands


def _moved(motion, axis):
    target = [0] * len(motion.config.axes)
    target[0] = axis.to_pulses(axis.max_deg - 2.0)
    try:
        motion.move_to(tuple(target), "near the limit")
    except BaseException:  # it is stopped
        pass


@pytest.mark.slow
def test_axes_measures_both_and_says_the_number(at, monkeypatch, capsys):
    monkeypatch.setattr(sim_drive, "QUICK_STOP_FACTOR", RAMP / 400.0)
    config = fast_config(SLOWER)
    with device(Truth(noise_deg=0.005), config=config, speedup=1.0) as (_, bus, port):
        text = quick_text(bus, port)
        for old, new in SLOWER.items():
            text = text.replace(old, new)
        (at / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        assert main(["axes", "--yes"]) == 0
    said = capsys.readouterr().out
    evidence = DeviceRecord.load(at / "device.json").state(STOP_PROVED)
    for name, known in evidence["distances"].items():
        assert len(known["speeds"]) == 2
        found = StopDistance.of(**known)
        np.testing.assert_allclose(found.at(90.0), 8100 / (2 * RAMP), rtol=0.4)
        assert f"{name}: stopping distance" in said and "deg at 90 deg/s" in said
