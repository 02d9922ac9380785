"""What the live page shows, from records alone: no browser, no web framework."""

import itertools
import json
import pathlib
import re
import tempfile
import time

import numpy as np
import pytest
from harness import fast_config, fast_text, session, simulator
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.config import parse_config
from rig.journal.run_folder import Journal, is_written, read_journal
from rig.outputs.run_state import RunState
from rig_workbench import live
from rig_workbench.live import charts
from rig_workbench.live.watcher import Tail, Watcher
from rig_workbench.outputs import view


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder and configuration of a finished calibration."""
    folder = tmp_path_factory.mktemp("live") / "run"
    config = fast_config()
    with simulator(config) as sim:
        assert session(sim.start(), folder, sim) == 0
    return folder, config


def queue(state):
    return live.draw("queue", postures=view.queue(state), count=len(state.postures))


def trouble(state, running, folder):
    return live.draw("trouble", lines=view.trouble(state, running, folder))


AXES = ["pitch", "yaw", "roll"]


def numbers(state, running):
    return live.draw(
        "numbers",
        rows=view.numbers(state.present({}, running), running, state.names),
    )


def waiting(state):
    return [p.name for p in state.postures.values() if p.state == "waiting"]


def state_of(records):
    state = RunState()
    for record in records:
        state.apply(record)
    return state


def begun(**more):
    """Records with which a run of three postures begins."""
    config = parse_config(fast_text()).described()
    candidates = [[100 * i, -50 * i * i, 300 - i] for i in range(6)]
    choice = {"indices": [4, 1, 3], "method": "exact", "log_det": 1.0}
    records = [
        {"event": "start", "mode": "calibrate", "config": config, "pid": 7} | more,
        {"event": "plan", "candidates": candidates, "choice": choice},
        {"event": "queue", "names": ["select:3", "select:4", "select:1"]},
        {"event": "visit", "name": "select:3", "pulses": candidates[3]},
    ]
    return numbered(json.loads(json.dumps(records)))


def numbered(records):
    return [{"seq": i, "time": 100.0 + i} | r for i, r in enumerate(records)]


def posture(name, **more):
    values = {"pulses": [0, 0, 0], "measured_deg": [1.0, 2.0, 3.0], "samples": 4}
    return {"event": "posture", "name": name, "std_deg": [0.1] * 3} | values | more


def test_a_finished_run_shows_what_its_journal_holds(run):
    folder, config = run
    records = read_journal(folder / "journal.jsonl")
    state = state_of(records)
    measured = [r for r in records if r["event"] == "posture"]
    assert [p.name for p in state.done] == [r["name"] for r in measured]
    for shown, record in zip(state.done, measured, strict=True):
        assert shown.measured == record["measured_deg"]
        wanted = config.to_deg(record["pulses"])
        np.testing.assert_allclose(shown.commanded, wanted, atol=1e-6)
    assert state.planned == len(measured)
    assert not waiting(state)
    assert not state.damaged
    assert view.headline(state, running=False) == ("good", "Done")
    assert not view.trouble(state, False, "run")
    end = [r for r in measured if r["role"] == "reference"][-1]
    assert state.drift[-1][1] == end["measured_deg"]


def test_every_moment_of_a_run_can_be_drawn(run):
    state = RunState()
    for record in read_journal(run[0] / "journal.jsonl"):
        state.apply(record)
        now, said = view.headline(state, True), view.progress(state)
        for text in (
            live.draw("head", state=state, now=now, said=said, folder="run"),
            queue(state),
            live.draw(
                "numbers",
                rows=view.numbers(state.present({}, True), True, state.names),
            ),
            trouble(state, True, "run"),
            live.draw("log", lines=state.log),
        ):
            assert "nan" not in text and "None" not in text
        samples = [{"time": state.time, "drives": [None] * 3, "deg": [1, 2, 3]}]
        drawn = charts.charts(state, samples, state.time)
        json.dumps(drawn, allow_nan=False)


def test_places_of_a_commissioning_step_are_shown_and_what_goes_on_is_the_step():
    stand = posture("pitch:plus", pulses=[100, 0, 0]) | {"event": "stand"}
    start = begun(mode="axes")[0]
    fault = {"event": "fault", "code": 3, "reason": "the phone fell silent"}
    state = state_of(numbered([start, stand, fault]))
    assert "pitch:plus" in queue(state)
    commanded = view.angle(state.to_deg([100, 0, 0])[0])
    for running in (True, False):
        assert commanded in numbers(state, running)
    told = trouble(state, False, "runs/axes")
    assert "To continue: jaxcal-rig setup axes<" in told and "resume" not in told
    killed = trouble(state_of(numbered([start, stand])), False, "runs/axes")
    assert "To continue: jaxcal-rig setup axes<" in killed


def test_the_posture_under_way_goes_through_its_states():
    records = begun()
    seen = [state_of(records).postures["select:3"].state]
    for phase in ("moving", "settling", "measuring"):
        records += [{"event": "phase", "phase": phase}]
        seen.append(state_of(numbered(records)).postures["select:3"].state)
    assert seen == ["moving", "moving", "settling", "measuring"]
    state = state_of(numbered(records))
    assert view.headline(state, True) == ("run", "Measuring posture 3")
    records += [posture("select:3")]
    state = state_of(numbered(records))
    assert state.postures["select:3"].state == "done"
    assert waiting(state) == ["select:4", "select:1"]


def test_out_of_reach_and_withdrawn_postures_say_why():
    records = [
        *begun(),
        {"event": "unreachable", "name": "select:3", "reason": "yaw ended short <b>"},
        posture("select:4"),
        {"event": "void", "names": ["select:4"]},
    ]
    state = state_of(numbered(records))
    shown = queue(state)
    assert "yaw ended short &lt;b&gt;" in shown and "an axis slipped" in shown
    assert not state.done
    again = [*records, {"event": "queue", "names": ["select:4", "select:1"]}]
    assert state_of(numbered(again)).postures["select:4"].state == "waiting"


def test_what_a_session_warned_of_is_in_sight():
    records = [*begun(), {"event": "sender_refused", "reason": "a second phone"}]
    assert "a second phone" in trouble(state_of(numbered(records)), True, "run")


def test_the_queue_shows_the_present_then_what_comes_then_the_newest():
    records = [
        *begun(),
        {"event": "held_out", "pairs": [[[0, 0, 0], [1, 1, 1]]]},
        posture("select:3"),
        posture("select:4"),
        {"event": "visit", "name": "select:1", "pulses": [0, 0, 0]},
    ]
    shown = re.findall(r"<b>(.*?)</b>", queue(state_of(numbered(records))))
    held_out = ["target 0, raw", "target 0, compensated"]
    assert shown == ["posture 1", *held_out, "posture 4", "posture 3"]


def test_of_a_long_queue_the_present_and_the_newest_are_shown():
    count = 100
    waiting = {"event": "collection", "pulses": [[i, 0, 0] for i in range(count)]}
    records = [*begun(mode="collect")[:1], waiting]
    records += [posture(f"collect:{i}") for i in range(60)]
    told = queue(state_of(numbered(records)))
    shown = [int(n) for n in re.findall(r"<b>posture (\d+)</b>", told)]
    assert shown == [*range(60, 80), *range(59, 39, -1)]
    assert f"{count} in all" in told


def test_another_choice_forgets_what_was_only_waiting():
    choice = {"indices": [4, 5], "method": "exact", "log_det": 1.0}
    records = [*begun(), posture("select:3"), {"event": "replan", "choice": choice}]
    state = state_of(numbered(records))
    assert set(state.postures) == {"select:3", "select:4", "select:5"}


@pytest.mark.parametrize(
    ("last", "running", "tone", "part"),
    [
        ({"event": "end", "code": 0, "reason": ""}, False, "good", "Done"),
        ({"event": "end", "code": 1, "reason": ""}, False, "warn", "recalibrate"),
        ({"event": "paused", "code": 4, "reason": "Ctrl-C"}, False, "warn", "Paused"),
        ({"event": "stopped", "code": 143, "reason": "SIGTERM"}, False, "bad", "Stop"),
        ({"event": "fault", "code": 3, "reason": "pitch stuck"}, False, "bad", "fault"),
        (None, False, "bad", "without a last record"),
        (None, True, "run", "Moving"),
    ],
)
def test_the_headline_says_how_it_stands(last, running, tone, part):
    records = [*begun(), {"event": "phase", "phase": "moving"}]
    state = state_of(numbered(records + ([last] if last else [])))
    shown = view.headline(state, running)
    assert shown[0] == tone and part in shown[1]
    told = trouble(state, running, "runs/one")
    if last and last["event"] != "end":
        assert last["reason"] in told
    if tone == "bad":
        assert "jaxcal-rig resume runs/one" in told


@pytest.mark.parametrize("event", ["fault", "stopped", "resume"])
def test_the_posture_that_was_interrupted_waits_again(event):
    records = [*begun(), {"event": "phase", "phase": "measuring"}]
    state = state_of(numbered([*records, {"event": event, "reason": "why"}]))
    assert state.postures["select:3"].state == "waiting"
    assert waiting(state) == ["select:3", "select:4", "select:1"]
    assert state.current is None


def test_a_resumed_run_is_alive_again_under_its_new_process():
    ended = {"event": "paused", "code": 4, "reason": "paused by Ctrl-C"}
    resumed = {"event": "resume", "pid": 8, "host": "here"}
    state = state_of(numbered([*begun(), ended, resumed]))
    assert (state.pid, state.host, state.ended) == (8, "here", None)


def test_what_goes_on_after_a_fault_is_what_the_console_said():
    lack = "the device is not HOMED: yaw. Run `jaxcal-rig setup home`. Then resume"
    fault = {"event": "fault", "code": 3, "reason": "alarm", "go_on": lack}
    state = state_of(numbered([*begun(), fault]))
    assert f"To continue: {lack}" in view.trouble(state, False, "runs/one")


def test_a_missing_record_is_told_and_a_foreign_one_harms_nothing(tmp_path):
    records = begun()
    del records[2]
    assert state_of(records).damaged
    lines = [*begun(), {"event": "posture", "name": 3}, {"event": "new in version 9"}]
    text = "".join(json.dumps(r) + "\n" for r in numbered(lines))
    (tmp_path / "journal.jsonl").write_text(text)
    watcher = Watcher(tmp_path)
    watcher.poll()
    assert watcher.state.damaged
    assert watcher.state.current == "select:3"
    assert not watcher.running


def test_the_last_word_of_a_session_that_ends_meanwhile_is_read(tmp_path, monkeypatch):
    """It was taken for one that had armed nothing: STOPPED, of no drive."""
    path = tmp_path / "journal.jsonl"
    path.write_text("".join(json.dumps(r) + "\n" for r in numbered(begun())))
    unit = {"axis": "yaw", "unit": 2, "acknowledged": True, "standing": True}

    def ends(journal):
        with path.open("a") as file:
            record = {"event": "stop", "reason": "SIGTERM", "units": [unit]}
            file.write(json.dumps(record | {"time": time.time()}) + "\n")
        return False

    watcher = Watcher(tmp_path)
    monkeypatch.setattr(watcher, "ask", lambda number: None)
    monkeypatch.setattr("rig_workbench.live.watcher.is_written", ends)
    assert [each.axis for each in watcher.stop()] == ["yaw"]


@settings(deadline=None)
@given(
    st.lists(st.integers(0, 10**9), max_size=12),
    st.lists(st.integers(1, 40), min_size=1, max_size=20),
)
def test_a_tail_gives_each_record_once_however_the_bytes_arrive(numbers, sizes):
    data = b"".join(json.dumps({"n": n}).encode() + b"\n" for n in numbers)
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "file.jsonl"
        tail, found = Tail(path), list(Tail(path).read())
        for size in itertools.cycle(sizes):
            with path.open("ab") as file:
                file.write(data[:size])
            data = data[size:]
            found += tail.read()
            if not data:
                break
    assert [record["n"] for record in found] == numbers


def test_a_tail_follows_a_file_that_was_replaced(tmp_path):
    path = tmp_path / "telemetry.jsonl"
    path.write_text('{"n":1}\n{"n":2}\n')
    tail = Tail(path)
    assert len(tail.read()) == 2
    path.rename(tmp_path / "old")
    assert tail.read() == []
    path.write_text('{"n":3}\n')
    assert tail.read() == [{"n": 3}]


def test_a_session_is_known_by_the_lock_on_its_journal(tmp_path):
    path = tmp_path / "journal.jsonl"
    assert not is_written(path)
    journal = Journal(path)
    assert is_written(path)
    journal.close()
    assert not is_written(path)
    asked = [is_written(path) for _ in range(50)]
    Journal(path).close()  # asking has left nothing behind
    assert not any(asked)


def test_a_run_that_is_over_shows_no_difference():
    now = {"commanded": [1, 2, 3], "drives": [0, 0, 0], "measured": [9, 9, 9]}
    now["std"] = [0.1, 0.1, 0.1]
    while_running, after = (
        view.numbers(now, running, (AXES, AXES)) for running in (True, False)
    )
    assert [row[4] for row in while_running] == [view.angle(d) for d in (8, 7, 6)]
    assert {row[4] for row in after} == {view.angle(None)}
    assert [row[:4] for row in after] == [row[:4] for row in while_running]
