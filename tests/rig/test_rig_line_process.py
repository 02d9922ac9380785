"""The process that owns the port: motors stop when their session does not."""

import contextlib
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest
from harness import fast_config, fast_text, free_port, line_here, simulator
from loaded import modules_of, required_apart

from rig.config import load_config
from rig.core.line_client import line_of
from rig.core.stop import stop_all
from rig.faults import LimitError
from rig.journal.lock import BusLock, read_armed

SLOW = {  # what is left of a way takes longer than STANDS_S; a stop takes 0.03 s
    "speed_deg_s = 400": "speed_deg_s = 8",
    "accel_deg_s2 = 8000": "accel_deg_s2 = 60",
    "min_deg = -20": "min_deg = -30",
}
STANDS_S, LOOK_S = 0.5, 0.002
FAR_DEG = 6.0  # still to go when the session is hit


def targets_left(sim):
    """Degrees that each drive that moves has still to go."""
    with sim.server.lock:
        return [
            abs(d.target - d.position) / abs(d.pulses_per_deg) * d.travels
            for d in sim.drives
        ]


def wait_for(what, seconds=60.0):
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)
    return found


def stands_after(sim):
    """Seconds until all drives stand, but for those in which a busy computer ran
    nothing of this test either; and how far short of their targets."""
    begun, goals = time.monotonic(), [drive.executions[-1] for drive in sim.drives]
    stalls_s, before = 0.0, begun
    while True:
        with sim.server.lock:
            if not any(drive.advance() or drive.moving for drive in sim.drives):
                break
        time.sleep(LOOK_S)
        stalls_s += max(0.0, time.monotonic() - before - 5 * LOOK_S)
        before = time.monotonic()
    short = [
        abs(goal - d.position) / abs(d.pulses_per_deg)
        for goal, d in zip(goals, sim.drives, strict=True)
    ]
    took_s = time.monotonic() - begun
    print(f"stood after {took_s:.3f} s, of which stalls {stalls_s:.3f}")
    return took_s - stalls_s, max(short)


@contextlib.contextmanager
def moving_session(tmp_path, changes=SLOW):
    """A session of another process in the middle of a long move."""
    config = fast_config(changes)
    with simulator(config, speedup=1.0) as sim:
        served, port = sim.start(), free_port()
        path = tmp_path / "given.toml"
        text = fast_text({**changes, "port = 5020": f"port = {served.bus.port}",
                          "port = 2055": f"port = {port}"})  # fmt: skip
        path.write_text(text)
        sim.start_phone(port)
        program = pathlib.Path(__file__).with_name("harness.py")
        session = subprocess.Popen(
            [sys.executable, str(program), str(tmp_path), str(path), "none", "none"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip
        try:
            wait_for(lambda: max(targets_left(sim)) > FAR_DEG)
            yield sim, session, BusLock(load_config(path).bus)
        finally:
            with contextlib.suppress(ProcessLookupError):
                session.send_signal(signal.SIGCONT)
            session.kill()
            session.communicate()


def owner_of(session):
    """The process that owns the port of a session."""
    children = f"/proc/{session.pid}/task/{session.pid}/children"
    for pid in pathlib.Path(children).read_text().split():
        command = pathlib.Path(f"/proc/{pid}/cmdline").read_bytes()
        if b"rig.core.line_process" in command:
            return int(pid)
    raise AssertionError("the session has no process of a line")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_motors_stand_when_their_session_is_killed_or_frozen(number, tmp_path):
    with moving_session(tmp_path) as (sim, session, lock):
        session.send_signal(number)
        took, short = stands_after(sim)
        assert took < STANDS_S, took
        assert short > 1.0  # its stop, not its target, is where it stands
        wait_for(lambda: read_armed(lock.armed_path)["standing"], 5.0)
        if number == signal.SIGKILL:
            _, said = session.communicate(timeout=20)  # until its line has ended too
            assert "the session has ended while the drives were armed" in said
            assert lock.freed(0.0)
        else:  # it goes on to find that its drives were stopped
            session.send_signal(signal.SIGCONT)
            told, said = session.communicate(timeout=60)
            assert session.returncode == 3, told
            assert "no sign of life for 0.26 s" in said + told
        assert said.count("acknowledged, at rest") == 3


def test_drives_are_stopped_though_the_process_of_the_line_was_killed(tmp_path):
    with moving_session(tmp_path) as (sim, session, lock):
        os.kill(owner_of(session), signal.SIGKILL)
        took, short = stands_after(sim)
        assert took < 2 * STANDS_S and short > 1.0
        told, _ = session.communicate(timeout=60)
        assert session.returncode == 3
        assert "the process of the line has ended by signal 9" in told
        assert read_armed(lock.armed_path)["standing"]


@pytest.mark.slow
def test_a_line_that_is_told_to_end_stops_its_drives_first(tmp_path):
    with moving_session(tmp_path) as (sim, session, lock):
        os.kill(owner_of(session), signal.SIGTERM)
        took, short = stands_after(sim)
        assert took < STANDS_S and short > 1.0
        told, _ = session.communicate(timeout=60)
        assert session.returncode == 3 and "SIGTERM came while the drives" in told
        assert read_armed(lock.armed_path)["standing"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_of_a_terminal_reach_the_session_alone(number, tmp_path):
    with moving_session(tmp_path) as (sim, session, _):
        for _ in range(2):  # the first Ctrl-C is a pause
            os.killpg(session.pid, number)
            time.sleep(0.02)
        took, short = stands_after(sim)
        assert took < STANDS_S and short > 1.0
        told, said = session.communicate(timeout=60)
        assert session.returncode == 128 + number, told
        assert "were armed: they were stopped" not in said


@pytest.mark.slow
def test_stop_ends_a_frozen_session_whose_drives_stand(tmp_path):
    with moving_session(tmp_path) as (sim, session, lock):
        session.send_signal(signal.SIGSTOP)
        stop = [sys.executable, "-m", "rig", "stop", str(tmp_path / "given.toml")]
        done = subprocess.run(stop, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stdout.count("standing") >= 3
        assert not any(drive.moving for drive in sim.drives)
        assert session.wait(10) == -signal.SIGKILL and lock.freed(1.0)


@contextlib.contextmanager
def line(make=line_of, **changes):
    with simulator(fast_config(changes)) as sim:
        made, drives = make(sim.start(), lambda event, **fields: None)
        with made:
            yield sim, made, drives


def test_it_refuses_what_leaves_limits_or_pace_though_the_session_asks():
    with line() as (sim, _, drives):
        axis = drives[0].axis
        speed, accel = (n * abs(axis.pulses_per_deg) for n in axis.drive_motion)
        drives[0].arm()
        for count, faster, harder in (
            (axis.max_pulses + 1, 1.0, 1.0),
            (axis.min_pulses - 1, 1.0, 1.0),
            (100, 1.01, 1.0),
            (100, 1.0, 1.01),
        ):
            with pytest.raises(LimitError, match=r"are outside"):
                drives[0].move(count, faster * speed, harder * accel)
        assert sim.executions()[0] == []
        drives[0].move(100, speed, accel)
        assert sim.executions()[0] == [100]


def test_drives_answer_over_it_as_they_do_here():
    """The same drives, asked by either way."""
    with simulator(fast_config({'map = "leadshine_pr"': 'map = "generic"'})) as sim:
        served, found = sim.start(), []
        for make in (line_here, line_of):
            made, drives = make(served, lambda event, **fields: None)
            with made:
                drives[1].set_zero(0)
                drives[1].forget_origin()
                drives[0].go(5)
                wait_for(lambda d=drives[0]: not d.status().moving)
                status = [d.steady() for d in drives]
                found.append([
                    [(s.word, s.position, s.enabled, s.done) for s in status],
                    [d.origin for d in drives], [d.says_homed for d in drives],
                    [d.held() for d in drives], [d.alarm() for d in drives],
                    [d.ids() for d in drives], drives[0].pulses_per_rev(),
                    [d.watch_counts(0.5) for d in drives],
                ])  # fmt: skip
        assert found[0] == found[1]


def test_a_stop_goes_before_what_was_asked_earlier():
    """A move that waits for its turn when the stop comes is not made after it."""
    with line() as (sim, made, drives):
        for drive in drives:
            drive.arm()
        axis = drives[0].axis
        motion = [n * abs(axis.pulses_per_deg) for n in axis.drive_motion]
        asked = dict(axis=0, method="move", args=[200, *motion], wait_s=1.0)
        with made.urgent():
            results = stop_all(drives)
            # As of a thread that asked before the stop and was not scheduled since.
            made._channels[0].send(asked | {"number": 10**6, "epoch": 0})
            reply = made._channels[0].receive(5.0)
        assert all(result.standing for result in results)
        assert "a stop was requested" in reply["error"]["text"]
        assert sim.executions() == [[], [], []]


def test_what_it_loads_is_small_and_has_no_numbers_library(tmp_path):
    loaded = modules_of("import rig.core.line_process", tmp_path)
    heavy = ("numpy", "scipy", "pydantic", "jax", "tomlkit", "rig.config", "serial")
    assert required_apart(loaded, heavy) == []
    lines = 0
    for name in loaded:
        if name == "rig" or name.startswith("rig."):
            place = pathlib.Path(__file__).parents[2].joinpath(*name.split("."))
            file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
            lines += len(file.read_text().splitlines())
    assert lines < 2200, lines  # all that there is to read to know that motors stop
