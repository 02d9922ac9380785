"""rig.toml of a new device, with comments."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from rig.config.settings import BusSettings

OF_LINE = {
    "rtu": ("device", "baudrate", "parity", "stopbits", "bytesize"),
    "serial": ("device", "baudrate"),
    "can": ("device", "baudrate"),
}


def new_text(
    bus: BusSettings,
    axes: Sequence[Mapping[str, Any]],
    form: str = "",
    port: int = 0,
    *,
    names: Sequence[str] = (),
    unit: str = "mm",
    sensor: Mapping[str, Any] | None = None,
    model: str = "",
) -> str:
    """A whole configuration.

    Args:
        bus: as it was reached.
        axes: name, kind (X, Y, Z, deg or mm), unit, family, pulses and, of mm, lead of
            each.
        form: of the phone's app; none: numbers are measured.
        port: that the phone connects to.
        names, unit: of the numbers.
        sensor: keys of ``[readings]`` that say where they come from.
        model: URDF file of an arm.
    """
    import jinja2

    keys = OF_LINE.get(bus.transport, ("host", "port")) + ("echo",) * bus.echo
    text = pathlib.Path(__file__).with_name("new.toml.j2").read_text(encoding="utf-8")
    template = jinja2.Template(
        text,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    return template.render(
        bus=dict(bus), keys=keys, axes=axes, form=form, port=port, names=list(names),
        unit=unit, sensor=dict(sensor or {}), model=model,
    )  # fmt: skip
