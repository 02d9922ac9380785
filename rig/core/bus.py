"""The Modbus line. This is the only file that opens a drive port.

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
import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from rig.config.settings import BusSettings
from rig.core.faults import Fault

METHODS = {3: "read_holding_registers", 6: "write_register", 16: "write_registers"}
TURNAROUND_S = 0.05  # for the units to act on a broadcast, which none answers
GATEWAY_CODES = (10, 11)  # the unit behind the gateway is silent
PROBES = 6  # questions of another length to a unit whose replies come late
LATEST_S = 10.0  # no gateway keeps a reply for so long


class BusError(Fault):
    """No valid reply: silence, noise, a closed port, or a reply to something else."""

    def __init__(
        self,
        text: str,
        advice: str = "Check the unit's power, cable and id, and the line's settings",
    ) -> None:
        self.advice = advice
        super().__init__(text)


class Rejected(BusError):
    """The drive answered with an exception."""

    def __init__(self, unit: int, code: int, address: int) -> None:
        from pymodbus.constants import ExcCodes

        self.code = code
        name = next((each.name for each in ExcCodes if each == code), "unknown")
        name = name.lower().replace("_", " ")
        super().__init__(
            f"unit {unit} answered exception {code} ({name}) at 0x{address:04X}",
            "See its manual, and check that the axis's map is that of this drive",
        )


class Bus:
    """One Modbus line with any number of units; safe to use from several threads."""

    def __init__(
        self,
        settings: BusSettings,
        silence_s: float = 0.0,
        emit: Callable[..., Any] = lambda event, **fields: None,
    ) -> None:
        self.settings = settings
        # On Modbus TCP the gateway keeps the line's silence.
        self.silence_s = 0.0 if settings.transport == "tcp" else silence_s
        self.check: Callable[[], None] = lambda: None  # before each exchange; may raise
        self.silent: set[int] = set()  # units that did not answer the last time
        self._tell = emit  # told of every write before it is sent, of a stop's after
        self._untold: list[dict[str, Any]] = []
        self._lock = threading.RLock()
        self._urgent = False
        self._timeout_s = settings.timeout_s
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

    def open(self) -> Bus:
        """Open the port; BusError where it is absent, refused or held by another."""
        with self._lock:
            self._client = self._client or self._make_client()
            if not self._client.connect():
                why, advice = _why_closed(self.settings)
                raise BusError(f"cannot open {self.settings.where}: {why}", advice)
        return self

    def close(self) -> None:
        """Close the port; opening it again is possible."""
        with self._lock:
            if self._client is not None:
                self._client.close()
                self._client = None

    @contextlib.contextmanager
    def urgent(self, timeout_s: float | None = None) -> Iterator[None]:
        """Keep the line for a stop: no exchange of another thread, no ``check``.

        A reply is waited for ``timeout_s``, or as configured where that is shorter.
        """
        with self._lock:
            before = self._urgent, self._timeout_s
            outermost = not self._urgent
            configured = self.settings.timeout_s
            self._urgent = True
            self._timeout_s = min(timeout_s or configured, configured)
            try:
                yield
            finally:
                self._urgent, self._timeout_s = before
                untold, self._untold = (self._untold, []) if outermost else ([], [])
        for fields in untold if outermost else ():
            self._tell("write", **fields)

    def __enter__(self) -> Bus:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def read_words(
        self, unit: int, address: int, count: int, retries: int | None = None
    ) -> list[int]:
        """Read holding registers, with as many more tries as configured or given.

        Raises:
            BusError: no valid reply after all tries.
            Rejected: the drive answered with an exception, every time.
        """
        tries = 1 + (self.settings.read_retries if retries is None else retries)
        for left in reversed(range(tries)):
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
                if not left:
                    error.args = (f"{error}, tried {tries} times",)
                    raise
        raise AssertionError("unreachable")

    def write(self, unit: int, address: int, function: int, words: list[int]) -> None:
        """Write registers once. Never retried: a lost reply may hide a started move.

        Raises:
            BusError: no valid reply; whether the drive obeyed is unknown.
            Rejected: the drive refused.
        """
        self._emit(unit, address, words)
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
                found = len(self._read(unit, address, count))
            except Rejected:  # or the oldest was answered like this
                del owed[0]
                owed.append((count, time.monotonic()))
                continue
            if found == count:
                owed.clear()
            elif found in lengths:
                del owed[: lengths.index(found) + 1]
        if self._owed.get(unit):
            raise BusError(
                f"unit {unit}: its replies come too late to be told apart",
                "Raise bus.timeout_s",
            )

    def broadcast(self, address: int, function: int, words: list[int]) -> None:
        """Write registers of every unit on a serial line; no unit answers."""
        self._emit(0, address, words)
        with self._lock:
            self._send(function, 0, address, words, no_response_expected=True)
            self._quiet_until += TURNAROUND_S

    def _emit(self, unit: int, address: int, words: list[int]) -> None:
        """Tell of a write. A journal on a disk that hangs must not hold up a stop."""
        fields = {"unit": unit, "address": address, "words": words}
        if self._urgent:
            self._untold.append(fields | {"sent": round(time.time(), 4)})
        else:
            self._tell("write", **fields)

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
                    given = reply.function_code
                    raise BusError(f"unit {unit}: the reply is of function {given}")
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
        time.sleep(max(0.0, self._quiet_until - time.monotonic()))
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
                known = self._owed.setdefault(unit, [])
                known.append((owed, time.monotonic()))
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
