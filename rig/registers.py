"""Registers of a drive: values, words, frames and bits, without the schema of a map
that ``config.maps`` adds and a stop does without.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, get_args

Kind = Literal["u16", "i16", "u32", "i32", "u48", "i48", "u64", "i64", "f32", "f64"]
FORMATS: tuple[Kind, ...] = get_args(Kind)
REGISTERS = (3, 4)  # functions that read registers; 1 and 2 read bits
FLOATS = {"f32": ">f", "f64": ">d"}
COIL_ON = 0xFF00  # as function 5 writes it
VALUES = ("position", "speed", "accel", "decel", "timeout", "min", "max", "home")
ROUNDING = 1e-9  # of a product that is a whole number of counts but for its last bits
LOWEST, HIGHEST = -(2**31), 2**31 - 1  # of a position
FLAGS = ("enabled", "done", "moving", "fault")


class Word(NamedTuple):
    """What a frame has at one place: one or two registers."""

    value: int | str  # a constant, or one of VALUES
    kind: Kind = "u16"


def encode(value: float, kind: Kind, word_order: str) -> list[int]:
    """Registers of a value; ValueError where it does not fit the type."""
    try:
        if kind in FLOATS:
            data = struct.pack(FLOATS[kind], value)
        else:
            size, signed = 2 * registers_of(kind), kind[0] == "i"
            data = round(value).to_bytes(size, "big", signed=signed)
    except (OverflowError, ValueError):
        raise ValueError(f"{value} does not fit {kind}") from None
    words = list(struct.unpack(f">{len(data) // 2}H", data))
    return words if word_order == "big" else words[::-1]


def decode(words: list[int], kind: Kind, word_order: str) -> float:
    """Value of registers: a whole number, but of f32 and f64."""
    ordered = words if word_order == "big" else words[::-1]
    data = struct.pack(f">{len(words)}H", *ordered)
    if kind in FLOATS:
        value: float = struct.unpack(FLOATS[kind], data)[0]
        return value
    return int.from_bytes(data, "big", signed=kind[0] == "i")


def registers_of(kind: Kind) -> int:
    return int(kind[1:]) // 16


def word_of(word: Any) -> Word:
    """A word of a frame as a map writes it; ValueError where it is none."""
    if type(word) is int and 0 <= word <= 0xFFFF:
        return Word(word)
    name, _, kind = str(word).partition(":")
    if isinstance(word, str) and name in VALUES and kind in FORMATS:
        return Word(name, kind)
    raise ValueError(
        f"must be 0..65535 or NAME:TYPE with NAME of {', '.join(VALUES)} and TYPE of "
        f"{', '.join(FORMATS)}, got {word!r}"
    )


def registers_in(words: Sequence[Word]) -> int:
    return sum(registers_of(word.kind) for word in words)


def motion_counts(
    units: Any, pulses_per_rev: int, speed: float, accel: float
) -> dict[str, int]:
    """Register values, in the ``units`` of a map, of a speed and of ramps, in pulses a
    second and a second squared: never faster or harder than these."""
    per = {"pulse_per_s": 1.0, "pulse_per_s2": 1.0}
    per_pulse = per.get(units.speed, 1.0 / pulses_per_rev) * units.speed_per_unit
    counts = {"speed": math.floor(speed * per_pulse * (1.0 + ROUNDING))}
    if units.accel == "s_per_rev_per_s":  # longer is gentler
        time = units.accel_per_unit * pulses_per_rev / accel
        ramp = math.ceil(time * (1.0 - ROUNDING))
    else:
        per_pulse = per.get(units.accel, 1.0 / pulses_per_rev) * units.accel_per_unit
        ramp = math.floor(accel * per_pulse * (1.0 + ROUNDING))
    return counts | {"accel": ramp, "decel": ramp}


class Table:
    """A table of a map, its keys as attributes."""

    def __init__(self, **values: Any) -> None:
        vars(self).update(values)

    def __eq__(self, other: object) -> bool:
        return vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]  # as of a dictionary


class Value(Table):
    """A value to read: registers by function 3 or 4, or bits by 1 or 2."""

    address: int
    type: Kind
    function: Literal[1, 2, 3, 4]
    bits: int  # 0: as many as the registers have

    @property
    def count(self) -> int:
        return registers_of(self.type)

    @property
    def quantity(self) -> int:
        """Registers, or bits, that are asked for."""
        return self.bits or self.count * (1 if self.function in REGISTERS else 16)


class Place(Value):
    """A position, in counts once it is multiplied by ``counts``."""

    counts: float


class Bits(Table):
    """Bits of the status word: every ``set`` bit is 1 and every ``clear`` bit is 0."""

    set: tuple[int, ...]
    clear: tuple[int, ...]

    def holds(self, word: int) -> bool:
        pairs = [*((b, 1) for b in self.set), *((b, 0) for b in self.clear)]
        return all(word >> b & 1 == value for b, value in pairs)


class Flags(Value):
    """The status word and what its bits say."""

    def flags(self, word: int) -> dict[str, bool]:
        """Which of FLAGS a word has."""
        named = {name: getattr(self, name) for name in FLAGS}
        return {name: not bits or bits.holds(word) for name, bits in named.items()}


class Frame(Table):
    """One frame to write: constants, and values by name such as ``position:i32``."""

    address: int
    words: tuple[Word, ...]
    function: Literal[5, 6, 16]

    @property
    def count(self) -> int:
        return registers_in(self.words)

    def registers(self, word_order: str, **values: float) -> list[int]:
        """What the frame holds, with the values that its words name."""
        found = []
        for value, kind in self.words:
            number = values[value] if isinstance(value, str) else value
            found += encode(number, kind, word_order)
        return [COIL_ON * bool(n) for n in found] if self.function == 5 else found

    def places(self) -> Iterator[tuple[int, Word]]:
        address = self.address
        for word in self.words:
            yield address, word
            address += registers_of(word.kind)


class Frames(Table):
    """Frames that are written one after another."""

    write: Sequence[Any]

    def place_of(self, name: str) -> tuple[int, Kind] | None:
        """Address and type of a named value, or None where no frame holds it."""
        places = (place for frame in self.write for place in frame.places())
        return next(((a, w.kind) for a, w in places if w.value == name), None)
