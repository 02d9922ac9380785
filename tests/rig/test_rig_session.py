"""Whole sessions: calibrate, collect, verify, goto, resume."""

import csv
import dataclasses
import gc
import json
import pathlib
import re
import signal
import sys
import threading
import warnings

import numpy as np
import pytest
from harness import (
    QUIET,
    SESSION,
    commissioned,
    fast_config,
    fast_text,
    make_run,
    notes_of,
    on_phase,
    session,
    simulator,
)
from scipy import special

import jaxcal
from rig.__main__ import main
from rig.command_run import run_safely
from rig.config import parse_config
from rig.faults import Refused
from rig.journal.run_folder import read_journal
from rig.procedures.calibrate import calibrate, collect
from rig.procedures.plan import choose, draw
from rig_workbench.simulator import Truth

TRUTH = np.column_stack([Truth().matrix, Truth().bias])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A noisy calibration that ended well, with what it said."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    text = fast_text(session='\n[session]\nmethod = "exact"\n')
    config = parse_config(text)
    said = []
    with simulator(config, noise_deg=0.005) as sim:
        code = session(sim.start(), folder, sim, said, figures=True)
    assert code == 0, said
    return folder, said


@pytest.mark.slow
def test_the_truth_lies_in_the_stated_intervals(finished):
    summary = json.loads((finished[0] / "summary.json").read_text())
    found = np.column_stack([summary["A"], summary["b"]])
    ratio = np.abs(found - TRUTH) / np.array(summary["ci95"])
    assert ratio.max() < 1.5  # 95 % of sessions stay under 1
    saved = jaxcal.Calibration.load(finished[0] / "calibration.json")
    wide = np.sqrt(np.diag(saved.covariance))
    flat = np.concatenate(
        [*np.array(summary["ci95"])[:, :3], np.array(summary["ci95"])[:, 3]]
    )
    # Student's t of the degrees of freedom, by one standard error of each.
    wide *= special.stdtrit(summary["dof"], 1 - 0.025 / 12)
    np.testing.assert_allclose(flat, wide, rtol=1e-6)
    assert summary["after"]["rms"] < 0.1 < 1.0 < summary["before"]["rms"]


def test_everything_is_saved_and_loads(finished):
    folder, _ = finished
    loaded = jaxcal.Calibration.load(folder / "calibration.json")
    np.testing.assert_allclose(loaded.matrix, TRUTH[:, :3], atol=0.01)
    assert len(loaded.provenance["notes"]["zero_pulses"]) == 3
    rows = list(csv.DictReader((folder / "pairs.csv").open()))
    assert [row["role"] for row in rows].count("select") == 4
    for row in rows:
        pulses = [int(row[f"pulses_{axis}"]) for axis in ("pitch", "yaw", "roll")]
        angle = float(row["u_deg_pitch"])
        assert angle == pytest.approx(pulses[0] * 360 / (10000 * 10), abs=1e-6)
    page = (folder / "report.html").read_text()
    assert page.count("data:image/svg+xml;base64,") == 2
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert "no patient" in page


def test_the_choice_is_shown_before_anything_moves(finished):
    _, said = finished
    shown = next(i for i, line in enumerate(said) if "log det" in line)
    armed = next(i for i, line in enumerate(said) if line.startswith("armed"))
    assert shown < armed
    assert "D-efficiency" in said[shown] and "proven optimum" in said[shown]


def test_progress_tells_the_time_left(finished):
    assert any(re.search(r"\[ *3/14\].*about \d+ s left", line) for line in finished[1])


def test_held_out_postures_are_not_the_chosen_ones(finished):
    records = read_journal(finished[0] / "journal.jsonl")
    postures = {r["name"]: tuple(r["pulses"]) for r in records if "samples" in r
                and r["event"] == "posture"}  # fmt: skip
    chosen = {p for name, p in postures.items() if name.startswith("select")}
    held = {p for name, p in postures.items() if not name.startswith("select")}
    assert len(chosen) == 4 and not chosen & held


def test_a_finished_run_resumes_to_the_same_without_moving(finished, tmp_path):
    folder, _ = finished
    before = (folder / "summary.json").read_text()
    code = session(parse_config(fast_text(session='\n[session]\nmethod = "exact"\n')),
                   folder)  # fmt: skip
    assert code == 0
    assert json.loads((folder / "summary.json").read_text()) == json.loads(before)


def test_resume_refuses_a_changed_configuration(finished):
    changed = parse_config(fast_text({"std_deg = 0.1": "std_deg = 0.2"}))
    named = r"rig\.toml has changed.*settle\.std_deg: was 0\.1, is 0\.2"
    with pytest.raises(ValueError, match=named):
        make_run(
            changed, finished[0], "calibrate", [].append,
            record=commissioned(changed, finished[0]),
        )  # fmt: skip


def test_a_changed_verify_limit_does_not_keep_a_run_from_resuming(finished, tmp_path):
    limits = "verify_limit_deg = 9.0\nreference_tolerance_deg = 3.0\n"
    table = '\n[session]\nmethod = "exact"\n' + limits
    judged = parse_config(fast_text({"stall_s = 0.3": "stall_s = 0.4"}, session=table))
    record = commissioned(judged, finished[0])
    make_run(judged, finished[0], "calibrate", [].append, record=record).journal.close()
    other = parse_config(fast_text({"samples = 5": "samples = 6"}, session=table))
    with pytest.raises(ValueError, match=r"settle.samples: was 5, is 6"):
        make_run(other, finished[0], "calibrate", [].append, record=record)


def test_a_resume_that_is_refused_before_it_moves_is_bad_input(tmp_path):
    """Moves of the session before it are no reason to call it a fault."""
    config, said = fast_config(), []

    def pause(run, phase):
        if phase == "settling":
            signal.raise_signal(signal.SIGINT)

    def refuse(run):
        raise Refused("not confirmed")

    with simulator(config) as sim:
        served = sim.start()
        assert session(served, tmp_path, sim, listeners=[pause]) == 4
        events = [r["event"] for r in read_journal(tmp_path / "journal.jsonl")]
        assert events.count("pausing") == 1
        assert events.index("pausing") < events.index("paused")
        record = commissioned(served, tmp_path)
        run = make_run(served, tmp_path, "calibrate", said.append, record=record)
        run.confirm = refuse
        moves = [list(ran) for ran in sim.executions()]
        assert run_safely(run, calibrate) == 2
        assert sim.executions() == moves
    assert any(line.startswith("refused: not confirmed") for line in said)


def test_resume_checks_the_reference_posture_first(tmp_path):
    config = fast_config()
    with simulator(config) as sim:
        served, said, pressed = sim.start(), [], []

        def press_once(run, phase):
            if len(run.journal.events("posture")) == 2 and not pressed:
                pressed.append(True)
                signal.raise_signal(signal.SIGINT)

        assert session(served, tmp_path / "run", sim, said, [press_once]) == 4
        ran = sum(map(len, sim.executions()))
        plant = sim.plant
        plant.truth = Truth(noise_deg=0.0, heading_deg=plant.truth.heading_deg + 3.0)
        assert session(served, tmp_path / "run", sim, said) == 3
        assert "the phone or the device was moved" in said[-2]
        postures = read_journal(tmp_path / "run/journal.jsonl")
        assert sum(r["event"] == "posture" for r in postures) in (2, 3)
        assert sum(map(len, sim.executions())) > ran


def test_a_posture_out_of_reach_is_masked_and_the_rest_selected_again(tmp_path):
    text = fast_text(session=SESSION + "max_unreachable = 40\nseed = 3\n")
    config, said = parse_config(text), []
    with simulator(config, travel_deg=(-20, 14)) as sim:
        code = session(sim.start(), tmp_path / "run", sim, said)
    records = read_journal(tmp_path / "run/journal.jsonl")
    lost = {r["name"] for r in records if r["event"] == "unreachable"}
    assert code == 0, said[-5:]
    assert any(name.startswith("select") for name in lost)
    replans = [r["choice"]["indices"] for r in records if r["event"] == "replan"]
    for number, indices in enumerate(replans):
        gone = sorted(lost, key=[r.get("name") for r in records].index)[: number + 1]
        assert not {f"select:{i}" for i in indices} & set(gone)
    measured = [r for r in records if r["event"] == "posture"]
    assert sum(r["role"] == "select" for r in measured) == 4
    found = json.loads((tmp_path / "run/summary.json").read_text())
    np.testing.assert_allclose(
        np.column_stack([found["A"], found["b"]]), TRUTH, atol=1e-3
    )


def test_a_disk_that_fills_while_saving_loses_nothing(tmp_path, monkeypatch):
    def full(path, text):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rig.journal.run_folder.write_text", full)
    said = []
    with simulator(fast_config()) as sim:
        config = sim.start()
        assert session(config, tmp_path, sim, said) == 3
        assert f"fault: cannot write to {tmp_path}: No space left on device" in said
        assert all(drive.stops for drive in sim.drives)
        moves = [list(drive.executions) for drive in sim.drives]
        monkeypatch.undo()
        assert session(config, tmp_path) == 0
        assert [list(drive.executions) for drive in sim.drives] == moves
    assert (tmp_path / "report.html").is_file()


def test_a_stop_that_is_lost_while_planning_opens_no_port(tmp_path, monkeypatch):
    """As where it comes in a garbage collection, whose exceptions are dropped."""
    said = []

    def lost(config, candidates):
        runs[0].signals.request_stop("SIGTERM", 143)
        return choose(config, candidates)

    monkeypatch.setattr("rig.procedures.calibrate.choose", lost)
    config = fast_config()
    runs = [make_run(config, tmp_path, "calibrate", said.append,
                record=commissioned(config, tmp_path))]  # fmt: skip
    assert run_safely(runs[0], calibrate) == 143
    assert said[0].startswith("planning: 4 of 50 candidates by exact")
    assert not any(line.startswith("IMU") for line in said)


def test_too_many_out_of_reach_is_a_fault(tmp_path):
    text = fast_text(session=SESSION + "max_unreachable = 1\nseed = 3\n")
    config, said = parse_config(text), []
    with simulator(config, travel_deg=(-14, 12)) as sim:
        assert session(sim.start(), tmp_path / "run", sim, said) == 3
    assert any("max_unreachable" in line for line in said)


def test_a_terminal_that_goes_away_stops_the_run_and_not_the_stop(tmp_path):
    config = fast_config()
    folder = tmp_path / "run"
    folder.mkdir()
    with simulator(config) as sim:
        served = sim.start()

        def broken(text):
            if "1/8" in text or "stop" in text or "acknowledged" in text:
                raise BrokenPipeError("Broken pipe")

        record = commissioned(served, folder)
        run = make_run(served, folder, "calibrate", broken, record=record)
        run.listeners.append(sim.answer)
        assert run_safely(run, calibrate) == 3
        assert all(drive.stops for drive in sim.drives)
        assert read_journal(folder / "journal.jsonl")[-1]["event"] == "stopped"
        assert session(served, folder, sim) == 0


@pytest.mark.slow
def test_held_out_targets_are_drawn_again_when_a_chosen_posture_is_void(tmp_path):
    """A slip found during verification: the first calibration was wrong."""
    config = fast_config()
    with simulator(config) as sim:
        served, folder, pressed = sim.start(), tmp_path / "run", []

        def press(run, phase):
            if {"before:0", "after:0"} & set(run.postures()):
                if not pressed:
                    pressed.append(True)
                    run.journal.write("void", names=[next(iter(run.postures()))])
                    signal.raise_signal(signal.SIGINT)

        assert session(served, folder, sim, listeners=[press]) == 4
        assert session(served, folder, sim) == 0
    records = read_journal(folder / "journal.jsonl")
    assert sum(r["event"] == "held_out" for r in records) == 2
    voided = [r["names"] for r in records if r["event"] == "void"]
    assert any(name.startswith(("before", "after")) for name in voided[-1])
    found = json.loads((folder / "summary.json").read_text())
    assert found["after"]["max"] < 0.01


def test_collect_records_a_dataset_and_resumes(tmp_path):
    config, said = fast_config(), []
    folder = tmp_path / "collection"
    folder.mkdir()
    with simulator(config) as sim:
        served, pressed = sim.start(), []

        def once():
            record = commissioned(served, folder)
            run = make_run(served, folder, "collect", said.append, record=record)
            run.listeners.append(sim.answer)

            def press(phase):
                if len(run.journal.events("posture")) == 3 and not pressed:
                    pressed.append(True)
                    signal.raise_signal(signal.SIGINT)

            on_phase(run, press)
            return run_safely(run, lambda r: collect(r, 8))

        assert once() == 4
        assert once() == 0
    data = np.load(folder / "dataset.npz")
    assert data["candidates"].shape == data["measured"].shape == (1, 8, 3)
    predicted = data["candidates"] @ TRUTH[:, :3].T + TRUTH[:, 3]
    np.testing.assert_allclose(data["measured"], predicted, atol=1e-3)
    low, high = np.array(config.ranges).T
    assert (data["candidates"] >= low - 0.01).all()
    assert (data["candidates"] <= high + 0.01).all()


# By the command line


@pytest.mark.slow
def test_verify_and_goto_use_a_saved_calibration(finished, tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text())
    given = [str(finished[0]), "--config", str(path), "--simulate", *QUIET]
    assert main(["verify", *given, "--count", "2", "--out", str(tmp_path / "v")]) == 0
    assert "still holds" in capsys.readouterr().out
    assert main(["goto", *given, "--to", "2", "-3", "4",
                 "--out", str(tmp_path / "g")]) == 0  # fmt: skip
    reached = re.search(r"off by \[(.*)\]", capsys.readouterr().out)
    assert max(abs(float(v)) for v in reached.group(1).split(",")) < 0.1


@pytest.mark.slow
def test_verify_says_when_it_is_time_to_recalibrate(finished, tmp_path, capsys):
    """A calibration whose device has changed since."""
    stale = jaxcal.identify(
        np.vstack([np.zeros(3), 10 * np.eye(3)]),
        np.vstack([np.zeros(3), 10 * np.eye(3)]) @ TRUTH[:, :3].T + TRUTH[:, 3] + 1.0,
        noise_std=0.01,
        notes=notes_of(fast_config()),
    )
    stale.save(tmp_path / "calibration.json")
    path = tmp_path / "rig.toml"
    path.write_text(fast_text())
    given = [str(tmp_path), "--config", str(path), "--simulate", *QUIET]
    code = main(["verify", *given, "--count", "2", "--out", str(tmp_path / "v")])
    assert code == 1
    said = capsys.readouterr().out
    assert "RECALIBRATE" in said and "Run `jaxcal-rig calibrate`" in said
    assert "good; next" not in said


@pytest.mark.slow
def test_goto_refuses_what_the_limits_do_not_reach(finished, tmp_path, capsys):
    code = main(["goto", str(finished[0]), "--simulate", "--to", "40", "0", "0",
                 "--out", str(tmp_path)])  # fmt: skip
    assert code == 2
    assert "(limits " in capsys.readouterr().out


def test_a_session_leaves_no_thread_and_no_open_socket(tmp_path):
    before = set(threading.enumerate())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        with simulator(fast_config()) as sim:
            assert session(sim.start(), tmp_path / "run", sim) == 0
        gc.collect()
    assert not [str(w.message) for w in caught if w.category is ResourceWarning]
    assert set(threading.enumerate()) <= before


def test_without_matplotlib_the_report_says_that_figures_are_missing(
    finished, tmp_path, monkeypatch
):
    from rig_workbench.outputs.report import write_report

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    summary = json.loads((finished[0] / "summary.json").read_text())
    records = read_journal(finished[0] / "journal.jsonl")
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    page = write_report(tmp_path, records).read_text()
    assert page.count("matplotlib is not installed") == 2 and "data:image" not in page


def test_run_folders_are_never_reused(tmp_path):
    from rig.journal.run_folder import new_run_folder

    folders = {new_run_folder(tmp_path, "calibrate") for _ in range(5)}
    assert len(folders) == 5
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ValueError, match="cannot make"):
        new_run_folder(pathlib.Path(blocked), "calibrate")


def test_a_plan_that_leaves_the_limits_is_refused_before_arming(tmp_path):
    config = fast_config()
    folder = tmp_path / "run"
    folder.mkdir()
    said = []
    record = commissioned(config, folder)
    run = make_run(config, folder, "calibrate", said.append, record=record)
    wild = draw(config, config.session.candidates)
    wild[:, 0] = 99999
    choice = choose(config, config.to_deg(draw(config, config.session.candidates)))
    run.journal.write(
        "plan", candidates=wild.tolist(), choice=dataclasses.asdict(choice)
    )
    assert run_safely(run, calibrate) == 2
    assert any("outside the limits" in line for line in said)
