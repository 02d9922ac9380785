"""What a configuration file with faults still says about stopping the drives.

``stop`` needs the bus, and of each axis the unit and the map. A file that no session
would accept is read for these alone; what is wrong is named, never guessed.
"""

from __future__ import annotations

import dataclasses
import pathlib
import re
import tomllib
from typing import Any

from pydantic import ValidationError

from rig.config.axis import Axis
from rig.config.files import load_config
from rig.config.maps import load_map
from rig.config.schema import ConfigError, read_text
from rig.config.settings import BusSettings


@dataclasses.dataclass
class Stoppable:
    """What can be stopped, and what of the file was of no use."""

    bus: BusSettings | None
    axes: list[Axis]  # of a file with faults only name, unit and map are set
    ignored: list[str]  # faults of the file
    lost: list[str]  # axes that cannot be stopped, with the reason


def read_for_stop(path: pathlib.Path) -> Stoppable:
    """Bus and drives of a configuration file, as far as it can be read.

    Raises:
        ConfigError: the file itself cannot be read.
    """
    try:
        config = load_config(path)
        return Stoppable(config.bus, list(config.axes), [], [])
    except ConfigError as error:
        text = read_text(path)
        found = Stoppable(None, [], list(error.faults), [])
    data = _tables(text, found)
    found.bus = _bus(data.get("bus"), found)
    tables = data.get("axes")
    for number, table in enumerate(tables if isinstance(tables, list) else []):
        _axis(number, table, path.parent, found)
    known = len(found.axes) + len(found.lost)
    if known < 3:
        found.lost.append(f"the file has {known} of 3 [[axes]] that can be read")
    return found


def _tables(text: str, found: Stoppable) -> dict[str, Any]:
    """The file's tables, without the lines that are not TOML by themselves."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        pass
    lines: list[str] = []
    headless = False  # whose table these keys are in is not known
    for number, line in enumerate(text.splitlines(), start=1):
        header = line.lstrip().startswith("[")
        try:
            tomllib.loads(line)
            headless = headless and not header
        except tomllib.TOMLDecodeError:
            found.ignored.append(f"line {number} ignored: {line.strip()}")
            headless = headless or header
            line = ""
        lines.append("" if headless else line)
    while True:
        try:
            return tomllib.loads("\n".join(lines))
        except tomllib.TOMLDecodeError as error:  # a key or a table given twice
            place = re.search(r"at line (\d+)", str(error))
            number = int(place[1]) if place else len(lines)
            found.ignored.append(f"line {number} ignored: {error}")
            lines[number - 1 :] = ["", *lines[number:]] if place else []


def _bus(table: Any, found: Stoppable) -> BusSettings | None:
    """Bus settings, with defaults in the place of keys that are wrong."""
    if not isinstance(table, dict):
        found.ignored.append("bus: there is no [bus] table that can be read")
        return None
    table = dict(table)
    while True:
        try:
            return BusSettings.model_validate(table)
        except ValidationError as error:
            wrong = {
                str(e["loc"][0]) for e in error.errors() if e["loc"]
            } & table.keys()
            if not wrong:  # a key that is needed is missing
                found.ignored.append("bus: its address is missing or wrong")
                return None
            for name in wrong:
                del table[name]


def _axis(number: int, table: Any, folder: pathlib.Path, found: Stoppable) -> None:
    table = table if isinstance(table, dict) else {}
    name, unit = table.get("name", f"axes[{number}]"), table.get("unit")
    if type(unit) is not int or not 1 <= unit <= 247:
        found.lost.append(f"{name}: unit must be in [1, 247], got {unit!r}")
        return
    try:
        family = load_map(str(table.get("map", "")), folder)
    except ValueError as error:
        found.lost.append(f"{name} (unit {unit}): {' '.join(str(error).split())}")
        return
    axis = Axis.model_construct(
        name=name, unit=unit, map=family,
        rotates="X", min_pulses=0, max_pulses=0,  # of no use to a stop
    )  # fmt: skip
    found.axes.append(axis)
