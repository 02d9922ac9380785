"""The watchdogs: of the motion loop, and of the line in drives that have one."""

import pathlib
import signal
import subprocess
import sys
import time

import pytest
from harness import HASTY, Simulator, changed, fast_config, fast_text, session
from test_rig_motion import bench

from rig.command_run import Run
from rig.config import load_config
from rig.config.config import EXAMPLES
from rig.core import stop
from rig.core.device import timeouts_left
from rig.faults import MotionFault
from rig.journal.run_folder import read_journal
from rig.registers import decode
from rig_workbench.simulator import Truth, parse_fault

WATCHED = {'map = "leadshine_pr"': 'map = "generic"'}
REGISTER, BEFORE = 0x2B, [0, 60000, 45000]  # what the drives held; 0: no watch


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A drive that a busy computer does not see standing keeps its watch."""
    monkeypatch.setattr(stop, "VERIFY_S", 3.0)


def watched_simulator(config, **habits):
    """Drives that had a communication timeout of their own, or none."""
    sim = Simulator(config, Truth(noise_deg=0.0, **habits), rate_hz=250.0)
    for drive, counts in zip(sim.drives, BEFORE, strict=True):
        drive.write(REGISTER, [counts])
    return sim


def timeouts(sim):
    return [decode(drive.read(REGISTER, 1), "u16", "big") for drive in sim.drives]


def while_moving(found, sim):
    """A listener that notes what the drives are set to once the session moves."""

    def listen(run, phase):
        if phase == "moving" and not found:
            found.append(timeouts(sim))

    return listen


# The motion loop


@pytest.mark.parametrize("name", ["leadshine_pr", "oriental_az", "generic"])
def test_the_heartbeat_ends_before_a_whole_step(name):
    """It was 3 s, where a step of these takes 1.75 s or less."""
    config = load_config(EXAMPLES / f"{name}.toml")
    motion, axis = config.motion, config.axes[0]
    step = motion.max_step_deg / axis.speed_deg_s + axis.speed_deg_s / axis.accel_deg_s2
    assert config.heartbeat_s < step
    # and is longer than the longest exchange, which may have to connect first
    assert config.heartbeat_s > 2 * config.bus.timeout_s + motion.poll_s


def test_every_frame_is_a_sign_of_life():
    """A loop that waits for replies that come late, each in time, is not stopped."""
    with bench(fast_config()) as motion:
        device = motion.device
        device.guard(moving=True)
        for drive in device.drives:
            fed = device.heartbeat._fed
            drive.status()
            assert device.heartbeat._fed > fed and device.heartbeat._moving


# The line


def test_drives_that_watch_their_line_do_by_default_and_are_as_before_at_the_end(
    tmp_path,
):
    config = fast_config(WATCHED)
    seconds = config.heartbeat_s + 0.5 * 3  # longer than a read with all its tries
    assert config.comm_timeouts_s == pytest.approx(
        dict.fromkeys(("pitch", "yaw", "roll"), seconds)
    )
    set_to = []
    with watched_simulator(config) as sim:
        code = session(
            sim.start(), tmp_path, sim, listeners=[while_moving(set_to, sim)]
        )
        assert code == 0
        assert set_to == [[round(seconds * 1000)] * 3]
        assert timeouts(sim) == BEFORE
    records = read_journal(tmp_path / "journal.jsonl")
    lent = {r["axis"]: r["before"] for r in records if r["event"] == "comm_timeout"}
    assert list(lent.values()) == BEFORE
    stopped = max(r["seq"] for r in records if r["event"] == "stop")
    back = [r["seq"] for r in records if r["event"] == "comm_restored"]
    assert len(back) == 3 and min(back) > stopped  # after the drives stand
    assert timeouts_left(records) == {}


@pytest.mark.slow
def test_no_success_ends_in_an_alarm(tmp_path):
    """Drives whose watch acts while they stand, too, and a line that falls silent."""
    config = fast_config(WATCHED)
    with watched_simulator(config, idle_watchdog=True) as sim:
        sim.drives[1].write(REGISTER, [0])
        sim.drives[2].write(REGISTER, [0])
        quick = changed(
            sim.start(),
            axes=tuple(changed(a, comm_timeout_s=1.8) for a in config.axes),
        )
        assert session(quick, tmp_path, sim) == 0
        time.sleep(1.9)
        with sim.server.lock:
            for drive in sim.drives:
                drive.advance()
                assert not drive.alarm


@pytest.mark.parametrize("way", ["fault", "pause", "signal", "error"])
def test_they_are_as_before_on_every_way_out(way, tmp_path):
    config = fast_config(WATCHED)
    with watched_simulator(config) as sim:
        set_to = []

        def listen(run, phase):
            if phase != "settling" or set_to:
                return
            set_to.append(timeouts(sim))
            if way == "fault":
                sim.drives[0].raise_alarm(0x30)
            elif way == "error":
                raise ZeroDivisionError
            else:
                number = signal.SIGINT if way == "pause" else signal.SIGTERM
                signal.raise_signal(number)

        code = session(sim.start(), tmp_path, sim, listeners=[listen])
        assert code == {"fault": 3, "error": 3, "pause": 4, "signal": 143}[way]
        assert set_to[0] != BEFORE and timeouts(sim) == BEFORE


@pytest.mark.slow
def test_a_drive_that_was_not_seen_to_stand_keeps_its_watch_until_a_resume(tmp_path):
    config, said = fast_config(WATCHED | HASTY), []
    with watched_simulator(config) as sim:

        def listen(run, phase):
            if phase == "settling":
                sim.faults.add(parse_fault("dead_drive,axis=yaw"))

        assert session(sim.start(), tmp_path, sim, said, [listen]) == 3
        sim.repair()
        here = timeouts(sim)
        assert [here[0], here[2]] == [BEFORE[0], BEFORE[2]] and here[1] != BEFORE[1]
        assert any("yaw: its communication timeout" in line for line in said)
        assert list(timeouts_left(read_journal(tmp_path / "journal.jsonl"))) == ["yaw"]
        # Its place was not read, so it is homed before the run goes on.
        assert session(sim.start(), tmp_path, sim, said) == 2
        assert "not HOMED: yaw" in said[-1]
        assert session(sim.start(), tmp_path, sim, said) == 0, said[-5:]
        assert timeouts(sim) == BEFORE


@pytest.mark.slow
def test_a_resumed_run_puts_back_what_a_killed_one_left(tmp_path):
    from harness import free_port

    config = fast_config(WATCHED)
    with watched_simulator(config) as sim:
        served, port = sim.start(), free_port()
        path = tmp_path / "given.toml"
        path.write_text(fast_text({
            **WATCHED, "port = 5020": f"port = {served.bus.port}",
            "port = 2055": f"port = {port}"}))  # fmt: skip
        sim.start_phone(port)
        child = subprocess.run(
            [sys.executable, str(pathlib.Path(__file__).with_name("harness.py")),
             str(tmp_path), str(path), "sigkill", "moving"],
            capture_output=True, timeout=90, check=False,
        )  # fmt: skip
        assert child.returncode == -signal.SIGKILL
        assert timeouts(sim) != BEFORE
        assert session(load_config(path), tmp_path) == 2  # home first
        assert timeouts(sim) != BEFORE
        assert session(load_config(path), tmp_path) == 0
        assert timeouts(sim) == BEFORE


def test_a_drive_that_was_set_again_since_the_kill_keeps_that():
    """Its register no longer holds what the killed session wrote."""
    config = fast_config(WATCHED)
    with bench(config, arm=False) as motion:
        sim, device = motion.sim, motion.device
        device.emit("comm_timeout", axis="pitch", before=7, counts=2750)
        sim.drives[0].write(REGISTER, [1234])
        device.arm()
        device.stopper.stop("", latch=False)
        device._restore_watches({"pitch", "yaw", "roll"})
        assert timeouts(sim)[0] == 1234


def test_a_drive_whose_watch_cannot_be_read_is_not_armed():
    with bench(fast_config(WATCHED), arm=False) as motion:
        del motion.sim.drives[1]._registers[REGISTER]
        with pytest.raises(MotionFault, match="yaw: its communication timeout cannot"):
            motion.device.arm()
        assert not motion.device.armed


# Signals while a session stops


@pytest.mark.parametrize("after", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_during_the_stop_of_a_session_change_nothing(
    after, tmp_path, monkeypatch
):
    """Ctrl-C, pressed twice and again while the drives are being stopped."""
    real = stop.stop_all

    def stop_all(drives):
        for _ in range(2):
            signal.raise_signal(after)
        results = real(drives)
        signal.raise_signal(after)
        return results

    emit = Run.emit

    def noted(run, event, **fields):
        record = emit(run, event, **fields)
        if event == "comm_restored":  # the device is closing
            signal.raise_signal(after)
        return record

    monkeypatch.setattr(stop, "stop_all", stop_all)
    monkeypatch.setattr(Run, "emit", noted)
    config = fast_config(WATCHED)
    with watched_simulator(config) as sim:

        def listen(run, phase):
            if phase == "settling":
                signal.raise_signal(signal.SIGTERM)

        assert session(sim.start(), tmp_path, sim, listeners=[listen]) == 143
        assert all(drive.stops for drive in sim.drives)
        assert timeouts(sim) == BEFORE
    *_, last = read_journal(tmp_path / "journal.jsonl")
    assert last["event"] == "stopped" and last["code"] == 143
