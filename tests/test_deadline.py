"""``Deadline`` against a clock that the test moves."""

import math

import pytest

from jaxcal import deadline
from jaxcal.deadline import Deadline


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(deadline.time, "perf_counter", lambda: now[0])
    return now


def test_a_deadline_runs_from_when_it_was_made_and_stays_passed(clock):
    whole = Deadline(8.0)
    clock[0] += 2.0
    assert (whole.elapsed_s, whole.remaining_s, whole.passed) == (2.0, 6.0, False)
    clock[0] += 7.0
    assert (whole.elapsed_s, whole.remaining_s, whole.passed) == (9.0, 0.0, True)


def test_a_part_ends_before_the_whole_also_when_nothing_is_left(clock):
    whole = Deadline(8.0)
    clock[0] += 2.0
    half = whole.part(0.5)
    assert half.remaining_s == 3.0
    clock[0] += 6.0
    assert whole.part(0.5).passed


def test_no_limit_never_passes(clock):
    forever = Deadline()
    clock[0] += 1e9
    assert not forever.passed and not forever.part(0.5).passed
    assert forever.remaining_s == math.inf
