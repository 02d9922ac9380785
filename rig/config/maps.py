"""Register maps: where a family of drives keeps status, position and alarm, and what is
written to move, stop, enable: a TOML file in ``rig/maps``, or of one's own."""

import contextlib
import pathlib
import tomllib
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainValidator, WithJsonSchema

from rig import registers
from rig.config.schema import Section, key, parse, read_text
from rig.registers import FLAGS, Kind, Word, registers_in, word_of

MAP_FOLDER = pathlib.Path(__file__).parent.parent / "maps"


def _codes(names: Any) -> Any:
    try:
        return {int(code, 0): text for code, text in names.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"must be numbers and their names: {error}") from None


Register = Annotated[int, Field(ge=0, le=0xFFFF)]
BitNumbers = tuple[Annotated[int, Field(ge=0, le=31)], ...]
FrameWord = Annotated[Word, PlainValidator(word_of), WithJsonSchema({"type": "string"})]
Names = Annotated[
    dict[int, str], BeforeValidator(_codes), WithJsonSchema({"type": "object"})
]


class Read(Section, registers.Value):
    """A value to read: registers, or bits."""

    address: Register = key("address of the register or bit as in the protocol, from 0")
    type: Kind = key("type of the number", "u16")
    function: Literal[1, 2, 3, 4] = key(
        "3: holding registers, 4: input registers, 1: coils, 2: discrete inputs", 3
    )
    bits: int = key("read by function 1 or 2; 0: 16 for a register of type", 0, 0, 64)

    def broken_rules(self) -> Iterator[str]:
        of_registers = self.function in registers.REGISTERS
        if of_registers and self.bits:
            yield f"bits: are read by function 1 or 2, got function {self.function}"
        elif not of_registers and (self.type[0] != "u" or self.bits > 16 * self.count):
            must = "u16, u32, u48 or u64 and hold the bits"
            yield f"type: must be {must}, got {self.type}"


class Position(Read, registers.Place):
    """The drive's own position in pulses."""

    type: Kind = "i32"
    counts: float = key("pulses per unit of the registers", 1.0, 1e-12, 1e12)


class Alarm(Read):
    """The alarm's code; 0 is none."""

    names: Names = key("names of codes, such as 0x0001", {})


class Predicate(Section, registers.Bits):
    """Bits of the status word: every ``set`` bit is 1 and every ``clear`` bit is 0."""

    set: BitNumbers = ()
    clear: BitNumbers = ()

    def broken_rules(self) -> Iterator[str]:
        if not self.set and not self.clear:
            yield "set: name at least one bit in set or clear"


class StatusWord(Read, registers.Flags):
    """The status word and what its bits say."""

    done: Predicate
    moving: Predicate
    fault: Predicate
    enabled: Predicate | None = None  # where no bit says it, the drive always is

    def broken_rules(self) -> Iterator[str]:
        yield from super().broken_rules()
        width = self.bits or 16 * self.count
        for name in FLAGS:
            bits = getattr(self, name)
            if bits and max((*bits.set, *bits.clear)) >= width:
                yield f"{name}: must name bits 0..{width - 1} of {self.type}"


class Write(Section, registers.Frame):
    """One frame to write: constants, and values by name such as ``position:i32``."""

    address: Register
    words: Annotated[tuple[FrameWord, ...], Field(min_length=1)]
    function: Literal[5, 6, 16] = Field(
        default_factory=lambda made: 6 if registers_in(made["words"]) == 1 else 16
    )

    def broken_rules(self) -> Iterator[str]:
        if self.function != 16 and self.count != 1:
            yield "function: must be 16, or 6 for one register, or 5 for one coil"
        if self.count > 123 or self.address + self.count > 0x10000:
            yield f"words: {self.count} registers from {self.address} do not fit"


class Writes(Section, registers.Frames):
    """Frames that are written one after another."""

    write: Annotated[tuple[Write, ...], Field(min_length=1)]


class Trigger(Section):
    """The register and the value whose writing starts the move."""

    address: Register
    value: Register


# Words that make a family move by a distance, by the register they are written to:
# Leadshine PR, Oriental AZ, Applied Motion.
RELATIVE = {0x6200: (0x0041, 0x0081), 0x005B: (2, 3), 0x007C: (0x0066,)}


class Move(Writes):
    """An absolute move; after a lost reply it may be sent twice."""

    trigger: Trigger

    def broken_rules(self) -> Iterator[str]:
        if not self.place_of("position"):
            yield "write: no frame writes position"
        *_, (address, last) = self.write[-1].places()
        if (address, last.value) != (self.trigger.address, self.trigger.value):
            yield "trigger: must be the last word of the last frame"
        for address, word in (p for frame in self.write for p in frame.places()):
            if word.value in RELATIVE.get(address, ()):
                place = f"0x{word.value:04X} in register 0x{address:04X}"
                yield f"write: {place} is a relative move; targets must be absolute"


Positive = Annotated[float, Field(ge=1e-12, le=1e12)]


class CommTimeout(Writes):
    """The drive's own watch over the line."""

    per_s: Positive  # register counts for one second


class Units(Section):
    """Units of the speed and acceleration registers, and their counts for 1."""

    speed: Literal["rev_per_s", "pulse_per_s"]
    speed_per_unit: Positive
    accel: Literal["rev_per_s2", "pulse_per_s2", "s_per_rev_per_s"]
    accel_per_unit: Positive


class DriveMap(Section):
    """One drive family, of whatever kind."""

    schema_: Literal[1] = key("version of the schema", alias="schema")
    drive: str = key("modbus, or your own: `FILE.py:CLASS`, `MODULE:CLASS`", "modbus")
    name: str = key("name of the map", min_length=1)
    title: str = key("drives it is for", min_length=1)
    sources: str = key("source of these values", min_length=1)
    confidence: str = key("how far the map was tested", "")
    restart_s: float = key("watched after a stop, lest it moves on", 2.0, 2.0, 60)
    absolute_encoder: bool = key("the position survives a loss of power", False)
    ready_s: float = key("longest, to enable or reset an alarm", 1.0, 0, 30)
    inter_frame_s: float = key("silence that the drive needs between frames", 0.0, 0, 1)
    settings: dict[str, str | int | float | bool] = key("data of your own class", {})

    @property
    def register_units(self) -> Units | None:
        """Units of registers for speed and acceleration, where there are any."""
        return getattr(self, "units", None)

    def place_of(self, name: str) -> tuple[int, Kind] | None:
        """Register of a value of a move, and its type, where there is one."""
        frames = getattr(self, "move", None)
        return frames.place_of(name) if frames else None

    def has(self, table: str) -> bool:
        """Whether there is a table, such as ``comm_timeout``, ``limits``, ``home``."""
        return getattr(self, table, None) is not None


class RegisterMap(DriveMap):
    """One family of Modbus drives, by its registers."""

    drive: Literal["modbus"] = "modbus"
    word_order: Literal["big", "little"] = key("of 32-bit pairs; big: high word first")
    inter_frame_s: float = key("silence that the drive needs between frames", ..., 0, 1)
    settings: dict[str, str | int | float | bool] = key(
        "none: registers are keys of a class of your own", {}, max_length=0
    )
    serial: dict[str, int | str] = key("default line format of the maker", {})
    units: Units = key("`speed`, `accel`; counts `speed_per_unit`, `accel_per_unit`")
    status: StatusWord = key("`done`, `moving`, `fault`, `enabled` as `{ set, clear }`")
    position: Position = key("address, type (i32) of the position in pulses")
    alarm: Alarm | None = key("address, type; `names` of its codes", None)
    move: Move = key(
        "`write`: frames of numbers, or `position:i32`, `speed:u16`, `accel`, `decel`; "
        "`trigger` is the last word"
    )
    stop: Writes = key("`write`: frames of the quick stop; torque must stay on")
    hold: Writes | None = key("`write` with `position`, its target after a stop", None)
    broadcast_stop: bool = key("all units of a serial line obey a stop to 0", False)
    enable: Writes | None = key("`write`: switch the power stage on", None)
    alarm_reset: Writes | None = key("`write`: reset an alarm", None)
    comm_timeout: CommTimeout | None = key(
        "`timeout` of the line, counts `per_s`", None
    )
    limits: Writes | None = key("`write` with `min` and `max` in pulses", None)
    set_zero: Writes | None = key(
        "`write`: its place becomes 0; or `home:i32`: 2^30, if it takes a value", None
    )
    identity: dict[str, Read] = key("registers that `identify` prints", {})
    recognise: dict[str, tuple[int, int]] = key("[lowest, highest] of `identity`", {})
    pulses_per_rev: Read | None = key("register of pulses per motor turn", None)
    target: Position | None = key("of the last move; read if its reply is lost", None)
    home: Writes | None = key("`write`: start the drive's own homing", None)
    homed: Predicate | None = key(
        "bits set by homing, cleared by a loss of power", None
    )

    @property
    def home_place(self) -> tuple[int, str] | None:
        """Where ``set_zero`` takes the count that home becomes; None: it becomes 0."""
        return self.set_zero.place_of("home") if self.set_zero else None

    def broken_rules(self) -> Iterator[str]:
        if self.stop.place_of("position"):
            yield "stop.write: must not write a position"
        for name in sorted(self.recognise.keys() - self.identity.keys()):
            yield f"recognise.{name}: is not a register of identity"


def available_maps() -> list[str]:
    return sorted(path.stem for path in MAP_FOLDER.glob("*.toml"))


def load_map(name: str, folder: pathlib.Path | None = None) -> DriveMap:
    """Read a map by name (one that ships; ValueError where there is none) or by path,
    relative to ``folder``; ConfigError lists every fault."""
    path = MAP_FOLDER / f"{name}.toml"
    if name.endswith(".toml"):
        path = (folder or pathlib.Path()) / name
    elif name not in available_maps():
        raise ValueError(
            f"no register map {name!r}; there are {', '.join(available_maps())}, or "
            "give the path of a .toml file"
        )
    return parse_map(read_text(path), path.name, path.parent)


def parse_map(text: str, source: str, folder: pathlib.Path) -> DriveMap:
    """The map of a text; ConfigError lists every fault. ``folder`` is where the file of
    a class is looked for."""
    kind: type[DriveMap] = RegisterMap
    with contextlib.suppress(tomllib.TOMLDecodeError):  # which `parse` words
        if tomllib.loads(text).get("drive", "modbus") != "modbus":
            kind = DriveMap
    drive_map = parse(kind, text, source)
    drive_map._folder = folder.resolve()
    return drive_map
