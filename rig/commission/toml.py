"""rig.toml: written once with comments, and corrected in place afterwards."""

from __future__ import annotations

import datetime
import pathlib
import shutil
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcal.files import write_text
from rig.config import ConfigError, RigConfig, load_config, parse_config
from rig.config.schema import read_text


def edit(path: pathlib.Path, values: Mapping[str, Any]) -> RigConfig:
    """Set keys of a configuration such as ``axes.roll.unit``; None takes one out.

    Comments and layout stay. The old file is kept beside it with its time in its name;
    the new one appears at once and whole, and only if it is valid.

    Raises:
        ConfigError: the result would not be valid; the file is as it was.
    """
    text = read_text(path)
    edited = set_values(text, values)
    config = parse_config(edited, path.parent, str(path))
    if edited != text:
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")
        shutil.copy2(path, path.with_name(f"{path.name}.{stamp}.bak"))
        write_text(path, edited)
    return config


def set_values(text: str, values: Mapping[str, Any]) -> str:
    """A TOML text with other values; ``axes.NAME.KEY`` is the axis of that name."""
    import tomlkit

    document: Any = tomlkit.parse(text)
    for where, value in values.items():
        *path, key = where.split(".")
        table = document
        if path and path[0] == "axes":
            named = [axis for axis in document.get("axes", []) if axis["name"] in path]
            if not named:
                raise ConfigError("rig.toml", [f"{where}: there is no such axis"])
            table, path = named[0], []
        for part in path:
            table = table.setdefault(part, tomlkit.table())
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value
    return tomlkit.dumps(document)


def create(path: pathlib.Path, text: str) -> RigConfig:
    """Write a new configuration; ConfigError where it is not valid."""
    config = parse_config(text, path.parent, str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
    return load_config(path) if path.exists() else config


def bus_text(bus: Any) -> str:
    """The ``[bus]`` table of settings."""
    lines = ["[bus]", f'transport = "{bus.transport}"']
    if bus.transport == "rtu":
        lines += [
            f'device = "{bus.device}"',
            f"baudrate = {bus.baudrate}",
            f'parity = "{bus.parity}"',
            f"stopbits = {bus.stopbits}",
            f"bytesize = {bus.bytesize}",
        ]
    else:
        lines += [f'host = "{bus.host}"', f"port = {bus.port}"]
    return "\n".join(lines) + "\n"


def axis_text(name: str, letter: str, unit: int, family: str, pulses: int) -> str:
    """An ``[[axes]]`` table with cautious limits and speeds."""
    return f"""
[[axes]]
name = "{name}"
unit = {unit}
map = "{family}"
pulses_per_rev = {pulses}     # omega: pulses for one motor turn, as set in the drive
reduction = 1.0            # kappa: motor turns for one joint turn
direction = 1              # -1 where positive pulses turn the joint the negative way
rotates = "{letter}"              # axis of the joint in the device's frame
min_deg = -20              # soft limits
max_deg = 20
speed_deg_s = 10           # slow: there is no emergency stop in software
accel_deg_s2 = 40
"""


HEAD = """\
# Written by `jaxcal-rig setup`. Every key is described in docs/rig.md.
# Calibrate with no patient attached; a hardware emergency stop is required.
output = "runs"            # every run makes its own folder in here
device = "device.json"     # what was proved of this device

"""

TAIL = """
[mechanism]
order = "ZXY"              # axes of the joints from the base outwards

[session]
zero = "here"              # the device stands in its zero posture when a session begins
"""


def imu_text(form: str, port: int) -> str:
    """The ``[imu]`` table for an app that connects to this computer."""
    lines = ["", "[imu]", f'format = "{form}"', 'transport = "listen"']
    lines.append('host = "0.0.0.0"           # every address of this computer')
    lines.append(f"port = {port}")
    if form == "hyperimu":
        lines.append("column_count = 4           # stamp, azimuth, pitch, roll")
    if form == "lines":
        lines.append('order = "ZYX"              # of the three angles in a line')
    if form == "sensorlogger":
        lines.append("stale_s = 1.0              # messages come in batches")
    return "\n".join(lines) + "\n"


def new_text(
    bus: Any, axes: Sequence[tuple[str, str, int, str, int]], form: str, port: int
) -> str:
    """A whole configuration: (name, letter, unit, map, pulses per turn) of each axis."""
    tables = "".join(axis_text(*axis) for axis in axes)
    return HEAD + bus_text(bus) + tables + imu_text(form, port) + TAIL
