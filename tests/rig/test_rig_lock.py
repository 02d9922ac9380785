"""The lock of a bus: one holder, by any name of the bus, and dead holders forgotten."""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import pytest
from harness import fast_text

from rig.__main__ import main
from rig.config.settings import BusSettings
from rig.faults import Refused
from rig.journal import lock
from rig.journal.lock import BusLock

HOLDER = """
import sys, time
from rig.config.settings import BusSettings
from rig.journal import lock
import pathlib
lock.FOLDER = pathlib.Path(sys.argv[1])
settings = BusSettings(transport="tcp", host="localhost", port=int(sys.argv[2]))
held = lock.BusLock(settings).acquire("calibrate")
held.tell(run="runs/calibrate-1")
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Locks of these tests alone."""
    monkeypatch.setattr(lock, "FOLDER", tmp_path / "locks")
    return tmp_path / "locks"


@pytest.fixture
def held_elsewhere(folder):
    """Another process that holds the lock of localhost:5020."""
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder), "5020"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout.readline() == "held\n"
    yield child
    child.kill()
    child.wait()
    child.stdout.close()


def tcp(host="127.0.0.1", port=5020, transport="tcp"):
    return BusSettings(transport=transport, host=host, port=port)


def test_a_second_holder_is_refused_and_the_first_is_named(held_elsewhere):
    with pytest.raises(Refused) as caught:
        BusLock(tcp()).acquire("verify")
    for said in ("127.0.0.1:5020", "calibrate", "runs/calibrate-1",
                 f"process {held_elsewhere.pid}"):  # fmt: skip
        assert said in str(caught.value)
    told = BusLock(tcp()).holder()
    assert told["pid"] == held_elsewhere.pid and told["command"] == "calibrate"
    assert told["run"] == "runs/calibrate-1" and told["since"]


def test_every_session_and_identify_are_refused_before_a_port_opens(
    held_elsewhere, tmp_path, capsys
):
    path, runs = tmp_path / "rig.toml", tmp_path / "runs"
    path.write_text(fast_text())  # nothing listens there: opening would say so
    for command in (["calibrate"], ["collect", "--count", "1"], ["identify"]):
        more = (
            [] if command == ["identify"] else ["--arm", "--zero", "--out", f"{runs}"]
        )
        assert main([*command, "--config", str(path), *more]) == 2
        error = capsys.readouterr().err
        assert f"process {held_elsewhere.pid}" in error and "cannot open" not in error
    assert not runs.exists()


def test_a_killed_holder_leaves_no_lock(held_elsewhere, folder):
    held_elsewhere.kill()
    held_elsewhere.wait()
    (content,) = folder.glob("*.lock")
    assert str(held_elsewhere.pid) in content.read_text()  # stale, and not believed
    assert BusLock(tcp()).holder() is None
    assert BusLock(tcp()).signal_holder(signal.SIGTERM) is None
    with BusLock(tcp()).acquire("verify"):
        assert BusLock(tcp()).holder()["pid"] == os.getpid()
    assert BusLock(tcp()).holder() is None and not content.read_text()


def test_the_holder_is_asked_to_end_and_is_seen_to_let_go(held_elsewhere):
    told = BusLock(tcp()).signal_holder(signal.SIGTERM)
    assert told["pid"] == held_elsewhere.pid
    assert BusLock(tcp()).freed(10)
    assert held_elsewhere.wait(10) == -signal.SIGTERM


def test_a_stopped_holder_still_holds(held_elsewhere):
    held_elsewhere.send_signal(signal.SIGSTOP)
    assert not BusLock(tcp()).freed(0.1)


def test_this_process_is_never_signalled():
    with BusLock(tcp()).acquire("stop"):
        assert BusLock(tcp()).signal_holder(signal.SIGKILL)["pid"] == os.getpid()


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (tcp("localhost"), tcp("127.0.0.1"), True),
        (tcp("::1"), tcp("LOCALHOST"), True),
        (tcp(), tcp(transport="rtu_tcp"), True),
        (tcp(), tcp(port=5021), False),
        (tcp("192.0.2.1"), tcp("192.0.2.2"), False),
        (tcp("192.0.2.1"), tcp("::ffff:192.0.2.1"), True),
    ],
)
def test_two_names_of_one_address_are_one_lock(one, other, same):
    assert (BusLock(one).path == BusLock(other).path) is same


def test_two_names_of_one_serial_port_are_one_lock(tmp_path):
    port, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    port.touch()
    link.symlink_to(port)
    one, other = (
        BusLock(BusSettings(transport="rtu", device=str(name))) for name in (port, link)
    )
    with (
        one.acquire("calibrate"),
        pytest.raises(Refused, match="in use by `calibrate`"),
    ):
        other.acquire("verify")
    with other.acquire("verify"):
        assert one.holder()["command"] == "verify"


def test_asking_who_holds_it_never_keeps_anyone_out():
    stop = threading.Event()

    def ask():
        while not stop.is_set():
            BusLock(tcp()).holder()

    askers = [threading.Thread(target=ask) for _ in range(2)]
    for thread in askers:
        thread.start()
    held = []
    try:
        for _ in range(20):
            with BusLock(tcp()).acquire("verify"):  # Refused if an asker kept us out
                held.append(BusLock(tcp()).holder()["command"])
                time.sleep(0.001)
    finally:
        stop.set()
        for thread in askers:
            thread.join()
    assert held == ["verify"] * 20


def test_a_lock_folder_of_another_user_is_refused(folder, monkeypatch):
    folder.mkdir()
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(Refused, match="belongs to user"):
        BusLock(tcp()).acquire("verify")


def test_a_link_in_the_place_of_a_lock_is_refused(folder, tmp_path):
    folder.mkdir()
    precious = tmp_path / "precious"
    precious.write_text("kept")
    pathlib.Path(BusLock(tcp()).path).symlink_to(precious)
    with pytest.raises(Refused, match="cannot lock"):
        BusLock(tcp()).acquire("verify")
    assert precious.read_text() == "kept"
