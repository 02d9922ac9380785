"""Modbus: the line. ``wire`` does the framing.

Reads are retried, a motion write is sent exactly once. RTU frames bear no number: after
a failed exchange the line is emptied, and a unit that owes a reply is asked for another
number of registers first, until what it answers can only be the answer to that.
"""

from __future__ import annotations

import contextlib
import os
import struct
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rig.drives.drive import Drive
from rig.drives.line import BusError, Line
from rig.drives.wire import LATER, Wire
from rig.registers import REGISTERS

if TYPE_CHECKING:
    from rig.config.settings import BusSettings

EXCEPTIONS = {
    1: "illegal function", 2: "illegal address", 3: "illegal value",
    4: "device failure", 5: "acknowledge", 6: "device busy", 7: "negative acknowledge",
    8: "memory parity error", 10: "gateway path unavailable", 11: "gateway no response",
}  # fmt: skip
TURNAROUND_S = 0.05  # for the units to act on a broadcast, which none answers
GATEWAY_CODES = (10, 11)  # the unit behind the gateway is silent
PASSING = (5, 6, 8, 10, 11)  # exceptions: acknowledge, busy, CRC; silence at a gateway
OUT_OF_REACH = (2, 3)  # of the target of a move
FRAME_BITS = 2 * 24 * 11  # of a stop and its reply on a serial line, at most
PROBES = 6  # questions of another length to a unit whose replies come late
LATEST_S = 10.0  # no gateway keeps a reply for so long
LISTEN_S = 2.0  # for a late reply of a unit that has never answered
NOBODY = 250  # a number that no unit has


class Rejected(BusError):
    def __init__(self, unit: int, code: int, address: int) -> None:
        self.code = code
        self.refused = code not in PASSING
        self.out_of_reach = code in OUT_OF_REACH
        name = EXCEPTIONS.get(code, "unknown")
        super().__init__(
            f"unit {unit} answered exception {code} ({name}) at 0x{address:04X}",
            "See its manual, and check that the axis's map is for this drive",
        )


class Bus(Line):
    """One Modbus line with any number of units; safe to use from several threads."""

    transports = ("tcp", "rtu_tcp", "rtu")

    def __init__(self, settings: BusSettings, *silence_emit: Any, **named: Any) -> None:
        super().__init__(settings, *silence_emit, **named)
        if settings.transport == "tcp":  # the gateway keeps the line's silence
            self.silence_s = 0.0
        self._quiet_until = 0.0
        # Of a unit: function and bytes of each reply that may still come, and when it
        # was asked; and a function and an address that were read well.
        self._owed: dict[int, list[tuple[int, int, float]]] = {}
        self._readable: dict[int, tuple[int, int]] = {}
        self.listen_s = LISTEN_S
        self._client = Wire(settings)
        self._spare: Wire | None = None  # a second connection, of a stop
        self._alone = False  # the gateway gives no second one
        self._wire_of: dict[int, Wire] = {}  # to ask a unit over next
        self._doubted: set[int] = set()  # whose acknowledgement may be an echo

    def connect(self) -> None:
        try:
            self._client.open()
        except ModuleNotFoundError as error:
            why = f"a serial port needs {error.name}, which is not installed"
            raise BusError(why, "Install pyserial", lost=True) from None
        except Exception as error:  # pyserial lets termios' own errors out
            why, advice = _why_closed(self.settings, error)
            text = f"cannot open {self.settings.where}: {why}"
            raise BusError(text, advice, lost=True) from None

    def close(self) -> None:
        with self._lock:
            for wire in filter(None, (self._client, self._spare)):
                wire.close()
            self._client, self._spare, self._alone = Wire(self.settings), None, False

    @property
    def echoes(self) -> bool:
        """Whether the adapter was seen to send back what it is sent."""
        return bool(self._client.echo)

    @property
    def late(self) -> set[int]:
        """Units whose replies came after their time."""
        return self._client.late

    def answers_for_every_unit(self) -> bool:
        """Whether the server also answers for a unit number that no device has."""
        if self.settings.transport == "rtu":
            return False
        try:
            function, address = next(iter(self._readable.values()), (3, 0))
            self.read(NOBODY, function, address, 1, 0)
        except BusError:
            return False
        finally:
            self._owed.pop(NOBODY, None)
        return True

    @property
    def noise(self) -> str:
        """What came last that was no reply, in hex."""
        return self._client.noise

    def doubts(self, unit: int) -> bool:
        """Whether its last acknowledgement may have been the request, sent back."""
        return self.echoes and unit in self._doubted

    @property
    def quick_s(self) -> float:
        return super().quick_s + FRAME_BITS / self.settings.baudrate

    def stops_at_once(self, drives: Sequence[Drive]) -> bool:
        """On a serial line, where all are of a family that takes a broadcast."""
        maps: list[Any] = [drive.axis.map for drive in drives]  # of registers
        alike = all(each.stop == maps[0].stop for each in maps)
        serial = self.settings.transport != "tcp"
        return serial and alike and bool(maps[0].broadcast_stop)

    def stop_at_once(self, drives: Sequence[Drive]) -> None:
        """Write the stop to every unit of a serial line; none answers."""
        if not self.stops_at_once(drives):
            return
        family: Any = drives[0].axis.map
        for frame in family.stop.write:
            words = frame.registers(family.word_order)
            self.tell(0, address=frame.address, words=words)
            request = written(frame.function, frame.address, words)
            with self._lock:
                self._send(frame.function, 0, request, answered=False)
                self._quiet_until += TURNAROUND_S

    def read(
        self,
        unit: int,
        function: int,
        address: int,
        quantity: int,
        retries: int | None = None,
    ) -> bytes:
        """The data of ``quantity`` registers, two bytes each, or bits from the lowest.

        ``function``: 3 holding or 4 input registers, 1 coils, 2 discrete inputs;
        ``retries`` after the first try, where not as ``Line.read_tries``. BusError: no
        valid reply after all tries; Rejected: an exception, every time.
        """
        tries = self.read_tries if retries is None else 1 + retries
        size = data_size(function, quantity)
        for tries_left in reversed(range(tries)):
            try:
                self._catch_up(unit, (function, address))
                data = self._read(unit, function, address, quantity)
                if len(data) == size:
                    if function in REGISTERS or unit not in self._readable:
                        self._readable[unit] = function, address
                    return data
                what = "registers" if function in REGISTERS else "bits"
                raise BusError(
                    f"unit {unit}: asked for {quantity} {what} at 0x{address:04X}, got "
                    f"{len(data)} bytes"
                )
            except BusError as error:
                if not tries_left:
                    self._tell_late(unit, error)
                    error.args = (f"{error}, tried {tries} times",)
                    raise
        raise AssertionError("unreachable")

    def _tell_late(self, unit: int, error: BusError) -> None:
        """Say of a unit that has never answered, so that nothing was moved and there is
        time to wait, whether its reply is only late."""
        if self._urgent or unit in self._readable or error.refused or error.lost:
            return
        if unit not in self.silent or unit == NOBODY:
            return
        with self._lock, contextlib.suppress(OSError, BusError):
            if self._client.listen(unit, self.listen_s):
                late = f"late by more than {self._timeout_s:g} s: raise bus.timeout_s"
                error.args = (f"unit {unit}: no valid reply ({late})",)
                error.advice = LATER

    def write(self, unit: int, address: int, function: int, words: list[int]) -> None:
        """Write registers once. Never retried: after a BusError that is not Rejected it
        is unknown whether the drive obeyed; a lost reply may hide a started move."""
        self.tell(unit, address=address, words=words)
        if not self._urgent:  # an acknowledgement of a stop tells of a stop, also late
            self._catch_up(unit, self._readable.get(unit))
        request = written(function, address, words)
        unsure = function != 16 and self._client.echo is None
        reply = self._exchange(function, unit, request, address, owed=0)
        (self._doubted.add if unsure else self._doubted.discard)(unit)
        if reply != request[:4]:  # address and value, or their number
            self._resynchronise(unit, function, 0)
            raise BusError(f"unit {unit}: the reply to a write is not its echo")

    def _read(self, unit: int, function: int, address: int, quantity: int) -> bytes:
        request = struct.pack(">HH", address, quantity)
        size = data_size(function, quantity)
        reply = self._exchange(function, unit, request, address, owed=size)
        odd = function in REGISTERS and reply and reply[0] % 2
        if not reply or len(reply) != 1 + reply[0] or odd:
            self._resynchronise(unit, function, size)
            raise BusError(f"unit {unit}: the reply to a read has no whole registers")
        # Another length: an earlier request's reply; this one's may follow.
        if len(reply) != 1 + size:
            self._resynchronise(unit, function, size)
        return reply[1:]

    def _catch_up(self, unit: int, place: tuple[int, int] | None) -> None:
        """Be sure that no earlier reply of a unit on an RTU line is still to come, else
        BusError. A unit answers in order: once it has answered a question whose reply
        has a length that it owes nowhere, all before it has come, or is lost."""
        place = self._readable.get(unit, place)
        if place is None:
            return
        function, address = place
        for _ in range(PROBES):
            recent = time.monotonic() - LATEST_S
            owed = [reply for reply in self._owed.get(unit, []) if reply[2] > recent]
            self._owed[unit] = owed
            if not owed:
                return
            sizes = [size if asked == function else 0 for asked, size, _ in owed]
            step = 1 if function in REGISTERS else 8
            quantity = next(
                n for n in range(step, 99 * step, step)
                if data_size(function, n) not in sizes
            )  # fmt: skip
            try:
                received = len(self._read(unit, function, address, quantity))
            except Rejected:  # or the oldest was answered like this
                del owed[0]
                size = data_size(function, quantity)
                owed.append((function, size, time.monotonic()))
                continue
            if received == data_size(function, quantity):
                owed.clear()
            elif received in sizes:
                del owed[: sizes.index(received) + 1]
                self.late.add(unit)
        if self._owed.get(unit):
            why = f"unit {unit}: its replies are too late to be assigned"
            raise BusError(why, LATER)

    def _exchange(
        self, function: int, unit: int, request: bytes, address: int, owed: int
    ) -> bytes:
        """The data of the reply to one request. Before BusError the line is emptied;
        a reply of ``owed`` bytes may still come."""
        with self._lock:
            if not self._urgent:
                self.check()  # holding the lock: nothing is sent after another's stop
            self.silent.add(unit)
            try:
                reply = self._send(function, unit, request)
                if reply[0] & 0x7F != function:
                    other = reply[0]
                    raise BusError(f"unit {unit}: the reply is of function {other}")
                refused = bool(reply[0] & 0x80)
                if refused and (len(reply) != 2 or not reply[1]):
                    raise BusError(f"unit {unit}: the refusal has no code")
            except BusError:
                self._resynchronise(unit, function, owed)
                raise
            code = reply[1] if refused else 0
            if code not in GATEWAY_CODES:
                self.silent.discard(unit)
            if refused:
                raise Rejected(unit, code, address)  # a refusal is a whole reply
            return reply[1:]

    def _send(
        self, function: int, unit: int, data: bytes, answered: bool = True
    ) -> bytes:
        """The PDU of the reply to a request that is sent once."""
        if (silent_s := self._quiet_until - time.monotonic()) > 0.0:
            time.sleep(silent_s)  # sleep(0) takes .1 ms as well
        self._choose_connection(unit)
        self.open()  # connecting, where it is lost, may take as long as configured
        pdu = bytes([function]) + data
        if not self._urgent:
            self._client.ask_only(bytes([unit]) + pdu)
        try:
            return self._client.exchange(unit, pdu, self._timeout_s, answered)
        except BusError as error:
            if self._spare is None:
                raise
            self._client, self._spare = self._spare, self._client
            if not error.lost:
                raise
            self._spare, self._alone = None, True  # the other has no second chance
            if not self._urgent:
                raise
            return self._client.exchange(unit, pdu, self._timeout_s, answered)
        finally:
            self._wire_of[unit] = self._client  # each unit has both by turns
            self._quiet_until = time.monotonic() + self.silence_s

    def _choose_connection(self, unit: int) -> None:
        """The one of two that a unit has answered over, or was not asked over last. A
        stop asks for a second where a gateway may be busy over the first."""
        if self._spare is not None and self._spare is self._wire_of.get(unit):
            self._client, self._spare = self._spare, self._client
        elif self._urgent and not (self._spare or self._alone) and self._client.owes():
            self._alone = True
            second = Wire(self.settings)
            with contextlib.suppress(Exception):  # it gives none
                second.open()
                self._client, self._spare, self._alone = second, self._client, False

    def _resynchronise(self, unit: int, function: int, owed: int) -> None:
        """Empty an RTU line; a reply of ``owed`` bytes may still come."""
        with self._lock:
            if self.settings.transport == "tcp":
                return
            owing = (function, owed, time.monotonic())
            self._owed.setdefault(unit, []).append(owing)
            gap = max(0.02, 20 * 11.0 / self.settings.baudrate, self.silence_s)
            end = time.monotonic() + 2 * self._timeout_s
            try:
                while self._client.socket is not None and time.monotonic() < end:
                    time.sleep(gap)
                    if not self._client.discard():
                        return
            except OSError:
                self._client.close()


def _why_closed(settings: BusSettings, error: Exception) -> tuple[str, str]:
    if settings.transport != "rtu":
        why = "nothing answers there, or all its connections are in use"
        return why, "Check power, cable and address"
    if not os.path.exists(settings.device):
        return "there is no such port", "Plug in the adapter, or correct bus.device"
    if not os.access(settings.device, os.R_OK | os.W_OK):
        return "you have no permission to open it", "Join its group, often dialout"
    if isinstance(error, ValueError):  # a line format that the port does not know
        return str(error), "Correct [bus]"
    return "in use by another program", "Close that program"


def data_size(function: int, quantity: int) -> int:
    return 2 * quantity if function in REGISTERS else (quantity + 7) // 8


def written(function: int, address: int, words: list[int]) -> bytes:
    """The data of a request to write registers, or a coil."""
    data = struct.pack(f">{len(words)}H", *words)
    more = struct.pack(">HB", len(words), len(data)) if function == 16 else b""
    return struct.pack(">H", address) + more + data


def words_of(data: bytes) -> list[int]:
    return [*struct.unpack(f">{len(data) // 2}H", data)]
