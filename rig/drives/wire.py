"""Modbus frames on one connection: numbered over TCP; with a CRC on a serial port, or
through a socket.

A late reply over TCP is dropped by its number and the connection kept, since a gateway
may give no other for seconds. It serves one request after the other, so the same is
asked but a few times: little stands in the way of a stop. A reply of RTU is looked for
in all that came, past an adapter's echo and noise."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from typing import TYPE_CHECKING, Any

from rig.drives.line import BusError

if TYPE_CHECKING:
    from rig.config.settings import BusSettings

HEX_BYTES = 32  # shown of what came
READS, WRITES = (1, 2, 3, 4), (5, 6, 15, 16)  # functions
FILLERS = (0x00, 0xFF)  # bytes that a converter puts before a reply
MOST_UNANSWERED = 3  # of one request, which is then waited for and not sent again
OWED_S = 10.0  # no gateway keeps a reply for so long
OLDEST = 4096  # requests since that of a late reply; other numbers are none
LATER = "Raise bus.timeout_s"
UNACKNOWLEDGED_MS = 5000  # until a connection whose peer is gone is given up


def crc16(data: bytes) -> bytes:
    """The two CRC bytes of an RTU frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


def rtu_reply(came: bytes, unit: int, function: int) -> bytes | None:
    """The PDU of the first whole reply in what came; None where there is none yet."""
    for start in range(len(came) - 4):
        if came[start] == unit and came[start + 1] & 0x7F == function:
            refused = came[start + 1] & 0x80
            size = 8 if function in WRITES else 5 + came[start + 2]
            size = 5 if refused else size
            frame = came[start : start + size]
            if len(frame) == size and crc16(frame[:-2]) == frame[-2:]:
                return frame[1:-2]
    return None


class Wire:
    """One connection, opened once and kept."""

    def __init__(self, settings: BusSettings) -> None:
        self.settings = settings
        self.socket: Any = None  # or the serial port
        # Whether the adapter sends back what it is sent; None: a read will show it.
        self.echo: bool | None = settings.echo or None
        self._numbered = settings.transport == "tcp"
        self._is_socket = settings.transport != "rtu"
        self._number = time.time_ns() & 0xFFFF
        self._asked = b""  # the last request, without a number,
        self._unanswered: dict[int, float] = {}  # numbers, and when they were sent
        self._missed: dict[int, int] = {}  # units of RTU that owe a reply: its function
        self.late: set[int] = set()  # units whose reply came after its time
        self._accepted: set[int] = set()  # those of the last request
        self._came = b""  # over TCP, and not looked at yet
        self.noise = ""  # what came last that was no reply, in hex

    def open(self) -> None:
        """Connect, unless it is; OSError where that cannot be."""
        s = self.settings
        if self.socket is not None:
            return
        self._came, self._asked = b"", b""
        self._unanswered.clear()
        if self._is_socket:
            made = socket.create_connection((s.host, s.port), s.timeout_s)
            made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with contextlib.suppress(AttributeError, OSError):  # Linux has it
                option = socket.TCP_USER_TIMEOUT
                made.setsockopt(socket.IPPROTO_TCP, option, UNACKNOWLEDGED_MS)
            self.socket = made
            return
        import serial  # type: ignore[import-untyped]  # no stubs

        self.socket = serial.Serial(
            s.device, s.baudrate, s.bytesize, s.parity, s.stopbits, timeout=0,
            write_timeout=s.timeout_s, exclusive=True,
        )  # fmt: skip

    def close(self) -> None:
        if self.socket is not None:
            with contextlib.suppress(OSError):
                self.socket.close()
            self.socket = None

    def exchange(
        self, unit: int, pdu: bytes, timeout_s: float, answered: bool = True
    ) -> bytes:
        """Send a request once; the PDU of its reply, empty where none is ``answered``;
        BusError where none came in time, ``lost`` where the connection is."""
        try:
            return self._exchange(unit, pdu, timeout_s, answered)
        except BusError:
            raise
        except Exception as error:  # of the system, or of pyserial
            self.close()
            text = " ".join(f"{type(error).__name__}: {error}".split())
            raise BusError(f"unit {unit}: no valid reply ({text})", lost=True) from None

    def _exchange(
        self, unit: int, pdu: bytes, timeout_s: float, answered: bool
    ) -> bytes:
        self.open()
        came = self.pending()
        self._look_for_late(came)
        self.open()  # the peer may have closed it meanwhile
        if self._numbered:
            self._came += came
            frame = self._numbered_request(bytes([unit]) + pdu)
        else:
            frame = bytes([unit]) + pdu
            frame += crc16(frame)
        if frame:
            (self.socket.sendall if self._is_socket else self.socket.write)(frame)
        end, came, late = time.monotonic() + timeout_s, b"", 0
        while answered:
            wait_s = end - time.monotonic()
            data = self._read(max(0.0, wait_s))
            came += data
            if self._numbered:
                self._came += data
                reply, dropped = self._numbered_reply(unit)
                late += dropped
            else:
                reply = self._reply_beside_echo(came, frame)
            if reply is not None:
                self._look_for_late(came, unit)  # this is no earlier one's
                return reply
            if wait_s <= 0.0:
                if self.echo and came.startswith(frame):
                    came = came[len(frame) :]
                self._look_for_late(came)
                if not self._numbered:
                    self._missed[unit] = pdu[0]
                if late:
                    self.late.add(unit)
                is_late, begun = unit in self.late, bytes([unit, pdu[0]])
                why = self._why(came, timeout_s, is_late, begun)
                error = BusError(f"unit {unit}: no valid reply ({why})")
                error.advice = LATER if is_late else error.advice
                raise error
        return b""

    def _look_for_late(self, came: bytes, but: int | None = None) -> None:
        """Note units of RTU whose reply is in what came after its time."""
        for unit, function in list(self._missed.items()) if came else ():
            if unit != but and rtu_reply(came, unit, function) is not None:
                self.late.add(unit)
                del self._missed[unit]

    def listen(self, unit: int, seconds: float) -> bool:
        """Wait for a reply of a unit after its time; whether one came."""
        end, came = time.monotonic() + seconds, b""
        while unit not in self.late and time.monotonic() < end:
            data = self._read(max(0.0, end - time.monotonic()))
            came += data
            if not self._numbered:
                self._look_for_late(came)
                continue
            self._came += data
            if self._numbered_reply(unit)[0] is not None:
                self.late.add(unit)
        return unit in self.late

    def _why(
        self, came: bytes, timeout_s: float, late: bool = False, begun: bytes = b"\0"
    ) -> str:
        if late:
            return f"late by over {timeout_s:g} s, like others: raise bus.timeout_s"
        if not came:
            return f"no reply within {timeout_s:g} s"
        if not self._numbered and came.startswith(begun):
            return f"incomplete after {timeout_s:g} s: raise bus.timeout_s"
        more = f" ... {len(came)} bytes" if len(came) > HEX_BYTES else ""
        self.noise = came[:HEX_BYTES].hex(" ") + more
        return f"the bytes received are not a reply: {self.noise}"

    @property
    def owes(self) -> bool:
        """Whether a gateway may be busy with requests of before."""
        recent = time.monotonic() - OWED_S
        return any(sent > recent for sent in self._unanswered.values())

    def _numbered_request(self, request: bytes) -> bytes:
        """A frame to send; empty where the same was sent often enough, since the answer
        to any number of one request is its answer."""
        if request != self._asked:
            self._asked, self._accepted = request, set()
        elif len(self._accepted) >= MOST_UNANSWERED and self.owes:
            return b""
        self._number = self._number + 1 & 0xFFFF
        self._accepted.add(self._number)
        self._unanswered[self._number] = time.monotonic()
        return struct.pack(">HHH", self._number, 0, len(request)) + request

    def _numbered_reply(self, unit: int) -> tuple[bytes | None, int]:
        """The reply to the last request, and how many replies to others it passed."""
        late = 0
        while len(self._came) > 7:
            number, protocol, size, sender = struct.unpack_from(">HHHB", self._came)
            age = self._number - number & 0xFFFF
            if protocol or not 3 <= size <= 254 or age > OLDEST:
                if self._came[0] not in FILLERS:  # no frame begins anywhere here
                    text = self._why(self._came, 0.0)
                    self.close()
                    raise BusError(f"unit {unit}: no valid reply ({text})")
                self._came = self._came[1:]
                continue
            if len(self._came) < 6 + size:
                break
            reply, self._came = self._came[7 : 6 + size], self._came[6 + size :]
            self._unanswered.pop(number, None)
            if number not in self._accepted:
                late += 1
                continue
            self._asked = b""
            if sender != unit:
                raise BusError(f"unit {unit}: another unit replied, {sender}")
            return reply, late
        return None, late

    def _reply_beside_echo(self, came: bytes, request: bytes) -> bytes | None:
        """The reply of an RTU line. That to function 5 or 6 repeats its request."""
        begin, unit, function = came.find(request), request[0], request[1]
        alike = function in (5, 6)
        if begin >= 0 and (not alike or self.echo):
            self.echo, came = True, came[begin + len(request) :]
        elif alike and self.echo:
            return None
        reply = rtu_reply(came, unit, function)
        if reply is not None and function in READS and self.echo is None:
            self.echo = False
        return reply

    def _read(self, seconds: float) -> bytes:
        """What comes within a time; OSError where connection or port is gone."""
        if not select.select([self.socket], [], [], seconds)[0]:
            return b""
        if not self._is_socket:
            return bytes(self.socket.read(max(1, self.socket.in_waiting)))
        data: bytes = self.socket.recv(4096)
        if not data:
            raise ConnectionResetError("the other end closed the connection")
        return data

    def pending(self) -> bytes:
        """What came since; a connection that its peer has closed is closed."""
        came = b""
        try:
            while data := self._read(0.0):
                came += data
        except OSError:
            self.close()
        return came

    def discard(self) -> bool:
        """Empty what came; whether there was anything."""
        if self._is_socket:
            return bool(self.pending())
        waiting = bool(self.socket.in_waiting)
        if waiting:
            self.socket.reset_input_buffer()
        return waiting
