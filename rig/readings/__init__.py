"""What is measured: a phone's attitude, or the numbers of a sensor, each a ``source``;
``geometry`` is how two readings compare."""

from __future__ import annotations

from rig.config import RigConfig
from rig.faults import Report, unheard
from rig.parts import part
from rig.readings.source import Source


def make_source(config: RigConfig, report: Report = unheard) -> Source:
    """What a device is measured with; to be opened. ``report`` gets its events."""
    if config.readings is not None:
        source: Source = part("numbers", "[readings]")(config.readings, report)
        return source
    from rig.readings.phone import Imu

    return Imu(config.phone, report)
