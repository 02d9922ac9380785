"""A phone that comes back on a new connection may have another heading."""

import dataclasses
import threading

import numpy as np
import pytest
from harness import (
    commissioned,
    fast_config,
    make_run,
    on_phase,
    session,
    simulator,
)

from rig.command_run import run_safely
from rig.journal.run_folder import read_journal
from rig.procedures.calibrate import collect
from rig_workbench.simulator import Truth, parse_fault

TURNED = 25.0  # degrees: beyond the envelope of the limits, too


PUSHING = {'format = "hyperimu"': 'format = "sensorlogger"'}


def collected(folder, phase, heading=TURNED, drift=0.0, changes=None):
    """Code and journal of a collection; at its third posture the phone comes back."""
    folder.mkdir(exist_ok=True)
    config, done, said = fast_config(changes), [], []
    with simulator(config, truth=Truth(noise_deg=0.0)) as sim:
        served = sim.start()
        run = make_run(
            served, folder, "collect", said.append,
            record=commissioned(served, folder, sim),
        )  # fmt: skip
        run.listeners.append(sim.answer)

        def drop(entered):
            count = len(run.journal.events("posture"))
            if entered == phase and count == 3 and not done:
                done.append(True)
                truth = sim.plant.truth
                sim.plant.truth = dataclasses.replace(
                    truth, heading_deg=truth.heading_deg + heading
                )
                sim.faults.add(parse_fault("imu_disconnect,count=1"))
            if drift and count == 7:
                truth = sim.plant.truth
                sim.plant.truth = dataclasses.replace(truth, heading_deg=170.0 + drift)

        on_phase(run, drop)
        code = run_safely(run, lambda r: collect(r, 8))
    assert done
    return code, read_journal(folder / "journal.jsonl"), said


def angles(records):
    return {r["name"]: r["measured_deg"] for r in records if r["event"] == "posture"}


@pytest.mark.parametrize(
    ("phase", "changes"),
    [
        ("measuring", None),
        *(
            pytest.param(phase, None, marks=pytest.mark.slow)
            for phase in ("moving", "settling", "saving")
        ),
        # Another session of the app, on any connection.
        pytest.param("measuring", PUSHING, marks=pytest.mark.slow),
    ],
)
def test_postures_after_it_are_as_right_as_those_before(phase, changes, tmp_path):
    """E: `collect` stored every later yaw wrong and ended with 0."""
    code, plain, said = collected(
        tmp_path / "plain", phase, heading=0.0, changes=changes
    )
    assert code == 0, said[-5:]
    code, records, said = collected(tmp_path / "turned", phase, changes=changes)
    assert code == 0, said[-5:]
    found, wanted = angles(records), angles(plain)
    assert found.keys() == wanted.keys()
    for name in wanted:
        np.testing.assert_allclose(found[name], wanted[name], atol=0.01, err_msg=name)
    events = [record["event"] for record in records]
    assert "imu_reconnected" in events
    (told,) = [r for r in records if r["event"] == "reoriented"]
    assert told["turned_deg"] == pytest.approx(TURNED, abs=0.01)


def test_a_zero_that_moved_at_the_end_of_a_collection_is_told(tmp_path):
    code, _, said = collected(tmp_path / "run", "saving", heading=0.0, drift=3.0)
    assert code == 1
    assert any(
        line.startswith("RECALIBRATE: at the end the zero posture") for line in said
    )


class HeldTerminal(list):
    """Ctrl-S was pressed: what is printed after the first warning waits."""

    def __init__(self):
        self.held = threading.Event()

    def append(self, line):
        super().append(line)
        if line.startswith("WARNING"):
            self.held.wait(30)


def test_a_held_terminal_does_not_hold_the_thread_that_hears_the_phone(tmp_path):
    said, done = HeldTerminal(), []
    with simulator(fast_config()) as sim:

        def intrude(run, entered):
            if len(run.journal.events("posture")) == 2 and not done:
                done.append(entered)
                sim.faults.add(parse_fault("imu_second_sender,count=1"))

        code = session(sim.start(), tmp_path / "run", sim, said, [intrude])
    said.held.set()
    assert code == 0, said[-5:]
    assert any(line.startswith("WARNING: refused a sender") for line in said)
