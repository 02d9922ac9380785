"""What a stop, or who moves drives, needs of rig.toml: bus, units and maps of axes.

Of a file that is not TOML every line counts that can be read, the first value of a key.
A value that is none is replaced by its default, a name by the nearest there is, a map
that is missing by that of all others; what looks like an axis is one, or told as lost.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import pathlib
import re
import tomllib
import unicodedata
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

from rig.registers import FLAGS, FORMATS, Bits, Flags, Frame, Frames, Place, word_of
from rig.registers import registers_in as count_of

FILE = pathlib.Path("rig.toml")  # without --config
MAP_FOLDER = pathlib.Path(__file__).parent / "maps"
HEADER = re.compile(
    r"\s*([\[({][\[({\s]*)?([\"']?[A-Za-z_][\w.\"'-]*)\s*([\])}][\])}\s]*)?"
    r"((?![=:,]).*)"
)
ASSIGNMENT = re.compile(
    r"([A-Za-z_][\w-]*)[\"']?\s*[=:]+\s*(\"[^\"]*\"|'[^']*'|[^,;#]+?)"
    r"\s*(?=[,;#}]|$|\s[\w-]+\s*=)"
)
NOTE = re.compile(r"\s*(;|//)")  # as other formats have them
APART = re.compile(r"\s*([A-Za-z_]\w*)\s+(\"[^\"]*\"|'[^']*'|[^\s,;#]+)\s*(?:[#,].*)?")
QUOTES = dict.fromkeys(
    map(ord, "\u201c\u201d\u201e\u201f\u2018\u2019\u201a\u00ab\u00bb\u00b4`"), '"'
) | dict.fromkeys(map(ord, "\u200b\u200c\u200d\u2060\ufeff"))  # of no width
NUMBER = re.compile(
    r"(?<![\w.])(?:0[xX]\w+|[-+]?\d[\d_]*\.?\d*(?:e[-+]?\d+)?)(?![\w.])"
)
LOOK_AHEAD = 40  # lines of one value
SENSORS = ("imu", "readings")  # tables with a host of their own
DEEP = 3  # tables inside tables that are looked at
NEAR, NEAR_NAME = 0.75, 0.6  # of a key, and of the name of a map or a transport
NETWORK = ("tcp", "rtu_tcp")  # transports that have a host
TRANSPORTS = (*NETWORK, "rtu", "serial", "can")
RANGES = {
    "port": (1, 65535), "baudrate": (1200, 3_000_000), "stopbits": (1, 2),
    "bytesize": (7, 8), "timeout_s": (0.01, 5), "read_retries": (0, 10),
}  # fmt: skip
AXIS = (
    "unit", "map", "min_deg", "max_deg", "pulses_per_rev", "reduction", "rotates",
    "speed_deg_s", "accel_deg_s2",
)  # fmt: skip
FRAMES = (  # of a map, besides its stop
    "move", "home", "hold", "enable", "alarm_reset", "comm_timeout", "limits",
    "set_zero",
)  # fmt: skip
OTHER_NAMES = {  # of keys, without lines
    "host": "hostname ip ipaddress address addr server".split(),
    "unit": "unitid slave slaveid node nodeid station address id".split(),
}
KEYS = {"name", "transport", "host", "device", "parity", "echo", *RANGES, *AXIS}
Faults = list[str]


def where_of(bus: Any) -> str:
    if bus.transport not in NETWORK:
        return f"{bus.device} at {bus.baudrate} baud"
    return f"{bus.host}:{bus.port} ({bus.transport})"


@dataclasses.dataclass
class Bus:
    """``[bus]``, with the defaults of its keys."""

    transport: str = ""
    host: str = ""
    port: int = 502
    device: str = ""
    baudrate: int = 115200
    parity: str = "N"
    stopbits: int = 1
    bytesize: int = 8
    echo: bool = False
    timeout_s: float = 0.3
    read_retries: int = 2

    where = property(where_of)


@dataclasses.dataclass
class StopConfig:
    """What could be read of a file, or of what a session armed."""

    bus: Bus | None
    axes: list[SimpleNamespace]  # name, unit and map of each that can be stopped
    lost: list[tuple[str, int]]  # name and unit, 0 where unknown, of the others
    faults: Faults
    bus_faults: Faults

    @property
    def silence_s(self) -> float:
        """Silence between frames that the slowest of the drives wants."""
        return max((axis.map.inter_frame_s for axis in self.axes), default=0.0)


def found(path: pathlib.Path) -> pathlib.Path:
    """A path or, of a folder, its rig.toml, in whatever case its name is written."""
    with contextlib.suppress(OSError):
        path = path / FILE if path.is_dir() else path
        files = [] if path.exists() else path.parent.iterdir()
        return next((f for f in files if f.name.lower() == path.name.lower()), path)
    return path


def read_file(path: pathlib.Path) -> StopConfig:
    """All that is of use in a configuration file; OSError where it cannot be opened."""
    if path.exists() and not path.is_file():
        raise OSError("it is no file")  # a pipe would never end
    faults: Faults = []
    data = tables_of(_decoded(path.read_bytes()), faults)
    return _read(_bus_table(data), _axes_of(data), path.parent, faults)


def read_armed(armed: dict[str, Any]) -> StopConfig:
    """All that is of use in what a session left beside its lock."""
    return _read(armed.get("bus"), rows_of(armed.get("drives")), None, [])


def _read(
    bus_table: Any,
    rows: list[dict[str, Any]],
    folder: pathlib.Path | None,
    faults: Faults,
) -> StopConfig:
    bus_faults: Faults = []
    bus = bus_of(bus_table, bus_faults)
    axes: list[SimpleNamespace] = []
    lost: list[tuple[str, int]] = []
    map_names = [_near(row, "map") for row in rows]
    maps = {name for name in map_names if isinstance(name, str) and name.strip()}
    for number, row in enumerate(rows, 1):
        axis_faults: Faults = []
        name = _near(row, "name")
        if not isinstance(name, str):
            axis_faults.append("it has no name")
            name = f"axis {number}"
        unit = int(_number(_near(row, "unit"), 0, 1, 247, "unit", axis_faults))
        try:
            drive_map = _map_of(row, maps, folder, axis_faults)
        except Exception as error:  # any fault of a map costs its own axis alone
            drive_map = None
            reason = getattr(error, "strerror", None) or error
            axis_faults.append(f"its map cannot be read: {reason}")
        faults += [f"{name}: {fault}" for fault in axis_faults]
        if not unit or drive_map is None:
            lost.append((name, unit))
        elif unit not in [axis.unit for axis in axes]:  # two of one drive are one
            axes.append(SimpleNamespace(name=name, unit=unit, map=drive_map))
    if bus and bus.transport in ("serial", "can"):
        if axes and all(axis.map.drive == "modbus" for axis in axes):
            bus_faults.append(f"transport: drives of Modbus have none {bus.transport}")
            bus.transport = "rtu"
    return StopConfig(bus, axes, lost, faults + bus_faults, bus_faults)


def bus_of(table: Any, faults: Faults) -> Bus | None:
    """The bus of a table; None where it does not say where that is."""
    table = rows_of(table)[0] if rows_of(table) else {}
    bus = Bus()
    for field in dataclasses.fields(bus):
        value, default = _near(table, field.name), getattr(bus, field.name)
        if value is None:
            continue
        if isinstance(default, bool):
            value = value is True or str(value).lower() == "true"
        elif isinstance(default, str):
            if not isinstance(value, str):
                faults.append(f"bus.{field.name}: no text, {value!r}")
                value = default
            value = value.strip(" \t\"'()<>[]")
        else:
            low, high = RANGES[field.name]
            value = _number(value, default, low, high, f"bus.{field.name}", faults)
            value = type(default)(value)
        setattr(bus, field.name, value)
    host = re.fullmatch(r"(?:\w+://)?([^/:]+)(?::(\d+))?/*", bus.host)
    if host and host[2] and _near(table, "port") is None:
        bus.port = int(_number(host[2], 502, 1, 65535, "bus.host", faults))
    bus.host = host[1] if host else bus.host
    bus.parity = bus.parity[:1].upper() if bus.parity[:1].upper() in "NEO" else "N"
    fault = "" if bus.transport in TRANSPORTS else f"not one of {', '.join(TRANSPORTS)}"
    near = difflib.get_close_matches(bus.transport.lower(), TRANSPORTS, 1, NEAR_NAME)
    given, bus.transport = bus.transport, near[0] if near else ""
    if not (bus.host or bus.device):
        faults.append("[bus] has no host and no device")
        return None
    if not (bus.host if bus.transport in NETWORK else bus.device and bus.transport):
        fault = fault or "host or device is missing"
        bus.transport = "tcp" if bus.host else "rtu"
    if fault:
        faults.append(f"bus.transport: {fault}, {given!r}; trying {bus.transport}")
    return bus


def _map_of(
    row: dict[str, Any], maps: set[str], folder: pathlib.Path | None, faults: Faults
) -> SimpleNamespace | None:
    name = _near(row, "map")
    if not isinstance(name, str) or not name.strip():
        tried = "; trying that of the others" if len(maps) == 1 else ""
        faults.append(f"it has no map{tried}")
        if not tried:
            return None
        (name,) = maps
    if folder is None:
        return map_of(name, pathlib.Path(str(row.get("folder", ""))), faults)
    custom = name.lower().endswith(".toml")
    path = found(folder / name if custom else MAP_FOLDER / f"{name}.toml")
    if not path.is_file():
        names = [path.stem for path in MAP_FOLDER.glob("*.toml")]
        near = difflib.get_close_matches(path.stem.lower(), names, 1, NEAR_NAME)
        tried = f"; trying {near[0]}" if near else ""
        faults.append(f"no map {name}{tried}")
        if not near:
            return None
        path = MAP_FOLDER / f"{near[0]}.toml"
    return map_of(_decoded(path.read_bytes()), path.parent, faults)


def map_of(text: str, folder: pathlib.Path, faults: Faults) -> SimpleNamespace | None:
    """What of a map stops its drives and sees them stand; None where it cannot."""
    data = tables_of(text, faults)
    drive = str(data.get("drive"))
    drive_map = SimpleNamespace(
        name=str(data.get("name", "map")), drive=drive if ":" in drive else "modbus",
        folder=folder, text=text, settings=data.get("settings", {}),
        restart_s=_number(data.get("restart_s", 2.0), 2.0, 2.0, 60, "restart_s", []),
        inter_frame_s=_number(data.get("inter_frame_s", 0), 0.0, 0, 1, "silence", []),
        word_order="little" if data.get("word_order") == "little" else "big",
        broadcast_stop=data.get("broadcast_stop") is True,
        stop=_frames(_near(data, "stop")),
        position=_value(data.get("position"), "i32"), status=None,
        **{name: _frames(data.get(name)) for name in FRAMES},
        **{name: _value(data.get(name), "u16") for name in ("alarm", "pulses_per_rev")},
        target=_value(data.get("target"), "i32"), homed=_bits(data.get("homed")),
        units=SimpleNamespace(**_table(data.get("units"))),
        identity={n: _value(v, "u16") for n, v in _table(data.get("identity")).items()},
        recognise=_table(data.get("recognise")),
    )  # fmt: skip
    if drive_map.alarm:
        names, drive_map.alarm.names = _table(_table(data["alarm"]).get("names")), {}
        with contextlib.suppress(ValueError):  # a stop needs none
            drive_map.alarm.names = {int(code, 0): names[code] for code in names}
    if drive_map.comm_timeout:
        drive_map.comm_timeout.per_s = _table(data["comm_timeout"]).get("per_s")
    set_zero = drive_map.set_zero
    drive_map.home_place = set_zero.place_of("home") if set_zero else None
    status = _near(data, "status")
    if value := _value(status, "u16"):
        bits = {name: _bits(status.get(name)) for name in FLAGS}
        if bits["done"] and bits["moving"]:
            never = Bits(set=(0,), clear=(0,))
            bits["fault"] = bits["fault"] or never
            drive_map.status = Flags(**vars(value), **bits)
    name, modbus = drive_map.name, drive_map.drive == "modbus"
    if modbus and drive_map.stop is None:
        faults.append(f"the map {name} has no readable [stop]")
        return None
    if modbus and not (drive_map.status and drive_map.position):
        faults.append(f"[status] or [position] of the map {name} cannot be read")
    return drive_map


def _frames(table: Any) -> Frames | None:
    rows = rows_of(table.get("write")) if rows_of(table) == [table] else []
    try:
        frames = []
        for row in rows:
            listed = row["words"] if isinstance(row["words"], list) else [row["words"]]
            numbers = ((word, _register(word)) for word in listed)
            words = tuple(word_of(w if n is None else n) for w, n in numbers)
            function = row.get("function")
            if count_of(words) > 1 or function not in (5, 6, 16):
                function = 6 if count_of(words) == 1 else 16
            if (address := _register(row["address"])) is None:
                return None
            frames.append(Frame(address=address, words=words, function=function))
    except (KeyError, TypeError, ValueError):
        return None
    return Frames(write=tuple(frames)) if frames else None


def _value(table: Any, kind: str) -> Place | None:
    address = _register(table.get("address")) if isinstance(table, dict) else None
    kind = str(_table(table).get("type", kind))
    if address is None or kind not in FORMATS:
        return None
    function, bits = table.get("function"), table.get("bits")
    return Place(
        address=address, type=kind,
        function=function if function in range(1, 5) else 3,
        bits=bits if bits in range(65) else 0,
        counts=_number(table.get("counts", 1.0), 1.0, 1e-12, 1e12, "counts", []),
    )  # fmt: skip


def _register(value: Any) -> int | None:
    """An address or a word, also as text."""
    number = int(_number(value, -1, 0, 0xFFFF, "register", []))
    return number if number >= 0 else None


def _bits(table: Any) -> Bits | None:
    bits = {}
    for name in ("set", "clear"):
        numbers = _table(table).get(name)
        listed = numbers if type(numbers) is list else []
        bits[name] = tuple(number for number in listed if type(number) is int)
    return Bits(**bits) if any(bits.values()) else None


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def rows_of(tables: Any) -> list[dict[str, Any]]:
    """Tables of a list, or the one that stands alone."""
    listed = tables if isinstance(tables, list) else [tables]
    return [table for table in listed if isinstance(table, dict)]


def _near(table: dict[str, Any], name: str) -> Any:
    """The value of a key, or of one that is nearly called so."""
    if name in table:
        return table[name]
    keys = {re.sub("[_-]", "", key.lower()): key for key in table}
    near = difflib.get_close_matches(name, keys, 1, NEAR)
    near += [key for key in OTHER_NAMES.get(name, ()) if key in keys]
    return table[keys[near[0]]] if near else None


def _number(
    value: Any, default: float, low: float, high: float, name: str, faults: Faults
) -> float:
    """The one number of a value, which may be in a text or a list."""
    try:
        words = NUMBER.findall(re.sub(r"(?<=\d)[ '](?=\d{3}\b)", "", str(value)))
        (number,) = {float(int(w, 16) if w[:2] in ("0x", "0X") else w) for w in words}
        if low <= number <= high and (isinstance(default, float) or number % 1 == 0):
            return number
    except ValueError:
        pass
    used = f"; using {default:g}" if default else ""
    faults.append(f"{name}: not a number in [{low:g}, {high:g}], {value!r:.60}{used}")
    return default


def _decoded(data: bytes) -> str:
    """Text in UTF-8, 16 or 32, of which the zeros are left out."""
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = data.decode("utf-16" if utf16 else "utf-8-sig", errors="replace")
    return text.replace("\0", "")


def tables_of(text: str, faults: Faults) -> dict[str, Any]:
    """A TOML text; of one that is broken all lines that can be read."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        faults.append(f"not valid TOML: {error}")
    text = unicodedata.normalize("NFKC", text.translate(QUOTES))
    text = re.sub(r",(\s*})", r"\1", text)
    root: dict[str, Any] = {}
    table, lines = root, text.splitlines()
    while lines:
        header = HEADER.fullmatch(lines[0])
        if header and ("[" in (header[1] or "") or header[3]):
            *path, last = (part for part in re.split(r"[\s.\"']+", header[2]) if part)
            table = root
            for part in path:
                table = _inner(table, part)
            if (header[1] or "").count("[") > 1 or _called(last, "axes"):
                table[last] = [*rows_of(table.get(last)), {}]
            table = _inner(table, last)
            lines[0] = header[4]
        values, count = _first_values(lines)
        for key, value in values:
            table = _added(root, table, key, value)
        del lines[:count]
    return root


def _added(
    root: dict[str, Any], table: dict[str, Any], key: str, value: Any
) -> dict[str, Any]:
    """Add a value where the first of its key counts. The table that goes on: a second
    name, unit or map begins another axis, a second transport another section."""
    old = table.get(key)
    if isinstance(value, str) and value[:1] in ("[", "{"):
        for name in (name for name in ("axes", "bus") if _called(key, name)):
            root[name] = [*rows_of(root.get(name)), {}]  # a list or table with a fault
            return _inner(root, name)
    if isinstance(old, dict) and isinstance(value, dict):
        for inner_key, inner_value in value.items():
            _added(root, old, inner_key, inner_value)
    elif not old or (_out_of_range(key, old) and not _out_of_range(key, value)):
        table[key] = value
    elif key == "transport" and value != old:
        return _inner(root, "bus" if _is_transport(value) else "imu")
    elif key in ("name", "unit", "map") and value != old and _axis_keys(table):
        if _unit_of(value) if key == "unit" else value and isinstance(value, str):
            root["axes"] = [*rows_of(root.get("axes")), {key: value}]
            return _inner(root, "axes")
    return table


def _out_of_range(key: str, value: Any) -> bool:
    faults: Faults = []
    if key in RANGES:
        _number(value, 0, *RANGES[key], key, faults)
    return bool(faults)


def _inner(table: dict[str, Any], name: str) -> dict[str, Any]:
    """The table of a name, or the last of several, made where there is none."""
    if not rows_of(table.get(name)):
        table[name] = {}
    return rows_of(table[name])[-1]


def _first_values(lines: Sequence[str]) -> tuple[list[tuple[str, Any]], int]:
    """What the first lines say, and how many they are."""
    for count in range(1, min(len(lines), LOOK_AHEAD) + 1):
        try:
            return [*tomllib.loads("\n".join(lines[:count])).items()], count
        except (ValueError, RecursionError):
            continue
    pairs = ASSIGNMENT.findall("" if NOTE.match(lines[0]) else lines[0])
    if not pairs and (apart := APART.fullmatch(lines[0])) and apart[1].lower() in KEYS:
        pairs = [apart.groups()]  # the sign between them is gone
    return [(key, value.strip(" \"'\ufffd")) for key, value in pairs], 1


def _tables(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[Any, Any]]:
    """Every table that is not deep inside, after the names on the way to it."""
    for table in rows_of(value):
        yield path, table
        for key in table if len(path) < DEEP else ():
            yield from _tables(table[key], (*path, key))


def _called(key: str, name: str) -> bool:
    word = key.lower()
    return name in word or bool(difflib.get_close_matches(name, [word], 1, NEAR))


def _axis_keys(table: dict[str, Any]) -> set[str]:
    """The keys that only an axis has; the unit of numbers or angles is none."""
    return {
        key for key in AXIS if key in table and (key != "unit" or _unit_of(table[key]))
    }


def _axes_of(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Every table that is called an axis, or looks like one."""
    rows = []
    for path, table in _tables(data):
        keys = _axis_keys(table)
        if any(_called(part, "axes") for part in path):
            inner = table and all(isinstance(value, dict) for value in table.values())
            keys |= set() if inner else {"map"}
        elif path and _called(path[0], "readings"):  # registers of a sensor have a unit
            keys -= {"unit"}
        rows += [table] * bool(keys)
    return rows


def _bus_table(data: dict[str, Any]) -> dict[str, Any]:
    """The first value of each key of tables called bus, else of one that says where."""
    tables = [(path[-1] if path else "", table) for path, table in _tables(data)
              if not any(_called(path[0], n) for n in SENSORS if path)]  # fmt: skip
    bus: dict[str, Any] = {}
    for table in [table for name, table in tables if _called(name, "bus")]:
        bus |= {key: table[key] for key in table if not bus.get(key)}
    places = [t for _, t in tables if _is_transport(_near(t, "transport"))]
    says = (t for t in (bus, *places) if _near(t, "host") or _near(t, "device"))
    return next(says, bus)


def _is_transport(value: Any) -> bool:
    return bool(difflib.get_close_matches(str(value).lower(), TRANSPORTS, 1, NEAR_NAME))


def _unit_of(value: Any) -> int:
    return int(_number(value, 0, 1, 247, "unit", []))
