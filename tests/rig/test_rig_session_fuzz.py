"""Sessions with faults at random keep what is promised; see ``session_fuzz``."""

import pathlib
import subprocess
import sys

import pytest

PROGRAM = pathlib.Path(__file__).parent / "session_fuzz.py"


def played(first, count, *more):
    """Those sessions, in a process whose clocks are theirs alone."""
    numbers = ["--first", str(first), "--sessions", str(count), *more]
    return subprocess.run(
        [sys.executable, str(PROGRAM), *numbers], capture_output=True, text=True
    )


@pytest.mark.parametrize("first", range(0, 100, 25))
def test_sessions_with_faults_at_random_keep_their_promises(first):
    done = played(first, 25)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("first", range(100, 1100, 250))
def test_a_thousand_more(first):
    done = played(first, 250)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("number", [232, 344, 1322, 2668, 2877, 3056, 3156, 3904, 6749])
def test_sessions_that_broke_a_promise_once(number):
    """A drive lost its origin between two looks; a posture was measured while another
    moved the device; jogs are others'."""
    done = played(number, 1)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_session_follows_from_its_number():
    one, again = played(2, 1), played(2, 1)
    assert one.stdout.splitlines()[:-1] == again.stdout.splitlines()[:-1]
    assert "ended with 0" in one.stdout


@pytest.mark.parametrize("seconds", ["0.05", "0.3", "0.5", "0.7"])
def test_a_drive_that_lost_its_origin_beside_the_first_zero_is_noticed(seconds):
    """It stood where the zero was taken, and no move had said where it was left."""
    done = played(0, 1, "--fault", "reset_lost", seconds)
    assert done.returncode == 0, done.stdout
    assert "ended with 3" in done.stdout or "ended with 2" in done.stdout


def test_a_killed_session_goes_on():
    done = played(0, 1, "--fault", "killed", "1.5")
    assert done.returncode == 0 and "ended with None" in done.stdout
