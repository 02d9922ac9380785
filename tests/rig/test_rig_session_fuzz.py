"""Sessions with faults at random keep what is promised; see ``session_fuzz``."""

import pathlib
import subprocess
import sys

import pytest

PROGRAM = pathlib.Path(__file__).parent / "session_fuzz.py"


def played(first, count):
    """Those sessions, in a process whose clocks are theirs alone."""
    numbers = ["--first", str(first), "--sessions", str(count)]
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


def test_a_session_follows_from_its_number():
    one, again = played(8, 1), played(8, 1)
    assert one.stdout.splitlines()[:-1] == again.stdout.splitlines()[:-1]
    assert "killed" in one.stdout


def test_a_drive_that_lost_its_origin_beside_the_first_zero_is_noticed():
    """It stood where the zero was taken, and no move had said where it was left."""
    done = played(37, 1)
    assert done.returncode == 0 and "reset_lost" in done.stdout
