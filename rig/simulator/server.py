"""A Modbus server for the simulated drives: TCP, RTU over TCP, RTU on a pty.

Functions 3, 6 and 16. Written from the protocol's text, so that client and server do
not share a library's mistakes.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import socket
import struct
import threading
import time
import tty
from collections.abc import Callable

from rig.simulator.drive import DriveException, SimDrive
from rig.simulator.faults import FaultInjector

TARGET_SILENT = 11  # what a gateway answers for a unit that does not

Cut = Callable[[bytes], tuple[bytes, list[bytes]]]  # to the rest, and the answers


def crc16(data: bytes) -> bytes:
    """The two CRC bytes of an RTU frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


class ModbusServer:
    """Units by id behind one line; requests are served one at a time."""

    def __init__(
        self,
        drives: dict[int, SimDrive],
        faults: FaultInjector,
        seed: int = 0,
        latency_s: float = 0.0,
    ) -> None:
        self.latency_s = latency_s
        self.drives = drives
        self.faults = faults
        self.requests = 0
        self.lock = threading.RLock()
        self._axis = {unit: axis for axis, unit in enumerate(drives)}
        self._random = random.Random(seed)
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self._listener: socket.socket | None = None
        self._open = contextlib.ExitStack()

    def serve_tcp(self, port: int = 0, rtu: bool = False) -> int:
        """Listen on loopback; returns the port."""
        listener = socket.create_server(("127.0.0.1", port), backlog=8)
        self._open.callback(listener.close)
        self._listener = listener
        self._start(self._accept, listener, self._cut_rtu if rtu else self._cut_mbap)
        return int(listener.getsockname()[1])

    def serve_pty(self) -> str:
        """Open a pseudo-terminal; returns the path a client opens as a serial port."""
        master, slave = os.openpty()
        for fd in (master, slave):  # the slave stays open, or the master hangs up
            tty.setraw(fd)
            self._open.callback(os.close, fd)
        self._start(self._serve, master, self._cut_rtu)
        return os.ttyname(slave)

    def close(self) -> None:
        self._closing.set()
        if self._listener is not None:  # wakes the thread that accepts
            with contextlib.suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
        for thread in list(self._threads):
            thread.join(2.0)
        self._open.close()

    def _start(self, target: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=target, args=args, daemon=True)
        self._threads = [t for t in self._threads if t.is_alive()]
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket, cut: Cut) -> None:
        with contextlib.suppress(OSError):  # as when it is shut down
            while not self._closing.is_set():
                connection, _ = listener.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._start(self._serve_socket, connection, cut)

    def _serve_socket(self, connection: socket.socket, cut: Cut) -> None:
        with contextlib.closing(connection):
            self._serve(connection.fileno(), cut)

    def _serve(self, fd: int, cut: Cut) -> None:
        buffer = b""
        with contextlib.suppress(OSError):
            while not self._closing.is_set():
                if not select.select([fd], [], [], 0.1)[0]:
                    buffer = b""  # a frame does not pause for so long
                    continue
                data = os.read(fd, 4096)
                if not data:
                    return
                buffer, answers = cut(buffer + data)
                for answer in answers:
                    os.write(fd, answer)

    def _cut_mbap(self, buffer: bytes) -> tuple[bytes, list[bytes]]:
        answers: list[bytes] = []
        while len(buffer) >= 8:
            tid, protocol, length = struct.unpack(">HHH", buffer[:6])
            if protocol or not 2 <= length <= 254:
                return b"", answers
            if len(buffer) < 6 + length:
                break
            unit, pdu = buffer[6], buffer[7 : 6 + length]
            buffer = buffer[6 + length :]
            for noise, reply, spoilt in self._answer(unit, pdu):
                if spoilt:  # what is mangled on the drives' side, the gateway refuses
                    reply = bytes([pdu[0] | 0x80, TARGET_SILENT])
                head = struct.pack(">HHHB", tid, 0, len(reply) + 1, unit)
                answers.append(noise + head + reply)
        return buffer, answers

    def _cut_rtu(self, buffer: bytes) -> tuple[bytes, list[bytes]]:
        answers: list[bytes] = []
        while len(buffer) >= 8:
            size = 9 + buffer[6] if buffer[1] == 16 else 8
            if len(buffer) < size:
                break
            frame = buffer[:size]
            if crc16(frame[:-2]) != frame[-2:]:
                buffer = buffer[1:]
                continue
            buffer = buffer[size:]
            for noise, reply, spoilt in self._answer(frame[0], frame[1:-2]):
                body = frame[:1] + reply
                answer = bytearray(body + crc16(body))
                if spoilt:
                    place = self._random.randrange(len(answer))
                    answer[place] ^= self._random.randrange(1, 256)
                answers.append(noise + bytes(answer))
        return buffer, answers

    def _spoils(self, axis: int) -> bool:
        fault = self.faults.take("spoilt_frames", axis)
        return fault is not None and self._random.random() < fault.share

    def _broadcast(self, pdu: bytes) -> None:
        """A write to unit 0: every drive of a family that takes it obeys, none says."""
        with self.lock:
            for unit, drive in self.drives.items():
                dead = self.faults.take("dead_drive", self._axis[unit])
                if drive.map.broadcast_stop and not dead and pdu[0] in (6, 16):
                    _execute(drive, pdu)

    def _answer(self, unit: int, pdu: bytes) -> list[tuple[bytes, bytes, bool]]:
        """Noise to send first, the reply's PDU, if that is spoilt; empty: silence."""
        axis, faults = self._axis.get(unit), self.faults
        if unit == 0:
            self._broadcast(pdu)
        if axis is None:
            return []
        if faults.take("dead_drive", axis) or faults.take("lost_request", axis):
            return []
        if self._spoils(axis):  # some drives say that the CRC was wrong, most nothing
            wrong_crc = [(b"", bytes([pdu[0] | 0x80, 8]), False)]
            return self._random.choice([wrong_crc, []])
        if faults.take("exception_reply", axis):
            return [(b"", bytes([pdu[0] | 0x80, 4]), False)]
        with self.lock:
            self.requests += 1
            reply = _execute(self.drives[unit], pdu)
        if faults.take("lost_reply", axis):
            return []
        if pdu[0] in (6, 16) and faults.take("lost_write_reply", axis):
            return []
        if delayed := faults.take("delayed_reply", axis):
            time.sleep(0.5 if delayed.seconds is None else delayed.seconds)
        time.sleep(self.latency_s)
        noise = b""
        if faults.take("noise_bytes", axis):
            noise = self._random.randbytes(self._random.randint(1, 6))
        return [(noise, reply, self._spoils(axis))]


def _execute(drive: SimDrive, pdu: bytes) -> bytes:
    function = pdu[0]
    try:
        if function == 3 and len(pdu) == 5:
            address, count = struct.unpack(">HH", pdu[1:])
            if not 1 <= count <= 125:
                raise DriveException(3)
            words = drive.read(address, count)
            return struct.pack(f">BB{count}H", 3, 2 * count, *words)
        if function == 6 and len(pdu) == 5:
            address, value = struct.unpack(">HH", pdu[1:])
            drive.write(address, [value])
            return pdu
        if function == 16 and len(pdu) >= 8:
            address, count, size = struct.unpack(">HHB", pdu[1:6])
            if size != 2 * count or len(pdu) != 6 + size or not count:
                raise DriveException(3)
            drive.write(address, list(struct.unpack(f">{count}H", pdu[6:])))
            return pdu[:5]
        raise DriveException(1)
    except DriveException as error:
        return bytes([function | 0x80, error.code])
