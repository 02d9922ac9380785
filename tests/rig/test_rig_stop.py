"""Stopping: who is asked, who hears it first, and with what file it still works."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from harness import (
    HASTY,
    commissioned,
    fast_config,
    fast_text,
    make_run,
    on_phase,
    simulator,
)
from test_rig_motion import bench

from rig import stopping
from rig.__main__ import main
from rig.command_run import run_safely
from rig.config import load_config
from rig.core.stop import UnitStop, stop_all
from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive
from rig.faults import Signals, StopRequested
from rig.journal import lock
from rig.journal.lock import BusLock, read_armed
from rig.outputs.messages import event_lines
from rig.procedures.calibrate import collect
from rig_workbench.simulator import parse_fault

GENERIC = {'map = "leadshine_pr"': 'map = "generic"', **HASTY}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Locks of these tests alone, also in their child processes."""
    monkeypatch.setattr(lock, "FOLDER", tmp_path / "locks")
    monkeypatch.setenv("JAXCAL_RIG_LOCKS", str(tmp_path / "locks"))
    return tmp_path / "locks"


@pytest.fixture
def rig(tmp_path):
    """A simulated rig, and the path of a configuration that reaches it."""
    config = fast_config()
    with simulator(config, speedup=0.02) as sim:
        sim.path = tmp_path / "rig.toml"
        sim.path.write_text(text_for(sim.start().bus.port))
        commissioned(load_config(sim.path), tmp_path)
        yield sim


def text_for(port, **changes):
    return fast_text({**HASTY, "port = 5020": f"port = {port}", **changes})


def set_moving(sim, served):
    with Bus(served.bus) as bus:
        for axis, drive in zip(served.axes, sim.drives, strict=True):
            ModbusDrive(bus, axis).go(
                axis.to_pulses(0) + (5000 if drive.position < 0 else 0)
            )


def heard(sim):
    """Units in the order in which their stops arrive; 0 is a broadcast."""
    order = []
    answer = sim.server._answer

    def noted(unit, pdu):
        if pdu[0] in (6, 16):
            order.append(unit)
        return answer(unit, pdu)

    sim.server._answer = noted
    return order


# Who hears it first


def test_units_that_answered_are_told_before_one_that_did_not():
    config = fast_config(HASTY)
    with simulator(config) as sim, Bus(sim.start().bus) as bus:
        drives = [ModbusDrive(bus, axis) for axis in config.axes]
        sim.faults.add(parse_fault("dead_drive,axis=pitch"))
        with pytest.raises(BusError):
            drives[0].status(retries=0)
        order = heard(sim)
        stop_all(drives)
        assert order[:3] == [2, 3, 1]


@pytest.mark.parametrize("transport", ["tcp", "rtu"])
def test_one_short_wait_lies_between_a_dead_first_unit_and_the_others(
    transport,
):
    """Nothing is known of it yet: the others wait for it once, and not for long."""
    config = fast_config()  # bus.timeout_s = 0.5
    with simulator(config, transport=transport) as sim, Bus(sim.start().bus) as bus:
        drives = [ModbusDrive(bus, axis) for axis in config.axes]
        sim.faults.add(parse_fault("dead_drive,axis=pitch"))
        order, waited = heard(sim), []
        send = bus._send

        def noted(function, unit, *args, **more):
            waited.append((unit, bus._timeout_s))
            return send(function, unit, *args, **more)

        bus._send = noted
        pitch, *others = stop_all(drives)
        assert order[:3] == [1, 2, 3]
        assert [unit for unit, _ in waited[:3]] == [1, 2, 3]
        assert max(seconds for _, seconds in waited[:3]) < 0.06
        assert all(result.acknowledged and result.standing for result in others)
        assert not pitch.acknowledged
        tries = [seconds for unit, seconds in waited if unit == 1]
        assert tries[1:3] == [0.5, 0.5]  # as long as configured, once they were told


@pytest.mark.parametrize("transport", ["rtu_tcp", "rtu", "tcp"])
def test_a_family_that_takes_a_broadcast_hears_one_first_on_a_serial_line(transport):
    config = fast_config(GENERIC)
    with simulator(config, transport=transport) as sim:
        served, order = sim.start(), heard(sim)
        with Bus(served.bus) as bus:
            results = stop_all([ModbusDrive(bus, axis) for axis in config.axes])
        assert order == ([] if transport == "tcp" else [0]) + [1, 2, 3]
        assert all(result.acknowledged for result in results)
        expected = 1 if transport == "tcp" else 2
        assert [len(drive.stops) for drive in sim.drives] == [expected] * 3


def test_families_that_differ_are_told_one_by_one():
    """Where one of them keeps its stop, another may keep something else."""
    scale = "pulses_per_rev = 10000\nreduction = 10\ndirection"  # of yaw alone
    old, new = (f'map = "{name}"\n{scale}' for name in ("leadshine_pr", "generic"))
    config = fast_config({old: new})
    assert {axis.map.name for axis in config.axes} == {"generic", "leadshine_pr"}
    with simulator(config, transport="rtu_tcp") as sim:
        served, order = sim.start(), heard(sim)
        with Bus(served.bus) as bus:
            stop_all([ModbusDrive(bus, axis) for axis in config.axes])
        assert order == [1, 2, 3]


def test_a_signal_is_looked_at_before_every_frame():
    with bench(fast_config(HASTY)) as motion, motion.signals as signals:
        signals.armed = True
        asked = []
        send = motion.device.line._send

        def noted(function, unit, *args, **more):
            asked.append(unit)
            reply = send(function, unit, *args, **more)
            signal.raise_signal(signal.SIGTERM)
            return reply

        motion.device.line._send = noted
        with pytest.raises(StopRequested):
            motion.device.statuses()
        assert asked == [1]  # one frame, where a look at three drives has six
        sent = len(asked)
        results = motion.device.stopper.stop("SIGTERM")
        assert all(result.standing for result in results)
        assert set(asked[sent : sent + 3]) == {1, 2, 3}


def test_between_the_tries_of_a_dead_unit_a_signal_is_looked_at():
    with bench(fast_config(HASTY)) as motion, motion.signals as signals:
        signals.armed = True
        motion.sim.faults.add(parse_fault("dead_drive,axis=pitch"))
        asked = []
        send = motion.device.line._send

        def noted(function, unit, *args, **more):
            asked.append(unit)
            signals.request_stop("SIGTERM", 143)
            return send(function, unit, *args, **more)

        motion.device.line._send = noted
        with pytest.raises(StopRequested):
            motion.device.statuses()
        assert asked == [1]


def test_a_loop_that_waited_for_the_line_sends_nothing_after_the_stop():
    """The heartbeat's thread stops while the motion loop is about to move."""
    with bench(fast_config(HASTY)) as motion:
        device, caught = motion.device, []
        target = motion.config.axes[0].to_pulses(5)

        def move():
            try:
                device.drives[0].go(target)
            except StopRequested as error:
                caught.append(error)

        with device.line.urgent():  # as a stop holds it
            thread = threading.Thread(target=move)
            thread.start()
            time.sleep(0.05)
            device.stopper.stop("heartbeat lost")
        thread.join(5)
        assert caught and motion.sim.executions() == [[], [], []]


# The session that moves is asked first


@contextlib.contextmanager
def running_session(sim, tmp_path):
    """`calibrate` in another process, while it moves."""
    from harness import free_port

    port = free_port()
    text = sim.path.read_text().replace("port = 2055", f"port = {port}")
    sim.path.write_text(text)
    child = subprocess.Popen(
        [sys.executable, "-m", "rig", "calibrate", "--config", str(sim.path),
         "--arm", "--zero", "--out", str(tmp_path / "runs")],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    said = []
    reader = threading.Thread(target=lambda: said.extend(child.stdout))
    reader.start()
    sim.start_phone(port)
    end = time.monotonic() + 60
    while not any(drive.moving for drive in sim.drives):
        assert time.monotonic() < end and child.poll() is None, "".join(said)
        time.sleep(0.01)
    try:
        yield child
    finally:
        child.kill()
        child.wait()
        reader.join()
        child.stdout.close()


def test_stop_ends_the_session_that_moves_and_then_stops_every_unit(
    rig, tmp_path, capsys
):
    with running_session(rig, tmp_path) as child:
        # A second session is refused meanwhile; it would have opened the same bus.
        code = main(["identify", "--config", str(rig.path)])
        assert code == 2 and f"process {child.pid}" in capsys.readouterr().err
        assert main(["stop", "--config", str(rig.path)]) == 0
        said = capsys.readouterr().out
        assert f"in use by `calibrate` in {tmp_path}" in said
        assert f"process {child.pid}" in said and "asking it to stop" in said
        assert "it reported that all its drives are at rest" in said
        assert said.count("acknowledged, standing") == 3
        assert child.wait(10) == 128 + signal.SIGTERM
    assert not any(drive.moving for drive in rig.drives)
    assert all(len(drive.stops) >= 2 for drive in rig.drives)


@pytest.mark.parametrize(
    "transport", ["tcp", pytest.param("rtu", marks=pytest.mark.slow)]
)
def test_a_suspended_session_is_ended_and_its_drives_are_stopped(transport, tmp_path):
    """C: it took 8 s over TCP, and on a serial line nothing was stopped."""
    with simulator(fast_config(), transport=transport, speedup=0.02) as sim:
        bus = sim.start().bus
        sim.path = tmp_path / "rig.toml"
        sim.path.write_text(text_for(bus.port))
        if transport == "rtu":
            pytest.importorskip("serial", reason="serial ports need pyserial")
            old = 'transport = "tcp"\nhost = "127.0.0.1"\nport = 5020'
            new = f'transport = "rtu"\ndevice = "{bus.device}"'
            sim.path.write_text(fast_text({**HASTY, old: new}))
        commissioned(load_config(sim.path), tmp_path)
        with running_session(sim, tmp_path) as child:
            begun = time.monotonic()
            child.send_signal(signal.SIGSTOP)
            sim.path.write_text("this is no TOML")  # what it armed is enough
            command = [sys.executable, "-m", "rig", "stop", "--config", str(sim.path)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            took = max(
                min(at for at in drive.stops if at > begun) - begun
                for drive in sim.drives
            )
            said = done.stdout
            assert "killing it" in said
            assert (
                "it reported that all its drives are at rest" in said
            )  # its line's process
            assert said.count("acknowledged, standing") == 3
            assert child.wait(5) == -signal.SIGKILL
        assert not any(drive.moving for drive in sim.drives)
        assert took < 2.0  # its line's process, before this command was loaded


@pytest.mark.parametrize(
    "suspended", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_the_page_says_stopped_from_the_word_of_the_drives(suspended, rig, tmp_path):
    """C: it said "STOP sent", and the drives of a suspended session went on."""
    pytest.importorskip("nicegui", reason="the page needs the extra live")
    from rig_workbench.live.watcher import Watcher

    with running_session(rig, tmp_path) as child:
        if suspended:
            child.send_signal(signal.SIGSTOP)
        (run,) = (tmp_path / "runs").iterdir()
        watcher = Watcher(run)
        reader = threading.Thread(
            target=lambda: [watcher.poll() or time.sleep(0.02) for _ in range(100)]
        )
        reader.start()
        units = watcher.stop()
        assert [unit.axis for unit in units] == ["pitch", "yaw", "roll"]
        assert all(unit.acknowledged and unit.standing for unit in units)
        assert not any(drive.moving for drive in rig.drives)
        assert child.wait(20) == (-signal.SIGKILL if suspended else 143)
        reader.join()


def load_all():
    """What a command would have loaded while it waits: here it must not count."""
    import pymodbus.client  # noqa: F401


@pytest.mark.parametrize(
    "number",
    [signal.SIGTSTP, *(pytest.param(number, marks=pytest.mark.slow)
                       for number in (signal.SIGQUIT, signal.SIGHUP))],
)  # fmt: skip
def test_a_signal_that_would_end_or_suspend_a_session_stops_its_drives_first(
    number, rig, tmp_path
):
    """C: SIGQUIT and Ctrl-\\ ended the session without one stop frame."""
    with running_session(rig, tmp_path) as child:
        child.send_signal(number)
        assert child.wait(20) == 128 + number
    assert all(drive.stops for drive in rig.drives)
    assert not any(drive.moving for drive in rig.drives)


def test_a_loop_that_does_not_answer_to_a_stop_is_not_waited_for():
    """Its main thread hangs, say on a disk; so does whoever writes the journal."""
    with bench(fast_config(HASTY)) as motion, motion.signals as signals:
        signals.armed = True
        device, hangs = motion.device, threading.Event()
        motion.device.line._tell = lambda event, **fields: hangs.wait(10)
        device.stopper.emit = lambda event, **fields: hangs.wait(10)
        signals.request_stop("SIGTERM", 143)  # as the second thread would
        end = time.monotonic() + 3.0
        while not all(drive.stops for drive in motion.sim.drives):
            assert time.monotonic() < end, "nothing was stopped"
            time.sleep(0.01)
        hangs.set()


def test_a_signal_is_heard_while_the_main_thread_hangs():
    """Python runs its handlers there; a second thread hears what they cannot."""
    code = (
        "import os, signal, time\n"
        "from rig.faults import Signals\n"
        "with Signals() as signals:\n"
        "    signals.armed = True\n"
        "    signal.signal(signal.SIGTERM, lambda *_: None)  # as one that never runs\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    end = time.monotonic() + 5\n"
        "    while not signals.overdue(0.0) and time.monotonic() < end:\n"
        "        time.sleep(0.02)\n"
        "    print(signals.overdue(0.0))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60
    )
    assert done.stdout == "SIGTERM\n", done.stderr


@pytest.mark.slow
def test_stop_says_so_when_it_cannot_open_the_port_of_a_holder(tmp_path, capsys):
    """Here the holder is this process, which is not ended."""
    pytest.importorskip("serial", reason="serial ports need pyserial")
    with simulator(fast_config(), transport="rtu") as sim:
        settings = sim.start().bus
        path = tmp_path / "rig.toml"
        path.write_text(fast_text({
            'transport = "tcp"\nhost = "127.0.0.1"\nport = 5020':
            f'transport = "rtu"\ndevice = "{settings.device}"'}))  # fmt: skip
        with Bus(settings), BusLock(settings).acquire("calibrate"):
            assert main(["stop", "--config", str(path)]) == 3
        shown = capsys.readouterr()
        assert f"process {os.getpid()}" in shown.out
        assert "NOTHING WAS STOPPED BY THIS COMMAND" in shown.err
        assert "in use by another program" in shown.err
        assert not any(drive.stops for drive in sim.drives)


def test_what_a_dead_holder_left_is_not_believed(rig, capsys):
    """Its pid may belong to another process by now."""
    innocent = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        held = BusLock(load_config(rig.path).bus)
        with held.acquire("calibrate"):
            stale = held.path.read_text().replace(str(os.getpid()), str(innocent.pid))
        held.path.write_text(stale)
        assert main(["stop", "--config", str(rig.path)]) == 0
        assert "in use by" not in capsys.readouterr().out
        assert innocent.poll() is None
    finally:
        innocent.kill()
        innocent.wait()


def test_stop_works_where_no_lock_can_be_made(rig, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(lock, "FOLDER", tmp_path / "no" / "such" / "folder")
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert capsys.readouterr().out.count("acknowledged, standing") == 3


# Signals while it stops


def stop_in_a_process(sim, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "rig", "stop", "--config", str(sim.path)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_no_signal_cuts_the_command_short(rig, number):
    rig.faults.add(parse_fault("dead_drive,axis=pitch"))  # so that it takes seconds
    child = stop_in_a_process(rig)
    end = time.monotonic() + 30
    while not rig.drives[2].stops:
        assert time.monotonic() < end and child.poll() is None
        time.sleep(0.005)
    for _ in range(2):
        child.send_signal(number)
        time.sleep(0.02)
    said, _ = child.communicate(timeout=30)
    assert child.returncode == 3
    assert said.count("acknowledged, standing") == 2 and "NOT acknowledged" in said
    assert "Traceback" not in said


def test_a_reader_that_went_away_does_not_keep_it_from_stopping(rig):
    config = load_config(rig.path)
    BusLock(config.bus).leave(config)
    rig.path.write_text("no TOML")
    child = stop_in_a_process(rig)
    child.stdout.close()
    child.wait(30)
    assert all(drive.stops for drive in rig.drives)


def test_a_handler_only_sets_a_flag_and_the_loop_says_it():
    said = []
    with Signals() as signals, bench() as motion:
        motion.device.requests = signals
        motion.device.emit = lambda event, **fields: said.append(event)
        signals.armed = True
        signal.raise_signal(signal.SIGINT)
        assert signals.pause and not said
        motion.device.guard()
        motion.device.guard()
        assert said == ["pausing"]
        signals.armed, signals.ending = False, True
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.raise_signal(number)  # while the run ends: nothing is raised


# With a broken file, or none

BROKEN = {
    "a wrong value": ("settle", 'std_deg = "much"'),
    "an unknown key": ("settle", "sampels = 3"),
    "a line that is not TOML": ("settle", "std deg 3"),
    "a text without its end": ("settle", 'app = "phone'),
    "a key given twice": ("mechanism", 'order = "ZXY"\norder = "ZYX"'),
    "a wrong bus key": ("bus", 'read_retries = "two"'),
    "a unit that is none": ("axes", "unit = 900"),
}


@pytest.mark.parametrize("name", [*BROKEN, "no file"])
@pytest.mark.parametrize("standing", [False, True])
def test_what_was_armed_is_stopped_whatever_the_file_says(name, standing, rig, capsys):
    config = load_config(rig.path)
    BusLock(config.bus).leave(config)
    if standing:  # when the last session ended
        BusLock(config.bus).stood()
    if name == "no file":
        rig.path.unlink()
    else:
        section, line = BROKEN[name]
        text = rig.path.read_text()
        key = line.partition(" =")[0]
        old = [each for each in text.splitlines() if each.startswith(f"{key} = ")]
        text = text.replace(old[0] if old else f"[{section}]", line if old
                            else f"[{section}]\n{line}", 1)  # fmt: skip
        rig.path.write_text(text)
        assert main(["check", str(rig.path)]) == 2
    capsys.readouterr()
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert capsys.readouterr().out.count("acknowledged, standing") == 3
    assert all(drive.stops for drive in rig.drives)


@pytest.mark.parametrize("lost", ["name", "map"])
def test_what_another_version_armed_is_stopped_by_the_file(lost, rig, capsys):
    config = load_config(rig.path)
    bus = BusLock(config.bus)
    bus.leave(config)
    armed = json.loads(bus.armed_path.read_text())
    armed["drives"][1][lost] = "schema = 99"
    if lost == "name":
        del armed["drives"][1]["name"]
    bus.armed_path.write_text(json.dumps(armed))
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert "what was armed cannot be read" in capsys.readouterr().out
    assert all(drive.stops for drive in rig.drives)


def test_a_device_whose_drives_stand_is_left_alone_by_a_stop_of_another(rig, tmp_path):
    """Without a file of use, what is armed is stopped, not what was once."""
    with simulator(fast_config(), speedup=0.02) as other:
        served = other.start()
        BusLock(served.bus).leave(served)
        BusLock(served.bus).stood()
        config = load_config(rig.path)
        BusLock(config.bus).leave(config)
        assert main(["stop", "--config", str(tmp_path / "none.toml")]) == 0
        assert all(drive.stops for drive in rig.drives)
        assert not any(drive.stops for drive in other.drives)


def test_a_session_leaves_what_a_stop_needs_and_says_when_all_stand(tmp_path, folder):
    with simulator(fast_config()) as sim:
        served = sim.start()
        seen = []

        def look(run, phase):
            seen.append(read_armed(BusLock(served.bus).armed_path))

        record = commissioned(served, tmp_path, sim)
        run = make_run(served, tmp_path, "collect", [].append, record=record)
        run.listeners.append(sim.answer)
        on_phase(run, lambda phase: look(run, phase))
        assert run_safely(run, lambda r: collect(r, 1)) == 0
    (armed,) = {json.dumps(each, sort_keys=True) for each in seen if each}
    armed = json.loads(armed)
    assert [each["unit"] for each in armed["drives"]] == [1, 2, 3]
    assert not armed["standing"]
    assert read_armed(BusLock(served.bus).armed_path)["standing"]


@pytest.mark.parametrize(
    "text",
    ["", "[bus]\n", "axes = 3\nbus = 4", "\0", '[bus]\ntransport = "tcp"\nport = 1'],
)
def test_a_file_of_no_use_says_that_nothing_was_stopped(
    text, tmp_path, capsys, monkeypatch
):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    assert main(["stop", "--config", str(path)]) == 3
    assert "NOTHING WAS STOPPED BY THIS COMMAND" in capsys.readouterr().err
    path.unlink()
    monkeypatch.chdir(tmp_path)
    for given in (["--config", str(path)], []):
        assert main(["stop", *given]) == 3
        assert "NOTHING WAS STOPPED BY THIS COMMAND" in capsys.readouterr().err


def test_units_are_told_one_by_one_where_there_is_something_to_say():
    units = [vars(UnitStop(name, unit, True, True)) for unit, name in enumerate("ab")]
    stopped = {"event": "stop", "reason": "x", "units": units}
    assert event_lines(stopped) == ["stop: x", "  a, b: acknowledged, at rest"]
    units[1]["standing"] = False
    assert [line.split(":")[0] for line in event_lines(stopped)[1:]] == [
        "  a (unit 0)", "  b (unit 1)",
    ]  # fmt: skip


# Output that cannot be written

CLOSED = """
import os, signal, sys
from rig.__main__ import main
os.kill(os.getpid(), signal.SIGHUP)
sys.exit(main())
"""


def test_a_closed_terminal_takes_nothing_from_a_stop_but_its_words(tmp_path):
    """Neither its hang-up nor what cannot be written: the exit code is a stop's."""
    computer, terminal = os.openpty()
    words = ["-c", CLOSED, "stop", "--config", str(tmp_path / "none.toml")]
    with os.fdopen(terminal, "w") as gone:
        os.close(computer)
        code = subprocess.run(
            [sys.executable, *words], stdin=gone, stdout=gone, stderr=gone, timeout=30
        ).returncode
    assert code == 3


def test_a_stop_goes_on_where_its_words_cannot_be_written(rig, capsys, monkeypatch):
    """Of a folder with letters that the terminal lacks, on a disk that is full."""
    with open("/dev/full", "w", encoding="ascii") as full, monkeypatch.context() as m:
        m.setattr(sys, "stdout", full)
        stopping._say("/home/jürgen/rig.toml")
        assert sys.stdout is None  # of which nothing is flushed when it ends
        assert main(["stop", "--config", str(rig.path)]) == 0
        with contextlib.suppress(OSError):
            full.close()
    assert all(drive.stops for drive in rig.drives)
