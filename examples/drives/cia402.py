"""Servo drives of CANopen by CiA 402, in profile position mode, over python-canopen.

A worked example of docs/rig/drives.md: ``pip install canopen``. ``[bus]`` has
``transport = "can"``, python-can's ``INTERFACE:CHANNEL`` as ``device`` (the interface
is socketcan where there is none) and the bit rate as ``baudrate``; ``unit`` is the
node. A count is the drive's position unit (0x6064).
"""

from __future__ import annotations

import contextlib
import time
from typing import Any

from rig.drives import Drive, Line
from rig.drives.drive import Look
from rig.drives.line import BusError, Refusal
from rig.faults import Refused

CONTROL, STATUS, ERROR, MODE, MODE_SHOWN = 0x6040, 0x6041, 0x603F, 0x6060, 0x6061
POSITION, TARGET, SPEED, ACCEL, DECEL = 0x6064, 0x607A, 0x6081, 0x6083, 0x6084
IDENTITY, AT_HALT, PER_TURN = 0x1018, 0x605D, 0x608F
SIZES = {MODE: 1, CONTROL: 2, AT_HALT: 2}  # bytes of what is written; else 4
SHUT_DOWN, SWITCH_ON, ENABLE, RESET, HALT = 0x06, 0x07, 0x0F, 0x80, 0x100
NEW, AT_ONCE = 0x10, 0x20  # bits of the control word: a new target, taken at once
FAULT, REACHED, TAKEN = 0x08, 0x400, 0x1000  # bits of the status word
POWER, ENABLED = 0x6F, 0x27  # mask and value of "operation enabled"
PROFILE_POSITION = 1
NMT_START = 1
RAMP_DOWN = 1  # at a halt, and stay enabled
OUT_OF_RANGE = range(0x06090030, 0x06090033)  # SDO aborts of a value
STEP_S, STEPS = 0.01, 20  # of the state machine, and of a target that is taken


class CanLine(Line):
    """A CAN bus with one node for each axis."""

    transports = ("can",)
    _network: Any = None

    def connect(self) -> None:
        if self._network is None:
            try:
                import can
                import canopen
            except ModuleNotFoundError as error:
                raise Refused(
                    f"drives on CANopen need {error.name}, which is not installed: "
                    "pip install canopen"
                ) from None
            s, network = self.settings, canopen.Network()
            interface, _, channel = s.device.rpartition(":")
            try:
                network.connect(
                    interface=interface or "socketcan",
                    channel=channel,
                    bitrate=s.baudrate,
                )
            except (can.CanError, ValueError, ImportError) as error:
                raise BusError(f"cannot open {s.where}: {error}") from None
            self._network = network

    def start(self, unit: int) -> None:
        """Tell a node to leave "pre-operational", in which many enable no power stage.
        No node answers."""
        with self.exchange(unit):
            self._network.send_message(0, [NMT_START, unit])

    def close(self) -> None:
        with self._lock:
            if self._network is not None:
                self._network.disconnect()
                self._network = None

    def read(self, unit: int, index: int, sub: int = 0, signed: bool = False) -> int:
        """The value of an object."""
        with self._sdo(unit, index) as sdo:
            return int.from_bytes(sdo.upload(index, sub), "little", signed=signed)

    def write(self, unit: int, index: int, value: int) -> None:
        """Set an object, once."""
        self.tell(unit, address=index, words=[value])
        size = SIZES.get(index, 4)
        with self._sdo(unit, index) as sdo:
            sdo.download(index, 0, value.to_bytes(size, "little", signed=value < 0))

    @contextlib.contextmanager
    def _sdo(self, unit: int, index: int) -> Any:
        import canopen

        with self.exchange(unit) as seconds:
            if unit not in self._network:
                self._network.add_node(unit, canopen.ObjectDictionary())
            sdo = self._network[unit].sdo
            sdo.RESPONSE_TIMEOUT, sdo.MAX_RETRIES = seconds, 0
            try:
                yield sdo
            except canopen.SdoAbortedError as error:
                far = index == TARGET and error.code in OUT_OF_RANGE
                raise Refusal(f"unit {unit}, 0x{index:04X}: {error}", far) from None


class Cia402Drive(Drive):
    """One node."""

    line_type = CanLine
    line: CanLine
    can_reset = True

    def ids(self) -> dict[str, int | str]:
        """The vendor, and of product and serial number those that it has."""
        unit, known = self.axis.unit, {}
        for name, sub in {"vendor": 1, "product": 2, "serial": 4}.items():
            with contextlib.suppress(Refusal):
                known[name] = self.line.read(unit, IDENTITY, sub)
        return known

    def _word(self) -> int:
        return self.line.read(self.axis.unit, STATUS)

    def _control(self, word: int) -> None:
        self.line.write(self.axis.unit, CONTROL, word)

    def arm(self) -> None:
        """Through the states of the power stage, halted: no old target is gone on to.
        What a halt does depends on the mode, so that comes first."""
        self.line.start(self.axis.unit)
        self._set_mode()
        with contextlib.suppress(Refusal):  # a drive that ramps down anyway
            self.line.write(self.axis.unit, AT_HALT, RAMP_DOWN)
        for word in (SHUT_DOWN, SWITCH_ON, ENABLE):
            self._control(word | HALT)
            time.sleep(STEP_S)

    def _set_mode(self) -> None:
        """Profile position, and wait until the drive says so."""
        unit = self.axis.unit
        self.line.write(unit, MODE, PROFILE_POSITION)
        with contextlib.suppress(Refusal):  # a drive that does not say so
            for _ in range(STEPS):
                if self.line.read(unit, MODE_SHOWN) == PROFILE_POSITION:
                    return
                time.sleep(STEP_S)
            raise BusError(f"unit {unit} does not take profile position mode")

    def look(self, retries: int) -> Look:
        for left in reversed(range(1 + retries)):
            try:
                word, count = self._word(), self.position()
                break
            except BusError as error:
                if error.refused or not left:
                    raise
        on, moving = word & POWER == ENABLED, not word & REACHED
        return Look(count, on, not moving, moving and on, bool(word & FAULT), word)

    def position(self) -> int:
        return self.line.read(self.axis.unit, POSITION, signed=True)

    def standing(self) -> bool:
        return bool(self._word() & REACHED)

    def alarm(self) -> str:
        if not self._word() & FAULT:
            return ""
        return f"error 0x{self.line.read(self.axis.unit, ERROR):04X}"

    def reset(self) -> None:
        self._control(RESET)
        time.sleep(STEP_S)
        self._control(0)
        self.arm()

    def move(self, count: int, speed: float, accel: float) -> None:
        """The new target and the end of a halt are one word, so that none goes on to an
        old target; the bit is taken back once the drive has taken it."""
        unit, line = self.axis.unit, self.line
        self._set_mode()
        line.write(unit, SPEED, max(1, int(speed)))
        for ramp in (ACCEL, DECEL):
            with contextlib.suppress(Refusal):  # its own, where it takes none
                line.write(unit, ramp, max(1, int(accel)))
        line.write(unit, TARGET, count)
        self._control(ENABLE | NEW | AT_ONCE)
        for _ in range(STEPS):
            if self._word() & TAKEN:
                break
            time.sleep(STEP_S)
        self._control(ENABLE | AT_ONCE)

    def stop(self) -> None:
        self._control(ENABLE | HALT)

    def hold(self, pulses: int) -> None:
        self.line.write(self.axis.unit, TARGET, pulses + self.origin)

    def held(self) -> int | None:
        return self.line.read(self.axis.unit, TARGET, signed=True)

    def pulses_per_rev(self) -> int | None:
        with contextlib.suppress(Refusal):
            turns = self.line.read(self.axis.unit, PER_TURN, 2)
            return self.line.read(self.axis.unit, PER_TURN, 1) // max(1, turns) or None
        return None
