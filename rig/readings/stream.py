"""Bytes of a phone to attitudes: no sockets, no threads, bounded memory.

A reading is accepted only if its whole record is well formed: the agreed number of
columns, plain decimal numbers, angles a rotation can have, a stamp that does not run
backwards, no impossible jump. Everything else is counted and dropped.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

from scipy.spatial.transform import Rotation

from rig.config.settings import ImuSettings
from rig.readings.geometry import Array, Reading, angle_between_deg, euler_to_matrix
from rig.readings.source import JumpGate

MAX_LINE = 8192  # bytes; SensorLog's header has under 3000, other lines under 1000
MAX_BODY = 1 << 20  # bytes of one pushed message
NUMBER = re.compile(r"[+-]?[0-9]{1,20}(?:\.[0-9]{1,17})?(?:[eE][+-]?[0-9]{1,2})?")
TOKEN = re.compile(r"[-+.:0-9A-Za-z_ ()/]{0,64}")  # a date has a blank
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of stamps
DAY_S = 86400.0  # a phone's clock is no further off
QUATERNION = ("quaternion{}", "quat{}", "q{}", "rotationvector{}")  # ends of names
ODD_STAMPS = 50  # stamps in a row out of line that mean the phone's clock was set
AHEAD_S = 1.0  # a stamp so far ahead of the clock is torn, not early
ROUNDED = 1 + 1e-5  # full turns in radians are written a little too large
CLOCK_CREEP = 2e-4  # the phone's clock may run this much faster or slower


class _Dropped(ValueError):
    """A record is not used; the text is the counter's name."""


class LineSplitter:
    """A byte stream to lines; CR, LF and ``#`` end one. Never holds over MAX_LINE."""

    def __init__(self, torn: bool = True) -> None:
        self._tail = b""
        self.torn = torn  # the first line may be the end of one that began earlier

    def feed(self, data: bytes) -> list[bytes]:
        """Complete lines, without their ends; empty and over-long ones are left out."""
        parts = re.split(rb"[\r\n#]", self._tail + data)
        self._tail = parts.pop()
        lines = []
        for part in parts:
            whole = not self.torn or _is_header(part) or part[:1] + part[-1:] == b"{}"
            self.torn = False
            if part and whole and len(part) <= MAX_LINE:
                lines.append(part)
        if len(self._tail) > MAX_LINE:
            self._tail, self.torn = b"", True
        return lines


def _is_header(line: bytes) -> bool:
    """Whether it is a line of names, which is whole whatever came before."""
    fields = re.split(r"[,;\t|]", line.decode("utf-8", "replace"))
    return len(fields) > 2 and all(re.match(r"\s*[A-Za-z]{2}", f) for f in fields)


def _number(text: str) -> float:
    if not NUMBER.fullmatch(text):
        raise _Dropped("not a number")
    return float(text)


class StreamParser:
    """Records of one phone to readings on the computer's clock."""

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._width = settings.column_count or None
        self._stamp_column = settings.stamp_column
        self._quaternion = settings.quaternion_columns
        self._named = ""  # columns by their names, where a header came
        self._unit_s: float | None = None  # of a stamp, once one came
        self.first = ""  # record that was used, as it came
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
        self._gate = JumpGate(angle_between_deg, self._settings.max_jump_deg)

    def lines(self, lines: list[bytes], now: float) -> list[Reading]:
        """Readings of CSV lines that arrived at ``now`` (monotonic s)."""
        if self._settings.format != "json":
            return self._accept(lines, self._line, now)
        entries: list[Any] = []
        for line in lines:
            try:
                told = [*_orientations(json.loads(line))]
            except (ValueError, RecursionError):
                self.counts["not JSON"] += 1
                continue
            self.counts["without a rotation vector or quaternion"] += not told
            entries += told
        return self._accept(entries, self._orientation, now)

    def body(self, body: bytes, now: float) -> list[Reading]:
        """Readings of one message Sensor Logger pushed; ``foreign`` says that it is
        another phone's than those before."""
        self.foreign = False
        try:
            message = json.loads(body)
            device, session = message.get("deviceId"), message.get("sessionId")
            entries = [*_orientations({"payload": message["payload"]})]
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.counts["not a Sensor Logger message"] += 1
            return []
        if self._device is not None and device != self._device:
            self.foreign = True
            self.counts["of another device"] += 1
            return []
        readings = self._accept(entries, self._orientation, now)
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
                if self._gate.jumps(matrix):
                    raise _Dropped("an impossible jump")
                readings.append(Reading(time, matrix))
                text = record.decode() if isinstance(record, bytes) else record
                self.first = self.first or str(text)
            except _Dropped as reason:
                self.counts[str(reason)] += 1
        self.counts["accepted"] += len(readings)
        return readings

    def _line(self, line: bytes) -> tuple[float | None, Array]:
        """Seconds on the phone's clock, and (3, 3) phone to its world."""
        s = self._settings
        text = line.decode("utf-8", "replace").strip(" \t\0")
        fields = [field.strip(" \t") for field in text.split(s.separator)]
        if fields[-1] == "" and len(fields) > 1:
            fields.pop()
        if s.format == "sensorlog" and _is_header(line):
            self._take_header(fields)
            raise _Dropped("a header")
        if s.format == "sensorlog" and not self._quaternion:
            raise _Dropped("before the header, which the app sends at the start")
        if not all(TOKEN.fullmatch(field) for field in fields):
            comma = s.separator != "," and re.search(r"\d,\d", text)
            raise _Dropped("decimal commas" if comma else "garbage")
        used = set(self._quaternion or s.columns)
        if self._stamp_column >= 0:
            used.add(self._stamp_column)
        self._check_width(fields, used)
        values = {column: _number(fields[column]) for column in used}
        self._width = len(fields)
        stamp = None
        if self._stamp_column >= 0:
            stamp = self._seconds(values[self._stamp_column], s.stamp_unit or "ms")
        if self._quaternion:
            return stamp, _quaternion([values[c] for c in self._quaternion])
        return stamp, self._euler([values[c] for c in s.columns])

    def _take_header(self, fields: list[str]) -> None:
        """Find the columns of the quaternion, and of its time in seconds, by name."""
        names = [re.sub(r"[^a-z]", "", f.partition("(")[0].lower()) for f in fields]
        for end in QUATERNION:
            ends = [end.format(letter) for letter in "xyzw"]
            places = [[i for i, n in enumerate(names) if n.endswith(e)] for e in ends]
            if all(len(columns) == 1 for columns in places):
                x, y, z, w = (columns[0] for columns in places)
                self._quaternion, self._width = (x, y, z, w), len(fields)
                name = "motiontimestamp"
                stamps = [i for i, n in enumerate(names) if n.startswith(name)]
                self._stamp_column = stamps[0] if stamps else -1
                self._unit_s = 1.0 if stamps else None
                used = [*self._quaternion, *stamps[:1]]
                names = [f"{fields[i]} (column {i})" for i in used]
                self._named = f"by the header: {', '.join(names)}, x y z w of a "
                self._named += "quaternion and its time"
                return

    def _seconds(self, stamp: float, unit: str) -> float:
        """A stamp in seconds, by the unit in which the first one is the present time
        within a day; else by that which is configured, or usual for the app."""
        if self._unit_s is None:
            now = time.time()
            units = [u for u in UNITS_S.values() if abs(stamp * u - now) < DAY_S]
            told = self._settings.stamp_unit
            self._unit_s = UNITS_S[unit] if told or not units else units[0]
        return stamp * self._unit_s

    @property
    def taken_for(self) -> str:
        """What the fields of a record are taken for, in words."""
        units = {value: name for name, value in UNITS_S.items()}
        unit = "" if self._unit_s is None else units[self._unit_s]
        return self._named or self._settings.fields(unit)

    def _check_width(self, fields: list[str], used: set[int]) -> None:
        width, whole = len(fields), max(self._width or 0, max(used) + 1)
        if width in (2 * whole - 1, 2 * whole) and self._settings.separator == ",":
            fractions = fields[1 + width % 2 :: 2]
            if all(map(str.isdecimal, fractions)) and "." not in "".join(fields):
                raise _Dropped("decimal commas")
        if width != (self._width or max(width, whole)):
            raise _Dropped(f"not of {self._width} columns")

    def _euler(self, values: list[float]) -> Array:
        s = self._settings
        degrees = [*map(math.degrees, values)] if s.unit == "rad" else values
        middle = degrees[1]  # an arc sine
        if s.format == "lines":
            middle = math.remainder(middle, 360.0)  # some write -10 as 350
        if max(map(abs, degrees)) > 360.0 * ROUNDED or abs(middle) > 90.0 * ROUNDED:
            raise _Dropped("an angle that no rotation has")
        signed = [v * sign for v, sign in zip(degrees, s.signs, strict=True)]
        return euler_to_matrix(signed, str(s.order))

    def _orientation(self, told: tuple[Any, list[Any]]) -> tuple[float | None, Array]:
        """Stamp and numbers of a JSON object."""
        stamp, numbers = told
        try:
            values = [float(value) for value in numbers[:4]]
            seconds = None if stamp is None else self._seconds(float(stamp), "ns")
        except (TypeError, ValueError, OverflowError):
            raise _Dropped("not a number") from None
        if len(values) == 3:  # Android's: the fourth follows from these
            values.append(math.sqrt(max(0.0, 1.0 - math.fsum(v * v for v in values))))
        return seconds, _quaternion(values)

    def _time(self, stamp: float | None, now: float) -> float:
        """When the phone measured, on the computer's clock: the least delay so far is
        the clocks' difference, so a record that waited in a buffer is as old as it is.
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
                why = "older than the previous reading" if older else "from the future"
                raise _Dropped(why)
            self._offset = math.inf
        self._odd, self._stamp = 0, stamp
        crept = self._offset + CLOCK_CREEP * max(0.0, now - self._offset_at)
        self._offset, self._offset_at = min(delay, crept), now
        return stamp + self._offset


def _orientations(data: Any) -> Iterator[tuple[Any, list[Any]]]:
    """Stamp and numbers, x y z and mostly w, of each orientation in what an app sent,
    alone, in a list or as a ``payload``: ``{"rotationVector": {"timestamp": ..,
    "value": [..]}}``, ``{"name": "orientation", "values": {"qx": ..}}``."""
    if isinstance(data, list):
        for entry in data:
            yield from _orientations(entry)
    if not isinstance(data, dict):
        return
    values = data.get("values", data.get("value", data))
    stamp = data.get("timestamp", data.get("time"))
    kind = re.sub("[^a-z]", "", str(data.get("type", data.get("name", ""))).lower())
    if isinstance(values, dict) and values.keys() >= {"qx", "qy", "qz", "qw"}:
        yield stamp, [values[key] for key in ("qx", "qy", "qz", "qw")]
    elif isinstance(values, list) and kind.endswith("rotationvector"):
        yield stamp, values
    else:
        for name, inner in data.items():
            if name == "payload":
                yield from _orientations(inner)
            elif isinstance(inner, dict):
                yield from _orientations({"name": name, **inner})


def _quaternion(values: list[float]) -> Array:
    if len(values) != 4 or not all(math.isfinite(value) for value in values):
        raise _Dropped("not a number")
    if not 0.98 <= math.fsum(value * value for value in values) <= 1.02:
        raise _Dropped("a quaternion whose length is not one")
    return Rotation.from_quat(values).as_matrix()
