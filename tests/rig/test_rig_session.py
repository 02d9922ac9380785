"""Whole sessions: calibrate, collect, verify, goto, resume, and the command line."""

import csv
import dataclasses
import gc
import importlib.util
import itertools
import json
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
from harness import (
    HASTY,
    SESSION,
    changed,
    commissioned,
    fast_config,
    fast_text,
    no_figures,
    on_phase,
    session,
    simulator,
)

import jaxcal
from rig.__main__ import main
from rig.arguments import make_parser
from rig.config import example_text, parse_config
from rig.faults import Refused
from rig.identification.fit import uncertainty
from rig.identification.orders import order_residuals
from rig.outputs.journal import read_journal
from rig.session.calibrate import calibrate
from rig.session.checking import collect
from rig.session.planning import choose, draw_candidates, travel_order
from rig.session.run import Run
from rig.session.runner import run_safely
from rig.simulator import Truth, parse_fault

TRUTH = np.column_stack([Truth().matrix, Truth().bias])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A noisy calibration that ended well, with what it said."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    text = fast_text(session='\n[session]\nmethod = "exact"\n')
    config = parse_config(text)
    said = []
    with simulator(config, noise_deg=0.02) as sim:
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
    each = np.array(summary["ci95_each"])
    flat = np.concatenate([each[:, :3].ravel(), each[:, 3]])
    ratio = flat / wide  # t with 8 degrees of freedom, 2.31, and less than that
    assert 1.7 < ratio[:9].min() < ratio[:9].max() < 2.31
    assert 1.2 < ratio[9:].min() < ratio[9:].max() < 4.0  # one ratio for three zeros
    assert summary["after"]["rms"] < 0.1 < 1.0 < summary["before"]["rms"]


@pytest.mark.slow
def test_stated_intervals_hold_the_truth_as_often_as_they_say(rng):
    """The arithmetic alone, many times: 95 % of each, and 95 % of all at once."""
    covered, all_covered = [], []
    for _ in range(300):
        u = rng.uniform(-18, 18, size=(12, 3))
        zero = rng.normal(0, 0.004, 3)
        y = u @ TRUTH[:, :3].T + TRUTH[:, 3] + rng.normal(0, 0.02, (12, 3)) - zero
        records = [
            {"commanded_deg": a, "measured_deg": b, "std_deg": [0.1] * 3, "samples": 25}
            for a, b in zip(u.tolist(), y.tolist(), strict=True)
        ]
        fitted = jaxcal.identify(u[:4], y[:4])
        stated = uncertainty(
            fitted, records[:4], records[4:], {"std_deg": [0.04] * 3, "samples": 100},
            np.zeros(3),
        )  # fmt: skip
        found = np.column_stack([fitted.matrix, fitted.bias])
        off = np.abs(found - TRUTH)
        covered.append(off <= np.array(stated["ci95_each"]))
        all_covered.append((off <= np.array(stated["ci95"])).all())
    assert 0.93 < np.mean(covered) < 0.97
    assert 0.92 < np.mean(all_covered)


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
    assert page.count("data:image/png;base64,") == 3
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
    named = r"configuration changed.*settle\.std_deg: 0\.1 then, 0\.2 now"
    with pytest.raises(Refused, match=named):
        Run(
            changed, finished[0], "calibrate", [].append,
            record=commissioned(changed, finished[0]),
        )  # fmt: skip


def test_a_changed_verify_limit_does_not_keep_a_run_from_resuming(finished, tmp_path):
    limits = "verify_limit_deg = 9.0\nreference_tolerance_deg = 3.0\n"
    table = '\n[session]\nmethod = "exact"\n' + limits
    judged = parse_config(fast_text({"stall_s = 0.3": "stall_s = 0.4"}, session=table))
    record = commissioned(judged, finished[0])
    Run(judged, finished[0], "calibrate", [].append, record=record).close()
    other = parse_config(fast_text({"samples = 5": "samples = 6"}, session=table))
    with pytest.raises(Refused, match=r"settle.samples: 5 then, 6 now"):
        Run(other, finished[0], "calibrate", [].append, record=record)


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
        run = Run(served, tmp_path, "calibrate", said.append, record=record)
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
    import rig.outputs.report

    def full(path, page):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rig.outputs.report, "write_page", full)
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

    monkeypatch.setattr("rig.session.calibrate.choose", lost)
    config = fast_config()
    runs = [Run(config, tmp_path, "calibrate", said.append,
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
        run = Run(served, folder, "calibrate", broken, record=record)
        run.on_imu_port = sim.start_phone
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
            run = Run(served, folder, "collect", said.append, record=record)
            run.on_imu_port = sim.start_phone

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


def test_the_wrong_euler_order_is_named(finished):
    records = [r for r in read_journal(finished[0] / "journal.jsonl")
               if r["event"] == "posture"]  # fmt: skip
    zero = next(r for r in read_journal(finished[0] / "journal.jsonl")
                if r["event"] == "zero")  # fmt: skip
    from rig.attitude import Frame

    config = fast_config()
    frame = Frame(np.array(zero["attitude"]), np.eye(3), "ZXY", config.letters)
    right = order_residuals(config, frame, records)
    assert right["best"] == "ZXY" and not right["warning"]
    wrong_config = parse_config(fast_text({'order = "ZXY"': 'order = "XYZ"'}))
    wrong = order_residuals(wrong_config, frame, records)
    assert "the order ZXY leaves" in wrong["warning"]


@pytest.mark.slow
def test_the_shipped_policy_makes_the_default_choice():
    """Not its stand-in: a session without a configuration selects with the policy."""
    config = parse_config(example_text("simulate"))
    candidates = config.to_deg(draw_candidates(config))
    choice = choose(config, candidates)
    assert (choice.method, choice.note, choice.proven) == ("policy", "", True)
    alone = jaxcal.select(candidates, 4, method="policy")
    assert sorted(choice.indices) == sorted(alone.indices.tolist())
    assert choice.efficiency > 0.95


def test_without_a_checkpoint_the_choice_is_the_exact_optimum(tmp_path, monkeypatch):
    from jaxcal.learning.runtime import weights

    config = parse_config(example_text("simulate"))
    candidates = config.to_deg(draw_candidates(config))
    monkeypatch.setattr(weights, "default_folder", lambda: tmp_path / "none")
    choice = choose(config, candidates)
    assert (choice.method, choice.efficiency) == ("exact", 1.0)
    assert "no policy could be used" in choice.note


def test_the_policys_place_is_taken_by_exact_when_it_is_missing_or_poor(monkeypatch):
    config = parse_config(fast_text(session=""))
    candidates = config.to_deg(draw_candidates(config))
    real = jaxcal.select

    def poor(points, k, method="policy", **options):
        if method != "policy":
            return real(points, k, method=method, **options)
        return real(points, k, method="random", **options)

    def absent(points, k, method="policy", **options):
        if method == "policy":
            raise FileNotFoundError("no checkpoint\nanywhere")
        return real(points, k, method=method, **options)

    best = float(real(candidates, 4, method="exact").log_det)
    for stand_in, part in ((poor, "D-efficiency of"), (absent, "no checkpoint")):
        monkeypatch.setattr(jaxcal, "select", stand_in)
        choice = choose(config, candidates)
        assert choice.log_det == pytest.approx(best)
        assert part in choice.note and "\n" not in choice.note


@pytest.mark.parametrize(
    "method",
    [
        "auto", "exact", "greedy", "random",
        pytest.param("exchange", marks=pytest.mark.slow),  # compiles for ten seconds
    ],
)  # fmt: skip
def test_every_method_of_a_session_makes_a_choice(method):
    text = f'\n[session]\nmethod = "{method}"\nmin_efficiency = 0.01\nseed = 3\n'
    config = parse_config(fast_text(session=text))
    degrees = config.to_deg(draw_candidates(config))
    best = jaxcal.select(degrees, 4, method="exact")
    choice = choose(config, degrees)
    assert choice.method == ("exact" if method == "auto" else method)
    assert choice.log_det <= best.log_det + 1e-9
    if method in ("auto", "exact"):
        assert choice.log_det == pytest.approx(best.log_det)
    assert ("proved" in choice.note) == (method == "auto")


@pytest.mark.parametrize("least", [0.5, 1.0])
def test_auto_answers_within_the_efficiency_asked_for(least):
    text = f'\n[session]\nmethod = "auto"\nmin_efficiency = {least}\n'
    config = parse_config(fast_text(session=text))
    degrees = config.to_deg(draw_candidates(config))
    best = jaxcal.select(degrees, 4, method="exact")
    choice = choose(config, degrees)
    assert choice.efficiency >= least - 1e-9
    assert choice.best_log_det == pytest.approx(best.log_det)


def test_travel_order_takes_the_least_time(rng):
    speeds = {"pitch": 10.0, "yaw": 20.0, "roll": 5.0}
    plain = fast_config()
    axes = (
        changed(axis, speed_deg_s=speeds[axis.name], accel_deg_s2=50.0)
        for axis in plain.axes
    )
    config = changed(plain, axes=tuple(axes))
    points = rng.uniform(-20, 20, size=(12, 3))

    def seconds(order, points=points):
        """Trapezoid profiles, the slowest axis sets the time; written apart."""
        path = np.vstack([np.zeros(3), points[list(order)]])
        ways, total = np.abs(np.diff(path, axis=0)), 0.0
        for way in ways:
            total += max(
                d / v + v / 50.0 if d > v * v / 50.0 else 2 * np.sqrt(d / 50.0)
                for d, v in zip(way, speeds.values(), strict=True)
            )
        return total

    order = travel_order(config, points, np.zeros(3))
    assert sorted(order) == list(range(12))
    assert seconds(order) < seconds(range(12))
    few = points[:5]
    best = min(seconds(o, few) for o in itertools.permutations(range(5)))
    found = travel_order(config, few, np.zeros(3))
    assert seconds(found, few) == pytest.approx(best)
    for count in (14, 201):  # above 12 improved, above 200 nearest neighbours
        many = travel_order(config, rng.uniform(-20, 20, (count, 3)), np.zeros(3))
        assert sorted(many) == list(range(count))
    assert travel_order(config, np.empty((0, 3)), np.zeros(3)) == []


# The command line


@pytest.mark.parametrize(
    ("method", "session_table"),
    [("exact", SESSION), pytest.param("policy", "", marks=pytest.mark.slow)],
)
def test_calibrate_simulate_takes_a_device_from_the_bus_to_its_calibration(
    method, session_table, tmp_path, capsys
):
    """Quickly with short windows; slowly without a configuration, as users do first."""
    given = ["--speedup", "5", "--rate", "250", "--out", str(tmp_path / "runs")]
    if session_table:
        (tmp_path / "rig.toml").write_text(fast_text(session=session_table))
        given += ["--config", str(tmp_path / "rig.toml")]
    with no_figures():
        assert main(["calibrate", "--simulate", *given]) == 0
    said = capsys.readouterr().out
    assert "95 % confidence" in said and "after compensation" in said
    commissioned, _, said = said.partition("each unit turns its own joint")
    assert "IDENTIFIED" in commissioned and "roll: 3.00 deg" in commissioned
    plan, _, moved = said.partition("armed:")
    assert moved and f"by {method}: log det" in plan
    assert "proven optimum" in plan and "gap 0." in plan and "note:" not in plan
    (folder,) = (tmp_path / "runs").iterdir()
    loaded = jaxcal.Calibration.load(folder / "calibration.json")
    assert loaded.num_measurements == 4
    np.testing.assert_allclose(loaded.matrix, TRUTH[:, :3], atol=0.005)


@pytest.mark.slow
def test_verify_and_goto_use_a_saved_calibration(finished, tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text())
    given = [str(finished[0]), "--config", str(path), "--simulate", "--rate", "250"]
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
        notes={"device": fast_config().device_fingerprint()},
    )
    stale.save(tmp_path / "calibration.json")
    path = tmp_path / "rig.toml"
    path.write_text(fast_text())
    given = [str(tmp_path), "--config", str(path), "--simulate", "--rate", "250"]
    code = main(["verify", *given, "--count", "2", "--out", str(tmp_path / "v")])
    assert code == 1
    assert "RECALIBRATE" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["leadshine_pr", "oriental_az", "applied_motion", "generic"]
)
def test_every_example_calibrates_on_the_simulator(name, tmp_path):
    """Each map, and HyperIMU, Sensor Logger and a line stream in client mode."""
    from rig.config.files import EXAMPLES

    code = main(["calibrate", "--simulate", "--speedup", "20", "--out", str(tmp_path),
                 "--config", str(EXAMPLES / f"{name}.toml")])  # fmt: skip
    assert code == 0
    (folder,) = tmp_path.iterdir()
    found = jaxcal.Calibration.load(folder / "calibration.json")
    np.testing.assert_allclose(found.matrix, TRUTH[:, :3], atol=0.005)
    np.testing.assert_allclose(found.bias, TRUTH[:, 3], atol=0.05)


@pytest.mark.slow
def test_goto_refuses_what_the_limits_do_not_reach(finished, tmp_path, capsys):
    code = main(["goto", str(finished[0]), "--simulate", "--to", "40", "0", "0",
                 "--out", str(tmp_path)])  # fmt: skip
    assert code == 2
    assert "outside [" in capsys.readouterr().out


def test_dry_run_opens_no_port(tmp_path, capsys):
    config = tmp_path / "rig.toml"
    config.write_text(fast_text({"port = 5020": "port = 1", "port = 2055": "port = 1"}))
    for command in (["calibrate"], ["collect", "--count", "3"]):
        code = main([*command, "--config", str(config), "--dry-run", "--out",
                     str(tmp_path / "runs")])  # fmt: skip
        assert code == 0
    said = capsys.readouterr().out
    assert "nothing was sent to the bus" in said and "about" in said
    for folder in (tmp_path / "runs").iterdir():
        events = {r["event"] for r in read_journal(folder / "journal.jsonl")}
        assert not events & {"write", "command", "stop"}


def test_nothing_moves_without_confirmation(tmp_path, capsys):
    config = fast_config()
    with simulator(config) as sim:
        served = sim.start()
        text = fast_text({"port = 5020": f"port = {served.bus.port}"})
        (tmp_path / "rig.toml").write_text(text)
        commissioned(config, tmp_path)
        code = main(["calibrate", "--config", str(tmp_path / "rig.toml"),
                     "--out", str(tmp_path / "runs")])  # fmt: skip
        assert code == 2
        assert "confirm with --arm" in capsys.readouterr().out
        assert sim.server.requests == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibrate"],
        ["calibrate", "--config", "/does/not/exist.toml"],
        ["resume", "/does/not/exist"],
        ["check", "/does/not/exist.toml"],
        ["example", "nobody"],
        ["verify", "/does/not/exist", "--simulate"],
        ["calibrate", "--simulate", "--fault", "earthquake"],
        ["collect", "--simulate", "--count", "0"],
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(
    arguments, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("rig: ") and "Traceback" not in error


def test_stop_works_alone_and_says_when_it_cannot(tmp_path, capsys):
    config = fast_config()
    with simulator(config) as sim:
        served = sim.start()
        path = tmp_path / "rig.toml"
        path.write_text(
            fast_text({**HASTY, "port = 5020": f"port = {served.bus.port}"})
        )
        assert main(["stop", "--config", str(path)]) == 0
        assert capsys.readouterr().out.count("acknowledged, standing") == 3
        assert all(drive.stops for drive in sim.drives)
        sim.faults.add(parse_fault("dead_drive,axis=yaw"))
        assert main(["stop", "--config", str(path)]) == 3
        assert "NOT acknowledged" in capsys.readouterr().out
    assert main(["stop", "--config", str(path)]) == 3
    error = capsys.readouterr().err
    assert "NOTHING WAS STOPPED" in error and "cannot open" in error


def test_identify_prints_every_drive(capsys):
    assert main(["identify", "--simulate"]) == 0
    said = capsys.readouterr().out
    assert said.count("pulses_per_rev = 10000") == 3


def test_help_and_stop_load_no_heavy_module(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1"}))
    program = (
        "import sys\n"
        "from rig.__main__ import main\n"
        "try:\n"
        "    main({})\n"
        "except SystemExit:\n"
        "    pass\n"
        "heavy = set('jax matplotlib numba scipy flax'.split()) & set(sys.modules)\n"
        "sys.exit(' '.join(heavy) or 0)\n"
    )
    for arguments in (["--help"], ["stop", "--config", str(path)]):
        subprocess.run(
            [sys.executable, "-c", program.format(arguments)], check=True,
            capture_output=True, cwd=tmp_path,
        )  # fmt: skip


def test_simulate_serves_a_session_in_another_process(tmp_path):
    """Two programs, as with real hardware: the simulator and the session."""
    from fault_matrix import _free_port

    bus, phone = _free_port(), _free_port()
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": f"port = {bus}",
                               "port = 2055": f"port = {phone}"}))  # fmt: skip
    commissioned(fast_config(), tmp_path)
    served = subprocess.Popen(
        [sys.executable, "-m", "rig", "simulate", "--config", str(path),
         "--rate", "250"], stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        for line in served.stdout:
            if "Ctrl-C" in line:
                break
        with no_figures():
            code = main(["calibrate", "--config", str(path), "--arm", "--zero",
                         "--out", str(tmp_path / "runs")])  # fmt: skip
        assert code == 0
    finally:
        os.kill(served.pid, signal.SIGINT)
        assert served.wait(60) == 0
        served.stdout.close()


def readme_commands():
    """The rig's commands of README, without their comments."""
    text = (pathlib.Path(__file__).parents[2] / "README.md").read_text()
    lines = [line.partition("#")[0].strip() for line in text.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("jaxcal-rig ")]


def test_the_commands_of_the_readme_parse():
    commands = readme_commands()
    named = {words[0] for words in commands}
    assert {"setup", "calibrate", "verify", "export", "stop"} <= named
    for words in commands:
        make_parser().parse_args(words)


def test_check_takes_its_file_with_and_without_config(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["example", "leadshine_pr"]) == 0
    (tmp_path / "rig.toml").write_text(capsys.readouterr().out)
    for given in (["--config", "rig.toml"], ["rig.toml"], []):
        assert main(["check", *given]) == 0
        assert "valid" in capsys.readouterr().out
    assert main(["verify", "calibration.json"]) == 2  # the file is found, not this
    assert "calibration.json: not a calibration" in capsys.readouterr().err
    (tmp_path / "rig.toml").unlink()
    assert main(["check"]) == main(["calibrate"]) == 2
    assert "--config FILE is required" in capsys.readouterr().err


def test_a_missing_package_is_one_line_with_the_command_that_installs_it(
    monkeypatch, capsys, tmp_path
):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1"}))
    for missing, stop in (("pymodbus", 2), ("pydantic", 2), ("jinja2", 3)):
        real = importlib.util.find_spec
        with monkeypatch.context() as patch:
            patch.setattr(
                importlib.util,
                "find_spec",
                lambda name, *more, gone=missing, real=real: (
                    None if name == gone else real(name, *more)
                ),
            )
            assert main(["calibrate", "--simulate", "--out", str(tmp_path)]) == 2
            error = capsys.readouterr().err
            assert missing in error and error.count("\n") == 1
            assert "pip install 'jaxcal[rig]'" in error
            assert main(["stop", "--config", str(path)]) == stop
            capsys.readouterr()


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
    from rig.outputs.report import write_report

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    summary = json.loads((finished[0] / "summary.json").read_text())
    records = read_journal(finished[0] / "journal.jsonl")
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    page = write_report(tmp_path, records).read_text()
    assert page.count("matplotlib is not installed") == 3 and "data:image" not in page


def test_run_folders_are_never_reused(tmp_path):
    from rig.session.folder import new_run_folder

    folders = {new_run_folder(tmp_path, "calibrate") for _ in range(5)}
    assert len(folders) == 5
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(Refused, match="cannot make"):
        new_run_folder(pathlib.Path(blocked), "calibrate")


def test_a_plan_that_leaves_the_limits_is_refused_before_arming(tmp_path):
    config = fast_config()
    folder = tmp_path / "run"
    folder.mkdir()
    said = []
    record = commissioned(config, folder)
    run = Run(config, folder, "calibrate", said.append, record=record)
    wild = draw_candidates(config)
    wild[:, 0] = 99999
    choice = choose(config, config.to_deg(draw_candidates(config)))
    run.journal.write(
        "plan", candidates=wild.tolist(), choice=dataclasses.asdict(choice)
    )
    assert run_safely(run, calibrate) == 2
    assert any("leaves the limits" in line for line in said)
