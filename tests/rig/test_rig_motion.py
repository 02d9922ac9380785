"""Motion: arming, limits, splitting, settling, and what stops it."""

import contextlib
import dataclasses
import signal
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from harness import (
    HASTY,
    UNSETTLED,
    WATCHED,
    fast_config,
    fast_text,
    line_here,
    read_words,
    simulator,
)

from rig.config import parse_config
from rig.core import measure as measuring
from rig.core import motion as moving
from rig.core.device import Device, Posture, approach, check_plan
from rig.core.measure import _unquiet, measure
from rig.core.motion import Arrival, move
from rig.core.proof import FIRST_DEG, GROWTH
from rig.drives.drive import HOME
from rig.faults import (
    LimitError,
    MotionFault,
    PauseRequested,
    Signals,
    StopRequested,
    Unreachable,
)
from rig.prove.home import unlimited
from rig.readings.geometry import Reading, euler_to_matrix, geometry_of
from rig.readings.source import ReadingError
from rig_workbench.simulator import Truth, parse_fault


@contextlib.contextmanager
def bench(config=None, arm=True, **options):
    """Motion on a simulated rig."""
    config = config or fast_config()
    with simulator(config, **options) as sim:
        served = sim.start()
        run = SimpleNamespace(
            config=served,
            predict=None,
            signals=Signals(),
            simulated=False,
            lines=line_here,
            emit=lambda event, **fields: sim.hear({"event": event, **fields}),
            journal=SimpleNamespace(records=[]),
        )
        checked = SimpleNamespace(missing=lambda *_: None, state=lambda _: None)
        run.record = checked
        device = Device(run)
        with device.imu as imu, device.line:
            sim.start_phone(imu.port)
            imu.wait_for_stream(5)
            if arm:
                device.arm()
            try:
                yield Motion(device, sim)
            finally:
                device.heartbeat.close()


@dataclasses.dataclass
class Motion:
    """A device that is moved, and the simulator behind it."""

    device: Device
    sim: object

    @property
    def config(self):
        return self.device.config

    @property
    def signals(self):
        return self.device.requests

    def move_to(self, target, name):
        return move(self.device, Posture(name, target))

    def measure(self, target):
        return measure(Arrival(self.device, Posture("", target)))


def test_nothing_moves_before_arming():
    with bench(arm=False) as motion:
        with pytest.raises(MotionFault, match="not armed"):
            motion.move_to((100, 100, 100), "x")
        assert motion.sim.executions() == [[], [], []]


def test_an_alarm_or_a_silent_phone_keeps_it_from_arming():
    with bench(arm=False) as motion:
        motion.sim.drives[1].raise_alarm(0x40)
        with pytest.raises(MotionFault, match="yaw is in alarm: alarm 0x40"):
            motion.device.arm()
        motion.device.arm(reset_alarms=True)
        assert motion.device.armed
    with bench(fast_config(HASTY), arm=False) as motion:
        motion.sim.faults.add(parse_fault("imu_gap"))
        time.sleep(motion.config.imu.stale_s + 0.1)
        with pytest.raises(ReadingError, match="reading is"):
            motion.device.arm()


def other_controller(motion):
    """What shares a gateway with us, where no lock is possible, moves yaw slowly."""
    with motion.sim.server.lock:
        drive = motion.sim.drives[1]
        drive._enable()
        drive.advance()
        drive._move(round(drive.position) + 5000, 10.0, 1e5)


def test_a_drive_that_another_controller_moves_keeps_it_from_arming():
    with bench(arm=False) as motion:
        other_controller(motion)
        with pytest.raises(MotionFault, match="yaw is already moving"):
            motion.device.arm()


def test_a_drive_that_another_controller_moves_ends_what_is_measured(monkeypatch):
    """Settled, then moved: slower than any reading of the phone shows."""
    with bench() as motion:
        settled = measuring._settled

        def then_moved(*args):
            statuses = settled(*args)
            other_controller(motion)
            return statuses

        monkeypatch.setattr(measuring, "_settled", then_moved)
        with pytest.raises(MotionFault, match="moves during the measurement"):
            measure(Arrival(motion.device, Posture("", (0, 0, 0))), 200)


def test_a_position_outside_the_limits_keeps_it_from_arming():
    with bench(arm=False) as motion:
        drive = motion.sim.drives[2]
        drive.position = motion.config.axes[2].max_pulses + 500.0
        with pytest.raises(MotionFault, match="outside its limits"):
            motion.device.arm()


def test_soft_limits_are_mirrored_in_drives_that_have_them():
    changes = {'map = "leadshine_pr"': 'map = "generic"',
               "[motion]": "[motion]\nmirror_limits = true"}  # fmt: skip
    with bench(parse_config(fast_text(changes))) as motion:
        axis = motion.config.axes[0]
        words = read_words(motion.device.line, axis.unit, 0x2C, 4)
        low, high = (a << 16 | b for a, b in (words[:2], words[2:]))
        assert (low - 2**32, high) == (axis.min_pulses, axis.max_pulses)


def test_before_home_is_set_the_drives_own_limits_leave_it_room():
    """Those of before, about 0, would shut out a home at 2^30."""
    changes = {'map = "leadshine_pr"': 'map = "generic"',
               "[motion]": "[motion]\nmirror_limits = true"}  # fmt: skip
    with bench(unlimited(parse_config(fast_text(changes)))) as motion:
        unit = motion.config.axes[0].unit
        words = read_words(motion.device.line, unit, 0x2C, 4)
        low, high = (a << 16 | b for a, b in (words[:2], words[2:]))
        assert low - 2**32 <= 0 < HOME <= high


def test_the_whole_plan_is_checked_before_the_first_move():
    config = fast_config()
    inside, outside = config.to_pulses([5, 5, 5]), config.to_pulses([5, 5, 20.1])
    check_plan(config, [inside])
    with pytest.raises(LimitError, match="roll"):
        check_plan(config, [inside, outside])


def test_the_point_of_approach_is_checked_too():
    text = fast_text({"[motion]": "[motion]\napproach_overshoot_deg = 3"})
    config = parse_config(text)
    check_plan(config, [config.to_pulses([-16.9, -16.9, -16.9])])
    with pytest.raises(LimitError):
        check_plan(config, [config.to_pulses([-17.5, 0, 0])])


def test_a_target_outside_sends_nothing():
    with bench() as motion:
        with pytest.raises(LimitError):
            motion.move_to((0, 0, 99999), "x")
        assert motion.sim.executions() == [[], [], []]


def test_long_moves_are_split_and_short_ones_are_not():
    with bench() as motion:
        start = motion.device.positions()
        target = motion.config.to_pulses([18.0, -18.0, 18.0])
        motion.move_to(target, "far")
        first = len(motion.sim.executions()[0])
        motion.move_to(start, "back")
        way = np.abs(motion.config.to_deg(np.subtract(target, start))).max()
        steps = first + int(np.ceil(way / motion.config.motion.max_step_deg))
        assert [len(ran) for ran in motion.sim.executions()] == [steps] * 3
        motion.move_to(target, "far")
        steps = 2 * steps - first
        assert [len(ran) for ran in motion.sim.executions()] == [steps] * 3
        near = motion.config.to_pulses([17.0, -17.0, 17.0])
        motion.move_to(near, "near")
        assert [len(ran) for ran in motion.sim.executions()] == [steps + 1] * 3
        assert motion.device.positions() == near


def test_a_session_begins_with_a_quarter_of_a_degree_and_grows():
    with bench() as motion:
        start = motion.config.to_deg(motion.device.positions())
        target = motion.config.to_pulses([18.0, -18.0, 18.0])
        motion.move_to(target, "far")
        for ran, axis, begin in zip(
            motion.sim.executions(), motion.config.axes, start, strict=True
        ):
            ways = np.abs(np.diff([begin, *map(axis.to_deg, ran)]))
            assert ways[0] <= FIRST_DEG + 0.01
            assert (ways[1:] <= GROWTH * ways[:-1] + 0.01).all()


def test_a_gearing_that_was_changed_since_is_seen_in_the_first_degree():
    """Ten times as far as told, by a drive whose register does not say so."""
    config = fast_config()
    pulses = config.axes[0].pulses_per_rev // 10
    truth = Truth(noise_deg=0.0, drive_pulses_per_rev=(pulses,) * 3)
    with bench(config, truth=truth) as motion:
        begin = motion.sim.plant.joints()
        with pytest.raises(MotionFault, match=r"the phone turned .* that may turn it"):
            motion.move_to(motion.config.to_pulses([10.0, -10.0, 10.0]), "far")
        assert np.abs(motion.sim.plant.joints() - begin).max() < 5.0


def test_every_posture_is_approached_from_one_side():
    text = fast_text({"[motion]": "[motion]\napproach_overshoot_deg = 2"})
    with bench(parse_config(text)) as motion:
        for goal in ([10, 10, 10], [-10, -10, -10]):
            target = motion.config.to_pulses(goal)
            motion.move_to(target, "x")
            via, _ = approach(motion.config, target)
            for ran, last, before, axis in zip(
                motion.sim.executions(), target, via, motion.config.axes, strict=True
            ):
                assert before in ran and ran[-1] == last
                up = [axis.to_deg(p) for p in ran[len(ran) - ran[::-1].index(before) :]]
                assert up == sorted(up)


def test_backlash_becomes_pure_bias_when_approached_from_one_side():
    changes = {"[motion]": "[motion]\napproach_overshoot_deg = 2"}
    spread = {}
    for name, text in (("plain", fast_text()), ("one side", fast_text(changes))):
        config = parse_config(text)
        with bench(config) as motion:
            plant = motion.sim.plant
            plant.truth = dataclasses.replace(plant.truth, backlash_deg=1.0)
            seen = []
            for start in (-15, 15):
                motion.move_to(motion.config.to_pulses([start] * 3), "start")
                motion.move_to(motion.config.to_pulses([0, 0, 0]), "zero")
                with motion.sim.server.lock:
                    seen.append(plant.joints())
            spread[name] = np.abs(seen[1] - seen[0]).max()
    assert spread["plain"] > 0.5
    assert spread["one side"] < 0.01


def test_settled_means_drives_done_and_imu_quiet():
    with bench(noise_deg=0.01) as motion:
        target = motion.config.to_pulses([5, 5, 5])
        motion.move_to(target, "x")
        measured = motion.measure(target)
        assert measured["samples"] == motion.config.settle.samples
        assert max(measured["std_deg"]) <= motion.config.settle.std_deg
        assert measured["feedback"] == list(target)


@pytest.mark.parametrize("moves", [False, True])
def test_readings_that_come_in_bursts_settle_over_more_than_the_window(moves):
    """Of a phone that saves power, or a busy computer: ten within 2 ms, then 0.1 s."""
    config = fast_config()
    times = [0.1 * burst + 2e-4 * number for burst in range(4) for number in range(10)]
    turns = [[5.0 * moves * (time < 0.25), 0.0, 0.0] for time in times]
    matrices = euler_to_matrix(turns, "ZYX")
    readings = [Reading(*each) for each in zip(times, matrices, strict=True)]
    imu = SimpleNamespace(dropped="", lost="", whose="the phone", stale_s=0.4)
    geometry = geometry_of(config)
    device = SimpleNamespace(config=config, frame=None, imu=imu, geometry=geometry)
    found = _unquiet(device, readings, now=0.35)
    assert "std_deg" in found if moves else found == ""
    assert "10 readings in 0.00 s" in _unquiet(device, readings[-10:], now=0.35)


def test_a_shaking_device_never_settles():
    # On a machine so busy that the phone is not heard, that is what it is told instead.
    reason = r"did not settle.*(std_deg|readings in)"
    with bench(fast_config(UNSETTLED), noise_deg=1.0) as motion:
        with pytest.raises(MotionFault, match=reason):
            motion.measure(motion.device.positions())


def test_a_creeping_device_never_settles():
    text = fast_text({**UNSETTLED, "slope_deg_s = 0.5": "slope_deg_s = 0.05"})
    with bench(parse_config(text)) as motion:
        plant = motion.sim.plant
        plant.truth = dataclasses.replace(plant.truth, drift_deg_per_min=60.0)
        with pytest.raises(MotionFault, match=r"did not settle.*slope"):
            motion.measure(motion.device.positions())


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("stuck_axis,axis=yaw@moving", "yaw does not follow"),
        ("alarm,axis=roll", "roll: alarm 0x30. .* continue with --reset-alarms"),
        ("sto,axis=yaw", "power stage of yaw was switched off while armed"),
        ("imu_gap@moving", "s old"),
        ("dead_drive,axis=pitch", "no valid reply"),
    ],
)
def test_trouble_on_the_way_is_noticed(fault, error):
    slow = {"speedup": 0.02} if fault == "imu_gap@moving" else {}
    with bench(fast_config(HASTY), **slow) as motion:
        if slow:
            motion.device.meanwhile = lambda: motion.sim.faults.add(
                parse_fault("imu_gap")
            )
        else:
            motion.sim.faults.add(parse_fault(fault.partition("@")[0]))
        motion.sim.enter("moving")
        with pytest.raises(Exception, match=error):
            motion.move_to(motion.config.to_pulses([10, 10, 10]), "x")
        results = motion.device.stopper.stop("test")
        assert sum(result.acknowledged for result in results) >= 2
        with pytest.raises(StopRequested):
            motion.move_to((0, 0, 0), "after a fault")


def test_a_power_stage_that_is_switched_off_at_rest_ends_what_is_measured():
    """The position may hold still all the same; an axis by gravity sinks later."""
    with bench() as motion:
        motion.sim.drives[2].cut(9.0)
        with pytest.raises(MotionFault, match="power stage of roll was switched off"):
            motion.measure(motion.device.positions())


@pytest.mark.parametrize(("counts", "fast"), [(2, False), (20, False), (60, True)])
def test_a_count_that_jumps_is_no_speed(counts, fast, monkeypatch):
    """A stepper of 1,000 counts a turn: its first move is of one or two."""
    monkeypatch.setattr(moving, "TOO_FAST", 1.6)
    config = SimpleNamespace(name="stepper")
    axis = SimpleNamespace(
        name="x", unit_name="mm", map=config, drive_motion=(0.002, 0.02),
        to_deg=lambda count: count / 1000.0, turns_per_deg=1.0,
    )  # fmt: skip
    device = SimpleNamespace(simulated=False)
    seen = [SimpleNamespace(position=0, asked=0.0, time=0.01),
            SimpleNamespace(position=counts, asked=0.5, time=0.51)]  # fmt: skip
    told = pytest.raises(MotionFault, match=r"moves at 0\.114 mm/s or faster")
    with told if fast else contextlib.nullcontext():
        moving._check_speed(device, axis, seen)


def test_what_moved_last_is_no_move_of_no_way():
    with bench() as motion:
        here = motion.device.positions()
        motion.move_to(here, "reference")
        assert motion.device.last_move is None
        motion.move_to((here[0] + 100, *here[1:]), "x")
        motion.move_to(motion.device.positions(), "reference")
        assert motion.device.last_move[0] == "x"


def test_a_missed_deadline_stops(monkeypatch):
    monkeypatch.setattr(moving, "DEADLINE_SLACK_S", 0.05)
    with bench(speedup=0.05) as motion:
        with pytest.raises(MotionFault, match="took longer than"):
            motion.move_to(motion.config.to_pulses([10, 10, 10]), "x")


def test_a_refused_target_is_out_of_reach_and_latches_nothing():
    with bench(travel_deg=(-15, 15)) as motion:
        with pytest.raises(Unreachable, match="answered exception 3"):
            motion.move_to(motion.config.to_pulses([0, 19, 0]), "x")
        motion.device.stopper.stop("out of reach", latch=False)
        motion.move_to(motion.config.to_pulses([0, 5, 0]), "y")


def test_signals_pause_first_and_stop_second():
    signals = Signals()
    with signals:
        signals.armed = True
        signal.raise_signal(signal.SIGINT)
        signals.check_stop()
        with pytest.raises(PauseRequested):
            signals.check_pause()
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(StopRequested) as caught:
            signals.check_stop()
        assert caught.value.exit_code == 130


def test_an_unarmed_program_ends_at_once():
    with Signals(), pytest.raises(StopRequested) as caught:
        signal.raise_signal(signal.SIGTERM)
    assert caught.value.exit_code == 143


def test_sigterm_stops_a_move_under_way():
    with bench(speedup=0.1) as motion, motion.signals as signals:
        signals.armed = True

        main = threading.main_thread().ident
        send = threading.Timer(0.15, signal.pthread_kill, (main, signal.SIGTERM))
        send.start()
        with pytest.raises(StopRequested):
            motion.move_to(motion.config.to_pulses([15, 15, 15]), "x")
        assert all(r.standing for r in motion.device.stopper.stop("SIGTERM"))


def test_a_lost_heartbeat_stops_the_drives():
    with bench(fast_config(HASTY), speedup=0.02) as motion:
        for drive, pulses in zip(
            motion.device.drives, motion.config.to_pulses([15, 15, 15]), strict=True
        ):
            drive.go(pulses)
        motion.device.heartbeat.feed(moving=True)  # and then the loop falls silent
        end = time.monotonic() + 60
        while not motion.device.stopper.reason:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert "this program paused for" in motion.device.stopper.reason
        end = time.monotonic() + 60
        while not motion.device.stopper.results:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert all(drive.stops for drive in motion.sim.drives)


def test_a_drives_own_watch_stops_it_when_the_host_is_gone():
    text = fast_text(WATCHED)
    with bench(parse_config(text), speedup=0.05) as motion:
        motion.device.heartbeat.close()
        target = motion.config.to_pulses([15, 15, 15])
        for drive, pulses in zip(motion.device.drives, target, strict=True):
            drive.go(pulses)
        time.sleep(1.2)  # nothing is said on the bus
        for sim, pulses in zip(motion.sim.drives, target, strict=True):
            with motion.sim.server.lock:
                sim.advance()
                assert sim.comm_stops == 1 and not sim.moving
                assert sim.position != pulses


def test_the_keep_alive_keeps_that_watch_quiet_while_the_plan_computes():
    text = fast_text(WATCHED)
    with bench(parse_config(text)) as motion:
        before = motion.sim.server.requests
        time.sleep(0.9)
        assert motion.sim.server.requests > before


def test_the_motion_and_stop_modules_never_load_jax():
    import subprocess
    import sys

    program = (
        "import sys, rig.core.motion, rig.core.measure, rig.core.stop\n"
        "heavy = {'jax', 'matplotlib', 'flax', 'rig.outputs'}\n"
        "heavy &= set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
