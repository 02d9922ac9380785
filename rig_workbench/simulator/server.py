"""A Modbus server for the simulated drives: TCP, RTU over TCP, RTU on a pty.

Functions 3, 6 and 16, written from the protocol's text. The frames are pymodbus's:
those of ``rig.drives.wire`` meet another hand's in every simulated session.
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

from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU

from rig_workbench.simulator.drive import DriveException, SimDrive
from rig_workbench.simulator.faults import FaultInjector

TARGET_SILENT = 11  # what a gateway answers for a unit that does not


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
        self._open = contextlib.ExitStack()

    def serve_tcp(self, port: int = 0, rtu: bool = False) -> int:
        """Listen on loopback; returns the port."""
        listener = socket.create_server(("127.0.0.1", port), backlog=8)
        listener.settimeout(0.1)
        self._open.callback(listener.close)
        self._start(self._accept, listener, rtu)
        return int(listener.getsockname()[1])

    def serve_pty(self) -> str:
        """Open a pseudo-terminal; returns the path a client opens as a serial port."""
        master, slave = os.openpty()
        for fd in (master, slave):  # the slave stays open, or the master hangs up
            tty.setraw(fd)
            self._open.callback(os.close, fd)
        self._start(self._serve, master, True)
        return os.ttyname(slave)

    def close(self) -> None:
        self._closing.set()
        for thread in self._threads:
            thread.join(2.0)
        self._open.close()

    def _start(self, target: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=target, args=args, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket, rtu: bool) -> None:
        while not self._closing.is_set():
            with contextlib.suppress(TimeoutError):
                connection, _ = listener.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._start(self._serve_socket, connection, rtu)

    def _serve_socket(self, connection: socket.socket, rtu: bool) -> None:
        with connection:
            self._serve(connection.fileno(), rtu)

    def _serve(self, fd: int, rtu: bool) -> None:
        buffer = b""
        with contextlib.suppress(OSError):
            while not self._closing.is_set():
                if not select.select([fd], [], [], 0.1)[0]:
                    buffer = b""  # a frame does not pause for so long
                elif data := os.read(fd, 4096):
                    buffer = self._take(fd, buffer + data, rtu)
                else:
                    return

    def _take(self, fd: int, buffer: bytes, rtu: bool) -> bytes:
        """Answer the requests in a buffer; what is left of it."""
        framer = (FramerRTU if rtu else FramerSocket)(DecodePDU(True))
        while len(buffer) >= 8:
            size = 6 + int.from_bytes(buffer[4:6], "big")
            if rtu:
                size = 9 + buffer[6] if buffer[1] == 16 else 8
            elif buffer[2:4] != b"\0\0" or not 8 <= size <= 260:
                return b""
            if len(buffer) < size:
                break
            frame = buffer[:size]
            crc = int.from_bytes(frame[-2:], "big")
            if rtu and not FramerRTU.check_CRC(frame[:-2], crc):
                buffer = buffer[1:]
                continue
            buffer = buffer[size:]
            body = frame[:-2] if rtu else frame[6:]
            number = int.from_bytes(frame[:2], "big")  # over TCP
            if (answer := self._answer(body[0], body[1:])) is not None:
                noise, reply, spoilt = answer
                if spoilt and not rtu:  # what the drives mangle, the gateway refuses
                    reply = bytes([body[1] | 0x80, TARGET_SILENT])
                sent = framer.encode(reply, body[0], number)
                if rtu and spoilt:
                    place = self._random.randrange(len(sent))
                    wrong = sent[place] ^ self._random.randrange(1, 256)
                    sent = sent[:place] + bytes([wrong]) + sent[place + 1 :]
                os.write(fd, noise + sent)
        return buffer

    def _spoils(self, axis: int) -> bool:
        fault = self.faults.take("spoilt_frames", axis)
        return fault is not None and self._random.random() < fault.share

    def _answer(self, unit: int, pdu: bytes) -> tuple[bytes, bytes, bool] | None:
        """Noise to send first, the reply's PDU, whether that is spoilt; None: silence.

        A write to unit 0 is obeyed by every drive of a family that takes it.
        """
        faults, function = self.faults, pdu[0]
        if unit == 0 and function in (6, 16):
            for unit_id, drive in self.drives.items():
                dead = faults.take("dead_drive", self._axis[unit_id])
                if drive.map.broadcast_stop and not dead:
                    self._execute(drive, pdu, broadcast=True)
        axis, silent = self._axis.get(unit), ("dead_drive", "lost_request")
        if axis is None or any(faults.take(kind, axis) for kind in silent):
            return None
        if self._spoils(axis):  # some drives say that the CRC was wrong, most nothing
            wrong_crc = (b"", bytes([function | 0x80, 8]), False)
            return self._random.choice([wrong_crc, None])
        if faults.take("exception_reply", axis):
            return b"", bytes([function | 0x80, 4]), False
        self.requests += 1
        reply = self._execute(self.drives[unit], pdu)
        if faults.take("lost_reply", axis):
            return None
        if function in (6, 16) and faults.take("lost_write_reply", axis):
            return None
        if delayed := faults.take("delayed_reply", axis):
            time.sleep(0.5 if delayed.seconds is None else delayed.seconds)
        time.sleep(self.latency_s)
        noise = b""
        if faults.take("noise_bytes", axis):
            noise = self._random.randbytes(self._random.randint(1, 6))
        return noise, reply, self._spoils(axis)

    def _execute(self, drive: SimDrive, pdu: bytes, broadcast: bool = False) -> bytes:
        function, data = pdu[0], pdu[1:]
        try:
            with self.lock:
                if function == 3 and len(data) == 4:
                    address, count = struct.unpack(">HH", data)
                    if not 1 <= count <= 125:
                        raise DriveException(3)
                    words = drive.read(address, count)
                    return struct.pack(f">BB{count}H", 3, 2 * count, *words)
                if function == 6 and len(data) == 4:
                    address, value = struct.unpack(">HH", data)
                    drive.write(address, [value], broadcast)
                    return pdu
                if function == 16 and len(data) >= 7:
                    address, count, size = struct.unpack(">HHB", data[:5])
                    if size != 2 * count or len(data) != 5 + size:
                        raise DriveException(3)
                    words = [*struct.unpack(f">{count}H", data[5:])]
                    drive.write(address, words, broadcast)
                    return pdu[:5]
                raise DriveException(1)
        except DriveException as error:
            return bytes([function | 0x80, error.code])
