"""Play, dead zone and breakaway, found in a closed loop over the real protocol."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest
from harness import (
    Simulator,
    commissioned,
    fast_config,
    fast_text,
    free_port,
    simulator,
)

from rig.config import AXIS_NAMES
from rig.journal.run_folder import read_journal
from rig.prove import steps
from rig.prove.steps import Operator
from rig_workbench.commission import characterise
from rig_workbench.commission.characterise import ENOUGH_DEG
from rig_workbench.simulator import Truth

pytestmark = pytest.mark.slow  # minutes together


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """Measure an axis of a simulated device: exit code, record, text."""
    monkeypatch.setattr("rig.core.proof.SLOW_DEG_S", 400.0)

    def measure(axis, **truth):
        config = fast_config().model_copy(update={"output": str(tmp_path)})
        told = []
        with simulator(config, truth=Truth(**truth)) as sim:
            served = sim.start()
            record = commissioned(served, tmp_path)
            place = steps.Site(
                served, record, Operator(yes=True, say=told.append),
                full_speed=True, listeners=(sim.answer,),
            )  # fmt: skip
            code = characterise.step(place, AXIS_NAMES[axis])
        runs = tmp_path.glob("characterise-*/journal.jsonl")
        records = read_journal(max(runs, key=lambda path: path.stat().st_mtime_ns))
        return code, records, "\n".join(told)

    return measure


def check(found, **true):
    """Intervals hold what they are of; those of the breakaway end at a width.

    An unlucky 95 % interval is off by some of its standard deviations of 0.005.
    """
    for name, value in true.items():
        each = found[name]
        for interval in each if isinstance(each, list) else [each]:
            assert interval["low"] - 0.01 <= value <= interval["high"] + 0.01, name
            if name == "breakaway_deg":
                assert interval["high"] - interval["low"] <= ENOUGH_DEG


@pytest.mark.parametrize(
    ("axis", "play", "zone", "breakaway"),
    [(0, 0.31, 0.2, 0.123), (2, 0.0, 0.0, 0.0), (1, 0.6, 0.35, 0.3)],
)
def test_each_lies_in_a_narrow_interval(measured, axis, play, zone, breakaway):
    code, records, told = measured(
        axis, noise_deg=0.005, backlash_deg=play, dead_zone_deg=zone,
        breakaway_deg=breakaway, dead_centre_deg=0.05,
    )  # fmt: skip
    assert code == 0, told
    (found,) = [record for record in records if record["event"] == "characterised"]
    check(found, backlash_deg=play, dead_zone_deg=zone, breakaway_deg=breakaway)
    assert found["dead_zone_at_deg"] == pytest.approx(Truth().jig_deg[axis], abs=1e-3)
    stands = [record for record in records if record["event"] == "stand"]
    assert len(stands) == found["measurements"]
    assert "motion.approach_overshoot_deg" in told


@pytest.mark.parametrize(
    ("truth", "says"),
    [
        ({"backlash_deg": 1.45}, "of play; the search ends at 1.5 deg"),
        ({"dead_zone_deg": 1.1}, "of dead zone; the search ends at 0.8 deg"),
        ({"breakaway_deg": 0.8}, "of breakaway; the search ends at 0.691 deg"),
    ],
)
def test_more_than_is_looked_for_is_said(measured, truth, says):
    code, records, told = measured(2, noise_deg=0.005, **truth)
    assert code != 0
    assert says in told
    assert not [record for record in records if record["event"] == "characterised"]


def test_no_room_is_said_before_anything_moves(measured, monkeypatch):
    monkeypatch.setattr(characterise, "FAR_DEG", 170.0)
    code, records, told = measured(0, noise_deg=0.005)
    assert code != 0
    assert "of room upwards" in told
    assert not [record for record in records if record["event"] == "command"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_one_that_is_ended_on_the_way_stands_and_begins_anew(tmp_path, number):
    """After a kill the drives end the small move that they were told; nothing else.

    Where they then stand was not noted, so they must be homed again.
    """
    port = free_port()
    with Simulator(fast_config(), Truth(noise_deg=0.005), rate_hz=250.0) as sim:
        bus = sim.start().bus
        text = fast_text({"port = 5020": f"port = {bus.port}",
                          "port = 2055": f"port = {port}"})  # fmt: skip
        path = tmp_path / "rig.toml"
        path.write_text(text.replace('output = "runs"', f'output = "{tmp_path}/runs"'))
        commissioned(fast_config(), tmp_path)
        sim.start_phone(port)
        command = [sys.executable, "-m", "rig", "characterise", "roll", "--yes",
                   "--config", str(path)]  # fmt: skip
        environment = os.environ | {
            "PYTHONPATH": str(pathlib.Path(__file__).parents[2])
        }
        with subprocess.Popen(command, env=environment, cwd=tmp_path) as child:
            end = time.monotonic() + 120
            while not moved(tmp_path, 6):
                assert child.poll() is None and time.monotonic() < end
                time.sleep(0.01)
            child.send_signal(number)
            code = child.wait(30)
        assert code == (143 if number == signal.SIGTERM else -number)
        time.sleep(1.0)
        for drive in sim.drives:
            with sim.server.lock:
                drive.advance()
            assert not drive.moving
            assert drive.stops or number == signal.SIGKILL
        again = subprocess.run(command, env=environment, cwd=tmp_path, check=False)
        assert again.returncode == (0 if number == signal.SIGTERM else 2)
    first, second = sorted(tmp_path.glob("runs/characterise-*/journal.jsonl"))
    assert read_journal(first)[-1]["event"] != "end"
    found = [r for r in read_journal(second) if r["event"] == "characterised"]
    assert bool(found) == (number == signal.SIGTERM)


def moved(folder, stands):
    """So many places were measured."""
    text = "".join(p.read_text() for p in folder.glob("runs/*/journal.jsonl"))
    return sum(json.loads(line)["event"] == "stand" for line in text.splitlines()[:-1]
               ) >= stands  # fmt: skip
