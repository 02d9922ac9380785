"""rig.toml: written once with comments, and corrected in place afterwards."""

from __future__ import annotations

import datetime
import json
import pathlib
import shutil
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcal.files import write_text
from rig.config import ConfigError, RigConfig, parse_config
from rig.config.schema import read_text
from rig.config.settings import BusSettings


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


HEAD = """\
# Written by `jaxcal-rig setup`. Every key is described in docs/rig.md.
# Calibrate with no patient attached; a hardware emergency stop is required.
output = "runs"       # every run makes its own folder in here
device = "device.json" # what was proved of this device
"""
AXIS = """
[[axes]]
name = "{name}"
unit = {unit}
map = "{family}"
pulses_per_rev = {pulses} # omega: pulses for one motor turn, as set in the drive
reduction = 1.0 # kappa: motor turns for one joint turn
direction = 1 # -1 where positive pulses turn the joint the negative way
rotates = "{letter}" # axis of the joint in the device's frame
min_deg = -20 # soft limits
max_deg = 20
speed_deg_s = 10 # slow: there is no emergency stop in software
accel_deg_s2 = 40
"""
IMU = """
[imu]
format = "{form}"
transport = "listen" # the phone connects to this computer
host = "0.0.0.0" # every address of this computer
port = {port}
"""
OF_FORMAT = {
    "hyperimu": "column_count = 4 # stamp, azimuth, pitch, roll\n",
    "lines": 'order = "ZYX" # of the three angles in a line\n',
    "sensorlogger": "stale_s = 1.0 # messages come in batches\n",
}
TAIL = """
[mechanism]
order = "ZXY" # axes of the joints from the base outwards

[session]
zero = "here" # the device stands in its zero posture when a session begins
"""
OF_LINE = ("device", "baudrate", "parity", "stopbits", "bytesize")


def new_text(
    bus: BusSettings, axes: Sequence[Mapping[str, Any]], form: str, port: int
) -> str:
    """A whole configuration.

    Args:
        bus: as it was reached.
        axes: name, letter, unit, family and pulses of each.
        form: of the phone's app.
        port: that the phone connects to.
    """
    keys = OF_LINE if bus.transport == "rtu" else ("host", "port")
    table = "".join(f"{key} = {json.dumps(getattr(bus, key))}\n" for key in keys)
    return (
        f'{HEAD}\n[bus]\ntransport = "{bus.transport}"\n{table}'
        + "".join(AXIS.format_map(axis) for axis in axes)
        + IMU.format(form=form, port=port)
        + OF_FORMAT[form]
        + TAIL
    )
