"""Register maps: a drive family as data.

A map is one TOML file in ``rig/maps`` (or anywhere: a configuration may give a path).
It says where a drive keeps its status, position and alarm, and which registers to write
to move, stop, enable. Nothing here opens a port. The schema is in docs/rig.md.
"""

from __future__ import annotations

import dataclasses
import pathlib
import tomllib
from typing import Any

__all__ = [
    "MAP_FOLDER",
    "MapError",
    "Predicate",
    "Read",
    "RegisterMap",
    "Write",
    "available_maps",
    "decode",
    "encode",
    "load_map",
    "parse_map",
]

MAP_FOLDER = pathlib.Path(__file__).parent / "maps"
SCHEMA = 1
TYPES = {"u16": (1, 0, 0xFFFF), "i16": (1, -0x8000, 0x7FFF)} | {
    "u32": (2, 0, 0xFFFFFFFF),
    "i32": (2, -0x80000000, 0x7FFFFFFF),
}
VALUES = ("position", "speed", "accel", "decel", "timeout", "min", "max")
SPEED_UNITS = ("rev_per_s", "pulse_per_s")
ACCEL_UNITS = ("rev_per_s2", "pulse_per_s2", "s_per_rev_per_s")


class MapError(ValueError):
    """A register map breaks the schema; the text lists every fault."""


@dataclasses.dataclass(frozen=True)
class Read:
    """A value to read: one or two registers."""

    address: int
    type: str  # u16, i16, u32, i32

    @property
    def count(self) -> int:
        """Registers to read."""
        return TYPES[self.type][0]


@dataclasses.dataclass(frozen=True)
class Write:
    """One frame to write: constants and values by name, such as ``position:i32``."""

    address: int
    function: int  # 6 or 16
    words: tuple[int | tuple[str, str], ...]

    @property
    def count(self) -> int:
        """Registers written."""
        return sum(1 if isinstance(w, int) else TYPES[w[1]][0] for w in self.words)

    def offset_of(self, name: str) -> tuple[int, str] | None:
        """Address and type of a named value inside the frame, or None."""
        address = self.address
        for word in self.words:
            if not isinstance(word, int):
                if word[0] == name:
                    return address, word[1]
                address += TYPES[word[1]][0]
            else:
                address += 1
        return None


@dataclasses.dataclass(frozen=True)
class Predicate:
    """Bits of the status word: every ``set`` bit is 1 and every ``clear`` bit is 0."""

    set: tuple[int, ...]
    clear: tuple[int, ...]

    def holds(self, word: int) -> bool:
        """Whether a status word satisfies it."""
        return all(word >> b & 1 for b in self.set) and not any(
            word >> b & 1 for b in self.clear
        )


@dataclasses.dataclass(frozen=True)
class RegisterMap:
    """One drive family."""

    name: str
    title: str
    word_order: str  # big: high word first; little: low word first
    inter_frame_s: float  # silence the drive wants between two frames
    serial: dict[str, Any]  # the maker's default line settings
    speed_unit: str
    speed_per_unit: float  # register counts for 1 of speed_unit
    accel_unit: str
    accel_per_unit: float
    status: Read
    done: Predicate
    moving: Predicate
    fault: Predicate
    enabled: Predicate | None
    position: Read
    alarm: Read | None
    alarm_names: dict[int, str]
    move: tuple[Write, ...]
    trigger: tuple[int, int]  # (address, value) whose writing starts the move
    stop: tuple[Write, ...]
    enable: tuple[Write, ...]
    alarm_reset: tuple[Write, ...]
    comm_timeout: tuple[Write, ...]
    comm_timeout_per_s: float  # register counts for one second
    limits: tuple[Write, ...]
    identity: tuple[tuple[str, Read], ...]
    digest: str  # of the parsed file, for the run's fingerprint


def encode(value: int, kind: str, word_order: str) -> list[int]:
    """Registers of a value.

    Raises:
        ValueError: the value does not fit the type.
    """
    count, low, high = TYPES[kind]
    if not low <= value <= high:
        raise ValueError(f"{value} does not fit {kind} ({low} to {high})")
    if count == 1:
        return [value & 0xFFFF]
    words = [value >> 16 & 0xFFFF, value & 0xFFFF]
    return words if word_order == "big" else words[::-1]


def decode(words: list[int], kind: str, word_order: str) -> int:
    """Value of one or two registers."""
    count, low, _ = TYPES[kind]
    if len(words) != count:
        raise ValueError(f"{kind} needs {count} registers, got {len(words)}")
    ordered = words if word_order == "big" else words[::-1]
    value = ordered[0] if count == 1 else ordered[0] << 16 | ordered[1]
    top = 1 << (16 * count - 1)
    return value - 2 * top if low < 0 and value >= top else value


def available_maps() -> list[str]:
    """Names of the maps that ship."""
    return sorted(path.stem for path in MAP_FOLDER.glob("*.toml"))


def load_map(name: str, folder: pathlib.Path | None = None) -> RegisterMap:
    """Read a map by name (one that ships) or by path, relative to ``folder``.

    Raises:
        MapError: no such map, not TOML, or the schema is broken.
    """
    path = MAP_FOLDER / f"{name}.toml"
    if name.endswith(".toml"):
        path = pathlib.Path(name)
        if not path.is_absolute() and folder is not None:
            path = folder / path
    elif name not in available_maps():
        raise MapError(
            f"no register map {name!r}: have {', '.join(available_maps())}, "
            "or give the path of a .toml file"
        )
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MapError(f"register map {path}: {error}") from None
    return parse_map(data, str(path.name))


def parse_map(data: dict[str, Any], source: str) -> RegisterMap:
    """Check a parsed map as a whole.

    Raises:
        MapError: with every fault, one a line.
    """
    from rig.mapschema import build

    faults: list[str] = []
    result = build(data, faults)
    if faults or result is None:
        raise MapError("\n".join(f"{source}: {fault}" for fault in faults))
    return result
