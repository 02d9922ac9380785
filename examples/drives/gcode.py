"""Steppers behind a GCode controller on a serial port: GRBL 1.1, or Marlin 2.

A worked example of docs/rig/drives.md. The controller has one axis for each unit, in
the order of ``letters``; all share its line, and move one after another. A count is
``1 / counts_per_unit`` of the controller's millimetre or degree with GRBL, and a step
with Marlin. Settings of the map:

    letters = "XYZABC"      # of units 1, 2, 3, ...
    counts_per_unit = 1000  # with Marlin: steps for a millimetre, as M92 says
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable

from rig.drives import Drive, Line
from rig.drives.drive import Look
from rig.drives.line import BusError, Refusal

TRAVEL = ("error:15", "error:3")  # GRBL: the target leaves the machine's travel
GREETING_S, PROBE_S = 5.0, 0.25  # of a board that its port's opening has reset
RESET = b"\x18"
LEAST_FEED = 1.0  # mm a minute: GRBL moves no slower
STILL_S = 0.1  # Marlin does not say whether it moves: so long no step
BEGINS_S = 0.3  # and so long after a move was asked for


class TextLine(Line):
    """Lines of text on a serial port, one answer to each."""

    transports = ("serial",)
    in_turn = True
    greeting = probe = ""  # of a board that begins; what one that runs answers to
    _port = None

    def connect(self) -> None:
        """Open the port, and wait until the board has begun: many are reset by it.

        The control line that resets is left as it is when the port is closed, so that
        the next opening does not, and the board keeps its place.
        """
        if self._port is not None:
            return
        import serial

        s = self.settings
        try:
            self._port = serial.serial_for_url(
                s.device, s.baudrate, timeout=0.01, exclusive=True
            )
        except (serial.SerialException, ValueError) as error:
            raise BusError(f"cannot open {s.where}: {error}") from None
        with contextlib.suppress(ImportError, AttributeError, OSError):  # POSIX has it
            import termios

            flags = termios.tcgetattr(self._port.fd)
            flags[2] &= ~termios.HUPCL
            termios.tcsetattr(self._port.fd, termios.TCSANOW, flags)
        end, begun = time.monotonic() + GREETING_S, self._begun
        while time.monotonic() < end:
            self._port.write(self.probe.encode())
            with contextlib.suppress(BusError):
                self._answer(0, begun, time.monotonic() + PROBE_S)
                return
        self.close()
        raise BusError(f"{s.where}: no greeting of a controller", "Check bus.baudrate")

    def _begun(self, line: str) -> bool:
        return line.startswith((self.greeting, "<", "ok"))

    def close(self) -> None:
        with self._lock:
            if self._port is not None:
                self._port.close()
                self._port = None

    def ask(
        self, unit: int, data: bytes, ends: Callable[[str], bool] | None = None
    ) -> list[str]:
        """Send, and wait for the lines up to the one that ends the answer: ``ok``,
        which the answer itself may follow.

        Raises:
            Refusal: the controller answered with an error. BusError: none came.
        """
        ends = ends or (lambda line: line.split()[:1] == ["ok"])
        with self.exchange(unit) as seconds:
            try:
                self._port.reset_input_buffer()
                self._port.write(data)
                return self._answer(unit, ends, time.monotonic() + seconds)
            except OSError:
                self.close()  # an adapter that was pulled out is opened again
                raise

    def _answer(self, unit: int, ends: Callable[[str], bool], end: float) -> list[str]:
        lines, buffer = [], b""
        while time.monotonic() < end:
            buffer += self._port.read(max(1, self._port.in_waiting))
            *whole, buffer = re.split(rb"[\r\n]+", buffer)
            for line in (raw.decode("ascii", "replace").strip() for raw in whole):
                lines.append(line)
                if ends(line):
                    return lines
                if line.lower().startswith(("error", "alarm", "!!")):
                    raise Refusal(f"unit {unit} answered {line!r}", line in TRAVEL)
        raise BusError(f"unit {unit}: no valid reply (silent for some time: {lines})")


class GCodeDrive(Drive):
    """One axis of a controller."""

    can_reset = True
    identity = switch_on = clear = ""  # commands

    def __init__(self, line, axis) -> None:
        super().__init__(line, axis)
        settings = axis.map.settings
        self._number = axis.unit - 1
        self._letter = str(settings.get("letters", "XYZABC"))[self._number]
        self._scale = float(settings.get("counts_per_unit", 1000))

    def _ask(self, text: str) -> list[str]:
        return self.line.ask(self.axis.unit, text.encode() + b"\n")

    def ids(self) -> dict[str, int | str]:
        answer = self._ask(self.identity)[:-1]
        return {"firmware": " ".join(answer)[:200], "axis": self._letter}

    def arm(self) -> None:
        self._ask(self.switch_on)

    def reset(self) -> None:
        self._ask(self.clear)

    def look(self, retries: int) -> Look:
        for left in reversed(range(1 + retries)):
            try:
                return self.glance()
            except BusError:
                if not left:
                    raise
        raise AssertionError("unreachable")

    def position(self) -> int:
        return self.glance().position

    def standing(self) -> bool:
        return self.glance().done

    def alarm(self) -> str:
        return "the controller is in alarm" if self.glance().fault else ""

    def place(self, count: int, speed: float) -> str:
        """Where to, and how fast. Ramps are those of the controller."""
        feed = 60.0 * speed / self._scale
        return f"{self._letter}{count / self._scale:.4f} F{max(feed, LEAST_FEED):.4f}"


class GrblLine(TextLine):
    greeting, probe = "Grbl", "?"


class Grbl(GCodeDrive):
    """GRBL moves by jogs, which alone can be cancelled."""

    line_type = GrblLine
    identity, switch_on, clear = "$I", "$X", "$X"
    _state = ""

    def glance(self) -> Look:
        return self._seen(b"?")

    def _seen(self, data: bytes) -> Look:
        """The report that ends the answer to some bytes."""
        unit = self.axis.unit
        *_, line = self.line.ask(unit, data, lambda line: line.startswith("<"))
        report = re.fullmatch(r"<(\w+)(?::(\d+))?\|MPos:([-\d.,]+)\|?.*>", line)
        if report is None:
            raise BusError(f"unit {unit}: {line!r} has no MPos: set $10=1")
        self._state, part, places = report.groups()
        count = round(float(places.split(",")[self._number]) * self._scale)
        holds = (self._state, part) == ("Hold", "1")
        moving = self._state in ("Run", "Jog", "Home") or holds
        fault = self._state in ("Alarm", "Door")
        on = self._state not in ("Sleep", "Hold")
        return Look(count, on, not (moving or fault), moving, fault)

    def arm(self) -> None:
        self._leave_hold()
        super().arm()

    def move(self, count: int, speed: float, accel: float) -> None:
        text = f"$J=G90 G53 G21 {self.place(count, speed)}"
        self.line.tell(self.axis.unit, text=text)
        self._ask(text)

    def stop(self) -> None:
        """Cancel all jogs, queued ones too; at rest this does nothing.

        A feed hold is sent only while another sender's program runs: at rest it would
        leave the controller in Hold and queue every later move. `hold` ends a Hold.
        """
        self.line.tell(self.axis.unit, text="stop")
        self._seen(b"\x85?")
        if self._state == "Run":
            self._seen(b"!?")

    def hold(self, pulses: int) -> None:
        self._leave_hold()

    def _leave_hold(self) -> None:
        """End a program that is held; its place is kept, as nothing moves."""
        look = self.glance()
        if self._state == "Hold" and not look.moving:
            greets = lambda line: line.startswith(GrblLine.greeting)  # noqa: E731
            self.line.ask(self.axis.unit, RESET, greets)


class MarlinLine(TextLine):
    greeting, probe = "start", "M114\n"


class Marlin(GCodeDrive):
    """Marlin says where its steppers are, and not whether they move."""

    line_type = MarlinLine
    identity, switch_on, clear = "M115", "M17", "M999"
    _goal = _count = None
    _moved = _asked = 0.0  # when its count changed, and was told to

    def glance(self) -> Look:
        if self._count is None:  # one look does not tell whether it moves
            self._count = self._steps()
            time.sleep(STILL_S)
        count, now = self._steps(), time.monotonic()
        if count != self._count:
            self._count, self._moved = count, now
        waits = self._goal not in (None, count) and now < self._asked + BEGINS_S
        moving = waits or now < self._moved + STILL_S
        return Look(count, True, not moving, moving, False)

    def _steps(self) -> int:
        text = " ".join(self._ask("M114"))
        found = re.search(rf"Count .*?\b{self._letter}: ?(-?\d+)", text)
        if found is None:
            raise BusError(f"unit {self.axis.unit}: no count in {text!r}")
        return int(found[1])

    def move(self, count: int, speed: float, accel: float) -> None:
        self._goal, self._asked = count, time.monotonic()
        self._ask("G90")
        text = f"G1 {self.place(count, speed)}"
        self.line.tell(self.axis.unit, text=text)
        self._ask(text)

    def stop(self) -> None:
        """At once, by its emergency parser: before what is queued."""
        self._goal = None
        self.line.tell(self.axis.unit, text="stop")
        self._ask("M410")
