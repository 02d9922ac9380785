"""``jaxcal postures``: where to put an arm, as a table, a file and a picture."""

from __future__ import annotations

import pathlib
from typing import Annotated

import numpy as np

from jaxcal.arguments import several
from jaxcal.commands.calibrations import ArmOptions
from jaxcal.commands.tables import Output, read_table
from jaxcal.extras import needs
from jaxcal.models.sensors import SENSORS, Placed
from jaxcal.selection import select

__all__ = ["postures"]


def postures(
    model: Annotated[str, "the arm's .urdf"],
    *,
    k: Annotated[int, "postures to measure in all", "K"],
    of_arm: ArmOptions,
    near: Annotated[
        list[list[float]] | None,
        "where a socket (x,y,z), a plane (normal, offset) or an anchor (x,y,z,zero) "
        "is, roughly; for other sensors x,y,z,radius around the tip; once for each",
        several(float, "numbers"),
    ] = None,
    measured: Annotated[
        str | None,
        "postures that were reached already: a table with columns named as the joints, "
        "and the sensor's",
        "FILE",
    ] = None,
    count: Annotated[int, "postures to choose from"] = 300,
    seed: Annotated[int, "of these"] = 0,
    picture: Annotated[
        pathlib.Path | None, "draw the arm at each of them: .png, .pdf, .svg"
    ] = None,
    output: Output,
) -> None:
    """Choose the postures to measure, in an order of little travel.

    Postures are made within the joint limits, where the sensor reads, and chosen for
    the predictions of the calibrated arm. With --measured the rest of the K is chosen
    beside what was reached, which shows where sockets and planes are, too. Collisions
    are not looked at.
    """
    reached = None if measured is None else read_table(measured)
    placed = issubclass(SENSORS[of_arm.sensor], Placed)
    arm = of_arm.read(model, reached, near if placed else None)
    header, done = (*arm.joint_names, *arm.sensor.inputs), None
    if reached is not None:
        done = of_arm.commands(arm, reached, header)
        arm = arm.located(done)
    left = k - (0 if done is None else len(done))
    if left < 1:
        reason = f"-k must be more than the {k - left} that were reached"
        raise ValueError(f"{reason}, got {k}")
    targets = None if placed else near
    offered = arm.postures(count, seed=seed, near=targets)
    chosen = select(offered, left, "exchange", model=arm, measured=done).indices
    plan = offered[chosen]
    plan = plan[arm.in_turn(plan)]
    if picture:
        with needs("study", "--picture"):
            from matplotlib.figure import Figure

        from jaxcal import plots

        figure = Figure(figsize=(8, 2.2 * -(-left // 4)), layout="constrained")
        plots.postures(figure, arm, plan).savefig(picture)
    if of_arm.radians:
        turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
        plan[:, turning] = np.radians(plan[:, turning])
    rows = plan.tolist()
    document = [dict(zip(header, row, strict=True)) for row in rows]
    if output.written(header, rows, document):
        return
    cells = [["", *header]]
    cells += [[f"{i + 1}", *(f"{x:.4g}" for x in row)] for i, row in enumerate(rows)]
    wide = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        print("  ".join(cell.rjust(n) for cell, n in zip(row, wide, strict=True)))
