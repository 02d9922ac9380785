"""Progress: silent for short tasks, plain lines in a log, a line on a terminal."""

from __future__ import annotations

import io

import pytest

from jaxcal.progress import Progress


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that the test sets."""
    seconds = [0.0]
    monkeypatch.setattr("jaxcal.progress.time.monotonic", lambda: seconds[0])
    return seconds


def run(progress: Progress, now: list[float]) -> None:
    progress("exact", 0, 1000)
    for done, second in ((50, 1.0), (100, 9.0), (250, 30.0), (260, 31.0)):
        now[0] = second
        progress("exact", done, 1000)


def test_progress_is_silent_at_first_and_says_what_is_left(now: list[float]) -> None:
    stream = io.StringIO()
    run(Progress(stream), now)
    assert stream.getvalue() == "exact: 250 of 1,000, 0:01:30 left\n"


def test_a_new_task_starts_its_own_clock(now: list[float]) -> None:
    stream = io.StringIO()
    progress = Progress(stream)
    run(progress, now)
    progress("greedy", 0, 10)
    now[0] = 43.0
    progress("greedy", 5, 10)
    assert stream.getvalue().splitlines()[1:] == ["greedy: 5 of 10, 0:00:12 left"]


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()])
def test_quiet_shows_nothing(now: list[float], stream: io.StringIO) -> None:
    run(Progress(stream, quiet=True), now)
    assert stream.getvalue() == ""


def test_the_line_is_taken_off_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxcal.progress._SILENT", 0.0)
    stream = Terminal()
    progress = Progress(stream)
    progress("exact", 0, 1000)
    progress("exact", 600, 1000)
    progress.clear()
    assert "exact: 600 of 1,000" in stream.getvalue()
    assert stream.getvalue().endswith("\r\x1b[K")
    written = stream.getvalue()
    progress.clear()
    assert stream.getvalue() == written
