"""Which units answer on a bus, and of which drive family each is. Reads only."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable

from rig.config.maps import RegisterMap, available_maps, load_map
from rig.config.registers import Read, decode
from rig.config.schema import ConfigError, parse
from rig.config.settings import BusSettings
from rig.core.bus import Bus, BusError, Rejected
from rig.journal import BusLock

# For each absent unit, three times; a drive answers within 25 ms at 9600 baud.
SCAN_TIMEOUT_S, RETRIES = 0.2, 2
ABSENT = (4, 10, 11)  # what servers and gateways answer for a unit that is not there
PARITIES = ("N", "E", "O")


@dataclasses.dataclass(frozen=True)
class Found:
    """A unit that answered."""

    unit: int
    families: tuple[str, ...]  # maps that its registers fit, the best first
    identity: dict[str, int]  # registers of the first of them
    pulses_per_rev: int | None = None  # by its own word

    def __str__(self) -> str:
        if not self.families:
            return f"unit {self.unit}: answers, of no known family"
        words = ", ".join(f"{name} = {value}" for name, value in self.identity.items())
        others = ", ".join(self.families[1:])
        more = f" (or {others})" if others else ""
        return f"unit {self.unit}: {self.families[0]}{more}" + (words and f", {words}")


def parse_bus(text: str) -> BusSettings:
    """Settings of ``tcp:HOST[:PORT]``, ``rtu_tcp:HOST[:PORT]`` or ``rtu:DEVICE,...``.

    After the device follow baud rate, parity, data bits and stop bits, as far as they
    are given: ``rtu:/dev/ttyUSB0,115200,N,8,1``; ``115200,8,N,1`` is the same.

    Raises:
        ConfigError: not such a text, or settings that cannot be.
    """
    transport, _, rest = text.partition(":")
    lines = [f'transport = "{transport}"']
    try:
        if transport == "rtu":
            device, *line = rest.split(",")
            lines.append(f'device = "{device}"')
            parity = [word for word in line[1:] if word in PARITIES]
            bits = [int(word) for word in line[1:] if word not in PARITIES]
            data = [bit for bit in bits if bit > 2]
            stop = [bit for bit in bits if bit <= 2]
            if max(len(parity), len(data), len(stop)) > 1:
                raise ValueError
            lines += [f"baudrate = {int(line[0])}"] if line else []
            lines += [f'parity = "{word}"' for word in parity]
            lines += [f"bytesize = {bit}" for bit in data]
            lines += [f"stopbits = {bit}" for bit in stop]
        elif transport in ("tcp", "rtu_tcp"):
            host, _, port = rest.rpartition(":") if ":" in rest else (rest, "", "")
            lines.append(f'host = "{host}"')
            lines += [f"port = {int(port)}"] if port else []
        else:
            raise ValueError
    except ValueError:
        raise ConfigError(
            "--bus",
            [
                "must be tcp:HOST[:PORT], rtu_tcp:HOST[:PORT] or "
                f"rtu:DEVICE[,BAUD[,PARITY[,BITS[,STOPBITS]]]], got {text!r}"
            ],
        ) from None
    return parse(BusSettings, "\n".join(lines), "--bus")


def scan(
    settings: BusSettings,
    units: int,
    say: Callable[[str], None],
    maps: tuple[RegisterMap, ...] = (),
) -> list[Found]:
    """Ask units 1 to ``units`` for their identity; ``maps`` beside those that ship.

    The bus is nobody else's meanwhile.
    """
    known = [*maps, *(load_map(name) for name in available_maps())]
    known = list({each.name: each for each in known}.values())
    short = settings.model_copy(
        update={
            "timeout_s": min(settings.timeout_s, SCAN_TIMEOUT_S),
            "read_retries": RETRIES,
        }
    )
    found: list[Found] = []
    silence_s = max(each.inter_frame_s for each in known)
    with BusLock(settings).acquire("scan"), Bus(short, silence_s) as bus:
        begun = time.monotonic()
        for unit in range(1, units + 1):
            if answer := _ask(bus, unit, known):
                found.append(answer)
                say(str(answer))
            if unit % 10 == 0 or unit == units:
                spent = time.monotonic() - begun
                left = spent / unit * (units - unit)
                say(f"  {unit} of {units} units asked, about {left:.0f} s left")
    if not found:
        say(
            "no unit answers. Check power, wiring, termination, the line format (baud "
            "rate and parity) and the units' ids"
        )
    return found


def _ask(bus: Bus, unit: int, known: list[RegisterMap]) -> Found | None:
    """What a unit is; None where it is silent, or a gateway says that it is."""
    there = False
    fitting: list[tuple[tuple[int, int], RegisterMap, dict[str, int]]] = []
    for each in known:
        try:
            _read(bus, unit, each.status, each.word_order)
            _read(bus, unit, each.position, each.word_order)
        except Rejected as refusal:
            there |= refusal.code not in ABSENT
            continue
        except BusError:
            if not there:
                return None
            continue
        there = True
        identity = _identity(bus, unit, each)
        told = {name for name in each.recognise if name in identity}
        if all(_within(each, name, identity[name]) for name in told):
            # Registers that are not there read as 0 in some drives.
            proved = sum(identity[name] != 0 for name in told)
            fitting.append(((proved, len(identity)), each, identity))
    if not fitting:
        return Found(unit, (), {}) if there else None
    fitting.sort(key=lambda one: one[0], reverse=True)
    _, first, identity = fitting[0]
    names = tuple(each.name for _, each, _ in fitting)
    return Found(unit, names, identity, _told(bus, unit, first))


def _within(each: RegisterMap, name: str, value: int) -> bool:
    low, high = each.recognise[name]
    return low <= value <= high


def _identity(bus: Bus, unit: int, each: RegisterMap) -> dict[str, int]:
    """Values of the identity registers; those that a model lacks are left out."""
    values = {}
    for name, read in each.identity.items():
        with contextlib.suppress(BusError):
            values[name] = _read(bus, unit, read, each.word_order)
    return values


def _told(bus: Bus, unit: int, each: RegisterMap) -> int | None:
    """Pulses for one turn by the drive's own word."""
    if each.pulses_per_rev is None:
        return None
    with contextlib.suppress(BusError):
        return _read(bus, unit, each.pulses_per_rev, each.word_order) or None
    return None


def _read(bus: Bus, unit: int, read: Read, word_order: str) -> int:
    words = bus.read_words(unit, read.address, read.count)
    return decode(words, read.type, word_order)
