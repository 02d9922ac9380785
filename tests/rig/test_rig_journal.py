"""The journal: whole lines, numbered, one writer, and torn ends repaired."""

import os
import subprocess
import sys

import pytest

from rig.faults import JournalError, StopRequested
from rig.journal.run_folder import Journal, read_journal


def test_records_survive_and_are_numbered(tmp_path):
    journal = Journal(tmp_path / "j")
    for number in range(5):
        journal.write("posture", sync=True, value=number)
    journal.close()
    again = Journal(tmp_path / "j")
    again.write("more")
    assert [r["seq"] for r in read_journal(tmp_path / "j")] == list(range(6))
    again.close()


@pytest.mark.parametrize("cut", [1, 5, 20, 40])
def test_a_torn_last_line_is_dropped_and_cut_off(tmp_path, cut):
    path = tmp_path / "j"
    journal = Journal(path)
    for number in range(3):
        journal.write("posture", value="x" * 20, number=number)
    journal.close()
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    assert len(read_journal(path)) == 2
    again = Journal(path)
    again.write("posture", number=99)
    again.close()
    assert [r.get("number") for r in read_journal(path)] == [0, 1, 99]


def test_damage_in_the_middle_is_an_error_not_a_guess(tmp_path):
    path = tmp_path / "j"
    journal = Journal(path)
    for number in range(4):
        journal.write("posture", number=number)
    journal.close()
    lines = path.read_bytes().splitlines(keepends=True)
    for broken in (lines[1][:10] + b"\n", b"", lines[2]):
        path.write_bytes(lines[0] + broken + b"".join(lines[2:]))
        with pytest.raises(JournalError, match="damaged"):
            read_journal(path)
        with pytest.raises(JournalError, match="damaged"):
            Journal(path)


def test_a_second_writer_is_refused(tmp_path):
    journal = Journal(tmp_path / "j")
    with pytest.raises(JournalError, match="another session"):
        Journal(tmp_path / "j")
    journal.close()
    Journal(tmp_path / "j").close()


def test_a_full_disk_leaves_whole_lines(tmp_path, monkeypatch):
    journal = Journal(tmp_path / "j")
    journal.write("posture", number=0)
    real = os.write

    def full(fd, data):
        if fd == journal._fd and len(data) > 10:
            return real(fd, data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(JournalError, match="No space left"):
        journal.write("posture", number=1)
    monkeypatch.undo()
    journal.write("posture", number=2)
    journal.close()
    assert [r["number"] for r in read_journal(tmp_path / "j")] == [0, 2]


def test_a_signal_during_a_write_leaves_whole_lines(tmp_path, monkeypatch):
    """While nothing is armed a signal ends the program at once, from its handler."""

    def interrupted(fd):
        raise StopRequested("SIGTERM", 143)

    path = tmp_path / "journal.jsonl"
    journal = Journal(path)
    journal.write("start")
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupted)
        with pytest.raises(StopRequested):
            journal.write("resume", sync=True)
    journal.write("stopped", sync=True)
    journal.close()
    assert [record["event"] for record in read_journal(path)] == ["start", "stopped"]


def test_sigkill_at_any_moment_leaves_a_readable_journal(tmp_path):
    program = (
        "import pathlib, sys\n"
        "from rig.journal.run_folder import Journal\n"
        "j = Journal(pathlib.Path(sys.argv[1]))\n"
        "print('ready', flush=True)\n"
        "n = len(j.records)\n"
        "while True:\n"
        "    j.write('posture', sync=n % 3 == 0, number=n, pad='y' * (n % 900))\n"
        "    n += 1\n"
    )
    path = tmp_path / "j"
    for _ in range(4):
        child = subprocess.Popen(
            [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE
        )
        assert child.stdout.readline() == b"ready\n"
        before = len(read_journal(path))
        while len(read_journal(path)) < before + 20:
            pass
        child.kill()
        child.wait()
        child.stdout.close()
        numbers = [r["number"] for r in read_journal(path)]
        assert numbers == list(range(len(numbers)))


def test_not_a_number_never_enters_the_journal(tmp_path):
    journal = Journal(tmp_path / "j")
    with pytest.raises(ValueError, match="JSON"):
        journal.write("posture", value=float("nan"))
    journal.close()
