"""What moves: drives on their line, by the kind that each axis's map names. A kind of
one's own is a class that a map names; ``examples/drives`` has two."""

from __future__ import annotations

import importlib
import importlib.util
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rig.drives.drive import Drive
from rig.drives.line import Line
from rig.faults import Refused, Report, unheard

if TYPE_CHECKING:
    from rig.config.axis import Axis
    from rig.config.maps import DriveMap
    from rig.config.settings import BusSettings

KINDS = {"modbus": "rig.drives.modbus:ModbusDrive"}


def named(text: str, folder: pathlib.Path) -> Any:
    """What ``MODULE:NAME``, or ``FILE.py:NAME`` of a folder, names; raises anything."""
    place, _, name = text.rpartition(":")
    if not place.endswith(".py"):
        return getattr(importlib.import_module(place), name)
    path = folder / place
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None  # it ends with .py
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)


def kind_of(drive_map: DriveMap) -> type[Drive]:
    """The class of a map's drives; Refused where there is no such class."""
    text = KINDS.get(drive_map.drive, drive_map.drive)
    try:
        drive_type: Any = named(text, drive_map.folder)
        if not isinstance(drive_type, type) or not issubclass(drive_type, Drive):
            name = getattr(drive_type, "__name__", repr(drive_type))
            raise TypeError(f"{name} is no subclass of rig.drives.Drive")
        line_type: Any = getattr(drive_type, "line_type", None)
        if not isinstance(line_type, type) or not issubclass(line_type, Line):
            must = "line_type must be a subclass of rig.drives.Line"
            raise TypeError(f"{drive_type.__name__}.{must}")
        for kind in (drive_type, line_type):
            for method in sorted(kind.__abstractmethods__):
                raise TypeError(f"{kind.__name__} must define {method}")
    except Exception as error:  # whatever the import of foreign code raises
        raise Refused(
            f"the map {drive_map.name} names drive = {drive_map.drive!r}, which cannot "
            f"be loaded: {type(error).__name__}: {error}. It must be modbus, "
            "FILE.py:CLASS or MODULE:CLASS"
        ) from None
    return drive_type


def make_drives(
    settings: BusSettings,
    axes: Sequence[Axis],
    silence_s: float = 0.0,
    emit: Report = unheard,
) -> tuple[Line, list[Drive]]:
    """The line of a device, to be opened, and the drive of each axis on it; Refused
    where they are of several kinds of line, or of none on this bus."""
    kinds: dict[str, type[Drive]] = {}
    for axis in axes:
        if axis.map.drive not in kinds:
            kinds[axis.map.drive] = kind_of(axis.map)
    lines = {kind.line_type for kind in kinds.values()}
    if len(lines) > 1:
        raise Refused(f"the drives of a device must be of one kind: {', '.join(kinds)}")
    line_type = lines.pop()
    if settings.transport not in line_type.transports:
        transports = ", ".join(line_type.transports)
        raise Refused(
            f"bus.transport: must be {transports} for drives of kind "
            f"{', '.join(kinds)}, got {settings.transport!r}"
        )
    line = line_type(settings, silence_s, emit)
    return line, [kinds[axis.map.drive](line, axis) for axis in axes]


__all__ = ["Drive", "Line", "kind_of", "make_drives", "named"]
