"""Modbus frames on one connection: numbered over TCP; with a CRC on a serial port, or
through a socket.

A late reply over TCP is known by its number and the connection kept, since a gateway
may give no other for seconds. It serves one request after the other, so the same is
asked but a few times: little stands in the way of a stop. A reply of RTU is looked for
in all that came, past an adapter's echo and noise."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from collections.abc import Callable, Container
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
        self._unechoed = False  # the last reply to a read came without one
        self._numbered = settings.transport == "tcp"
        self._is_socket = settings.transport != "rtu"
        self._number = time.time_ns() & 0xFFFF
        # Of a request, without a number: those it was sent under; and its reply, where
        # that came while another was asked.
        self._accepted: dict[bytes, set[int]] = {}
        self._kept: dict[bytes, bytes] = {}
        self._unanswered: dict[int, float] = {}  # numbers, and when they were sent
        # Units of RTU that owe a reply: its function, and when it was asked for.
        self._missed: dict[int, tuple[int, float]] = {}
        self.late: set[int] = set()  # units whose reply came after bus.timeout_s
        self._came = b""  # over TCP, and not looked at yet
        self.noise = ""  # what came last that was no reply, in hex

    def open(self) -> None:
        """Connect, unless it is; OSError where that cannot be."""
        s = self.settings
        if self.socket is not None:
            return
        self._came = b""
        for of_before in (self._accepted, self._kept, self._unanswered):
            of_before.clear()
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
        begun, came = time.monotonic(), b""
        while answered:
            wait_s = begun + timeout_s - time.monotonic()
            kept = bytes([unit]) + pdu in self._kept
            data = self._read(0.0 if kept else max(0.0, wait_s))
            came += data
            if self._numbered:
                self._came += data
                reply = self._numbered_reply(bytes([unit]) + pdu)
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
                    self._missed[unit] = pdu[0], begun
                is_late = unit in self.late
                why = self._why(came, timeout_s, is_late, bytes([unit, pdu[0]]))
                error = BusError(f"unit {unit}: no valid reply ({why})")
                error.advice = LATER if is_late else error.advice
                raise error
        return b""

    def _look_for_late(self, came: bytes, but: int | None = None) -> None:
        """Note units of RTU whose reply is in what came after its time."""
        for unit, (function, sent) in list(self._missed.items()) if came else ():
            if unit != but and rtu_reply(came, unit, function) is not None:
                self._note_late(unit, sent)
                del self._missed[unit]

    def _note_late(self, unit: int, sent: float) -> None:
        """A stop waits less than configured: what came after that alone is late."""
        if time.monotonic() - sent > self.settings.timeout_s:
            self.late.add(unit)

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
            self._numbered_reply(bytes([unit]))
        return unit in self.late

    def _why(
        self, came: bytes, timeout_s: float, late: bool = False, begun: bytes = b"\0"
    ) -> str:
        if late:
            waited_s = self.settings.timeout_s
            return f"late by over {waited_s:g} s, like others: raise bus.timeout_s"
        if not came and self.echo and self._unechoed:
            return "a reply came without an echo before: take out bus.echo"
        if not came:
            return f"no reply within {timeout_s:g} s"
        if not self._numbered and came.startswith(begun):
            return f"incomplete after {timeout_s:g} s: raise bus.timeout_s"
        more = f" ... {len(came)} bytes" if len(came) > HEX_BYTES else ""
        self.noise = came[:HEX_BYTES].hex(" ") + more
        return f"the bytes received are not a reply: {self.noise}"

    def owes(self, numbers: Container[int] = range(1 << 16)) -> bool:
        """Whether a gateway may be busy with requests of before, of these numbers."""
        recent = time.monotonic() - OWED_S
        return any(s > recent and n in numbers for n, s in self._unanswered.items())

    def ask_only(self, request: bytes) -> None:
        """Take no reply to another, and none that came before."""
        self._kept.clear()
        self._forget(lambda other: other != request)

    def _forget(self, which: Callable[[bytes], bool]) -> None:
        for request in filter(which, [*self._accepted]):
            del self._accepted[request]
            self._kept.pop(request, None)

    def _numbered_request(self, request: bytes) -> bytes:
        """A frame to send; empty where the same was sent often enough, or is answered
        since: the answer to any number of one request is its answer."""
        if request[1] in WRITES and request not in self._accepted:
            self._forget(lambda other: other[0] == request[0])  # it was before
        accepted = self._accepted.setdefault(request, set())
        often = len(accepted) >= MOST_UNANSWERED and self.owes(accepted)
        if often or request in self._kept:
            return b""
        self._number = self._number + 1 & 0xFFFF
        accepted.add(self._number)
        self._unanswered[self._number] = time.monotonic()
        return struct.pack(">HHH", self._number, 0, len(request)) + request

    def _numbered_reply(self, asked: bytes) -> bytes | None:
        """The reply to a request; those to others are kept for them."""
        unit = asked[0]
        while len(self._came) > 7 and asked not in self._kept:
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
            self._note_late(sender, self._unanswered.pop(number, time.monotonic()))
            for request, accepted in self._accepted.items():
                if number in accepted and request[0] == sender:
                    self._kept[request] = reply
                elif number in accepted and request == asked:
                    del self._accepted[asked]
                    raise BusError(f"unit {unit}: another unit replied, {sender}")
        if asked not in self._kept:
            return None
        del self._accepted[asked]  # asked again it is another request
        return self._kept.pop(asked)

    def _reply_beside_echo(self, came: bytes, request: bytes) -> bytes | None:
        """The reply of an RTU line. That to function 5 or 6 repeats its request."""
        begin, unit, function = came.find(request), request[0], request[1]
        alike = function in (5, 6)
        if begin >= 0 and (not alike or self.echo):
            self.echo, came = True, came[begin + len(request) :]
        elif alike and self.echo:
            return None
        reply = rtu_reply(came, unit, function)
        if reply is not None and function in READS:
            self._unechoed = begin < 0
            self.echo = bool(self.echo)
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
