"""rig.toml, corrected in place; its comments stay."""

from __future__ import annotations

import datetime
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

from jaxcal.files import write_text
from rig.config import ConfigError, RigConfig, parse_config
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
                raise ConfigError("rig.toml", [f"{where}: no such axis"])
            table, path = named[0], []
        for part in path:
            table = table.setdefault(part, tomlkit.table())
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value
    return tomlkit.dumps(document)
