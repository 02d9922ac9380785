"""The next measurement at the bench, and the closed loop with its journal."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.loop import Loop, next_measurement, run
from jaxcal.adaptive.rules import Gain, Priced, Random
from jaxcal.adaptive.session import fingerprint
from jaxcal.adaptive.tasks.knee import PRICED, knee

SMALL = {"cells": 6, "sigma": 0.05}


@pytest.fixture(scope="module")
def task():
    return knee(**SMALL)


@pytest.fixture(scope="module")
def sharp():
    """Thresholds of which nothing is answered wrongly."""
    return knee(**SMALL | {"sigma": 0.0}, slip=0.0, seconds=9.0, trips=2)


def device(truth, log=None, fail_at=None):
    """A device with sharp thresholds, which may be cut off before a measurement."""

    def measure(proposal):
        if proposal.number == fail_at:
            raise KeyboardInterrupt
        joint, u = proposal.coordinates
        if log is not None:
            log.append(proposal.design)
        return int(u > truth[int(joint)])

    return measure


def posterior(task, history):
    """(S,) float64, by the definition."""
    weights = np.asarray(task.prior, np.float64)
    for design, outcome in history:
        weights = weights * np.asarray(task.likelihood, np.float64)[design, outcome]
    return weights / weights.sum()


def test_a_proposal_is_the_largest_gain_of_the_exact_posterior(task):
    history = [(3, 1), (7, 0), (3, 1)]
    proposal = next_measurement(task, history, Gain(), seconds=30.0, uses=3)
    weights = posterior(task, history)
    table = np.asarray(task.likelihood, np.float64)
    p = table @ weights
    gains = -(p * np.log(p)).sum(1) + (table * np.log(table)).sum(1) @ weights
    assert proposal.design == int(gains.argmax())
    assert proposal.gain == pytest.approx(gains.max(), rel=1e-4)
    np.testing.assert_allclose(proposal.belief.weights, weights, atol=1e-6)
    np.testing.assert_allclose(proposal.coordinates, task.designs[proposal.design])
    assert proposal.number == 3
    assert int(proposal.session.uses) == 1  # two of the tests tripped


@pytest.mark.slow
def test_coordinates_are_as_good_as_indices(task):
    at = np.asarray(task.designs)
    by_index = next_measurement(task, [(3, 1), (np.int64(7), 0)], seconds=30, uses=3)
    named = [(tuple(at[3].tolist()), 1), ([1.0, 3 / 6], np.int32(0))]
    by_name = next_measurement(task, named, seconds=30, uses=3)
    assert tuple(at[7]) == (1.0, np.float32(3 / 6))
    assert by_index.design == by_name.design
    assert by_index.gain == by_name.gain


def test_a_spent_budget_proposes_nothing(task):
    proposal = next_measurement(task, [(3, 1)], seconds=30, uses=1)
    assert proposal.design is None
    assert proposal.coordinates is None


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ((99, 0), r"history\[1\]: design must be a whole number in \[0, 10\), got 99"),
        ((-1, 0), r"history\[1\]: design must be a whole number in \[0, 10\), got -1"),
        ((True, 0), r"history\[1\]: design must"),
        (((0.0, 0.51), 0), r"history\[1\]: design .* nearest is 2, \(0, 0.5\)"),
        ((0.5, 0), r"history\[1\]: design must be an index or have 2 coordinates"),
        ((("a", 1), 0), r"history\[1\]: design must be an array of numbers"),
        ((3, 2), r"history\[1\]: outcome must be a whole number in \[0, 2\), got 2"),
        ((3, 0.5), r"history\[1\]: outcome must be a whole number"),
        ((3, True), r"history\[1\]: outcome must be a whole number"),
        ((3,), r"history\[1\] must be a pair"),
        (5, r"history\[1\] must be a pair"),
    ],
)
def test_an_entry_that_cannot_be_is_named(task, entry, words):
    with pytest.raises(ValueError, match=words):
        next_measurement(task, [(3, 0), entry], seconds=30, uses=2)


def test_a_history_that_cannot_have_happened_is_refused(sharp):
    # Joint 0 trips at 2/6, then does not at 5/6.
    with pytest.raises(
        ValueError, match=r"history\[1\]: outcome 0 of design \(0, 0.83"
    ):
        next_measurement(sharp, [(1, 1), (4, 0)])
    next_measurement(sharp, [(1, 1), (0, 0)])


def test_what_follows_a_spent_budget_is_refused(task):
    with pytest.raises(ValueError, match=r"history\[1\] .*0 uses were left"):
        next_measurement(task, [(3, 1), (4, 0)], seconds=30, uses=1)


def test_a_drawn_budget_must_be_given(task):
    with pytest.raises(ValueError, match=r"seconds is missing.* 8 to 32 s"):
        next_measurement(task, uses=2)
    with pytest.raises(ValueError, match="uses is missing"):
        next_measurement(task, seconds=20.0)
    with pytest.raises(ValueError, match="seconds must be"):
        next_measurement(task, seconds=0.0, uses=2)


def test_a_closed_loop_measures_until_the_budget_is_spent(sharp):
    asked = []
    finished = run(sharp, PRICED, device((0.4, 0.7), asked))
    assert [int(design) for design, _ in finished.history] == asked
    assert bool(sharp.over(finished.session))
    assert not bool(sharp.over(replay_of(sharp, finished.history[:-1])))
    best = np.asarray(sharp.theta)[np.asarray(finished.belief.weights) > 0]
    assert (np.abs(best - (5 / 12, 9 / 12)) < 1e-6).all(axis=1).any()


def replay_of(task, history):
    loop = Loop(task, PRICED)
    loop.follow(history)
    return loop.session


@pytest.mark.parametrize("decider", [PRICED, Random()], ids=["priced", "random"])
def test_a_killed_loop_goes_on_as_if_it_had_not_been(tmp_path, sharp, decider):
    truth = (0.4, 0.7)
    whole = run(sharp, decider, device(truth), seed=3)
    assert len(whole.history) > 2
    for fail_at in range(len(whole.history)):
        path = tmp_path / f"{fail_at}.jsonl"
        with pytest.raises(KeyboardInterrupt):
            run(sharp, decider, device(truth, None, fail_at), journal=path, seed=3)
        asked = []
        resumed = run(sharp, decider, device(truth, asked), journal=path, seed=3)
        assert [int(d) for d, _ in resumed.history] == [
            int(d) for d, _ in whole.history
        ]
        assert len(asked) == len(whole.history) - fail_at
        np.testing.assert_array_equal(resumed.belief.weights, whole.belief.weights)
    again = run(sharp, decider, device(truth, asked := []), journal=path, seed=3)
    assert not asked
    assert len(again.history) == len(whole.history)


def test_every_cut_of_the_file_is_a_session_that_goes_on(tmp_path, sharp):
    path = tmp_path / "session.jsonl"
    whole = run(sharp, PRICED, device((0.4, 0.7)), journal=path)
    data = path.read_bytes()
    for size in {*range(0, len(data), 37), len(data) - 1, len(data)}:
        path.write_bytes(data[:size])
        asked = []
        run(sharp, PRICED, device((0.4, 0.7), asked), journal=path)
        complete = max(data[:size].count(b"\n") - 1, 0)
        assert len(asked) == len(whole.history) - complete
        assert path.read_bytes() == data


def test_a_second_writer_is_refused(tmp_path, sharp):
    path = tmp_path / "session.jsonl"
    tried = []

    def measure(proposal):
        with pytest.raises(ValueError, match="another session is writing this file"):
            run(sharp, PRICED, tried.append, journal=path)
        return device((0.4, 0.7))(proposal)

    once = run(sharp, PRICED, measure, journal=path)
    assert not tried
    again = run(sharp, PRICED, tried.append, journal=path)
    assert not tried and len(again.history) == len(once.history)


KILLED = """
import os, signal, sys
from jaxcal.adaptive.loop import run
from jaxcal.adaptive.tasks.knee import PRICED, knee

def measure(proposal):
    if proposal.number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return 0

task = knee(cells=6, sigma=0.0, slip=0.0, seconds=9.0, trips=2)
run(task, PRICED, measure, journal=sys.argv[1])
"""


@pytest.mark.slow
def test_a_session_goes_on_after_sigkill(tmp_path, sharp):
    path = tmp_path / "session.jsonl"
    killed = subprocess.run([sys.executable, "-c", KILLED, str(path)])
    assert killed.returncode == -signal.SIGKILL
    asked = []
    finished = run(sharp, PRICED, lambda p: asked.append(p.number) or 0, journal=path)
    assert asked[0] == 2 and len(finished.history) == len(asked) + 2


def test_a_measurement_is_on_the_disk_before_the_next_is_asked(tmp_path, sharp):
    path = tmp_path / "session.jsonl"

    def measure(proposal):
        lines = path.read_bytes().split(b"\n")
        assert len(lines) == proposal.number + 2
        assert lines[-1] == b""
        return device((0.4, 0.7))(proposal)

    assert len(run(sharp, PRICED, measure, journal=path).history) > 2


def test_another_task_decider_or_budget_is_refused(tmp_path, sharp):
    path = tmp_path / "session.jsonl"
    run(sharp, PRICED, device((0.4, 0.7)), journal=path)
    before = path.read_bytes()
    other = knee(**SMALL | {"sigma": 0.0}, slip=0.0, seconds=9.0, trips=2, rho=0.5)
    with pytest.raises(ValueError, match="another task"):
        run(other, PRICED, device((0.4, 0.7)), journal=path)
    with pytest.raises(ValueError, match="another decider"):
        run(sharp, Priced(c0=0.1), device((0.4, 0.7)), journal=path)
    with pytest.raises(ValueError, match="another seconds"):
        run(sharp, PRICED, device((0.4, 0.7)), journal=path, seconds=8.0)
    assert path.read_bytes() == before


def test_damage_inside_a_journal_is_an_error(tmp_path, sharp):
    path = tmp_path / "session.jsonl"
    run(sharp, PRICED, device((0.4, 0.7)), journal=path)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([*lines[:2], b"{]", *lines[3:]]))
    with pytest.raises(ValueError, match="line 3 is damaged"):
        run(sharp, PRICED, device((0.4, 0.7)), journal=path)
    path.write_text(json.dumps({"kind": "something else"}) + "\n")
    with pytest.raises(ValueError, match="not a journal"):
        run(sharp, PRICED, device((0.4, 0.7)), journal=path)


def test_an_outcome_that_is_none_is_not_written(tmp_path, sharp):
    path = tmp_path / "session.jsonl"
    with pytest.raises(ValueError, match="measurement 0: outcome must"):
        run(sharp, PRICED, lambda proposal: 2, journal=path)
    assert path.read_bytes().count(b"\n") == 1


def test_a_fingerprint_tells_tables_and_kinds_apart(task):
    assert fingerprint(task) == fingerprint(knee(**SMALL))
    assert fingerprint(task) != fingerprint(knee(**SMALL, slip=0.02))
    assert fingerprint(Gain()) != fingerprint(Random())


def test_a_likelihood_that_is_known_to_float32_bears_a_long_history():
    theta = np.linspace(0.0, 1.0, 11)
    yes = np.clip(theta, 1e-6, 1 - 1e-6)[None]
    table = np.stack([1 - yes, yes], axis=1)
    coin = GridTask.make(theta, [0.0], table, num_uses=1, horizon=400)
    history = [(0, 0), (0, 1)] * 150
    proposal = next_measurement(coin, history)
    np.testing.assert_allclose(
        proposal.belief.weights, posterior(coin, history), atol=1e-4
    )
