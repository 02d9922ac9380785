"""A lost reply to a move: the drive is read, and nothing is ever done twice."""

import json
import threading
import time

import numpy as np
import pytest
from fault_matrix import calibration, uninterrupted
from harness import (
    HASTY,
    MODBUS_MAPS,
    Simulator,
    fast_config,
    fast_text,
    session,
    simulator,
)
from test_rig_motion import bench

from rig.config import ConfigError, parse_config
from rig.config.maps import MAP_FOLDER, RegisterMap
from rig.config.schema import parse
from rig.core.motion import took
from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive
from rig.faults import MotionFault, StopRequested
from rig.journal.run_folder import read_journal
from rig_workbench.simulator import Truth, parse_fault

# Time enough for a busy computer: a reply that is late is one lost reply more.
TIMEOUT = {"timeout_s = 0.5": "timeout_s = 0.25"}


def hasty(register_map="leadshine_pr"):
    changes = {'map = "leadshine_pr"': f'map = "{register_map}"'}
    return parse_config(fast_text(TIMEOUT | changes))


def spoiling(motion, act):
    """Call ``act(axis)`` when a move is about to be sent; the events that were told."""
    told, emit = [], motion.device.emit

    def hear(event, **fields):
        told.append({"event": event, **fields})
        emit(event, **fields)
        if event == "command":
            act(fields["axis"])

    motion.device.emit = hear
    return told


def outcomes(told):
    return [r["outcome"] for r in told if r["event"] == "lost_reply"]


def once(fault):
    """An ``act`` that injects one fault at the first move of yaw."""
    left = [parse_fault(f"{fault},axis=yaw,count=1")]
    return lambda sim: (
        lambda axis: sim.faults.add(left.pop()) if axis == "yaw" and left else None
    )


@pytest.mark.parametrize("register_map", MODBUS_MAPS)
@pytest.mark.parametrize(
    ("fault", "outcome"),
    [("lost_write_reply", "obeyed"), ("lost_request", "not taken")],
)
def test_the_session_goes_on_and_every_drive_runs_each_move_once(
    register_map, fault, outcome
):
    with bench(hasty(register_map)) as motion:
        told = spoiling(motion, once(fault)(motion.sim))
        target = motion.config.to_pulses([3, 3, 3])
        motion.move_to(target, "x")
        if len(motion.config.axes[0].map.move.write) > 1:
            outcome = "not taken"  # the first frame was lost: it only stores the target
        assert outcomes(told) == [outcome]
        asked = [[r["pulses"] for r in told if r.get("axis") == a and "number" in r]
                 for a in ("pitch", "yaw", "roll")]  # fmt: skip
        assert motion.sim.executions() == asked
        assert motion.device.positions() == target


def test_a_move_that_the_drive_already_finished_counts_as_taken():
    """The whole move fits into the time in which the reply is waited for."""
    with bench(hasty(), speedup=20) as motion:
        told = spoiling(motion, once("lost_write_reply")(motion.sim))
        motion.move_to(motion.config.to_pulses([-6, 9, -2]), "x")
        assert outcomes(told) == ["obeyed"]
        for ran in motion.sim.executions():  # none was sent twice
            assert len(ran) == len(set(ran)) > 0


@pytest.mark.parametrize("register_map", MODBUS_MAPS)
def test_a_drive_shows_whether_it_took_a_move(register_map):
    config = hasty(register_map)
    with simulator(config, speedup=0.05) as sim, Bus(sim.start().bus) as bus:
        drive, start = ModbusDrive(bus, config.axes[0]), sim.drives[0].position
        before = drive.status()
        assert took(drive, 2000, before, 14) is False
        assert took(drive, round(start), before, 14) is True  # it stands there
        drive.go(2000)
        assert took(drive, 2000, before, 14) is True
        assert took(drive, 1000, before, 14) is None  # it goes elsewhere
        assert len(sim.drives[0].executions) == 1


def test_a_drive_on_its_way_elsewhere_stops_everything():
    with bench(hasty()) as motion:
        sim = motion.sim

        def elsewhere(axis):
            if axis == "yaw":  # another controller's move, in place of ours
                sim.faults.add(parse_fault("lost_request,axis=yaw,count=1"))
                words = [1, 0, 4000, 3, 5000, 5000, 0, 0x10]
                with sim.server.lock:
                    sim.drives[1].write(0x6200, words)

        told = spoiling(motion, elsewhere)
        with pytest.raises(BusError, match="no valid reply"):
            motion.move_to(motion.config.to_pulses([3, 3, 3]), "x")
        assert outcomes(told) == ["unknown"]
        assert sim.executions()[1] == [4000]


def test_a_drive_that_stays_silent_stops_everything():
    with bench(hasty()) as motion:
        dead = parse_fault("dead_drive,axis=yaw")
        spoiling(motion, lambda axis: axis == "yaw" and motion.sim.faults.add(dead))
        with pytest.raises(BusError):
            motion.move_to(motion.config.to_pulses([3, 3, 3]), "x")
        assert motion.sim.executions()[1:] == [[], []]


def test_an_alarm_behind_a_lost_reply_is_told():
    with bench(hasty()) as motion:
        sim = motion.sim

        def fail(axis):
            if axis == "yaw":
                sim.faults.add(parse_fault("lost_request,axis=yaw,count=1"))
                sim.faults.add(parse_fault("alarm,axis=yaw"))

        spoiling(motion, fail)
        with pytest.raises(MotionFault, match="yaw: alarm 0x30"):
            motion.move_to(motion.config.to_pulses([3, 3, 3]), "x")


@pytest.mark.parametrize("stop", ["signal", "latch"])
def test_no_move_is_sent_again_once_a_stop_was_asked_for(stop):
    with bench(hasty()) as motion:
        told = spoiling(motion, once("lost_request")(motion.sim))
        emit = motion.device.emit

        def hear(event, **fields):
            emit(event, **fields)
            if event == "lost_reply" and stop == "signal":
                motion.signals.request_stop("SIGTERM", 143)
            elif event == "lost_reply":
                motion.device.stopper.stop("heartbeat lost")

        motion.device.emit = hear
        with pytest.raises(StopRequested):
            motion.move_to(motion.config.to_pulses([3, 3, 3]), "x")
        assert outcomes(told) == ["not taken"]
        assert motion.sim.executions()[1] == []


def test_a_move_that_waited_for_the_line_while_it_was_stopped_is_not_sent():
    with bench(hasty()) as motion:
        device, held = motion.device, threading.Event()

        def stop():
            with device.line.urgent():  # as the stop path holds it
                held.set()
                time.sleep(0.1)
                device.stopper.reason = "stopped by another thread"

        thread = threading.Thread(target=stop)
        thread.start()
        held.wait()
        with pytest.raises(StopRequested):
            device.drives[0].go(100)
        thread.join()
        assert motion.sim.executions()[0] == []


def test_only_what_may_be_written_twice_is_retried():
    """Enabling is; a move, a homing and a stop are not."""
    config = fast_config(HASTY)
    with simulator(config) as sim, Bus(sim.start().bus) as bus:
        axis = config.axes[0]
        drive, table = ModbusDrive(bus, axis), axis.map
        for name in ("enable", "alarm_reset", "limits"):
            sim.faults.add(parse_fault("lost_write_reply,count=2"))
            drive.write(getattr(table, name), min=-9000, max=9000)
            sim.faults.clear()
        for act in (lambda: drive.write(table.home), drive.stop, lambda: drive.go(9)):
            sim.faults.add(parse_fault("lost_write_reply,count=1"))
            with pytest.raises(BusError):
                act()
        assert sim.executions()[0] == [9]


def rtu_session(seed, folder, said):
    pytest.importorskip("serial", reason="serial ports need pyserial")
    config = fast_config({"timeout_s = 0.5": "timeout_s = 0.15"})
    fault = parse_fault("spoilt_frames,share=0.03")
    with Simulator(
        config, Truth(noise_deg=0.0, seed=seed), [fault], transport="rtu", rate_hz=250.0
    ) as sim:
        code = session(sim.start(), folder, sim, said)
        return code, sim.executions()


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in range(2, 6))]
)
def test_spoilt_frames_do_not_end_a_session_on_rs485(seed, tmp_path):
    said = []
    code, ran = rtu_session(seed, tmp_path / "run", said)
    assert code == 0, said
    found = calibration(tmp_path / "run")
    assert np.abs(found - uninterrupted(tmp_path / "sound")).max() < 1e-6
    records = read_journal(tmp_path / "run" / "journal.jsonl")
    asked = [
        [r["pulses"] for r in records if r["event"] == "command" and r["axis"] == axis]
        for axis in ("pitch", "yaw", "roll")
    ]
    assert ran == asked  # each move once, in its order
    assert "unknown" not in json.dumps([r for r in records if "outcome" in r])


@pytest.mark.parametrize(
    ("register_map", "absolute", "relative"),
    [
        ("leadshine_pr", "words = [0x0001, ", "words = [0x0041, "),
        ("oriental_az", "words = [0, 0, 0, 1, ", "words = [0, 0, 0, 2, "),
        ("applied_motion", "0x0067", "0x0066"),
    ],
)
def test_a_relative_move_is_no_map(register_map, absolute, relative):
    text = (MAP_FOLDER / f"{register_map}.toml").read_text()
    parse(RegisterMap, text, "sound.toml")
    assert absolute in text
    with pytest.raises(ConfigError, match="is a relative move"):
        parse(RegisterMap, text.replace(absolute, relative), "relative.toml")
