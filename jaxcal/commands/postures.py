"""``jaxcal postures``: where to put an arm, as a table, a file and a picture."""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from jaxcal.arguments import flag, several
from jaxcal.commands.calibrations import ARM, commands_of, read_arm
from jaxcal.commands.tables import OUTPUT, read_table, written
from jaxcal.extras import needs
from jaxcal.models.sensors import SENSORS, Placed
from jaxcal.selection import select

__all__ = ["FLAGS", "postures"]

FLAGS = {
    "postures": (
        flag("model", "the arm's .urdf", "URDF"),
        flag("-k", "postures to measure in all", "K", int, long="--k", required=True),
        *ARM,
        flag("--near", "where a socket (x,y,z), a plane (normal, offset) or an anchor "
             "(x,y,z,zero) is, roughly; for other sensors x,y,z,radius around the tip; "
             "once for each", "N", several(float, "numbers"), action="append"),
        flag("--measured", "postures that were reached already: a table with columns "
             "named as the joints, and the sensor's"),
        flag("--count", "postures to choose from", "N", int, default=300),
        flag("--seed", "of these", "S", int, default=0),
        flag("--picture", "draw the arm at each of them: .png, .pdf, .svg"),
        *OUTPUT,
    ),
}  # fmt: skip


def postures(arguments: argparse.Namespace) -> None:
    """Choose the postures to measure, in an order of little travel.

    Postures are made within the joint limits, where the sensor reads, and chosen for
    the predictions of the calibrated arm. With --measured the rest of the K is chosen
    beside what was reached, which shows where sockets and planes are, too. Collisions
    are not looked at.
    """
    near = arguments.near
    reached = None if arguments.measured is None else read_table(arguments.measured)
    placed = issubclass(SENSORS[arguments.sensor], Placed)
    arm = read_arm(arguments, reached, near if placed else None)
    header, done = (*arm.joint_names, *arm.sensor.inputs), None
    if reached is not None:
        done = commands_of(arm, reached, header, arguments.radians)
        arm = arm.located(done)
    left = arguments.k - (0 if done is None else len(done))
    if left < 1:
        reason = f"-k must be more than the {arguments.k - left} that were reached"
        raise ValueError(f"{reason}, got {arguments.k}")
    targets = None if placed else near
    offered = arm.postures(arguments.count, seed=arguments.seed, near=targets)
    chosen = select(offered, left, "exchange", model=arm, measured=done).indices
    plan = offered[chosen]
    plan = plan[arm.in_turn(plan)]
    if arguments.picture:
        with needs("study", "--picture"):
            from matplotlib.figure import Figure

        from jaxcal import plots

        figure = Figure(figsize=(8, 2.2 * -(-left // 4)), layout="constrained")
        plots.postures(figure, arm, plan).savefig(pathlib.Path(arguments.picture))
    if arguments.radians:
        turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
        plan[:, turning] = np.radians(plan[:, turning])
    rows = plan.tolist()
    document = [dict(zip(header, row, strict=True)) for row in rows]
    if written(arguments, header, rows, document):
        return
    cells = [["", *header]]
    cells += [[f"{i + 1}", *(f"{x:.4g}" for x in row)] for i, row in enumerate(rows)]
    wide = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        print("  ".join(cell.rjust(n) for cell, n in zip(row, wide, strict=True)))
