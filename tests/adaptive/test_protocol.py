"""JSON lines between a session and another program, killed and started again."""

import json
import signal
import subprocess
import sys

import closed_loop_lines
import numpy as np
import pytest
from closed_loop_lines import answers

from jaxcal.adaptive.loop import Loop
from jaxcal.adaptive.tasks import registry

FILE = """
import numpy as np
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks import Entry


def edge(cells=8):
    at = (np.arange(cells) + 0.5) / cells
    push = np.arange(1, cells) / cells
    hit = 0.02 + 0.96 * (push[:, None] > at)
    return GridTask.make(
        at, push, np.stack([1 - hit, hit], axis=1), horizon=5, theta_names=["edge"]
    )


ENTRY = Entry(edge, about="an edge")
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "edge.py"
    path.write_text(FILE)
    return path


@pytest.fixture
def task(file):
    return registry.load(str(file)).make()


def asked(loop, *requests):
    lines = [r if isinstance(r, str) else json.dumps(r) for r in requests]
    return [json.loads(answer) for answer in answers(loop, lines)]


def test_a_session_is_that_of_the_loop(task):
    """The posterior is that of Bayes, by hand."""
    with Loop(task) as loop:
        first, done, state = asked(
            loop, {"do": "suggest"}, {"do": "observed", "outcome": 1}, {"do": "state"}
        )
        assert first["design"] == 3 and first["coordinates"] == [0.5]
        assert done == {"number": 1}
        at = (np.arange(8) + 0.5) / 8
        weights = np.where(at < 0.5, 0.98, 0.02)
        weights /= weights.sum()
        assert state["unknowns"]["edge"]["mean"] == pytest.approx(weights @ at)
        assert state["entropy"] == pytest.approx(
            -(weights * np.log(weights)).sum(), 1e-5
        )
        assert state["number"] == 1 and state["seconds"] is None and not state["over"]
        other, then = asked(
            loop, {"do": "observed", "outcome": 0, "design": [0.125]}, {"do": "suggest"}
        )
        assert other == {"number": 2} and then["number"] == 2
        assert [int(design) for design, _ in loop.history] == [3, 0]


def test_an_outcome_that_is_sent_twice_counts_once_and_the_end_is_told(task):
    with Loop(task) as loop:
        same = {"do": "observed", "outcome": 1, "number": 0}
        first, again = asked(loop, same, same)
        assert first == {"number": 1}
        assert again["error"].startswith("number must be 1, the next measurement")
        *_, last, over, beyond = asked(
            loop, *[{"do": "observed", "outcome": 0}] * 4, {"do": "suggest"},
            {"do": "observed", "outcome": 0},
        )  # fmt: skip
        assert last == {"number": 5} and over == {"number": 5, "over": True}
        assert "the session is over" in beyond["error"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("[1", "must be a JSON object"),
        ("[]", "do must be one of suggest, observed, state"),
        ('{"do": "stop"}', "do must be one of suggest, observed, state"),
        ('{"do": "suggest", "seed": 3}', "suggest takes no 'seed'"),
        ('{"do": "observed"}', "observed needs the outcome"),
        ('{"do": "observed", "outcome": 2}', "whole number in [0, 2), got 2"),
        ('{"do": "observed", "outcome": 0, "design": 9}', "number in [0, 7), got 9"),
    ],
)
def test_what_is_wrong_is_answered_and_changes_nothing(task, line, message):
    with Loop(task) as loop:
        error, state = asked(loop, line, {"do": "state"})
        assert message in error["error"]
        assert state["number"] == 0


def start(file, *more):
    return subprocess.Popen(
        [sys.executable, closed_loop_lines.__file__, str(file), *map(str, more)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, bufsize=1,
    )  # fmt: skip


def ask(program, request):
    program.stdin.write(json.dumps(request) + "\n")
    return json.loads(program.stdout.readline())


@pytest.mark.slow
def test_a_killed_program_goes_on_from_its_journal(file, task, tmp_path):
    journal = tmp_path / "session.jsonl"
    outcomes = [1, 0, 1, 0, 0]
    with Loop(task) as loop:
        whole = []
        for outcome in outcomes:
            whole.append(loop.suggest().design)
            loop.observed(outcome)
    seen = []
    for part in (outcomes[:2], outcomes[2:]):
        with start(file, "--journal", journal) as program:
            for outcome in part:
                seen.append(ask(program, {"do": "suggest"})["design"])
                number = len(seen) - 1
                sent = {"do": "observed", "outcome": outcome, "number": number}
                assert ask(program, sent) == {"number": number + 1}
            program.send_signal(signal.SIGKILL)
    assert seen == whole
