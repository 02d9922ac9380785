"""An arm and its sensor from the command line: ``--model arm.urdf --sensor socket``."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import several
from jaxcal.commands.tables import Table
from jaxcal.models import SerialChain
from jaxcal.models.sensors import SENSORS, Placed, Socket

__all__ = ["add_arm", "read_arm", "readings"]

Array = NDArray[np.float64]

_KINDS = tuple(kind for kind in SENSORS if kind != "several")


def add_arm(parser: argparse.ArgumentParser) -> None:
    """Flags of an arm from a URDF file."""
    add = parser.add_argument
    what = f"of an arm, what its tip is measured with: {', '.join(_KINDS)}"
    add("--sensor", choices=_KINDS, default="position", help=what)
    add("--base", metavar="LINK", help="of an arm, the link that stands still")
    add("--tip", metavar="LINK", help="of an arm, the link that is measured")
    add("--radians", action="store_true", help="joint columns are in radians")
    apart = "two sockets, how far apart they are and its std: 0,1,0.05,0.0001"
    add("--distance", type=several(float, "numbers"), action="append", help=apart)


def read_arm(arguments: argparse.Namespace, table: Table) -> SerialChain:
    """The arm in a URDF file; things that it touches are counted in the table."""
    kind = SENSORS[arguments.sensor]
    given: dict[str, Any] = {}
    if issubclass(kind, Placed) and arguments.sensor in table.names:
        column = table.columns([arguments.sensor])
        given["count"] = 1 + int(column.max(initial=0.0))
    if arguments.distance:
        if kind is not Socket:
            raise ValueError("--distance is of --sensor socket")
        given["distances"] = arguments.distance
    return SerialChain.from_urdf(
        arguments.model,
        base=arguments.base,
        tip=arguments.tip,
        sensor=kind(**given),
    )


def readings(
    arm: SerialChain, table: Table, arguments: argparse.Namespace
) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Commands in degrees, what was measured, and the names of both.

    A sensor whose readings are zeros (a contact) needs no columns of them.
    """
    inputs = table.inputs(arguments.inputs) if arguments.inputs else arm.inputs
    commands = table.columns(inputs).copy()
    if arguments.radians:
        turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
        commands[:, turning] = np.degrees(commands[:, turning])
    outputs = arm.sensor.outputs
    if arm.sensor.zeros:
        return commands, np.zeros((len(commands), len(outputs))), inputs, outputs
    named = arguments.outputs or set(outputs) - set(table.names)
    outputs = table.outputs(arguments.outputs) if named else outputs
    return commands, table.columns(outputs), inputs, outputs
