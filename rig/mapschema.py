"""The schema of a register map: every fault of a file is found in one pass."""

from __future__ import annotations

import hashlib
import json
from typing import Any, TypeGuard

from rig.registers import (
    ACCEL_UNITS,
    SCHEMA,
    SPEED_UNITS,
    TYPES,
    VALUES,
    Predicate,
    Read,
    RegisterMap,
    Write,
)

__all__ = ["build"]

_TABLES = {
    "schema", "name", "title", "sources", "confidence", "word_order", "inter_frame_s",
    "serial", "units", "status", "position", "alarm", "move", "stop", "enable",
    "alarm_reset", "comm_timeout", "limits", "identity",
}  # fmt: skip


def _is_int(value: Any, low: int, high: int) -> TypeGuard[int]:
    return type(value) is int and low <= value <= high


def _is_number(value: Any, low: float, high: float) -> TypeGuard[float]:
    return type(value) in (int, float) and low <= value <= high


def _read(data: Any, where: str, faults: list[str], default: str = "u16") -> Read:
    if not isinstance(data, dict):
        faults.append(f"{where}: a table with address and type is required")
        return Read(0, "u16")
    address, kind = data.get("address"), data.get("type", default)
    if not _is_int(address, 0, 0xFFFF):
        faults.append(f"{where}.address must be an integer 0..65535, got {address!r}")
        address = 0
    if kind not in TYPES:
        faults.append(f"{where}.type must be one of {', '.join(TYPES)}, got {kind!r}")
        kind = "u16"
    return Read(int(address), str(kind))


def _word(word: Any, where: str, faults: list[str]) -> int | tuple[str, str]:
    if _is_int(word, 0, 0xFFFF):
        return int(word)
    name, _, kind = str(word).partition(":")
    if isinstance(word, str) and name in VALUES and kind in TYPES:
        return name, kind
    faults.append(
        f"{where}: a word is 0..65535 or NAME:TYPE with NAME of {', '.join(VALUES)} "
        f"and TYPE of {', '.join(TYPES)}, got {word!r}"
    )
    return 0


def _writes(data: Any, where: str, faults: list[str]) -> tuple[Write, ...]:
    frames = data.get("write") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        faults.append(f"{where}.write: a list of frames is required")
        return ()
    result = []
    for number, frame in enumerate(frames):
        at = f"{where}.write[{number}]"
        if not isinstance(frame, dict):
            faults.append(f"{at}: a table with address and words is required")
            continue
        address, words = frame.get("address"), frame.get("words")
        if not _is_int(address, 0, 0xFFFF):
            faults.append(f"{at}.address must be 0..65535, got {address!r}")
            continue
        if not isinstance(words, list) or not words:
            faults.append(f"{at}.words: a list of words is required")
            continue
        parsed = tuple(_word(word, at, faults) for word in words)
        write = Write(int(address), 16, parsed)
        function = frame.get("function", 16 if write.count > 1 else 6)
        if function not in (6, 16) or (function == 6 and write.count != 1):
            faults.append(f"{at}.function must be 16, or 6 for one register")
            function = 16
        if write.count > 123 or address + write.count > 0x10000:
            faults.append(f"{at}: {write.count} registers from {address} do not fit")
        result.append(Write(write.address, int(function), parsed))
    return tuple(result)


def _predicate(data: Any, where: str, bits: int, faults: list[str]) -> Predicate:
    data = data if isinstance(data, dict) else {}
    parts = {}
    for key in ("set", "clear"):
        listed = data.get(key, [])
        if not isinstance(listed, list) or not all(
            _is_int(bit, 0, bits - 1) for bit in listed
        ):
            faults.append(f"{where}.{key} must list bits 0..{bits - 1}")
            listed = []
        parts[key] = tuple(int(bit) for bit in listed)
    if not parts["set"] and not parts["clear"]:
        faults.append(f"{where}: name at least one bit in set or clear")
    return Predicate(parts["set"], parts["clear"])


def _positive(data: dict[str, Any], key: str, where: str, faults: list[str]) -> float:
    value = data.get(key)
    if not _is_number(value, 1e-12, 1e12):
        faults.append(f"{where}.{key} must be a positive number, got {value!r}")
        return 1.0
    return float(value)


def _unit(data: dict[str, Any], key: str, known: tuple[str, ...], faults: list) -> str:
    value = data.get(key)
    if value not in known:
        faults.append(f"units.{key} must be one of {', '.join(known)}, got {value!r}")
        return known[0]
    return str(value)


def _check_move(
    move: tuple[Write, ...], data: Any, stop: tuple[Write, ...], faults: list[str]
) -> tuple[int, int]:
    trigger = data.get("trigger") if isinstance(data, dict) else None
    if not isinstance(trigger, dict) or not all(
        _is_int(trigger.get(key), 0, 0xFFFF) for key in ("address", "value")
    ):
        faults.append("move.trigger: a table with address and value is required")
        return 0, 0
    address, value = int(trigger["address"]), int(trigger["value"])
    if not any(frame.offset_of("position") for frame in move):
        faults.append("move.write: no frame writes position")
    if move:
        last = move[-1]
        if last.address + last.count - 1 != address or last.words[-1] != value:
            faults.append("move.trigger must be the last word of the last frame")
    if any(f.offset_of("position") for f in stop):
        faults.append("stop.write must not write a position")
    return address, value


def build(data: dict[str, Any], faults: list[str]) -> RegisterMap | None:
    """Turn a parsed TOML file into a map; what is wrong is appended to ``faults``."""
    if data.get("schema") != SCHEMA:
        faults.append(f"schema must be {SCHEMA}, got {data.get('schema')!r}")
    for key in sorted(set(data) - _TABLES):
        faults.append(f"unknown table or key {key!r}")
    for key in ("name", "title", "sources"):
        if not isinstance(data.get(key), str) or not data.get(key):
            faults.append(f"{key}: a text is required")
    order = data.get("word_order")
    if order not in ("big", "little"):
        faults.append(f"word_order must be big or little, got {order!r}")
    silence = data.get("inter_frame_s")
    if not _is_number(silence, 0, 1):
        faults.append(f"inter_frame_s must be 0..1 seconds, got {silence!r}")
        silence = 0.0
    units = data.get("units") if isinstance(data.get("units"), dict) else {}
    assert isinstance(units, dict)
    status_table = data.get("status") if isinstance(data.get("status"), dict) else {}
    assert isinstance(status_table, dict)
    status = _read(data.get("status"), "status", faults)
    bits = 16 * status.count
    predicates = {
        key: _predicate(status_table.get(key), f"status.{key}", bits, faults)
        for key in ("done", "moving", "fault")
    }
    enabled = None
    if "enabled" in status_table:
        enabled = _predicate(status_table["enabled"], "status.enabled", bits, faults)
    position = _read(data.get("position"), "position", faults, "i32")
    move_table = data.get("move")
    move = _writes(move_table, "move", faults)
    stop = _writes(data.get("stop"), "stop", faults)
    trigger = _check_move(move, move_table, stop, faults)
    optional = {
        key: _writes(data[key], key, faults) if key in data else ()
        for key in ("enable", "alarm_reset", "comm_timeout", "limits")
    }
    per_second = 1.0
    if "comm_timeout" in data and isinstance(data["comm_timeout"], dict):
        per_second = _positive(data["comm_timeout"], "per_s", "comm_timeout", faults)
    names, alarm = {}, None
    if "alarm" in data:
        alarm = _read(data["alarm"], "alarm", faults)
        listed = (
            data["alarm"].get("names", {}) if isinstance(data["alarm"], dict) else {}
        )
        for code, text in listed.items():
            try:
                names[int(code, 0)] = str(text)
            except ValueError:
                faults.append(f"alarm.names: {code!r} is not a number")
    identity = tuple(
        (str(key), _read(value, f"identity.{key}", faults))
        for key, value in (data.get("identity") or {}).items()
    )
    speed = _unit(units, "speed", SPEED_UNITS, faults)
    accel = _unit(units, "accel", ACCEL_UNITS, faults)
    scales = [
        _positive(units, key, "units", faults)
        for key in ("speed_per_unit", "accel_per_unit")
    ]
    serial = data.get("serial", {})
    if not isinstance(serial, dict) or set(serial) - {
        "baudrate", "parity", "stopbits", "bytesize"
    }:  # fmt: skip
        faults.append("serial may hold baudrate, parity, stopbits, bytesize")
        serial = {}
    if faults:
        return None
    text = json.dumps(data, sort_keys=True, default=str)
    return RegisterMap(
        name=data["name"], title=data["title"], word_order=str(order),
        inter_frame_s=float(silence), serial=serial,
        speed_unit=speed, speed_per_unit=scales[0],
        accel_unit=accel, accel_per_unit=scales[1],
        status=status, done=predicates["done"], moving=predicates["moving"],
        fault=predicates["fault"], enabled=enabled, position=position, alarm=alarm,
        alarm_names=names, move=move, trigger=trigger, stop=stop,
        enable=optional["enable"], alarm_reset=optional["alarm_reset"],
        comm_timeout=optional["comm_timeout"], comm_timeout_per_s=per_second,
        limits=optional["limits"], identity=identity,
        digest=hashlib.sha256(text.encode()).hexdigest(),
    )  # fmt: skip
