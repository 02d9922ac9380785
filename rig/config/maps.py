"""Register maps: a drive family as data.

A map is one TOML file in ``rig/maps`` (or anywhere: a configuration may give a path).
It says where a drive keeps its status, position and alarm, and which registers to write
to move, stop, enable. Nothing here opens a port.
"""

import hashlib
import json
import pathlib
import tomllib
from collections.abc import Iterator
from typing import Literal

from rig.config.registers import (
    Alarm,
    CommTimeout,
    Move,
    Position,
    Predicate,
    Read,
    StatusWord,
    Units,
    Writes,
)
from rig.config.schema import Section, key, parse, read_text

MAP_FOLDER = pathlib.Path(__file__).parent.parent / "maps"


class RegisterMap(Section):
    """One drive family."""

    schema_: Literal[1] = key("version of this schema", alias="schema")
    name: str = key("name of the map", min_length=1)
    title: str = key("drives it is for", min_length=1)
    sources: str = key("where the addresses are from", min_length=1)
    confidence: str = key("how far they were checked", "")
    word_order: Literal["big", "little"] = key(
        "of 32-bit pairs; big: high word first, little: low word first"
    )
    inter_frame_s: float = key("silence the drive wants between frames", ..., 0, 1)
    serial: dict[str, int | str] = key("the maker's default line format", {})
    units: Units = key(
        "`speed`, `accel` of the registers; `speed_per_unit`, `accel_per_unit` counts"
    )
    status: StatusWord = key(
        "address, type; `done`, `moving`, `fault`, `enabled` as bits `{ set, clear }`"
    )
    position: Position = key("address, type (i32) of the position in pulses")
    alarm: Alarm | None = key("address, type; `names` of its codes", None)
    move: Move = key(
        "`write`: frames of numbers, or `position:i32`, `speed:u16`, `accel`, `decel`; "
        "`trigger` is the last word"
    )
    stop: Writes = key("`write`: frames of the quick stop; torque must stay on")
    broadcast_stop: bool = key("every unit of a serial line obeys its stop to 0", False)
    enable: Writes | None = key("`write`: switch the power stage on", None)
    alarm_reset: Writes | None = key("`write`: reset an alarm", None)
    comm_timeout: CommTimeout | None = key(
        "`write` with `timeout`, counts `per_s`: the drive's own watch of the line",
        None,
    )
    limits: Writes | None = key("`write` with `min` and `max` in pulses", None)
    set_zero: Writes | None = key(
        "`write`: the present position becomes 0, or `home:i32` where the drive takes "
        "a value: 2^30 is written, which it never counts when it is switched on",
        None,
    )
    identity: dict[str, Read] = key("registers that `identify` prints", {})
    recognise: dict[str, tuple[int, int]] = key(
        "of identity registers: [lowest, highest] that a drive of this family holds", {}
    )
    pulses_per_rev: Read | None = key(
        "register of the drive's own pulses for one motor turn", None
    )
    target: Position | None = key(
        "register that holds the last target written, read back when the reply to a "
        "move is lost",
        None,
    )
    home: Writes | None = key("`write`: start the drive's own homing", None)
    homed: Predicate | None = key(
        "bits of the status word that are on from homing until the power fails", None
    )
    absolute_encoder: bool = key("the position outlasts a loss of power", False)
    ready_s: float = key(
        "the drive takes at most so long to enable, and to reset an alarm", 1.0, 0, 30
    )

    @property
    def home_place(self) -> tuple[int, str] | None:
        """Where ``set_zero`` takes the count that home becomes; None: it becomes 0."""
        return self.set_zero.place_of("home") if self.set_zero else None

    @property
    def digest(self) -> str:
        """SHA-256 of the parsed file."""
        known = tomllib.loads(self.text)
        data = json.dumps(known, sort_keys=True, default=str)
        return hashlib.sha256(data.encode()).hexdigest()

    def broken_rules(self) -> Iterator[str]:
        if self.stop.place_of("position"):
            yield "stop.write: must not write a position"
        for name in sorted(self.recognise.keys() - self.identity.keys()):
            yield f"recognise.{name}: is no register of identity"


def available_maps() -> list[str]:
    """Names of the maps that ship."""
    return sorted(path.stem for path in MAP_FOLDER.glob("*.toml"))


def load_map(name: str, folder: pathlib.Path | None = None) -> RegisterMap:
    """Read a map by name (one that ships) or by path, relative to ``folder``.

    Raises:
        ValueError: no such map.
        ConfigError: not TOML, or the schema is broken; lists every fault.
    """
    path = MAP_FOLDER / f"{name}.toml"
    if name.endswith(".toml"):
        path = (folder or pathlib.Path()) / name
    elif name not in available_maps():
        raise ValueError(
            f"no register map {name!r}: have {', '.join(available_maps())}, "
            "or give the path of a .toml file"
        )
    return parse(RegisterMap, read_text(path), path.name)
