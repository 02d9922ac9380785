"""Reads of every function and type, and replies that come late or in pieces.

The server is written from the Modbus application protocol 1.1b3 and its serial line
guide, with its own CRC; it shares no code with what it tests.
"""

import contextlib
import os
import select
import socket
import struct
import threading
import time
import tty

import pytest
from harness import read_words

from rig.config import ConfigError
from rig.config.axis import Axis
from rig.config.maps import load_map, parse_map
from rig.config.settings import BusSettings, ReadingRegister
from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive, decoded
from rig.prove import scan as scanning
from rig.stop_config import map_of


def crc(data):
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register >> 1) ^ (0xA001 * (register & 1))
    return register.to_bytes(2, "little")


class Server:
    """Registers and bits by function; ``units`` that answer, None: every one."""

    def __init__(self, units=(1,), late_s=0.0, pause_s=0.0):
        self.units, self.late_s, self.pause_s = units, late_s, pause_s
        self.tables = {1: {}, 2: {}, 3: {}, 4: {}}
        self.written = []
        self._closing = threading.Event()

    def reply(self, unit, pdu):
        if self.units is not None and unit not in self.units:
            return None
        function, address = pdu[0], int.from_bytes(pdu[1:3], "big")
        quantity = int.from_bytes(pdu[3:5], "big")
        if function in (5, 6, 16):
            self.written.append(pdu)
            return pdu[:5]
        table = self.tables[function]
        found = [table.get(address + i) for i in range(quantity)]
        if None in found:
            return bytes([function | 0x80, 2])
        if function in (3, 4):
            data = struct.pack(f">{quantity}H", *found)
        else:
            number = sum(bit << i for i, bit in enumerate(found))
            data = number.to_bytes((quantity + 7) // 8, "little")
        return bytes([function, len(data)]) + data

    def _answer(self, fd, frame):
        if time.sleep(self.late_s) or not self.pause_s:
            os.write(fd, frame)
            return
        for byte in frame:
            os.write(fd, bytes([byte]))
            time.sleep(self.pause_s)

    def _serve(self, fd, numbered):
        with contextlib.suppress(OSError):
            while not self._closing.is_set():
                if not select.select([fd], [], [], 0.02)[0]:
                    continue
                data = os.read(fd, 512)
                if not data:
                    return
                while data:
                    size = 6 + int.from_bytes(data[4:6], "big") if numbered else None
                    frame, data = (data[:size], data[size:]) if size else (data, b"")
                    pdu = frame[7:] if numbered else frame[1:-2]
                    unit = frame[6] if numbered else frame[0]
                    if (reply := self.reply(unit, pdu)) is None:
                        continue
                    if numbered:
                        head = frame[:4] + struct.pack(">HB", len(reply) + 1, unit)
                        self._answer(fd, head + reply)
                    else:
                        body = bytes([unit]) + reply
                        self._answer(fd, body + crc(body))

    @contextlib.contextmanager
    def on(self, transport, timeout_s=0.2, retries=0):
        """Settings of a line on which it answers."""
        with contextlib.ExitStack() as stack:
            if transport == "rtu":
                pytest.importorskip("serial", reason="serial ports need pyserial")
                ours, theirs = os.openpty()
                for fd in (ours, theirs):
                    tty.setraw(fd)
                    stack.callback(os.close, fd)
                where = {"device": os.ttyname(theirs)}
                target = lambda: self._serve(ours, False)  # noqa: E731
            else:
                listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
                where = {"host": "127.0.0.1", "port": listener.getsockname()[1]}

                def target():
                    with contextlib.suppress(OSError):
                        while True:
                            made, _ = listener.accept()
                            with made:
                                self._serve(made.fileno(), transport == "tcp")

            thread = threading.Thread(target=target, daemon=True)
            thread.start()
            if transport == "rtu":  # or it would read of what is opened next
                stack.callback(thread.join)
            stack.callback(self._closing.set)
            yield BusSettings(
                transport=transport, timeout_s=timeout_s, read_retries=retries, **where
            )


LINES = ["tcp", "rtu_tcp", "rtu"]
VALUES = [  # type, registers with the high word first, value
    ("i16", [0xFFFE], -2),
    ("i32", [0xFFFE, 0xEE8F], -70001),
    ("i48", [0xFFFF, 0xFFFE, 0xEE8F], -70001),
    ("u48", [0x0001, 0, 2], (1 << 32) + 2),
    ("i64", [0xFFFF, 0xFFFF, 0xFFFE, 0xEE8F], -70001),
    ("u64", [0x8000, 0, 0, 1], (1 << 63) + 1),
    ("f32", [0xC2F6, 0xE979], -123.456),  # of IEEE 754, as tables of it have it
    ("f64", [0x400C, 0, 0, 0], 3.5),
]


@pytest.mark.parametrize("function", [3, 4])
@pytest.mark.parametrize("transport", LINES)
def test_registers_of_every_type_and_word_order(transport, function):
    server = Server()
    for place, (_, words, _) in enumerate(VALUES):
        for i, word in enumerate(words):
            server.tables[function][100 * place + i] = word
            server.tables[function][1000 + 100 * place + len(words) - 1 - i] = word
    with server.on(transport) as settings, Bus(settings) as bus:
        for place, (kind, _, value) in enumerate(VALUES):
            for order, at in (("big", 0), ("little", 1000)):
                told = ReadingRegister(
                    address=at + 100 * place, type=kind, function=function,
                    word_order=order,
                )  # fmt: skip
                assert decoded(bus, told, 1, order) == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize("transport", LINES)
def test_bits_are_read_as_a_number_the_first_lowest(transport):
    server = Server()
    bits = [1, 0, 1, 1, 0, 0, 0, 0, 0, 1]  # of ten inputs: 11 were refused
    server.tables[2] = dict(enumerate(bits))
    server.tables[1] = {7: 1}
    with server.on(transport) as settings, Bus(settings) as bus:
        told = ReadingRegister(address=0, type="u16", function=2, bits=10)
        assert decoded(bus, told, 1, "big") == 0b1000001101
        coil = ReadingRegister(address=7, type="u16", function=1, bits=1)
        assert decoded(bus, coil, 1, "big") == 1


DRIVE = """
schema = 1
name = "level"
title = "a drive by input registers, discrete inputs and coils"
sources = "none"
word_order = "little"
inter_frame_s = 0
[units]
speed = "rev_per_s"
speed_per_unit = 60
accel = "rev_per_s2"
accel_per_unit = 60
[status]
address = 0
function = 2
bits = 4
done = { set = [2] }
moving = { set = [1] }
fault = { set = [3] }
enabled = { set = [0] }
[position]
address = 16
type = "f32"
function = 4
counts = 1000
[move]
write = [
  { address = 0, words = ["position:f32", "speed:u16"] },
  { address = 9, words = [1] },
]
trigger = { address = 9, value = 1 }
[stop]
write = [{ address = 5, function = 5, words = [1] }]
"""


def test_a_drive_of_floats_inputs_and_coils(tmp_path):
    """A position in turns as f32, its counts a thousandth; its stop is a coil."""
    server = Server()
    server.tables[2] = {0: 1, 1: 0, 2: 1, 3: 0}
    low, high = struct.unpack(">HH", struct.pack(">f", -1.25))[::-1]
    server.tables[4] = {16: low, 17: high}
    axis = Axis.unmoved("x", 1, parse_map(DRIVE, "level.toml", tmp_path))
    theirs = map_of(DRIVE, tmp_path, faults := [])
    assert not faults
    with server.on("tcp") as settings, Bus(settings) as bus:
        drive = ModbusDrive(bus, axis)
        status = drive.status()
        assert (status.position, status.enabled, status.done) == (-1250, True, True)
        drive.stop()
        assert server.written[-1] == bytes([5, 0, 5, 0xFF, 0])
        drive.write(drive.map.move, position=2500 / 1000, speed=7)
        assert struct.unpack(">f", server.written[-2][8:10] + server.written[-2][6:8])[
            0
        ] == pytest.approx(2.5)
    told = vars(theirs.position)
    assert (told["function"], told["type"], told["counts"]) == (4, "f32", 1000.0)
    assert theirs.status.quantity == 4 and theirs.stop.write[0].function == 5


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("bits = 4", "bits = 40", "must be u16, u32"),
        ("function = 4", "function = 4\nbits = 2", "are read by function 1 or 2"),
        ("set = [3]", "set = [4]", "fault: must name bits 0..3"),
        ("words = [1] }]\n", 'words = ["position:i32"] }]\n', "function: must be 16"),
    ],
)
def test_what_cannot_be_is_named(tmp_path, old, new, told):
    head, _, tail = DRIVE.rpartition("[stop]")
    text = DRIVE.replace(old, new) if old in head else head + "[stop]" + tail
    text = head + "[stop]" + tail.replace(old, new) if "i32" in new else text
    with pytest.raises(ConfigError, match=told):
        parse_map(text, "level.toml", tmp_path)


@pytest.mark.parametrize("transport", LINES)
def test_a_reply_that_comes_late_is_told_as_late(transport):
    server = Server(late_s=0.35)
    server.tables[3] = {0: 5}
    with server.on(transport, timeout_s=0.1) as settings, Bus(settings) as bus:
        with pytest.raises(
            BusError, match=r"late by more than 0.1 s.*raise bus.timeout_s"
        ):
            read_words(bus, 1, 0, 1)
    server._closing.clear()
    with server.on(transport, timeout_s=0.9) as settings, Bus(settings) as bus:
        assert read_words(bus, 1, 0, 1) == [5]


def test_a_silent_unit_is_not_told_as_late():
    with Server(units=(2,)).on("rtu_tcp", timeout_s=0.05) as settings:
        with Bus(settings) as bus:
            bus.listen_s = 0.2
            with pytest.raises(BusError, match=r"no reply within 0.05 s"):
                read_words(bus, 1, 0, 1)


@pytest.mark.parametrize("transport", LINES)
def test_pauses_between_bytes_longer_than_the_gap_of_frames_are_accepted(transport):
    """3.5 characters at 115200 baud are .3 ms (1.75 ms by the guide)."""
    server = Server(pause_s=0.01)
    server.tables[3] = {0: 5, 1: 6}
    with server.on(transport, timeout_s=0.5) as settings, Bus(settings) as bus:
        assert read_words(bus, 1, 0, 2) == [5, 6]
        bus.write(1, 0, 16, [1, 2])
        assert len(server.written) == 1


def test_a_reply_that_is_cut_by_the_timeout_is_told_as_such():
    server = Server(pause_s=0.03)
    server.tables[3] = dict(enumerate(range(8)))
    with server.on("rtu", timeout_s=0.2) as settings, Bus(settings) as bus:
        bus.listen_s = 0.0
        with pytest.raises(
            BusError, match=r"incomplete after 0.2 s: raise bus.timeout"
        ):
            read_words(bus, 1, 0, 8)


def test_scan_names_a_server_that_answers_for_every_unit_and_late_ones(monkeypatch):
    server, said = Server(units=None), []
    family = load_map("leadshine_pr")
    server.tables[3] = dict.fromkeys(
        [family.status.address, family.position.address, family.position.address + 1], 0
    )
    with server.on("tcp") as settings:
        answers = scanning.scan(settings, 3, said.append, (family,))
    assert len(answers) == 1 and any("answers for every unit id" in s for s in said)
    server, said = Server(units=(1, 2), late_s=0.3), []
    server.tables[3] = {0: 1}
    monkeypatch.setattr(scanning, "RETRIES", 0)
    with server.on("rtu_tcp") as settings:
        assert scanning.scan(settings, 3, said.append, (family,)) == []
    assert any("answer late" in line and "raise bus.timeout_s" in line for line in said)
