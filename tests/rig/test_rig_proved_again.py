"""What was proved in `axes` is looked at again when a session begins, and what stops a
device is tried before it is needed. Judged by the joints and the drives' own log."""

import contextlib
import functools
import re
import threading
import time

import harness
import numpy as np
import pytest
from commission import device, quick_text, turns
from harness import fast_config, no_figures, prove_stops

from rig.__main__ import main
from rig.command_run import Run
from rig.config import load_config
from rig.core import motion, stop
from rig.journal.device import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    STOP_PROVED,
    DeviceRecord,
)
from rig.journal.run_folder import read_journal
from rig_workbench.simulator import parse_fault


@contextlib.contextmanager
def proved(at, capsys, **options):
    """A simulated device that went through scan, home and axes."""
    with device(**options) as (sim, bus, port):
        text = quick_text(bus, port)
        if "config" in options:
            text = text.replace("leadshine_pr", options["config"].axes[0].map.name)
        (at / "rig.toml").write_text(text)
        commission(sim)
        with no_figures():
            yield sim


def commission(sim):
    """What scan, home and axes find of a simulated device, without their moves."""
    config = load_config("rig.toml")
    record = DeviceRecord.load(config.device_path)
    for state in (IDENTIFIED, HOMED):
        record.reach(state, config)
    record.reach(SIGN_CHECKED, config, turns=turns(sim, config))
    prove_stops(record, config)


def joints(sim):
    """Joint degrees by the drives' own log, from their targets and positions."""
    return [d.position / d.pulses_per_deg for d in sim.drives]


def session(capsys, *more):
    code = main(["calibrate", "--arm", "--zero", *more])
    return code, capsys.readouterr().out


def moves(sim):
    return sum(len(drive.executions) for drive in sim.drives)


@pytest.mark.slow
def test_axes_prove_the_stop_and_a_session_shows_each_axis(at, capsys):
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        assert main(["axes", "--yes"]) == 0
        found = DeviceRecord.load(at / "device.json").state(SIGN_CHECKED)["turns"]
        told = turns(sim, load_config("rig.toml"))
        np.testing.assert_allclose(found["deg"], told["deg"], atol=0.02)
        out = capsys.readouterr().out
        assert "the drives stop and do not move on: the stop of each unit" in out
        assert all(drive.stops for drive in sim.drives)
        code, said = session(capsys)
        assert code == 0, said
    record = DeviceRecord.load(at / "device.json")
    assert record.state(STOP_PROVED) and record.state(SIGN_CHECKED)["turns"]
    run = run_folder(at)
    shown = [r for r in read_journal(run / "journal.jsonl") if r["event"] == "shown"]
    assert [r["axis"] for r in shown] == ["pitch", "yaw", "roll"]
    for record in shown:
        assert record["ratio"] == pytest.approx(record["before"], rel=0.1)
        assert record["aside_deg"] < 4.0


# A: halted from outside


@pytest.mark.parametrize(
    "fault",
    [
        "halted,count=3",
        pytest.param("halted,axis=roll,count=1", marks=pytest.mark.slow),
        pytest.param("sto,count=3", marks=pytest.mark.slow),
    ],
)
def test_a_session_whose_drives_were_halted_does_not_move_again(
    fault, at, capsys, monkeypatch
):
    """It said "out of reach" and went on by itself."""
    halted = []
    emit = Run.emit

    def tell(run, event, **fields):
        record = emit(run, event, **fields)
        if event == "command" and fields["label"].startswith("select") and not halted:
            if len(run.postures()) >= 2:
                halted.append(time.monotonic())
                sim.faults.add(parse_fault(fault))
        return record

    with proved(at, capsys) as sim:
        monkeypatch.setattr(Run, "emit", tell)
        code, said = session(capsys)
        assert halted and code == 3, said
        stood, before = joints(sim), moves(sim)
        time.sleep(1.3 if "sto" in fault else 0.3)  # longer than the power was off
        assert joints(sim) == stood and moves(sim) == before
        reasons = (
            ["power stage"]
            if "sto" in fault
            else ["short of its target", "does not follow"]
        )
        assert any(reason in said for reason in reasons), said
        assert "last moved" in said
        run = run_folder(at)
        recorded = len(postures(run))
        sim.faults.clear()
        assert main(["resume", str(run), "--arm"]) == 0, capsys.readouterr().out
        assert len(postures(run)) > recorded


def run_folder(at):
    return next(iter((at / "runs").glob("calibrate-*")))


def postures(run):
    return [r for r in read_journal(run / "journal.jsonl") if r["event"] == "posture"]


@pytest.mark.slow
def test_a_place_where_an_axis_ends_twice_is_out_of_reach(at, capsys):
    """An obstacle in one posture, and the drive says nothing; going on is typed."""
    with proved(at, capsys) as sim:
        roll = sim.drives[2]

        @functools.cache
        def furthest():
            """Pulses of roll in the planned posture that is furthest."""
            records = read_journal(run_folder(at) / "journal.jsonl")
            plan = next(record for record in records if record["event"] == "plan")
            return max(plan["candidates"][i][2] for i in plan["choice"]["indices"])

        def start(begin=roll._start):
            begin()
            if roll.target == furthest():
                roll.target -= round(2.0 * roll.pulses_per_deg)

        roll._start = start
        code, said = session(capsys)
        assert code == 3 and "roll stopped" in said, said
        assert "It ended there before" not in said
        before, run = moves(sim), run_folder(at)
        code, said = main(["resume", str(run), "--arm"]), capsys.readouterr().out
        assert moves(sim) > before
        assert code in (0, 1) and "It ended there before" in said, said
    measured = [record["pulses"][2] for record in postures(run)]
    assert furthest() not in measured and len(measured) >= 4


def real_limits(monkeypatch):
    """Speeds and looks as sessions of a device have them, not as the harness does."""
    verify_s, stand_s, too_fast = harness.AS_OF_A_DEVICE
    monkeypatch.setattr(stop, "VERIFY_S", verify_s)
    monkeypatch.setattr(stop, "stand_s", stand_s)
    monkeypatch.setattr(motion, "TOO_FAST", too_fast)


# B, I: what a joint turns is not what it turned


@pytest.mark.parametrize(
    ("axis", "factor"),
    [
        ("roll", 2),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in [
                ("pitch", 2),
                ("yaw", 3),
                ("roll", 5),
                ("pitch", 5),
                ("yaw", 1 / 3),
            ]
        ),
    ],
)
def test_a_gearing_that_was_changed_since_is_found_in_small_moves(
    axis, factor, at, capsys
):
    with proved(at, capsys) as sim:
        sim.faults.add(parse_fault(f"regeared,axis={axis},factor={factor}"))
        begun, far = sim.plant.joints(), np.zeros(3)
        attitude = sim.plant.attitude

        def watched():
            far[:] = np.maximum(far, np.abs(sim.plant.joints() - begun))
            return attitude()

        sim.plant.attitude = watched
        code, said = session(capsys)
        assert code == 3, said
        assert axis in said and "`axes` measured" in said
        assert far.max() < 5.0, far
    record = DeviceRecord.load(at / "device.json")
    assert record.state(SIGN_CHECKED) is None


def test_a_phone_that_was_turned_on_its_holder_is_found(at, capsys):
    """A was wrong by .15, with exit code 0."""
    with proved(at, capsys) as sim:
        sim.faults.add(parse_fault("phone_turned"))
        code, said = session(capsys)
        assert code == 3 and "the phone or its holder was turned" in said
    record = DeviceRecord.load(at / "device.json")
    assert record.state(SIGN_CHECKED) is None


@pytest.mark.slow
def test_a_session_ends_well_at_the_limits_of_a_real_device(at, capsys, monkeypatch):
    """The harness allows drives that are quicker than told, and looks briefly."""
    real_limits(monkeypatch)
    with proved(at, capsys, speedup=1.0):
        code, said = session(capsys)
        assert code == 0, said
        assert "pitch, yaw, roll: acknowledged, at rest" in said


# C: speed


@pytest.mark.parametrize("factor", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_a_drive_that_ignores_its_speed_is_named(factor, at, capsys, monkeypatch):
    monkeypatch.setattr(motion, "TOO_FAST", 1.6)
    with proved(at, capsys, speedup=1.0) as sim:
        sim.faults.add(parse_fault(f"fast_drive,axis=yaw,factor={factor}"))
        text = (at / "rig.toml").read_text().replace("deg_s = 400", "deg_s = 20")
        (at / "rig.toml").write_text(text.replace("_s2 = 8000", "_s2 = 400"))
        code, said = session(capsys)
        assert code == 3, said
        assert "yaw moves at" in said and "instead of the commanded" in said, said


@pytest.mark.slow
def test_axes_stop_a_drive_that_is_too_fast(at, capsys, monkeypatch):
    monkeypatch.setattr(motion, "TOO_FAST", 1.6)
    with device(speedup=1.0) as (sim, bus, port):
        text = quick_text(bus, port).replace("deg_s = 400", "deg_s = 20")
        (at / "rig.toml").write_text(text.replace("_s2 = 8000", "_s2 = 400"))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        sim.faults.add(parse_fault("fast_drive,axis=yaw,factor=20"))
        assert main(["axes", "--yes"]) == 3
        assert "yaw moves at" in capsys.readouterr().out
        sim.faults.clear()
        assert main(["axes", "--yes"]) == 0


# D, E: the stop


@pytest.mark.parametrize(
    "axes", ["", pytest.param(",axis=pitch", marks=pytest.mark.slow)]
)
def test_a_stop_that_does_nothing_is_found_in_axes(axes, at, capsys):
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        sim.faults.add(parse_fault(f"stop_ignored{axes}"))
        assert main(["axes", "--yes"]) == 3
        assert "pitch" in (said := capsys.readouterr().out)
        assert "moved on to the target after the stop of each unit" in said
        record = DeviceRecord.load(at / "device.json")
        assert record.state(SIGN_CHECKED) and not record.state(STOP_PROVED)
        assert main(["calibrate", "--arm", "--zero"]) == 2
        assert "not STOP_PROVED" in capsys.readouterr().err


@pytest.mark.slow
def test_a_drive_that_goes_on_after_its_stop_is_seen_in_axes(at, capsys, monkeypatch):
    monkeypatch.setattr(stop, "stand_s", lambda drives: 0.6)
    with device() as (sim, bus, port):
        (at / "rig.toml").write_text(quick_text(bus, port))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        sim.faults.add(parse_fault("stop_resumes,axis=roll,seconds=0.3"))
        assert main(["axes", "--yes"]) == 3
        assert "roll moved again after the stop of each unit" in capsys.readouterr().out


@pytest.mark.slow
def test_a_session_that_was_stopped_looks_whether_its_drives_stay(
    at, capsys, monkeypatch
):
    """E: they went on to the old target a second later, when the session had ended."""
    real_limits(monkeypatch)
    stopped = []

    def strike(run, event, emit=Run.emit, **fields):
        record = emit(run, event, **fields)
        if event == "command" and fields["label"].startswith("select"):
            if not stopped and abs(fields["pulses"] - fields["start"]) > 1000:
                stopped.append(fields["label"])
                stop = functools.partial(run.signals.request_stop, "a test", 143)
                threading.Timer(0.4, stop).start()
        return record

    with proved(at, capsys, speedup=0.05) as sim:
        monkeypatch.setattr(Run, "emit", strike)
        sim.faults.add(parse_fault("stop_resumes,seconds=1.5,count=1"))
        code, said = session(capsys)
        assert code == 143 and stopped, said
        assert "moved on after its stop" in said
        assert said.count("acknowledged, standing") == 3 and "at rest" in said
        time.sleep(1.0)
        stood = joints(sim)
        time.sleep(0.5)
        assert joints(sim) == stood and not any(drive.moving for drive in sim.drives)
        # Nothing is left to go on to, where the map can say so.
        for drive in sim.drives:
            assert drive._value(drive.map.move, "position") == drive.position


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "told"),
    [("", None), ("unit_stop_ignored,axis=roll", "roll moved on .* stop of each unit"),
     ("watch_ignored,axis=yaw", "yaw moved on .* their watch of the line")],
    ids=["all", "unit", "watch"],
)  # fmt: skip
def test_each_way_to_stop_is_tried_where_the_map_has_it(fault, told, at, capsys):
    generic = fast_config({'map = "leadshine_pr"': 'map = "generic"'})
    with device(config=generic, transport="rtu", speedup=1.0) as (sim, bus, port):
        text = quick_text(bus, port).replace("leadshine_pr", "generic")
        (at / "rig.toml").write_text(text.replace("[bus]", "[bus]\ntimeout_s = 0.2"))
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        if fault:
            sim.faults.add(parse_fault(fault))
        code, said = main(["axes", "--yes"]), capsys.readouterr().out
        if told:
            assert code == 3 and re.search(told, said), said
            return
        assert code == 0, said
        ways = "the stop of each unit, the broadcast stop, their watch of the line"
        assert f"the drives stop and do not move on: {ways}" in said
        assert all(drive.comm_stops == 1 for drive in sim.drives)
