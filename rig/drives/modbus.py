"""Modbus: the line, and drives by their register maps.

pymodbus does the framing. What it leaves to its caller is done here: exception replies
are errors, replies are checked against their request, the silence between frames is
kept, reads are retried, and a motion write is sent exactly once. After any failed
exchange the line is emptied (or the connection opened again). RTU frames bear no
number, so a reply that comes later still could be taken for the answer to the next
request: a unit that owes one is asked for another number of registers first, until what
it answers can only be the answer to that.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from rig.config.axis import HIGHEST, LOWEST, Axis
from rig.config.maps import Read, RegisterMap, Writes, decode
from rig.config.settings import BusSettings, ReadingRegister
from rig.drives.drive import Drive, Look
from rig.drives.line import BusError, Line

METHODS = {3: "read_holding_registers", 6: "write_register", 16: "write_registers"}
TURNAROUND_S = 0.05  # for the units to act on a broadcast, which none answers
GATEWAY_CODES = (10, 11)  # the unit behind the gateway is silent
PASSING = (5, 6, 8, 10, 11)  # exceptions: acknowledge, busy, CRC; silence at a gateway
OUT_OF_REACH = (2, 3)  # of the target of a move
FRAME_BITS = 2 * 24 * 11  # of a stop and its reply on a serial line, at most
PROBES = 6  # questions of another length to a unit whose replies come late
LATEST_S = 10.0  # no gateway keeps a reply for so long


class Rejected(BusError):
    """The drive answered with an exception."""

    def __init__(self, unit: int, code: int, address: int) -> None:
        from pymodbus.constants import ExcCodes

        self.code = code
        self.refused = code not in PASSING
        self.out_of_reach = code in OUT_OF_REACH
        name = next(
            (exception.name for exception in ExcCodes if exception == code), "unknown"
        )
        name = name.lower().replace("_", " ")
        super().__init__(
            f"unit {unit} answered exception {code} ({name}) at 0x{address:04X}",
            "See its manual, and check that the axis's map is that of this drive",
        )


class Bus(Line):
    """One Modbus line with any number of units; safe to use from several threads."""

    transports = ("tcp", "rtu_tcp", "rtu")

    def __init__(
        self,
        settings: BusSettings,
        silence_s: float = 0.0,
        emit: Callable[..., Any] = lambda event, **fields: None,
    ) -> None:
        # On Modbus TCP the gateway keeps the line's silence.
        super().__init__(
            settings, (settings.transport != "tcp" and silence_s) or 0.0, emit
        )
        self._quiet_until = 0.0
        # Of a unit: registers in each reply that may still come, 0 of a write, and
        # when it was asked; and an address that was read well.
        self._owed: dict[int, list[tuple[int, float]]] = {}
        self._readable: dict[int, int] = {}
        self._client: Any = None

    def _make_client(self) -> Any:
        from pymodbus import FramerType
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient

        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
        s = self.settings
        how: dict[str, Any] = {"timeout": s.timeout_s, "retries": 0}
        how["framer"] = FramerType.SOCKET if s.transport == "tcp" else FramerType.RTU
        if s.transport != "rtu":
            return ModbusTcpClient(s.host, port=s.port, **how)
        line = s.model_dump(include={"baudrate", "parity", "stopbits", "bytesize"})
        return ModbusSerialClient(s.device, **line, **how)

    def connect(self) -> None:
        self._client = self._client or self._make_client()
        if not self._client.connect():
            why, advice = _why_closed(self.settings)
            raise BusError(f"cannot open {self.settings.where}: {why}", advice)

    def close(self) -> None:
        with self._lock:
            if self._client is not None:
                self._client.close()
                self._client = None

    @property
    def quick_s(self) -> float:
        return super().quick_s + FRAME_BITS / self.settings.baudrate

    def stops_at_once(self, drives: Sequence[Drive]) -> bool:
        """On a serial line, where all are of a family that takes a broadcast."""
        maps = [drive.map for drive in drives if isinstance(drive, ModbusDrive)]
        alike = all(each.stop == maps[0].stop for each in maps)
        return self.settings.transport != "tcp" and alike and maps[0].broadcast_stop

    def stop_at_once(self, drives: Sequence[Drive]) -> None:
        if self.stops_at_once(drives):
            assert isinstance(drives[0], ModbusDrive)
            family = drives[0].map
            for frame in family.stop.write:
                words = frame.registers(family.word_order)
                self.broadcast(frame.address, frame.function, words)

    def read_words(
        self, unit: int, address: int, count: int, retries: int | None = None
    ) -> list[int]:
        """Read holding registers, with as many more tries as configured or given.

        Raises:
            BusError: no valid reply after all tries.
            Rejected: the drive answered with an exception, every time.
        """
        tries = 1 + (self.settings.read_retries if retries is None else retries)
        for tries_left in reversed(range(tries)):
            try:
                self._catch_up(unit, address)
                words = self._read(unit, address, count)
                if len(words) == count:
                    self._readable[unit] = address
                    return words
                raise BusError(
                    f"unit {unit}: asked for {count} registers at 0x{address:04X}, "
                    f"got {len(words)}"
                )
            except BusError as error:
                if not tries_left:
                    error.args = (f"{error}, tried {tries} times",)
                    raise
        raise AssertionError("unreachable")

    def write(self, unit: int, address: int, function: int, words: list[int]) -> None:
        """Write registers once. Never retried: a lost reply may hide a started move.

        Raises:
            BusError: no valid reply; whether the drive obeyed is unknown.
            Rejected: the drive refused.
        """
        self.tell(unit, address=address, words=words)
        if not self._urgent:  # an acknowledgement of a stop tells of a stop, also late
            self._catch_up(unit, self._readable.get(unit))
        reply = self._exchange(function, unit, address, words)
        echoed = (
            list(reply.registers) == words
            if function == 6
            else reply.count == len(words)
        )
        if not echoed or reply.address != address:
            self._resynchronise(unit, 0)
            raise BusError(f"unit {unit}: the reply to a write does not echo it")

    def _read(self, unit: int, address: int, count: int) -> list[int]:
        """The registers of one reply, of any number."""
        words = list(self._exchange(3, unit, address, count).registers)
        # Another length: an earlier request's reply; this one's may follow.
        if len(words) != count:
            self._resynchronise(unit, count)
        return words

    def _catch_up(self, unit: int, address: int | None) -> None:
        """Be sure that no earlier reply of a unit on an RTU line is still to come.

        A unit answers in order: once it has answered a question whose reply has a
        length that it owes nowhere, all before it has come, or is lost.

        Raises:
            BusError: it is silent, or what it says is always the answer to another.
        """
        address = self._readable.get(unit, address)
        if address is None:
            return
        for _ in range(PROBES):
            recent = time.monotonic() - LATEST_S
            owed = [one for one in self._owed.get(unit, []) if one[1] > recent]
            self._owed[unit] = owed
            if not owed:
                return
            lengths = [length for length, _ in owed]
            count = next(n for n in range(1, 99) if n not in lengths)
            try:
                received = len(self._read(unit, address, count))
            except Rejected:  # or the oldest was answered like this
                del owed[0]
                owed.append((count, time.monotonic()))
                continue
            if received == count:
                owed.clear()
            elif received in lengths:
                del owed[: lengths.index(received) + 1]
        if self._owed.get(unit):
            raise BusError(
                f"unit {unit}: its replies come too late to be told apart",
                "Raise bus.timeout_s",
            )

    def broadcast(self, address: int, function: int, words: list[int]) -> None:
        """Write registers of every unit on a serial line; no unit answers."""
        self.tell(0, address=address, words=words)
        with self._lock:
            self._send(function, 0, address, words, no_response_expected=True)
            self._quiet_until += TURNAROUND_S

    def _exchange(self, function: int, unit: int, address: int, asked: Any) -> Any:
        """The reply to one request, for a number of registers or with words to write.

        Where none is valid, the line is emptied before BusError is raised.
        """
        with self._lock:
            if not self._urgent:
                self.check()  # holding the lock: nothing is sent after another's stop
            self.silent.add(unit)
            try:
                reply = self._send(function, unit, address, asked)
                if reply is None or reply.dev_id != unit:
                    raise BusError(f"unit {unit}: another unit replied")
                code = reply.exception_code if reply.isError() else 0
                if code not in GATEWAY_CODES:
                    self.silent.discard(unit)
                if code:
                    raise Rejected(unit, code, address)
                if reply.function_code != function:
                    other = reply.function_code
                    raise BusError(f"unit {unit}: the reply is of function {other}")
            except Rejected:
                raise  # a refusal is a whole reply
            except BusError:
                self._resynchronise(unit, asked if function == 3 else 0)
                raise
            return reply

    def _send(
        self, function: int, unit: int, address: int, asked: Any, **more: Any
    ) -> Any:
        if self._client is None:
            self.open()
        if function == 3:
            more["count"] = asked
        else:
            more |= {"value": asked[0]} if function == 6 else {"values": asked}
        if (silent_s := self._quiet_until - time.monotonic()) > 0.0:
            time.sleep(silent_s)  # sleep(0) takes .1 ms as well
        try:
            # Connecting, where it is lost, may take as long as configured.
            self._client.comm_params.timeout_connect = self.settings.timeout_s
            if not self._client.connect():
                raise ConnectionError("cannot connect")
            self._client.comm_params.timeout_connect = self._timeout_s
            send = getattr(self._client, METHODS[function])
            return send(address, device_id=unit, **more)
        except Exception as error:
            # pymodbus lets struct, index and socket errors of mangled frames out.
            text = " ".join(f"{type(error).__name__}: {error}".split())
            if "No response" in text:
                text = f"silent for {self._timeout_s:g} s"
            raise BusError(f"unit {unit}: no valid reply ({text})") from None
        finally:
            self._quiet_until = time.monotonic() + self.silence_s

    def _resynchronise(self, unit: int, owed: int) -> None:
        """Empty the line; a reply of ``owed`` registers of the unit may still come."""
        with self._lock:
            if self._client is None:
                return
            if self.settings.transport != "tcp":
                replies_owed = self._owed.setdefault(unit, [])
                replies_owed.append((owed, time.monotonic()))
            port = self._client.socket
            if self.settings.transport != "rtu" or port is None:
                self._client.close()  # the next request connects again
                return
            gap = max(0.02, 20 * 11.0 / self.settings.baudrate, self.silence_s)
            end = time.monotonic() + 2 * self._timeout_s
            try:
                while time.monotonic() < end:
                    time.sleep(gap)
                    if not port.in_waiting:
                        return
                    port.reset_input_buffer()
            except OSError:
                self._client.close()


def _why_closed(settings: BusSettings) -> tuple[str, str]:
    """The reason, and what to do."""
    if settings.transport != "rtu":
        why = "nothing answers there, or all its connections are taken"
        return why, "Check power, cable and address"
    if not os.path.exists(settings.device):
        return "there is no such port", "Plug in the adapter, or correct bus.device"
    if not os.access(settings.device, os.R_OK | os.W_OK):
        return "this user may not open it", "Join its group, often dialout"
    return "held by another program", "Close that program"


class ModbusDrive(Drive):
    """What a register map means, spoken over the bus."""

    line_type = Bus
    axis: Axis
    line: Bus

    @property
    def map(self) -> RegisterMap:
        """The registers of its family."""
        found = self.axis.map
        assert isinstance(found, RegisterMap)
        return found

    @property
    def counts_from_home(self) -> bool:  # type: ignore[override]  # of the map
        return self.map.home_place is not None

    @property
    def can_reset(self) -> bool:  # type: ignore[override]  # of the map
        return self.map.alarm_reset is not None

    @property
    def can_home(self) -> bool:  # type: ignore[override]  # of the map
        return self.map.home is not None

    @property
    def can_set_zero(self) -> bool:  # type: ignore[override]  # of the map
        return self.map.set_zero is not None

    @property
    def tells_homed(self) -> bool:  # type: ignore[override]  # of the map
        return self.map.homed is not None

    @property
    def says_homed(self) -> bool:  # type: ignore[override]  # of the status word
        bits = self.map.homed
        word = self.last.word if self.last else None
        return bits is not None and word is not None and bits.holds(word)

    def ids(self) -> dict[str, int | str]:
        """What the map calls identity; a register that refuses says so."""
        found: dict[str, int | str] = {}
        for name, read in self.map.identity.items():
            try:
                found[name] = self.read(read)
            except Rejected as error:
                found[name] = f"exception {error.code}"
        return found

    def lasting(self, ids: dict[str, int | str]) -> dict[str, int | str]:
        """Without signed registers, which are measurements, such as a temperature."""
        kinds = self.map.identity
        return {n: value for n, value in ids.items() if kinds[n].type.startswith("u")}

    def foreign(self, ids: dict[str, int | str]) -> str:
        for name, (low, high) in self.map.recognise.items():
            value = ids[name]
            if isinstance(value, int) and not low <= value <= high:
                return f"{name} is {value}, not in [{low}, {high}]"
        return ""

    def arm(self) -> None:
        self.write(self.map.enable)

    def look(self, retries: int) -> Look:
        word = self.read(self.map.status, retries)
        count = self.read(self.map.position, retries)
        return Look(position=count, **self.map.status.flags(word), word=word)

    def position(self) -> int:
        return self.read(self.map.position)

    def standing(self) -> bool:
        flags = self.map.status.flags(self.read(self.map.status))
        return flags["done"] and not flags["moving"]

    def alarm(self) -> str:
        """The alarm in words, empty where there is none or no register for it."""
        if not (read := self.map.alarm) or not (code := self.read(read)):
            return ""
        name = read.names.get(code)
        return f"alarm 0x{code:X}" + (f" ({name})" if name else "")

    def move(self, count: int, speed: float, accel: float) -> None:
        """Every frame is sent exactly once; speed and ramps as registers hold them."""
        self.write(self.map.move, position=count, **self.axis.motion_counts())

    def stop(self) -> None:
        """Quick stop; torque stays on."""
        self.write(self.map.stop)

    def reset(self) -> None:
        self.write(self.map.alarm_reset)

    def hold(self, pulses: int) -> None:
        self.write(self.map.hold, position=pulses + self.origin)

    def held(self) -> int | None:
        """The target register as it reads, None where it cannot be read."""
        read = self.map.target
        with contextlib.suppress(Rejected):
            return self.read(read) if read else None
        return None

    def home(self) -> None:
        self.write(self.map.home)

    def set_zero(self, count: int) -> None:
        self.write(self.map.set_zero, home=count)

    def mirror_limits(self) -> None:
        """Write the axis's soft limits into the drive, as far as it can count."""
        low, high = (
            min(max(pulses + self.origin, LOWEST), HIGHEST)
            for pulses in (self.axis.min_pulses, self.axis.max_pulses)
        )
        self.write(self.map.limits, min=low, max=high)

    def pulses_per_rev(self) -> int | None:
        if read := self.map.pulses_per_rev:
            with contextlib.suppress(Rejected):  # a model of the family without it
                return self.read(read) or None
        return None

    def watch(self) -> int:
        watch = self.map.comm_timeout
        assert watch is not None  # the map has one, or it is not asked
        place = watch.place_of("timeout") or (watch.write[0].address, "u16")
        return self.read(Read(address=place[0], type=place[1]))

    def set_watch(self, counts: int) -> None:
        self.write(self.map.comm_timeout, timeout=counts)

    def watch_counts(self, seconds: float) -> int:
        assert self.map.comm_timeout is not None
        return max(1, math.ceil(seconds * self.map.comm_timeout.per_s - 1e-9))

    def write(self, table: Writes | None, **values: int) -> None:
        """Send the frames of one of the map's tables; none where the map lacks it.

        What moves the drive, or stops it, is sent once; the rest may be written twice,
        and is retried as reads are.
        """
        once = any(
            table is motion for motion in (self.map.move, self.map.home, self.map.stop)
        )
        tries = 1 if once else 1 + self.line.settings.read_retries
        for tries_left in reversed(range(tries)):
            try:
                return self._write(table, values)
            except BusError as error:
                if not tries_left or error.refused:
                    raise

    def _write(self, table: Writes | None, values: dict[str, int]) -> None:
        for frame in table.write if table else ():
            words = frame.registers(self.map.word_order, **values)
            self.line.write(self.axis.unit, frame.address, frame.function, words)

    def read(self, read: Read, retries: int | None = None) -> int:
        """The value of one or two registers."""
        order = self.map.word_order
        return decoded(self.line, read, self.axis.unit, order, retries)


def decoded(
    bus: Bus,
    read: Read | ReadingRegister,
    unit: int,
    word_order: str,
    retries: int | None = None,
) -> int:
    """The value of one or two registers of a unit."""
    words = bus.read_words(unit, read.address, read.count, retries)
    return decode(words, read.type, word_order)
