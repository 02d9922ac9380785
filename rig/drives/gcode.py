"""Steppers behind a GCode controller on a serial port: GRBL 1.1, or Marlin 2.

The controller has one axis for each unit, in the order of ``letters``; all share its
line, and move one after another. A count is ``1 / counts_per_unit`` of the controller's
millimetre or degree with GRBL, and a step with Marlin. Settings of the map:

    dialect = "grbl"        # or "marlin"
    letters = "XYZABC"      # of units 1, 2, 3, ...
    counts_per_unit = 1000  # with Marlin: steps for a millimetre, as M92 says
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rig.drives.drive import Drive, Look
from rig.drives.line import BusError, Line, Refusal

if TYPE_CHECKING:
    from rig.config.axis import Axis

TRAVEL = ("error:15", "error:3")  # GRBL: the target leaves the machine's travel
STILL_S = 0.1  # Marlin does not say whether it moves: so long no step
BEGINS_S = 0.3  # and so long after a move was asked for


class TextLine(Line):
    """Lines of text on a serial port, one answer to each."""

    transports = ("serial",)
    in_turn = True
    _port: Any = None

    def connect(self) -> None:
        if self._port is None:
            import serial  # type: ignore[import-untyped]  # no stubs

            s = self.settings
            try:
                self._port = serial.serial_for_url(
                    s.device, s.baudrate, timeout=0.01, exclusive=True
                )
            except (serial.SerialException, ValueError) as error:
                raise BusError(f"cannot open {s.where}: {error}") from None

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

    line_type = TextLine
    line: TextLine
    can_reset = True

    def __init__(self, line: TextLine, axis: Axis) -> None:
        super().__init__(line, axis)
        known = axis.map.settings
        self._grbl = known.get("dialect", "grbl") == "grbl"
        self._number = axis.unit - 1
        self._letter = str(known.get("letters", "XYZABC"))[self._number]
        self._scale = float(known.get("counts_per_unit", 1000))
        self._goal: int | None = None
        self._moved = self._asked = 0.0  # when its count changed, and was told to
        self._count: int | None = None

    def _ask(self, text: str) -> list[str]:
        return self.line.ask(self.axis.unit, text.encode() + b"\n")

    def ids(self) -> dict[str, int | str]:
        told = self._ask("$I" if self._grbl else "M115")[:-1]
        return {"firmware": " ".join(told)[:200], "axis": self._letter}

    def arm(self) -> None:
        self._ask("$X" if self._grbl else "M17")

    def reset(self) -> None:
        self._ask("$X" if self._grbl else "M999")

    def look(self, retries: int) -> Look:
        for left in reversed(range(1 + retries)):
            try:
                return self._look_grbl() if self._grbl else self._look_marlin()
            except BusError:
                if not left:
                    raise
        raise AssertionError("unreachable")

    def _look_grbl(self) -> Look:
        unit = self.axis.unit
        *_, line = self.line.ask(unit, b"?", lambda line: line.startswith("<"))
        report = re.fullmatch(r"<(\w+)(?::(\d+))?\|MPos:([-\d.,]+)\|?.*>", line)
        if report is None:
            raise BusError(f"unit {unit}: {line!r} has no MPos: set $10=1")
        state, part, places = report.groups()
        count = round(float(places.split(",")[self._number]) * self._scale)
        moving = state in ("Run", "Jog", "Home") or (state, part) == ("Hold", "1")
        fault = state in ("Alarm", "Door")
        return Look(count, state != "Sleep", not (moving or fault), moving, fault)

    def _look_marlin(self) -> Look:
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

    def position(self) -> int:
        return self.look(0).position

    def standing(self) -> bool:
        return self.look(0).done

    def alarm(self) -> str:
        return "the controller is in alarm" if self.look(0).fault else ""

    def move(self, count: int, speed: float, accel: float) -> None:
        """Ramps are those that are set in the controller."""
        place, feed = count / self._scale, 60.0 * speed / self._scale
        self._goal, self._asked = count, time.monotonic()
        if not self._grbl:
            self._ask("G90")
        how = "$J=G90 G53 G21" if self._grbl else "G1"
        text = f"{how} {self._letter}{place:.4f} F{feed:.4f}"
        self.line.tell(self.axis.unit, text=text)
        self._ask(text)

    def stop(self) -> None:
        """Without the end of a line: the controller obeys before what is queued."""
        self._goal = None
        self.line.tell(self.axis.unit, text="stop")
        if self._grbl:  # feed hold, which ends a jog; and the end of jogs in the queue
            ends: Callable[[str], bool] = lambda line: line.startswith("<")  # noqa: E731
            self.line.ask(self.axis.unit, b"!\x85?", ends)
        else:
            self._ask("M410")
