"""Bytes of a phone to attitudes: no sockets, no threads, bounded memory.

A reading is accepted only if its whole record is well formed: the agreed number of
columns, plain decimal numbers, angles a rotation can have, a stamp that does not run
backwards, no impossible jump. Everything else is counted and dropped.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter, deque
from typing import Any

from scipy.spatial.transform import Rotation

from rig.config.settings import ImuSettings
from rig.readings.attitude import Array, Reading, angle_between_deg, euler_to_matrix

MAX_LINE = 1024  # bytes; a phone's line has under 200
MAX_BODY = 1 << 20  # bytes of one pushed message
NUMBER = re.compile(r"[+-]?[0-9]{1,15}(?:\.[0-9]{1,17})?(?:[eE][+-]?[0-9]{1,2})?")
TOKEN = re.compile(r"[-+.:0-9A-Za-z_]{0,64}")
REJOIN = 5  # readings in a row that agree with each other after a jump
ODD_STAMPS = 50  # stamps in a row out of line that mean the phone's clock was set
AHEAD_S = 1.0  # a stamp so far ahead of the clock is torn, not early
ROUNDED = 1 + 1e-5  # full turns in radians are written a little too large
CLOCK_CREEP = 2e-4  # the phone's clock may run this much faster or slower


class _Dropped(ValueError):
    """A record is not used; the text is the counter's name."""


class LineSplitter:
    """A byte stream to lines; CR, LF and ``#`` end one. Never holds over MAX_LINE."""

    def __init__(self) -> None:
        self._tail = b""
        self._skip = True  # the first line may be the end of one that began earlier

    def feed(self, data: bytes) -> list[bytes]:
        """Complete lines, without their ends; empty and over-long ones are left out."""
        parts = re.split(rb"[\r\n#]", self._tail + data)
        self._tail = parts.pop()
        lines = []
        for part in parts:
            if self._skip or len(part) > MAX_LINE:
                self._skip = False
            elif part:
                lines.append(part)
        if len(self._tail) > MAX_LINE:
            self._tail, self._skip = b"", True
        return lines


def _number(text: str) -> float:
    if not NUMBER.fullmatch(text):
        raise _Dropped("not a number")
    return float(text)


class StreamParser:
    """Records of one phone to readings on the computer's clock."""

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._width = settings.column_count or None
        self.counts: Counter[str] = Counter()
        self.foreign = False  # the last message was of another device
        self._device: Any = None  # deviceId of the phone that is heard
        self.sessions = 0  # of the app that pushes, by its sessionId
        self._session: Any = None
        self.reconnected()

    def reconnected(self) -> None:
        """A new connection: the phone may have moved and its clock may have changed."""
        self._stamp: float | None = None
        self._odd = 0
        self._offset, self._offset_at = math.inf, 0.0  # of the clocks; inf: unknown
        self._last: Array | None = None
        self._far: deque[Array] = deque(maxlen=REJOIN)

    def lines(self, lines: list[bytes], now: float) -> list[Reading]:
        """Readings of CSV lines that arrived at ``now`` (monotonic s)."""
        return self._accept(lines, self._line, now)

    def body(self, body: bytes, now: float) -> list[Reading]:
        """Readings of one message Sensor Logger pushed; ``foreign`` says that it is
        another phone's than those before."""
        self.foreign = False
        try:
            message = json.loads(body)
            device, session = message.get("deviceId"), message.get("sessionId")
            entries = [
                entry
                for entry in message["payload"]
                if isinstance(entry, dict) and entry.get("name") == "orientation"
            ]
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.counts["not a Sensor Logger message"] += 1
            return []
        if self._device is not None and device != self._device:
            self.foreign = True
            self.counts["of another device"] += 1
            return []
        readings = self._accept(entries, self._entry, now)
        if readings:
            self.sessions += not self.sessions or session != self._session
            self._device, self._session = device, session
        return readings

    def _accept(self, records: list[Any], parse: Any, now: float) -> list[Reading]:
        readings = []
        for record in records:
            try:
                stamp, matrix = parse(record)
                time = self._time(stamp, now)
                self._gate(matrix)
                readings.append(Reading(time, matrix))
            except _Dropped as reason:
                self.counts[str(reason)] += 1
        self.counts["accepted"] += len(readings)
        return readings

    def _line(self, line: bytes) -> tuple[float | None, Array]:
        """Seconds on the phone's clock, and (3, 3) phone to its world."""
        s = self._settings
        try:
            text = line.decode("ascii").strip(" \t\0")
        except UnicodeDecodeError:
            raise _Dropped("not text") from None
        fields = [field.strip(" \t") for field in text.split(s.separator)]
        if fields[-1] == "" and len(fields) > 1:
            fields.pop()
        used = set(s.quaternion_columns or s.columns)
        if s.stamp_column >= 0:
            used.add(s.stamp_column)
        if not all(TOKEN.fullmatch(field) for field in fields):
            raise _Dropped("garbage")
        self._check_width(fields, used)
        values = {column: _number(fields[column]) for column in used}
        stamp = values[s.stamp_column] / 1000.0 if s.stamp_column >= 0 else None
        if s.quaternion_columns:
            return stamp, _quaternion([values[c] for c in s.quaternion_columns])
        return stamp, self._euler([values[c] for c in s.columns])

    def _check_width(self, fields: list[str], used: set[int]) -> None:
        width = len(fields)
        if self._width is None and width > max(used):
            for column in used:
                _number(fields[column])
            self._width = width
        if width != self._width:
            raise _Dropped(f"not of {self._width} columns")

    def _euler(self, values: list[float]) -> Array:
        s = self._settings
        degrees = [*map(math.degrees, values)] if s.unit == "rad" else values
        middle = degrees[1]  # an arc sine
        if s.format == "lines":
            middle = math.remainder(middle, 360.0)  # some write -10 as 350
        if max(map(abs, degrees)) > 360.0 * ROUNDED or abs(middle) > 90.0 * ROUNDED:
            raise _Dropped("an angle no rotation has")
        signed = [v * sign for v, sign in zip(degrees, s.signs, strict=True)]
        return euler_to_matrix(signed, str(s.order))

    def _entry(self, entry: dict[str, Any]) -> tuple[float | None, Array]:
        values = entry.get("values")
        if not isinstance(values, dict):
            values = entry
        stamp = entry.get("time")
        try:
            numbers = [float(values[key]) for key in ("qx", "qy", "qz", "qw")]
            seconds = None if stamp is None else float(stamp) * 1e-9
        except (KeyError, TypeError, ValueError, OverflowError):
            raise _Dropped("no quaternion") from None
        return seconds, _quaternion(numbers)

    def _time(self, stamp: float | None, now: float) -> float:
        """When the phone measured, on the computer's clock.

        The least delay seen so far is taken for the clocks' difference, so a record
        that waited in a buffer is as old as it really is.
        """
        if stamp is None:
            return now
        if not math.isfinite(stamp):
            raise _Dropped("not a number")
        delay = now - stamp
        older = self._stamp is not None and stamp < self._stamp
        if older or AHEAD_S < self._offset - delay < math.inf:
            self._odd += 1
            if self._odd < ODD_STAMPS:
                raise _Dropped(
                    "older than the reading before" if older else "from the future"
                )
            self._offset = math.inf
        self._odd, self._stamp = 0, stamp
        crept = self._offset + CLOCK_CREEP * max(0.0, now - self._offset_at)
        self._offset, self._offset_at = min(delay, crept), now
        return stamp + self._offset

    def _gate(self, matrix: Array) -> None:
        limit = self._settings.max_jump_deg
        if self._last is not None and angle_between_deg(self._last, matrix) > limit:
            if self._far and angle_between_deg(self._far[-1], matrix) > limit:
                self._far.clear()
            self._far.append(matrix)
            if len(self._far) < REJOIN:
                raise _Dropped("an impossible jump")
        self._far.clear()
        self._last = matrix


def _quaternion(values: list[float]) -> Array:
    if not all(math.isfinite(value) for value in values):
        raise _Dropped("not a number")
    if not 0.98 <= math.fsum(value * value for value in values) <= 1.02:
        raise _Dropped("a quaternion that is not of length one")
    return Rotation.from_quat(values).as_matrix()
