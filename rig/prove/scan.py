"""Serial ports; which units answer on a bus, of which drive family. Reads only."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rig.config.axis import Axis
from rig.config.maps import DriveMap, RegisterMap, available_maps, load_map
from rig.config.schema import ConfigError, parse
from rig.config.settings import BusSettings
from rig.drives.bus import NOBODY, Bus, Rejected
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive
from rig.journal.lock import BusLock

# For each absent unit, three times; a drive answers within 25 ms at 9600 baud.
SCAN_TIMEOUT_S, RETRIES = 0.2, 2
ABSENT = (4, 10, 11)  # what servers and gateways answer for a unit that is not there
OF_BUS = {
    "tcp": ("host", "port"),
    "rtu_tcp": ("host", "port"),
    "rtu": ("device", "baudrate", "parity", "bytesize", "stopbits"),
}
OF_LINE = OF_BUS | dict.fromkeys(("serial", "can"), ("device", "baudrate"))


@dataclasses.dataclass(frozen=True)
class Answer:
    unit: int
    families: tuple[str, ...]  # maps that its registers fit, the best first
    identity: dict[str, int]  # registers of the first of them
    pulses_per_rev: int | None = None  # by its own word
    echo: bool = False  # its adapter sends back what it is sent

    def __str__(self) -> str:
        if not self.families:
            return f"unit {self.unit}: answers, unknown family"
        words = ", ".join(f"{name} = {value}" for name, value in self.identity.items())
        others = ", ".join(self.families[1:])
        more = f" (or {others})" if others else ""
        return f"unit {self.unit}: {self.families[0]}{more}" + (words and f", {words}")


def parse_bus(text: str) -> BusSettings:
    """Settings of ``tcp:HOST[:PORT]``, ``rtu:/dev/ttyUSB0,115200,N,8,1`` and the like;
    ConfigError where it is no such text, or they cannot be."""
    if (values := place_of(text, OF_LINE)) is None:
        kinds = "tcp:HOST[:PORT], rtu_tcp:HOST[:PORT], serial:DEVICE[,BAUD], "
        kinds += "can:CHANNEL[,BAUD] or rtu:DEVICE"
        must = f"must be {kinds}[,BAUD[,PARITY[,BITS[,STOPBITS]]]]"
        raise ConfigError("--bus", [f"{must}, got {text!r}"])
    lines = [f"{name} = {json.dumps(value)}" for name, value in values.items()]
    return parse(BusSettings, "\n".join(lines), "--bus")


def place_of(text: str, keys: Mapping[str, Sequence[str]]) -> dict[str, Any] | None:
    """Keys and values of ``TRANSPORT:VALUE...``, by the keys of each transport; None
    where it is no such text. After a device follow commas, after a host colons."""
    transport, _, rest = text.partition(":")
    names = keys.get(transport, ())
    words = rest.split("," if "device" in names else ":")
    if not names or len(words) > len(names) or not all(words):
        return None
    values = [int(word) if word.isdecimal() else word for word in words]
    return {"transport": transport, **dict(zip(names, values, strict=False))}


def serial_lines() -> list[str]:
    """One line for each serial port: device, and what its adapter calls itself."""
    from serial.tools import list_ports  # type: ignore[import-untyped]  # no stubs

    ports = sorted(list_ports.comports())
    return [f"{port.device}: {port.description} ({port.hwid})" for port in ports]


def scan(
    settings: BusSettings,
    units: int,
    say: Callable[[str], None],
    maps: tuple[DriveMap, ...] = (),
) -> list[Answer]:
    """Ask units 1 to ``units``, under the bus's lock; ``maps`` beside those shipped."""
    every = [*maps, *(load_map(name) for name in available_maps())]
    named = {drive_map.name: drive_map for drive_map in every}.values()
    families = [drive_map for drive_map in named if isinstance(drive_map, RegisterMap)]
    timeout_s = min(settings.timeout_s, SCAN_TIMEOUT_S)
    short = settings.model_copy(
        update={"timeout_s": timeout_s, "read_retries": RETRIES}
    )
    answers: list[Answer] = []
    silence_s = max(family.inter_frame_s for family in families)
    with BusLock(settings).acquire("scan"), Bus(short, silence_s) as bus:
        bus.listen_s = 0.0  # or each absent unit takes as long
        for unit in range(1, units + 1):
            if answer := _ask(bus, unit, families):
                answers.append(answer)
                say(str(answer))
            if unit % 10 == 0 or unit == units:
                say(f"  {unit} of {units} units asked")
        for_all = len(answers) == units and bus.answers_for_every_unit()
        echo, noise, late = bus.echoes, bus.noise, sorted(bus.late)
    if for_all:
        del answers[1:]
        say(
            f"{settings.where} answers for every unit id, even {NOBODY}, which no unit "
            "has: it is one device, or a gateway that ignores the id; counted as one"
        )
    if late:
        names = ", ".join(map(str, late))
        say(f"units {names} answer late, after {timeout_s:g} s: raise bus.timeout_s")
    if echo and not settings.echo:
        say("the adapter echoes what it is sent: set bus.echo = true")
    if not answers and not late:
        came = f", but bytes came that are not a reply: {noise}" if noise else ""
        say(
            f"no unit answers{came}. Check power, wiring, termination, the line format "
            "(baud rate and parity) and the units' ids"
        )
    return [dataclasses.replace(answer, echo=echo) for answer in answers]


def _ask(bus: Bus, unit: int, families: list[RegisterMap]) -> Answer | None:
    """What a unit is; None where it is silent, or a gateway says that it is."""
    there = False
    fitting: list[tuple[tuple[int, int], ModbusDrive, dict[str, int]]] = []
    for family in families:
        drive = ModbusDrive(bus, Axis.unmoved("", unit, family))
        try:
            drive.status(RETRIES)
        except Rejected as refusal:
            there |= refusal.code not in ABSENT
            continue
        except BusError:
            if not there:
                return None
            continue
        there = True
        told: dict[str, int | str] = {}
        with contextlib.suppress(BusError):
            told = drive.ids()
        if not drive.foreign(told):
            # Registers that a model lacks are left out; in some drives they read as 0.
            identity = {name: n for name, n in told.items() if isinstance(n, int)}
            proved = sum(identity.get(name, 0) != 0 for name in family.recognise)
            fitting.append(((proved, len(identity)), drive, identity))
    if not fitting:
        return Answer(unit, (), {}) if there else None
    fitting.sort(key=lambda one: one[0], reverse=True)
    _, first, identity = fitting[0]
    names = tuple(drive.axis.map.name for _, drive, _ in fitting)
    pulses = None
    with contextlib.suppress(BusError):
        pulses = first.pulses_per_rev()
    return Answer(unit, names, identity, pulses)
