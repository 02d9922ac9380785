"""Adapters and gateways as they are: an echo, bytes before a reply, one connection.

The gateway gives one connection, closes every other at once, and gives the next only a
while after the last has ended. The adapters stand between a pseudo-terminal, or a
socket, and the drives.
"""

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
import tty

import pytest
from harness import changed, fast_config, fast_text, read_words, simulator

from rig.__main__ import main
from rig.config import load_config
from rig.config.settings import BusSettings
from rig.core import stop as core_stop
from rig.core.stop import stop_all
from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive
from rig.drives.wire import crc16, rtu_reply
from rig.journal import lock
from rig.journal.lock import BusLock
from rig.prove import scan as scanning
from rig_workbench.simulator import parse_fault

TIMEOUT_S = 0.1


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Locks of these tests alone, also in their child processes."""
    monkeypatch.setattr(lock, "FOLDER", tmp_path / "locks")
    monkeypatch.setenv("JAXCAL_RIG_LOCKS", str(tmp_path / "locks"))
    monkeypatch.setattr(core_stop, "VERIFY_S", 0.6)


class Gateway:
    """One connection at a time; the next ``free_s`` after the last has ended."""

    def __init__(self, server, free_s=3.0, rtu=False):
        self.server, self.free_s, self.rtu = server, free_s, rtu
        self.given = self.refused = 0
        self._free, self._busy, self.open = 0.0, False, None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                if self._busy or time.monotonic() < self._free:
                    self.refused += 1
                    connection.close()
                    continue
                self._busy, self.open = True, connection
                self.given += 1
                threading.Thread(
                    target=self._serve, args=(connection,), daemon=True
                ).start()

    def _serve(self, connection):
        with connection:
            self.server._serve(connection.fileno(), self.rtu)
        self._free, self._busy = time.monotonic() + self.free_s, False

    def drop(self):
        """It restarts: the connection ends, and the next is given at once."""
        self.free_s = 0.0
        self.open.shutdown(socket.SHUT_RDWR)
        while self._busy:
            time.sleep(0.001)

    def close(self):
        self._listener.close()


@contextlib.contextmanager
def behind_a_gateway(transport="tcp", **options):
    config = fast_config()
    with simulator(config, transport=transport, speedup=0.02, **options) as sim:
        bus = sim.start().bus
        gateway = Gateway(sim.server, rtu=transport == "rtu_tcp")
        settings = changed(bus, port=gateway.port, timeout_s=TIMEOUT_S, read_retries=0)
        try:
            yield sim, gateway, settings, config
        finally:
            gateway.close()


@pytest.mark.parametrize("transport", ["tcp", "rtu_tcp"])
def test_a_late_reply_does_not_cost_the_only_connection(transport):
    """H: the rig closed it, the next came 3 s later, and no stop arrived."""
    with behind_a_gateway(transport) as (sim, gateway, settings, config):
        with Bus(settings) as bus:
            drives = [ModbusDrive(bus, axis) for axis in config.axes]
            places = [drive.status().position for drive in drives]
            for drive, axis in zip(drives, config.axes, strict=True):
                drive.go(axis.to_pulses(18.0))
            late = f"delayed_reply,count=1,axis=pitch,seconds={2 * TIMEOUT_S}"
            sim.faults.add(parse_fault(late))
            with pytest.raises(BusError):
                drives[0].status(retries=0)
            results = stop_all(drives)
        assert all(result.acknowledged and result.standing for result in results)
        assert gateway.given == 1  # another is asked for, and is not needed
        assert len(places) == 3 and all(drive.stops for drive in sim.drives)


def test_late_replies_over_tcp_are_dropped_by_their_numbers():
    with behind_a_gateway() as (sim, gateway, settings, config):
        sim.drives[0].position, sim.drives[1].position = 1234.0, -777.0
        with Bus(settings) as bus:
            drives = [ModbusDrive(bus, axis) for axis in config.axes]
            for delay in (1.2, 1.5, 2.5, 1.1):
                sim.faults.add(parse_fault(
                    f"delayed_reply,count=1,axis=pitch,seconds={delay * TIMEOUT_S}"
                ))  # fmt: skip
                with pytest.raises(BusError, match=r"silent|late"):
                    drives[0].position()
                for _ in range(4):
                    with contextlib.suppress(BusError):
                        assert drives[1].position() == -777
                    with contextlib.suppress(BusError):
                        assert drives[0].position() == 1234
        assert gateway.given == 1


def test_a_connection_that_the_gateway_ended_is_opened_again_by_the_next_request():
    with behind_a_gateway() as (sim, gateway, settings, config):
        with Bus(settings) as bus:
            drive = ModbusDrive(bus, config.axes[0])
            drive.status()
            gateway.drop()
            drive.go(config.axes[0].to_pulses(5.0))  # once, and not lost
            assert len(sim.executions()[0]) == 1
            gateway.drop()
            (result,) = stop_all([drive])
            assert result.acknowledged
        assert gateway.given == 3


HOLDS = """
import sys, time
from rig.config import load_config
from rig.config.settings import BusSettings
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig.journal.lock import BusLock
config = load_config(sys.argv[1])
lock = BusLock(config.bus).acquire("calibrate")
lock.leave(config)
bus = Bus(config.bus).open()
for axis in config.axes:
    ModbusDrive(bus, axis).status()
import signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("holds", flush=True)
time.sleep(60)
"""


def test_stop_waits_for_the_connection_of_a_session_that_it_killed(tmp_path, capsys):
    with behind_a_gateway() as (sim, gateway, _, _):
        gateway.free_s = 1.0
        path = tmp_path / "rig.toml"
        path.write_text(fast_text({"port = 5020": f"port = {gateway.port}"}))
        child = subprocess.Popen(
            [sys.executable, "-c", HOLDS, str(path)], stdout=subprocess.PIPE, text=True
        )
        try:
            assert child.stdout.readline() == "holds\n"
            assert main(["stop", "--config", str(path)]) == 0
        finally:
            child.kill()
            child.wait()
            child.stdout.close()
        said = capsys.readouterr().out
        assert "killing it" in said
        assert said.count("acknowledged, standing") == 3 and gateway.given == 2
        assert all(drive.stops for drive in sim.drives)


# Adapters


@contextlib.contextmanager
def adapter(sim, echo, filler, network=False):
    """A serial port, or a port, by which the drives are reached; its settings."""
    closing = threading.Event()

    def serve(fd):
        with contextlib.suppress(OSError):
            while not closing.is_set():
                if not select.select([fd], [], [], 0.05)[0]:
                    continue
                data = os.read(fd, 4096)
                if not data:
                    return
                if echo:
                    os.write(fd, data)
                reply = sim.server._answer(data[0], data[1:-2])
                if reply is not None and data[0]:
                    body = data[:1] + reply[1]
                    os.write(fd, filler + body + crc16(body))

    with contextlib.ExitStack() as stack:
        if network:
            listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
            where = {"transport": "rtu_tcp", "host": "127.0.0.1",
                     "port": listener.getsockname()[1]}  # fmt: skip

            def accept():
                with contextlib.suppress(OSError):
                    while True:
                        connection, _ = listener.accept()
                        with connection:
                            serve(connection.fileno())

            threading.Thread(target=accept, daemon=True).start()
        else:
            pytest.importorskip("serial", reason="serial ports need pyserial")
            ours, theirs = os.openpty()
            for fd in (ours, theirs):
                tty.setraw(fd)
                stack.callback(os.close, fd)
            where = {"transport": "rtu", "device": os.ttyname(theirs)}
            thread = threading.Thread(target=serve, args=[ours], daemon=True)
            thread.start()
            stack.callback(thread.join)
        stack.callback(closing.set)
        yield where


FAMILIES = ["leadshine_pr", "generic", "oriental_az", "applied_motion"]


@pytest.mark.parametrize("network", [False, True], ids=["serial", "network"])
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("echo", "filler"),
    [(True, b""), (False, b"\0"), (False, b"\xff"), (True, b"\xff\0\0")],
    ids=["echo", "00", "ff", "both"],
)
def test_a_drive_is_moved_and_stopped_through_it(echo, filler, family, network):
    config = fast_config({'map = "leadshine_pr"': f'map = "{family}"'})
    with (
        simulator(config, speedup=0.05) as sim,
        adapter(sim, echo, filler, network) as where,
    ):
        settings = changed(config.bus, **where, timeout_s=0.3, read_retries=0)
        with Bus(settings, config.silence_s) as bus:
            drives = [ModbusDrive(bus, axis) for axis in config.axes]
            assert drives[0].status().position == round(sim.drives[0].position)
            drives[0].go(config.axes[0].to_pulses(15.0))
            assert sim.drives[0].moving and len(sim.executions()[0]) == 1
            assert bus.echoes == echo
            results = stop_all(drives)
            assert all(r.acknowledged and r.standing for r in results), results


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("told", [False, True])
def test_an_echo_is_no_acknowledgement(family, told):
    """The first frame is the stop, whose reply may be the very same bytes."""
    config = fast_config({'map = "leadshine_pr"': f'map = "{family}"'})
    with simulator(config, speedup=0.05) as sim, adapter(sim, True, b"") as where:
        sim.faults.add(parse_fault("dead_drive,axis=pitch"))
        settings = changed(
            config.bus, **where, timeout_s=0.1, read_retries=0, echo=told
        )
        with Bus(settings) as bus:
            drives = [ModbusDrive(bus, axis) for axis in config.axes]
            pitch, *others = stop_all(drives)
        assert not pitch.acknowledged and not pitch.standing, pitch
        assert all(r.acknowledged and r.standing for r in others), others


def test_a_stop_that_only_the_echo_acknowledged_is_sent_again():
    """The drive never saw the first; its echo looked like a reply of function 6."""
    config = fast_config()
    with simulator(config, speedup=0.02) as sim, adapter(sim, True, b"") as where:
        settings = changed(config.bus, **where, timeout_s=0.1, read_retries=0)
        with sim.server.lock:
            for drive, axis in zip(sim.drives, config.axes, strict=True):
                drive._move(axis.to_pulses(18.0), 2000.0, 20000.0)
        sim.faults.add(parse_fault("lost_request,count=1,axis=pitch"))
        with Bus(settings) as bus:
            results = stop_all([ModbusDrive(bus, axis) for axis in config.axes])
        assert all(r.acknowledged and r.standing for r in results), results
        assert all(drive.stops for drive in sim.drives)


def test_drives_that_answer_late_beside_an_echo_are_seen_standing(monkeypatch):
    """A unit that was late once was never again given enough time to answer."""
    monkeypatch.setattr(core_stop, "VERIFY_S", 3.0)
    config = fast_config()
    with simulator(config, speedup=0.05) as sim, adapter(sim, True, b"") as where:
        for axis in config.axis_names:
            late = f"delayed_reply,axis={axis},seconds=0.15"
            sim.faults.add(parse_fault(late))
        settings = changed(config.bus, **where, timeout_s=0.3)
        with Bus(settings) as bus:
            results = stop_all([ModbusDrive(bus, axis) for axis in config.axes])
    assert all(r.acknowledged and r.standing for r in results), results


def test_a_key_of_an_echo_that_never_comes_is_said_to_be_wrong():
    config = fast_config()
    with simulator(config, speedup=0.05) as sim, adapter(sim, False, b"") as where:
        settings = changed(config.bus, **where, timeout_s=0.1, echo=True)
        with Bus(settings) as bus:
            results = stop_all([ModbusDrive(bus, axis) for axis in config.axes])
    assert all(r.standing and not r.acknowledged for r in results), results
    assert all("without an echo before: take out bus.echo" in str(r) for r in results)


def test_scan_finds_an_echo_and_setup_writes_its_key(capsys):
    config = fast_config()
    with simulator(config) as sim, adapter(sim, True, b"\0") as where:
        said = []
        settings = changed(config.bus, **where, timeout_s=0.2)
        answers = scanning.scan(settings, 3, said.append)
        assert [answer.unit for answer in answers] == [1, 2, 3]
        assert all(answer.echo for answer in answers)
        assert any("bus.echo = true" in line for line in said)
    from rig_workbench.commission.setup import new_text

    text = new_text(changed(settings, echo=True), [], "hyperimu", 2055)
    assert "echo = true" in text
    assert "echo" not in new_text(settings, [], "hyperimu", 2055)


@pytest.mark.parametrize("network", [False, True])
def test_bytes_that_are_no_reply_are_shown(network):
    config = fast_config()
    with simulator(config) as sim, adapter(sim, False, b"", network) as where:
        sim.server._answer = lambda unit, pdu: (b"", b"\x11\x22\x33", False)
        said, settings = [], changed(config.bus, **where, timeout_s=0.05)
        assert scanning.scan(settings, 1, said.append) == []
        assert any("no unit answers, but bytes came" in line and "11 22 33" in line
                   for line in said)  # fmt: skip
        with Bus(settings) as bus, pytest.raises(BusError, match="01 11 22 33"):
            read_words(bus, 1, 0, 1)


def test_rtu_frames_on_a_port_of_modbus_tcp_are_shown():
    with simulator(fast_config(), transport="rtu_tcp") as sim:
        settings = changed(sim.start().bus, transport="tcp", timeout_s=0.1)
        sim.server._take = lambda fd, *_: bytes(os.write(fd, b"\x01\x03\x02ab\x99"))
        with Bus(settings) as bus:
            with pytest.raises(BusError, match="01 03 02 61 62 99"):
                read_words(bus, 1, 0, 1)


def test_a_reply_is_found_among_other_bytes_and_nowhere_else():
    body = bytes([7, 3, 2, 0x12, 0x34])
    frame = body + crc16(body)
    for before in (b"", b"\0", b"\xff\xff", b"\x07\x03", bytes([7, 3, 0, 0, 0, 1])):
        assert rtu_reply(before + frame, 7, 3) == body[1:]
        assert rtu_reply(before + frame[:-1], 7, 3) is None
        assert rtu_reply(before + frame, 8, 3) is None
        assert rtu_reply(before + frame, 7, 16) is None
    refused = bytes([7, 0x83, 2])
    assert rtu_reply(b"\0" + refused + crc16(refused), 7, 3) == b"\x83\x02"


def test_a_pause_within_a_frame_is_waited_for():
    """A USB adapter that hands over what it has, in pieces."""
    config = fast_config()
    with simulator(config) as sim, adapter(sim, False, b"") as where:
        answer = sim.server._answer

        def slow(unit, pdu):
            time.sleep(0.02)
            return answer(unit, pdu)

        sim.server._answer = slow
        settings = changed(config.bus, **where, timeout_s=0.2)
        with Bus(settings) as bus:
            assert ModbusDrive(bus, config.axes[0]).status().enabled


def test_what_a_session_leaves_for_a_stop_says_the_echo(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 5020\necho = true"}))
    config = load_config(path)
    BusLock(config.bus).leave(config)
    armed = lock.read_armed(BusLock(config.bus).armed_path)
    assert armed["bus"]["echo"] is True


def test_a_refusal_without_a_code_is_no_acknowledgement():
    """Function 16 with the exception bit, and the words of an acknowledgement."""
    listener = socket.create_server(("127.0.0.1", 0))

    def answer():
        connection, _ = listener.accept()
        with connection:
            request = connection.recv(64)
            pdu = bytes([0x90]) + request[8:12]
            head = request[:4] + (len(pdu) + 1).to_bytes(2, "big") + request[6:7]
            connection.sendall(head + pdu)
            connection.recv(64)

    thread = threading.Thread(target=answer)
    thread.start()
    port = listener.getsockname()[1]
    with Bus(BusSettings(transport="tcp", host="127.0.0.1", port=port)) as bus:
        with pytest.raises(BusError, match="the refusal has no code"):
            bus.write(10, 0x00D3, 16, [1, 2])
    thread.join()
    listener.close()
